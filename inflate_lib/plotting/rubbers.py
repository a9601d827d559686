"""Figures of the chapter on walls of two rubbers."""

from inflate_lib.plotting.mechanics import plot_inflated_gallery
from inflate_lib.plotting.style import COLOURS, figure


def plot_bent(results, titles, there):
    """Inflated structures over their undeformed selves, the stiff rubber darker, with an arrow from where the tip was.

    The tip are the nodes `there`, (n,) bool, of the mesh that all of them share.
    """
    fig = plot_inflated_gallery(results, titles, columns=len(results))
    for ax, result in zip(fig.axes, results, strict=True):
        start, end = result.nodes[there].mean(axis=0), result.deformed()[there].mean(axis=0)
        ax.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": COLOURS.target, "linewidth": 1.8,
                                                "shrinkA": 0, "shrinkB": 0}, zorder=5)  # fmt: skip
        ax.plot(*start, "o", color=COLOURS.target, markersize=4, markeredgecolor="white", zorder=4)
    return fig


def plot_pressures(moved, pressures):
    """How far the tip has moved to the right, name → (steps + 1,), over the pressures (steps + 1,)."""
    fig, ax = figure(1, 1, width=11.0, height=7.0)
    for (name, values), style in zip(moved.items(), ("--", "-", ":"), strict=False):
        ax.plot(pressures, values, style, label=name)
    ax.axhline(0, color=COLOURS.ghost, linewidth=0.8)
    ax.set_xlabel("pressure over the shear modulus of the soft rubber, $p / \\mu$")
    ax.set_ylabel("movement of the tip to the right / side")
    ax.legend()
    return fig
