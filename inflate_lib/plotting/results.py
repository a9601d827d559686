"""Pictures of the experiments: generated structures against their targets, Figs. 7 to 12."""

import string

import matplotlib.pyplot as plt
import numpy as np

from inflate_lib.descriptors import describe, descriptor_matrix, get_descriptor
from inflate_lib.descriptors.shape import place_axis
from inflate_lib.mechanics.inflation import inflate
from inflate_lib.plotting.structures import draw_axis, draw_inflated, draw_label, same_scale
from inflate_lib.plotting.style import COLOURS, LEVELS, MARKERS, TEXT_WIDTH, figure, picture_axes


def plot_generated(experiment, descriptor, n_show=5):
    """Figs. 7 to 10: for each target the first `n_show` valid structures, undeformed above and inflated below with
    the target drawn in; on the right the distribution of all that were generated.

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
    level = experiment["level"].values
    levels = np.unique(level)
    fig = plt.figure(figsize=(TEXT_WIDTH / 2.54, 5.0 * len(levels) / 2.54))
    pictures, distribution = fig.subfigures(1, 2, width_ratios=[n_show, 1.9])
    axes = pictures.subplots(2 * len(levels), n_show, height_ratios=[0.9, 1] * len(levels), squeeze=False)
    one = get_descriptor(descriptor)
    for k in levels:
        target = experiment["target"].values[level == k][0]
        for column, row in enumerate(_first_valid(experiment, k, n_show)):
            above, below = axes[2 * k, column], axes[2 * k + 1, column]
            if row is None:
                picture_axes(above), picture_axes(below)
                continue
            label = experiment["label"].values[row].astype(float)
            draw_label(above, label)
            deformed = draw_inflated(below, inflate(label), ghost=False)
            if one.draw is not None:
                one.draw(below, target, deformed, color=COLOURS.target, linewidth=1.3, zorder=4)
            achieved = descriptor_matrix(experiment, descriptor)[row]
            below.set_xlabel(_words(achieved))
        first = axes[2 * k, 0]
        first.set_title(" ")  # makes room for the line below, which is wider than its column
        line = f"({string.ascii_lowercase[k]}) target ${one.symbol}$" + f" = {_words(target)}" * (len(target) <= 2)
        first.text(0, 1.06, line, transform=first.transAxes, fontsize="medium").set_in_layout(False)
    same_scale(axes[1::2])
    _plot_achieved(distribution.subplots(), experiment, one)
    return fig


def plot_generated_axes(experiment, n_show=3):
    """Fig. 11: for each target axis the first `n_show` valid structures, undeformed and inflated, with both axes.

    Parameters
    ----------
    experiment : xarray.Dataset
        Of the medial axis.
    n_show : int

    Returns
    -------
    matplotlib.figure.Figure
    """
    level = experiment["level"].values
    levels = np.unique(level)
    fig, axes = figure(len(levels), 2 * n_show, width=TEXT_WIDTH, height=3.6 * len(levels), squeeze=False)
    for k in levels:
        target = experiment["target"].values[level == k][0].reshape(-1, 2)
        for column, row in enumerate(_first_valid(experiment, k, n_show)):
            left, right = axes[k, 2 * column], axes[k, 2 * column + 1]
            if row is None:
                picture_axes(left), picture_axes(right)
                continue
            label = experiment["label"].values[row].astype(float)
            draw_label(left, label)
            result = inflate(label)
            deformed = draw_inflated(right, result, ghost=False)
            right.collections[0].set_alpha(0.45)
            draw_axis(right, place_axis(describe(result).medial_axis, deformed), colour=COLOURS.ink, size=2.0)
            right.plot(*place_axis(target, deformed).T, color=COLOURS.target, linestyle="--", linewidth=1.6, zorder=4)
        axes[k, 0].set_title(f"axis {k + 1}", loc="left")
    same_scale(axes[:, 1::2])
    axes[0, 1].plot([], [], "o-", color=COLOURS.ink, markersize=2, label="achieved")
    axes[0, 1].plot([], [], "--", color=COLOURS.target, label="target")
    fig.legend(*axes[0, 1].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return fig


def plot_axis_density(experiment):
    """Fig. 12: normalised density of the points of all achieved medial axes, one panel per target, the target on top.

    Parameters
    ----------
    experiment : xarray.Dataset
        Of the medial axis.

    Returns
    -------
    matplotlib.figure.Figure
    """
    import seaborn as sns  # which the figures of the book alone need

    level, valid = experiment["level"].values, experiment["valid"].values
    levels = np.unique(level)
    achieved = experiment["medial_axis"].values
    everything = np.concatenate([achieved[valid].reshape(-1, 2), experiment["target"].values.reshape(-1, 2)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    half = 1.1 * np.abs([low[0], high[0]]).max()
    fig, axes = figure(1, len(levels), width=13.0, height=8.5, sharey=True, squeeze=False)
    for k, ax in zip(levels, axes[0], strict=True):
        points = achieved[valid & (level == k)][:, 1:].reshape(-1, 2)  # the first point is the origin by definition
        if len(points):
            x, y = points.T
            sns.kdeplot(x=x, y=y, ax=ax, fill=True, cmap="Blues", levels=10, thresh=0.05, bw_adjust=0.6)
        target = experiment["target"].values[level == k][0].reshape(-1, 2)
        ax.plot(*target.T, "o-", color=COLOURS.target, markersize=2.5, linewidth=1.0, label="target")
        ax.set(xlabel="$x$", xlim=(-half, half), ylim=(-0.05, 1.05 * high[1]), title=f"axis {k + 1}")
        ax.set_aspect("equal")
        ax.set_xticks([0])  # the panels are too narrow for more; the scale is that of y
    axes[0, 0].set_ylabel("$y$")
    axes[0, 0].legend(loc="upper left")
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
    """Row numbers of the first n valid structures of a target, None where there are fewer."""
    rows = np.flatnonzero((experiment["level"].values == level) & experiment["valid"].values)[:n].tolist()
    return rows + [None] * (n - len(rows))


def _words(values):
    """One number or two in words; more are too many."""
    return ", ".join(f"{value:.3f}" for value in values) if len(values) <= 2 else ""


def _plot_achieved(ax, experiment, descriptor):
    """Distribution of what was achieved, by target: of two components in their plane, of more only the error."""
    level, valid = experiment["level"].values, experiment["valid"].values
    achieved, target = descriptor_matrix(experiment, descriptor.name), experiment["target"].values
    if descriptor.length == 2:
        for k in np.unique(level):
            here = valid & (level == k)
            h, w = achieved[here].T
            ax.plot(w, h, MARKERS[k], color=LEVELS[k], markersize=3.5, markeredgecolor="white", markeredgewidth=0.3)
            h, w = target[level == k][0]
            ax.plot(w, h, MARKERS[k], color=LEVELS[k], markersize=9, markeredgecolor=COLOURS.ink, markeredgewidth=1.4)
            ax.plot(w, h, "+", color=COLOURS.ink, markersize=9)
        up, across = descriptor.components
        labels = {"xlabel": f"achieved ${across}$", "ylabel": f"achieved ${up}$"}
        ax.set(**labels, title="(d) all valid structures; large: target")
        return
    error = descriptor.error
    values = achieved[:, 0] if descriptor.length == 1 else error.factor * error.of(achieved, target)
    for k in np.unique(level):
        reached = values[valid & (level == k)]
        if len(reached) > 1:
            body = ax.violinplot(reached, [k], widths=0.85, showextrema=False)["bodies"][0]
            body.set(facecolor=LEVELS[k], alpha=0.35)
        sideways = np.random.default_rng(0).uniform(-0.14, 0.14, len(reached))
        ax.plot(k + sideways, reached, MARKERS[k], color=LEVELS[k], markersize=2.8, markeredgecolor=COLOURS.ink,
                markeredgewidth=0.25)  # fmt: skip
        if descriptor.length == 1:
            ax.plot(
                [k - 0.45, k + 0.45], [target[level == k][0, 0]] * 2, color=COLOURS.target, linestyle="--", zorder=4
            )
    symbol = descriptor.symbol
    ax.set(xlabel=f"target ${symbol}$", ylabel=f"achieved ${symbol}$", title="(d) all valid structures")
    if descriptor.length == 1:
        ax.set_xticks(np.unique(level), [f"{target[level == k][0, 0]:.3f}" for k in np.unique(level)])
    else:
        ax.set_xticks(np.unique(level), [f"{k + 1}" for k in np.unique(level)])
        ax.set_ylabel(f"{error.noun} ({error.unit})")
