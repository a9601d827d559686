"""Figures of the chapter on all ten digits."""

import numpy as np

from inflate_lib.alternatives.all_digits import MET, nearest_miss, sizes_of
from inflate_lib.mechanics.inflation import PRESSURE
from inflate_lib.plotting.style import COLOURS, figure

_COUNTED = {"height": "height $h$", "width": "width $w$", "hull_area": "hull area $A$", "lean": "lean", "bow": "bow"}


def plot_by_digit(table):
    """For each digit its heights, widths, hull areas, leans and bows: a box of the middle half, whiskers of 98 %."""
    fig, axes = figure(1, len(_COUNTED), height=7.0, sharey=True)
    digits = np.unique(table.digit.values)
    for ax, (name, text) in zip(axes, _COUNTED.items(), strict=True):
        values = [table[name].values[(table.digit.values == digit) & table.height.notnull().values] for digit in digits]
        boxes = ax.boxplot(values, orientation="horizontal", whis=(1, 99), showfliers=False, widths=0.6,
                           patch_artist=True, tick_labels=[str(digit) for digit in digits],
                           medianprops={"color": COLOURS.ink})  # fmt: skip
        for digit, box in zip(digits, boxes["boxes"], strict=True):
            box.set(facecolor=COLOURS.target if digit == 7 else COLOURS.void, linewidth=0.8)
        ax.set_xlabel(text)
    axes[0].invert_yaxis()
    axes[0].set_ylabel("digit")
    return fig


def plot_reach(table, few):
    """The plane of height and width: where sevens meet targets, where all digits do, and a few, {letter: row}."""
    fig, ax = figure(1, 1, width=12.0, height=11.0)
    everything = sizes_of(table)
    low, high = 0.95 * everything.min(axis=0), 1.05 * everything.max(axis=0)
    height, width = (np.linspace(*ends, 400) for ends in zip(low, high, strict=True))
    targets = np.stack(np.meshgrid(height, width, indexing="ij"), axis=-1)
    parts = {
        "all digits": (everything, COLOURS.accent),
        "sevens": (sizes_of(table.where(table.digit == 7)), COLOURS.low),
    }
    for name, (sizes, colour) in parts.items():
        met = nearest_miss(sizes, targets) <= MET
        ax.contourf(width, height, met.astype(float), [0.5, 2], colors=[colour])
        ax.fill_between([], [], color=colour, label=name)
    for letter, row in few.items():
        place = float(table.width[row]), float(table.height[row])
        ax.plot(*place, "o", color=COLOURS.ink, markersize=3)
        ax.annotate(letter, place, xytext=(4, 3), textcoords="offset points")
    ax.set_xlabel("width $w$")
    ax.set_ylabel("height $h$")
    ax.set_aspect("equal")
    ax.legend(loc="upper left")
    return fig


def plot_snapping(followed):
    """How far structures have moved aside over the pressure, along their paths of equilibrium; dotted: not stable."""
    numbers = followed.structure.unique()
    rows = -(-len(numbers) // 5)
    fig, axes = figure(rows, min(5, len(numbers)), height=1 + 3.8 * rows, squeeze=False, sharex=True)
    for ax, number in zip(axes.flat, numbers, strict=False):
        part = followed[followed.structure == number]
        share, aside = part.pressure.values / PRESSURE, part.aside.values
        ax.plot(share, aside, ":", color=COLOURS.target)
        ax.plot(np.where(part.stable, share, np.nan), aside, color=COLOURS.wall)
        ax.set_title(f"no. {number}, a {part.digit.iloc[0]}")
    fig.supxlabel("pressure / full pressure", fontsize=9)
    fig.supylabel("mean displacement to the right / side", fontsize=9)
    return fig
