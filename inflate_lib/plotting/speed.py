"""Pictures of the appendix on cost: time against unknowns, and what peers need for the same."""

import numpy as np

from inflate_lib.plotting.style import COLOURS, figure

_WAYS = {"refined": ("o", "-", COLOURS.wall), "thin wall": ("s", "--", COLOURS.target)}


def plot_growth(table, slopes):
    """Milliseconds of an inflation, and multiply-adds of one factorisation, against unknowns.

    `table` has the columns of ``speed_growth.csv``; `slopes` maps "<way>, <column>" to the exponent of a straight line.
    """
    fig, axes = figure(1, 2, height=7.0, sharex=True)
    labels = {"ms": "one inflation (ms)", "multiply_adds": "one factorisation (multiply-adds)"}
    for ax, (column, label) in zip(axes, labels.items(), strict=True):
        for way, rows in table[table.converged].groupby("grown"):
            marker, line, colour = _WAYS[way]
            ax.loglog(rows.unknowns, rows[column], marker, color=colour, markersize=4)
            slope = slopes[f"{way}, {column}"]
            ends = np.array([rows.unknowns.min(), rows.unknowns.max()], dtype=float)
            middle = np.exp(np.log(rows.unknowns).mean()), np.exp(np.log(rows[column]).mean())
            height = middle[1] * (ends / middle[0]) ** slope
            ax.loglog(ends, height, line, color=colour, label=f"{way}: slope {slope:.2f}")
        ax.set_xlabel("unknowns")
        ax.set_ylabel(label)
        ax.legend(loc="upper left")
    return fig


def plot_peers(table):
    """Bars of the time per structure in multiples of ours, one panel for each number of load steps, logarithmic."""
    counts = sorted(table.load_steps.unique(), reverse=True)
    fig, axes = figure(1, len(counts), height=5.5, sharey=True, squeeze=False)
    for ax, count in zip(axes[0], counts, strict=True):
        rows = table[table.load_steps == count]
        colours = [COLOURS.wall if "inflate_lib" in solver else COLOURS.ghost for solver in rows.solver]
        ax.barh(rows.solver, rows.ratio - 1, left=1, color=colours)  # a logarithmic axis has no zero to begin at
        for name, ratio in zip(rows.solver, rows.ratio, strict=True):
            ax.text(1.15 * max(ratio, 1), name, f"{ratio:.1f}", va="center", fontsize=8)
        ax.set_xscale("log")
        ax.set_xlim(0.5, 4 * table.ratio.max())
        ax.axvline(1, color=COLOURS.ink, linewidth=0.8)
        ax.set_title("one load step" if count == 1 else f"{count} load steps")
        ax.set_xlabel("times ours (plain element)")
    axes[0, 0].invert_yaxis()
    return fig
