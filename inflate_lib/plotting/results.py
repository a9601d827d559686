"""Pictures of the experiments: generated structures against their targets, Figs. 7 to 12."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle

from inflate_lib.descriptors import describe, descriptor_matrix
from inflate_lib.mechanics.inflation import inflate
from inflate_lib.plotting.structures import draw_axis, draw_inflated, draw_label
from inflate_lib.plotting.style import COLOURS, LEVELS, TEXT_WIDTH, figure, picture_axes

MARKERS = ("o", "^", "s")
SYMBOLS = {"height": "$h$", "width": "$w$", "box": "$(h, w)$", "area": "$A$"}


def plot_generated(experiment, descriptor, n_show=5):
    """Figs. 7 to 10: for each target the first `n_show` valid structures, undeformed above and inflated below with
    the target drawn in; on the right the distribution of all that were generated.

    Parameters
    ----------
    experiment : xarray.Dataset
        From :func:`inflate_lib.models.train.run_experiment`.
    descriptor : {"height", "width", "box", "area"}
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
    extent = _extent(experiment)
    if descriptor in ("width", "box"):
        extent = max(extent[0], 1.05 * experiment["target"].values[:, -1].max()), extent[1]
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
            _draw_target(below, descriptor, target, deformed)
            achieved = descriptor_matrix(experiment, descriptor)[row]
            below.set_xlabel(", ".join(f"{value:.3f}" for value in achieved))
            middle = (deformed[:, 0].min() + deformed[:, 0].max()) / 2
            below.set(xlim=(middle - extent[0] / 2, middle + extent[0] / 2), ylim=(-0.08, extent[1]))
        wanted = ", ".join(f"{value:.3f}" for value in target)
        first = axes[2 * k, 0]
        first.set_title(" ")  # makes room for the line below, which is wider than its column
        line = f"({'abc'[k]}) target {SYMBOLS[descriptor]} = {wanted}"
        first.text(0, 1.06, line, transform=first.transAxes, fontsize="medium").set_in_layout(False)
    _plot_achieved(distribution.subplots(), experiment, descriptor)
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
    extent = _extent(experiment)
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
            base = _axis_base(result)
            draw_axis(right, describe(result).medial_axis + base, colour=COLOURS.ink, size=2.0)
            right.plot(*(target + base).T, color=COLOURS.target, linestyle="--", linewidth=1.6, zorder=4)
            middle = (deformed[:, 0].min() + deformed[:, 0].max()) / 2
            right.set(xlim=(middle - extent[0] / 2, middle + extent[0] / 2), ylim=(-0.08, extent[1]))
        axes[k, 0].set_title(f"axis {k + 1}", loc="left")
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
        "height", "width", "area" → experiment.
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
        ax.set(xlabel=f"target {SYMBOLS[name]}", ylabel=f"achieved {SYMBOLS[name]}")
    return fig


def _first_valid(experiment, level, n):
    """Row numbers of the first n valid structures of a target, None where there are fewer."""
    rows = np.flatnonzero((experiment["level"].values == level) & experiment["valid"].values)[:n].tolist()
    return rows + [None] * (n - len(rows))


def _extent(experiment):
    """Width and height that every inflated structure of an experiment fits in."""
    valid = experiment["valid"].values
    if not valid.any():
        return 1.2, 1.2
    return 1.05 * experiment["width"].values[valid].max(), max(1.0, 1.08 * experiment["height"].values[valid].max())


def _axis_base(result):
    """Where the first point of the medial axis lies on the inflated structure."""
    deformed = result.deformed()
    lowest = deformed[np.isclose(deformed[:, 1], deformed[:, 1].min(), atol=1e-9)]
    return np.array([(lowest[:, 0].min() + lowest[:, 0].max()) / 2, lowest[0, 1]])


def _draw_target(ax, descriptor, target, deformed):
    """The target as lines (height, width) or a rectangle (box); an area has no place in the picture."""
    left, bottom = deformed.min(axis=0)
    right, top = deformed.max(axis=0)
    style = {"color": COLOURS.target, "linewidth": 1.3, "linestyle": "--", "zorder": 4}
    if descriptor == "height":
        ax.plot([left - 0.05, right + 0.05], [bottom + target[0]] * 2, **style)
    elif descriptor == "width":
        middle = (left + right) / 2
        for x in (middle - target[0] / 2, middle + target[0] / 2):
            ax.plot([x, x], [bottom, top], **style)
    elif descriptor == "box":
        h, w = target
        ax.add_patch(
            Rectangle(((left + right - w) / 2, bottom), w, h, fill=False, edgecolor=COLOURS.target, linewidth=1.3,
                      linestyle="--", zorder=4, clip_on=False)
        )  # fmt: skip


def _plot_achieved(ax, experiment, descriptor):
    """Distribution of what was achieved, by target."""
    level, valid = experiment["level"].values, experiment["valid"].values
    achieved, target = descriptor_matrix(experiment, descriptor), experiment["target"].values
    if descriptor == "box":
        for k in np.unique(level):
            here = valid & (level == k)
            h, w = achieved[here].T
            ax.plot(w, h, MARKERS[k], color=LEVELS[k], markersize=3.5, markeredgecolor="white", markeredgewidth=0.3)
            h, w = target[level == k][0]
            ax.plot(w, h, MARKERS[k], color=LEVELS[k], markersize=9, markeredgecolor=COLOURS.ink, markeredgewidth=1.4)
            ax.plot(w, h, "+", color=COLOURS.ink, markersize=9)
        ax.set(xlabel="achieved $w$", ylabel="achieved $h$", title="(d) all valid structures; large: target")
        return
    for k in np.unique(level):
        reached = achieved[valid & (level == k), 0]
        if len(reached) > 1:
            body = ax.violinplot(reached, [k], widths=0.85, showextrema=False)["bodies"][0]
            body.set(facecolor=LEVELS[k], alpha=0.35)
        sideways = np.random.default_rng(0).uniform(-0.14, 0.14, len(reached))
        ax.plot(k + sideways, reached, MARKERS[k], color=LEVELS[k], markersize=2.8, markeredgecolor=COLOURS.ink,
                markeredgewidth=0.25)  # fmt: skip
        ax.plot([k - 0.45, k + 0.45], [target[level == k][0, 0]] * 2, color=COLOURS.target, linestyle="--", zorder=4)
    ax.set_xticks(np.unique(level), [f"{target[level == k][0, 0]:.3f}" for k in np.unique(level)])
    symbol = SYMBOLS[descriptor]
    ax.set(xlabel=f"target {symbol}", ylabel=f"achieved {symbol}", title="(d) all valid structures")
