"""Figures of the diffusion chapters: strips of images, schedules, loss weights and the schematic."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from matplotlib.ticker import LogFormatterMathtext

from inflate_lib.plotting.style import COLOURS, LINE_STYLES, figure, logarithmic, picture_axes

if TYPE_CHECKING:
    from inflate_lib.diffusion.schedule import Schedule


def _plot_strip(images, titles, low=0.0):
    """Grey images (h, w) side by side, black at `low` and white at 1; anything beyond is clipped."""
    fig, axes = figure(1, len(images), height=17.0 / len(images) + 0.9, squeeze=False)
    for ax, image, title in zip(axes[0], images, titles, strict=True):
        picture_axes(ax).imshow(image, vmin=low, vmax=1.0)
        ax.set_title(title)
        ax.spines[:].set_visible(True)
        ax.spines[:].set_color(COLOURS.ghost)
    return fig


def plot_noising(images, steps: Sequence[int]):
    """States of the forward process in [−1, 1] (k, h, w), after so many noising steps each."""
    return _plot_strip(images, [f"$t = {t}$" for t in steps], low=-1.0)


def plot_denoising(states, steps: Sequence[int]):
    """Fig. 5: the reverse process at the given numbers of denoising steps.

    ``states[k]`` is the image (h, w) after k steps, on the [0, 1] scale of the images, as the ``trajectory`` of
    ``generate`` holds them.
    """
    return _plot_strip([states[step] for step in steps], [f"step {step}" for step in steps])


def plot_schedules(schedules: "Mapping[str, Schedule]"):
    """What is left of the signal, and the signal-to-noise ratio, along several schedules."""
    fig, (left, right) = figure(1, 2, height=6.2)
    for (name, schedule), style in zip(schedules.items(), LINE_STYLES, strict=False):
        u = np.arange(1, len(schedule) + 1) / len(schedule)
        left.plot(u, schedule.alpha_bars, style, label=name)
        right.semilogy(u, schedule.signal_to_noise, style, label=name)
    right.axhline(1, color=COLOURS.ghost, linewidth=0.8)
    left.set(xlabel="$t/T$", ylabel=r"$\bar\alpha_t$ (share of signal variance)")
    right.set(xlabel="$t/T$", ylabel=r"signal-to-noise $\bar\alpha_t/(1-\bar\alpha_t)$", ylim=(1e-9, 1e5))
    left.legend()
    return fig


def plot_spread(steps, measured, exact):
    """Mean and standard deviation of simulated chains (dots) on the closed-form marginal (lines).

    ``measured`` and ``exact`` are arrays (2, k): means and standard deviations at ``steps``.
    """
    fig, ax = figure(height=5.5, width=10)
    names = (r"mean $\sqrt{\bar\alpha_t}\,x_0$", r"deviation $\sqrt{1-\bar\alpha_t}$")
    for name, dots, line, style, colour in zip(
        names, measured, exact, LINE_STYLES[:2], (COLOURS.wall, COLOURS.target), strict=True
    ):
        ax.plot(steps, line, style, color=colour, label=name)
        ax.plot(steps, dots, "o", color=colour, markersize=3.5)
    ax.set(xlabel="$t$", ylabel="pixel value")
    ax.legend()
    return fig


def plot_posterior(x, before, likelihood, posterior, formula, marks: Mapping[str, float]):
    """Bayes' rule for one pixel: two factors, their product on a grid, and the Gaussian of Eqs. 5 to 7 as dots.

    All are arrays over the grid ``x``, drawn scaled to a peak of one; ``marks`` names points on the axis.
    """
    fig, ax = figure(height=6.0, width=12)
    curves = (
        (before, "--", COLOURS.ghost, r"$q(x_{t-1} \mid x_0)$"),
        (likelihood, ":", COLOURS.target, r"$q(x_t \mid x_{t-1})$"),
        (posterior, "-", COLOURS.wall, "product, normalised"),
    )
    for values, style, colour, label in curves:
        ax.plot(x, values / values.max(), style, color=colour, label=label)
    every = max(1, len(x) // 60)
    ax.plot(x[::every], (formula / formula.max())[::every], "o", color=COLOURS.ink, markersize=2.5, label="closed form")
    for name, place in marks.items():
        ax.axvline(place, color=COLOURS.ghost, linewidth=0.6)
        ax.annotate(name, (place, 1.04), ha="center", annotation_clip=False)
    ax.set(xlabel="$x_{t-1}$", ylabel="density / its peak", ylim=(0, 1.15))
    ax.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return fig


def plot_vlb_weights(weights: Mapping[str, np.ndarray], capped: float):
    """Weight of the squared error at each step, in L_vlb (log scale), for several predictions.

    ``weights`` maps a name to the uncapped weights (T,); ``capped`` is what the last one is lowered to.
    """
    fig, ax = figure(height=6.2, width=12)
    for (name, values), style in zip(weights.items(), LINE_STYLES, strict=False):
        steps = np.arange(1, len(values) + 1)
        (line,) = ax.semilogy(steps, values, style, label=name)
        ax.plot(steps[-1], values[-1], "o", color=line.get_color(), markersize=4)
    ax.plot(len(steps), capped, "x", color=COLOURS.ink, markersize=6, label="last weight, capped")
    ax.set(xlabel="$t$", ylabel="weight in $L_{vlb}$ (nats)", ylim=(1e-5, 1e3))
    ax.legend(loc="upper center")
    return fig


def plot_losses(histories: Mapping[str, Mapping[str, list]]):
    """Simple loss and variational term during training, on logarithmic axes: a column for each model."""
    fig, axes = figure(2, len(histories), height=8.0, sharex=True, sharey="row", squeeze=False)
    for column, (name, history) in zip(axes.T, histories.items(), strict=True):
        for ax, key in zip(column, ("simple", "vlb"), strict=True):
            ax.plot(history["step"], history[key], color=COLOURS.wall, linewidth=0.9)
            ax.grid(axis="y", color="#E6E6E6")
        column[0].set_title(name)
        column[1].set_xlabel("training step")
    for ax, label in zip(axes[:, 0], ("$L_{simple}$", "$L_{vlb}$ (nats per pixel)"), strict=True):
        ax.set_ylabel(label)
        logarithmic(ax)
    axes[0, 0].xaxis.set_major_formatter(LogFormatterMathtext())  # 1000 and 10000 would meet
    return fig


def plot_losses_in_time(times, own, others: Mapping[str, np.ndarray]):
    """Squared error (k,) at time steps (k,) with the own descriptor, and by how much it grows with another or none."""
    fig, (left, right) = figure(1, 2, height=5.8)
    left.plot(times, own, "-o", color=COLOURS.wall, markersize=3)
    logarithmic(left, across=False)
    left.set(xlabel="$t$", ylabel="squared error per pixel")
    for (name, losses), style, colour in zip(others.items(), LINE_STYLES, (COLOURS.target, COLOURS.wall), strict=False):
        right.plot(times, 1e3 * (losses - own), style, marker="o", markersize=3, color=colour, label=name)
    right.axhline(0, color=COLOURS.ghost, linewidth=0.8)
    right.set(xlabel="$t$", ylabel=r"growth of the error ($10^{-3}$)")
    right.legend()
    return fig


def plot_answers(answers: Mapping[str, tuple]):
    """How a model answers: achieved against wanted, the fitted line, and the diagonal, one panel for each setting.

    ``answers`` maps a title to (wanted (n,), achieved (n,), function of wanted that was fitted).
    """
    fig, axes = figure(1, len(answers), height=6.0, sharex=True, sharey=True, squeeze=False)
    seen = np.concatenate([np.concatenate(values[:2]) for values in answers.values()])
    axes[0, 0].set(xlim=(seen.min() - 0.05, seen.max() + 0.05), ylim=(seen.min() - 0.05, seen.max() + 0.05))
    for ax, (title, (wanted, achieved, fitted)) in zip(axes[0], answers.items(), strict=True):
        ends = np.array([wanted.min(), wanted.max()])
        ax.plot(ends, ends, ":", color=COLOURS.ink, label="achieved = wanted", zorder=3)
        ax.plot(wanted, achieved, "o", color=COLOURS.wall, markersize=2, alpha=0.5)
        ax.plot(ends, fitted(ends), "-", color=COLOURS.target, label="fit")
        ax.set(title=title, xlabel="wanted", aspect="equal")
        ax.locator_params(nbins=4)
    axes[0, 0].set(ylabel="achieved")
    fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return fig


def plot_calibrated_guidance(wanted, panels: Mapping[str, Mapping[str, np.ndarray]]):
    """Mean and standard deviation, (2, n), of what was drawn for each of ``wanted`` (n,), in panels."""
    fig, axes = figure(1, len(panels), height=6.2, sharex=True, sharey=True)
    for ax, (title, curves) in zip(axes, panels.items(), strict=True):
        ax.plot(wanted, wanted, ":", color=COLOURS.ink, label="drawn = wanted")
        for (name, (mean, deviation)), style, colour in zip(
            curves.items(), LINE_STYLES, (COLOURS.wall, COLOURS.target), strict=False
        ):
            ax.fill_between(wanted, mean - deviation, mean + deviation, color=colour, alpha=0.2, linewidth=0)
            ax.plot(wanted, mean, style, color=colour, label=name)
        ax.set(title=title, xlabel="wanted value")
    axes[0].set(ylabel="drawn value")
    axes[0].legend(loc="upper left")
    return fig


def plot_schematic():
    """Fig. 1: how the network is trained, and how it makes structures (drawn, not computed)."""
    fig, ax = figure(height=9.6)
    ax.set(xlim=(0, 17), ylim=(0, 9.6))
    picture_axes(ax)
    training, sampling = 7.05, 2.35  # heights of the two lanes
    for y, name, colour in ((training, "training", COLOURS.void), (sampling, "sampling", "#FBEBDD")):
        box = FancyBboxPatch((0.15, y - 2.1), 16.7, 4.3, "round,pad=0,rounding_size=0.25", fc=colour, ec="none")
        ax.add_patch(box)
        ax.text(0.4, y + 1.85, name, fontweight="bold", va="center")

    _box(ax, 1.7, training + 0.75, "structure\n$\\mathbf{x}_0$")
    _box(ax, 4.9, training + 0.75, "noised to $t$\n$\\mathbf{x}_t$")
    _box(ax, 1.7, training - 0.55, "descriptor $\\mathbf{y}$")
    _box(ax, 4.9, training - 0.55, "network\n$\\zeta_d(\\mathbf{y})$")
    _box(ax, 1.7, training - 1.6, "time $t$", height=0.7)
    _box(ax, 4.9, training - 1.6, "sines $\\zeta_t(t)$", height=0.7)
    _box(ax, 7.9, training - 1.05, "$\\zeta=\\zeta_t+\\zeta_d$", width=1.7)
    _box(ax, 10.3, training + 0.35, "U-Net", width=1.8, height=1.9, strong=True)
    _box(ax, 12.9, training + 0.35, "$\\epsilon_\\theta$", width=1.1)
    _box(ax, 15.3, training + 0.35, "$\\epsilon$ that was added:\n$L_{simple}+\\lambda L_{vlb}$", width=2.7)
    for y in (0.75, -0.55, -1.6):
        _arrow(ax, (2.8, training + y), (3.8, training + y))
    _arrow(ax, (6.0, training - 0.55), (7.05, training - 0.9))
    _arrow(ax, (6.0, training - 1.6), (7.05, training - 1.2))
    _arrow(ax, (6.0, training + 0.75), (9.4, training + 0.75))
    _arrow(ax, (8.75, training - 1.05), (9.9, training - 0.6))
    _arrow(ax, (11.2, training + 0.35), (12.35, training + 0.35))
    _arrow(ax, (13.45, training + 0.35), (13.95, training + 0.35), both=True)
    _arrow(ax, (15.3, training - 0.2), (10.6, training - 0.6), curve=-0.35, dashed=True)
    ax.text(13.2, training - 1.6, "gradient", ha="center", va="center", fontsize=8)

    _box(ax, 1.7, sampling + 0.75, "pure noise\n$\\mathbf{x}_T$")
    _box(ax, 1.7, sampling - 0.9, "wanted $\\mathbf{y}$,\ntime $t$")
    _box(ax, 4.5, sampling - 0.9, "$\\zeta(\\mathbf{y},t)$", width=1.6)
    _box(ax, 5.1, sampling + 0.75, "U-Net", width=1.8, height=1.1, strong=True)
    _box(ax, 8.2, sampling + 0.75, "a little less noise\n$\\mathbf{x}_{t-1}$", width=2.5)
    _box(ax, 11.3, sampling + 0.75, "structure\n$\\mathbf{x}_0$", width=1.7)
    _box(ax, 14.9, sampling + 0.75, "label image:\nwall and void", width=2.6)
    _box(ax, 14.9, sampling - 0.9, "inflate (FEM)", width=2.6)
    _box(ax, 10.6, sampling - 0.9, "descriptor achieved:\nis it the one wanted?", width=3.4)
    _arrow(ax, (2.8, sampling + 0.75), (4.2, sampling + 0.75))
    _arrow(ax, (2.8, sampling - 0.9), (3.7, sampling - 0.9))
    _arrow(ax, (4.7, sampling - 0.4), (4.95, sampling + 0.2))
    _arrow(ax, (6.0, sampling + 0.75), (6.95, sampling + 0.75))
    _arrow(ax, (9.45, sampling + 0.75), (10.45, sampling + 0.75))
    _arrow(ax, (12.15, sampling + 0.75), (13.6, sampling + 0.75))
    _arrow(ax, (14.9, sampling + 0.25), (14.9, sampling - 0.4))
    _arrow(ax, (13.6, sampling - 0.9), (12.3, sampling - 0.9))
    _arrow(ax, (8.2, sampling + 1.25), (5.1, sampling + 1.3), curve=0.35)
    ax.text(6.65, sampling + 1.95, "$T$ times", ha="center", va="center", fontsize=8)
    return fig


def _box(ax, x, y, text, width=2.2, height=1.0, strong=False):
    """A rounded box with its centre at (x, y)."""
    corner = (x - width / 2, y - height / 2)
    face, edge = (COLOURS.wall, COLOURS.wall) if strong else ("white", COLOURS.ink)
    style = "round,pad=0,rounding_size=0.12"
    ax.add_patch(FancyBboxPatch(corner, width, height, style, fc=face, ec=edge, linewidth=0.8))
    ax.text(x, y, text, ha="center", va="center", fontsize=8, color="white" if strong else COLOURS.ink)


def _arrow(ax, start, end, curve=0.0, both=False, dashed=False):
    head = "<|-|>" if both else "-|>"
    line = {"linestyle": (0, (3, 2)) if dashed else "-", "linewidth": 0.9, "color": COLOURS.ink}
    style = f"arc3,rad={curve}"
    ax.add_patch(FancyArrowPatch(start, end, arrowstyle=head, mutation_scale=8, connectionstyle=style, **line))
