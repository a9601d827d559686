"""Pictures of the experiments: generated structures against their targets, Figs. 7 to 12."""

import string

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import gaussian_kde

from inflate_lib.descriptors import describe, descriptor_matrix, get_descriptor
from inflate_lib.descriptors.shape import place_axis
from inflate_lib.mechanics.inflation import inflate
from inflate_lib.plotting.structures import draw_axis, draw_pairs, row_width
from inflate_lib.plotting.style import COLOURS, LEVELS, MARKERS, TEXT_WIDTH, figure

_COLUMN = 2.4  # cm: a structure of Figs. 7 to 11


def plot_generated(experiment, descriptor, n_show=5):
    """Figs. 7 to 11: for each target the first `n_show` valid structures, undeformed above and inflated below with
    the target drawn in, all on one scale; on the right what all that were generated have achieved.

    Parameters
    ----------
    experiment : xarray.Dataset
        From :func:`inflate_lib.experiments.run.run_experiment`.
    descriptor : str
    n_show : int

    Returns
    -------
    matplotlib.figure.Figure
    """
    one, level = get_descriptor(descriptor), experiment["level"].values
    levels = np.unique(level)
    shown = [_first_valid(experiment, k, n_show) for k in levels]
    results = [[inflate(label.astype(float)) for label in experiment["label"].values[rows]] for rows in shown]
    wide = max(map(row_width, results))
    left, right = _COLUMN * n_show, max(5.0, TEXT_WIDTH - _COLUMN * n_show)  # cm
    side = left / max(wide, 1.0)  # cm of a side of the frame
    tall = [1.2 + side * (1.08 + max((float(np.ptp(r.deformed()[:, 1])) for r in row), default=0.0)) for row in results]
    fig = plt.figure(figsize=((left + right) / 2.54, sum(tall) / 2.54))
    pictures, achieved = fig.subfigures(1, 2, width_ratios=[left, right])
    axes = pictures.subplots(len(levels), 1, height_ratios=tall, squeeze=False)[:, 0]
    reached = descriptor_matrix(experiment, descriptor)
    for ax, k, rows, row in zip(axes, levels, shown, results, strict=True):
        target = experiment["target"].values[level == k][0]
        for number, result, nodes in zip(rows, row, draw_pairs(ax, row, wide, n_show), strict=True):
            if one.is_line:
                draw_axis(ax, place_axis(describe(result).medial_axis, nodes), colour=COLOURS.ink, size=1.8)
                ax.plot(*place_axis(target.reshape(-1, 2), nodes).T, "--", color=COLOURS.target, zorder=4)
            elif one.draw is not None:
                one.draw(ax, target, nodes, color=COLOURS.target, linewidth=1.3, zorder=4)
            words = _words(reached[number]) or _error(one, reached[number], target)
            middle = (nodes[:, 0].min() + nodes[:, 0].max()) / 2
            ax.text(middle, ax.get_ylim()[0], words, ha="center", va="top", fontsize="small")
        line = f"({string.ascii_lowercase[k]}) target ${one.symbol}$"
        ax.set_title(line + (f" = {_words(target)}" if len(target) <= 2 else f" {k + 1}"), loc="left")
    _plot_achieved(achieved, experiment, one, string.ascii_lowercase[len(levels)])
    return fig


def plot_generated_axes(experiment, n_show=3):
    """Fig. 11: :func:`plot_generated` of the medial axis, with the axis achieved in each inflated structure."""
    return plot_generated(experiment, "axis", n_show)


def plot_axis_density(experiment):
    """Fig. 12: density of the points of all achieved medial axes, one panel per target, the target on top; x stretched.

    Parameters
    ----------
    experiment : xarray.Dataset
        Of the medial axis.

    Returns
    -------
    matplotlib.figure.Figure
    """
    level, valid = experiment["level"].values, experiment["valid"].values
    levels = np.unique(level)
    achieved = experiment["medial_axis"].values
    everything = np.concatenate([achieved[valid].reshape(-1, 2), experiment["target"].values.reshape(-1, 2)])
    half, high = 1.1 * np.abs(everything).max(axis=0)
    x, y = np.meshgrid(np.linspace(-half, half, 81), np.linspace(-0.05, high, 121))
    fig, axes = figure(1, len(levels), height=8.5, sharex=True, sharey=True, squeeze=False)
    for k, ax in zip(levels, axes[0], strict=True):
        points = achieved[valid & (level == k)][:, 1:].reshape(-1, 2)  # the first point is the origin by definition
        density = np.zeros_like(x)
        if len(points):
            density = gaussian_kde(points.T, 0.6 * len(points) ** (-1 / 6))([x.ravel(), y.ravel()]).reshape(x.shape)
            density /= density.max()
        filled = ax.contourf(x, y, density, np.linspace(0.1, 1, 10), cmap="Blues")
        target = experiment["target"].values[level == k][0].reshape(-1, 2)
        ax.plot(*target.T, "--", color=COLOURS.target, linewidth=1.0, label="target")
        ax.set(xlabel="$x$ (stretched)", title=f"axis {k + 1}")
    axes[0, 0].set_ylabel("$y$")
    axes[0, 0].legend(loc="upper left")
    fig.colorbar(filled, ax=axes, label="density / its maximum", aspect=30)
    return fig


