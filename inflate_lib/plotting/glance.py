"""The picture on the first page: from a target to inflated structures, out of real results."""

from itertools import pairwise

import numpy as np
from matplotlib.patches import FancyArrowPatch

from inflate_lib.plotting.structures import draw_inflated, draw_label
from inflate_lib.plotting.style import COLOURS, figure, picture_axes


def plot_glance(target, states, steps, labels, results, heights):
    """A wanted height, and in each row how one structure came out of noise, what it is, and what it becomes.

    Parameters
    ----------
    target : float
        The height asked for.
    states : sequence of arrays (k, h, w)
        For each row the states of the reverse process that are shown, on the scale of the images.
    steps : sequence of int
        The k numbers of denoising steps that they belong to.
    labels : sequence of (28, 28) arrays
        Label image of each row.
    results : sequence of Inflation
    heights : sequence of float
        What was achieved.

    Returns
    -------
    matplotlib.figure.Figure
    """
    n_rows, n_states = max(1, len(results)), len(steps)
    columns = {"squeeze": False, "width_ratios": [0.9] + [1] * (n_states + 1) + [1.25]}
    fig, axes = figure(n_rows, n_states + 3, height=2.9 * n_rows + 0.9, **columns)
    for ax in axes.flat:
        picture_axes(ax)
    tallest = 1.08 * max([target, *heights])
    width = 1.15 * max((float(np.ptp(result.deformed()[:, 0])) for result in results), default=1.0)
    for row, result in enumerate(results):
        for ax, image in zip(axes[row, 1:-2], states[row], strict=True):
            ax.imshow(image, vmin=0, vmax=1)
        draw_label(axes[row, -2], labels[row])
        _draw_inflated(axes[row, -1], result, target, width, tallest)
        axes[row, -1].set_xlabel(f"$h$ = {heights[row]:.3f}")
    for ax in axes[:, 0]:
        _draw_target(ax, target, tallest)
    axes[0, 0].set_title("target")
    for column, step in enumerate(steps):
        axes[0, 1 + column].set_title(f"denoising\nstep {step}" if column == 0 else f"\nstep {step}")
    axes[0, -2].set_title("structure")
    axes[0, -1].set_title("inflated")
    fig.canvas.draw()  # places the axes, so that arrows can be drawn between them
    for row in axes:
        for left, right in pairwise(row):
            _arrow(fig, left.get_position(), right.get_position())
    return fig


def _draw_inflated(ax, result, target, width, tallest):
    """The inflated structure with its target as a dashed line."""
    deformed = draw_inflated(ax, result, ghost=False)
    middle = (deformed[:, 0].min() + deformed[:, 0].max()) / 2
    left, right = middle - width / 2, middle + width / 2
    ax.plot([left, right], [deformed[:, 1].min() + target] * 2, "--", color=COLOURS.target, linewidth=1.3)
    ax.set(xlim=(left, right), ylim=(-0.08, tallest))


def _draw_target(ax, target, tallest):
    """The wanted height as a measure over the ground."""
    ax.annotate("", (0, 0), (0, target), arrowprops={"arrowstyle": "<|-|>", "color": COLOURS.target, "linewidth": 1.4,
                                                     "shrinkA": 0, "shrinkB": 0})  # fmt: skip
    ax.plot([-0.2, 0.2], [target] * 2, "--", color=COLOURS.target, linewidth=1.3)
    ax.plot([-0.25, 0.25], [0, 0], color=COLOURS.ink, linewidth=1.2)
    ax.set(xlim=(-0.35, 0.35), ylim=(-0.08, tallest))
    ax.set_xlabel(f"$h$ = {target:.3f}")


def _arrow(fig, left, right):
    """A short arrow in the gap between two axes, at mid-height."""
    y, gap = (left.y0 + left.y1) / 2, right.x0 - left.x1
    if gap <= 0:
        return
    ends = (left.x1 + 0.1 * gap, y), (right.x0 - 0.1 * gap, y)
    fig.add_artist(
        FancyArrowPatch(*ends, transform=fig.transFigure, arrowstyle="-|>", mutation_scale=7, color=COLOURS.ink, lw=0.8)
    )