def plot_agreement(experiments):
    """Achieved against target, one panel per scalar descriptor: the line is perfect agreement, the crosses are means.

    Parameters
    ----------
    experiments : dict
        Name of a scalar descriptor → experiment.
    """
    fig, axes = figure(1, len(experiments), height=5.8, squeeze=False)
    for ax, (name, experiment) in zip(axes[0], experiments.items(), strict=True):
        target, achieved = experiment["target"].values[:, 0], descriptor_matrix(experiment, name)[:, 0]
        valid = experiment["valid"].values
        jitter = np.random.default_rng(0).normal(0, 0.004, len(target))
        ax.plot((target + jitter)[valid], achieved[valid], "o", markersize=2, alpha=0.5)
        for value in np.unique(target[valid]):
            ax.plot(value, achieved[valid & (target == value)].mean(), "x", color=COLOURS.ink, markersize=7)
        shown = np.concatenate([target, achieved[valid]])
        span = np.array([shown.min(), shown.max()])
        ax.plot(span, span, "--", color=COLOURS.target, linewidth=1)
        symbol = get_descriptor(name).symbol
        ax.set(xlabel=f"target ${symbol}$", ylabel=f"achieved ${symbol}$")
    return fig


def _first_valid(experiment, level, n):
    """Row numbers of the first n valid structures of a target, fewer where there are fewer."""
    return np.flatnonzero((experiment["level"].values == level) & experiment["valid"].values)[:n].tolist()


def _words(values):
    """One number or two in words; more are too many."""
    return ", ".join(f"{value:.3f}" for value in values) if len(values) <= 2 else ""


def _error(descriptor, achieved, target):
    """How far one structure is from its target, in words."""
    error = descriptor.error
    return f"{error.factor * error.of(achieved[None], target[None])[0]:.2f} {error.unit}"


def _plot_achieved(fig, experiment, descriptor, letter):
    """What was achieved, by target: axes with x stretched; of two components their plane; of more the error."""
    level, valid = experiment["level"].values, experiment["valid"].values
    achieved, target = descriptor_matrix(experiment, descriptor.name), experiment["target"].values
    levels = np.unique(level)
    targets = [target[level == k][0] for k in levels]
    reached = [achieved[valid & (level == k)] for k in levels]
    if descriptor.is_line or descriptor.length == 2:
        draw = _draw_axes if descriptor.is_line else _draw_plane
        axes = fig.subplots(len(levels), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for k, ax in enumerate(axes):
            draw(ax, k, reached, targets[k], descriptor)
        what = "axes, x stretched" if descriptor.is_line else "all valid structures"
        axes[0].set_title(f"({letter}) {what}")
        axes[-1].set_xlabel("$x$" if descriptor.is_line else f"achieved ${descriptor.components[1]}$")
        axes[0].legend(loc="upper left", handlelength=1.4, borderaxespad=0)
        return
    import seaborn as sns  # which the figures of the book alone need

    ax, error = fig.subplots(), descriptor.error
    for k, (values, wanted) in enumerate(zip(reached, targets, strict=True)):
        scalar = descriptor.length == 1
        values = values[:, 0] if scalar else error.factor * error.of(values, np.tile(wanted, (len(values), 1)))
        if len(values) > 1:
            options = {"color": LEVELS[k], "saturation": 1, "inner": None, "linewidth": 0, "alpha": 0.35}
            sns.violinplot(x=np.full(len(values), k), y=values, ax=ax, width=0.85, cut=0, native_scale=True, **options)
        sideways = np.random.default_rng(0).uniform(-0.14, 0.14, len(values))
        style = {"color": LEVELS[k], "markeredgecolor": COLOURS.ink, "markeredgewidth": 0.25}
        ax.plot(k + sideways, values, MARKERS[k], markersize=2.8, **style)
        if scalar:
            ax.plot([k - 0.45, k + 0.45], [wanted[0]] * 2, color=COLOURS.target, linestyle="--", zorder=4)
    symbol = descriptor.symbol
    ax.set(xlabel=f"target ${symbol}$", ylabel=f"achieved ${symbol}$", title=f"({letter}) all valid structures")
    if descriptor.length == 1:
        ax.set_xticks(range(len(targets)), [f"{wanted[0]:.3f}" for wanted in targets])
    else:
        ax.set_xticks(range(len(targets)), [f"{k + 1}" for k in levels])
        ax.set_ylabel(f"{error.noun} ({error.unit})")


def _draw_plane(ax, k, reached, target, descriptor):
    """Structures of target number `k` in the plane of two components, those of the other targets in grey."""
    for number, values in enumerate(reached):
        here = number == k
        look = {"color": LEVELS[number], "markeredgecolor": COLOURS.ink} if here else {"color": "#D9D9D9"}
        ax.plot(*values.T[::-1], MARKERS[number], markersize=3.2, markeredgewidth=0.25, zorder=1 + here, **look)
    ax.plot(*target[::-1], "+", color=COLOURS.target, markersize=11, markeredgewidth=1.6, label="target", zorder=3)
    up = descriptor.components[0]
    ax.set(ylabel=f"achieved ${up}$", aspect="equal")


def _draw_axes(ax, k, reached, target, descriptor):
    """All axes achieved for target number `k`, with x stretched."""
    for values in reached[k]:
        ax.plot(*values.reshape(-1, 2).T, color=COLOURS.wall, linewidth=0.5, alpha=0.4)
    ax.plot([], [], color=COLOURS.wall, linewidth=0.8, label="achieved")
    ax.plot(*target.reshape(-1, 2).T, color=COLOURS.target, linestyle="--", label="target")
    ax.set(ylabel="$y$")
