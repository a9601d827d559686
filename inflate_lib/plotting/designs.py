"""The contact sheet of an inverse design: every structure before and after inflation, with what was asked for."""

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from inflate_lib.descriptors import DESCRIPTORS, get_descriptor
from inflate_lib.descriptors.registry import registered
from inflate_lib.mechanics import stress
from inflate_lib.mechanics.stress import QUANTITIES
from inflate_lib.plotting.mechanics import STRETCH_MAP
from inflate_lib.plotting.structures import draw_pairs, row_width
from inflate_lib.plotting.style import COLOURS, TEXT_WIDTH, figure


def plot_designs(designs, columns=6, colour=None):
    """Contact sheet: each structure undeformed, below it inflated with the target in orange, its errors and its peak
    stress.

    Parameters
    ----------
    designs : inflate_lib.inverse.search.Designs
    columns : int
    colour : {"von-mises", "stretch"}, optional
        What the inflated structures are coloured by, on one scale; they are blue without.

    Returns
    -------
    matplotlib.figure.Figure
    """
    columns = min(columns, max(1, len(designs.designs)))
    rows = [designs.designs[start : start + columns] for start in range(0, len(designs.designs), columns)] or [[]]
    wide = max(row_width([one.result for one in row]) for row in rows)
    width, values = max(6.0, TEXT_WIDTH * columns / 6), {}
    lines = 2 + max((len(one.deviations) for one in designs.designs), default=0)
    tall = [0.4 * lines + 2.3 * width / max(wide, 1.0)] * len(rows)
    fig, axes = figure(len(rows), 1, width=width, height=sum(tall), squeeze=False)
    if colour:
        function, label, at_rest = QUANTITIES[colour]
        values = {id(one): getattr(stress, function)(one.result)[-1] for row in rows for one in row}
        top = max([at_rest + 1e-9, *(np.percentile(field, 99) for field in values.values())])  # one cell eats no scale
        style = {"colour": None, "norm": Normalize(at_rest, top), "cmap": STRETCH_MAP, "outline": COLOURS.ink}
    first = 1
    for ax, row in zip(axes[:, 0], rows, strict=True):
        styles = [style | {"array": values[id(one)]} for one in row] if colour else None
        placed = draw_pairs(ax, [one.result for one in row], wide, columns, styles)
        for number, (one, nodes) in enumerate(zip(row, placed, strict=True), first):
            _draw_targets(ax, designs.targets, nodes)
            middle = (nodes[:, 0].min() + nodes[:, 0].max()) / 2
            words = f"{number}" + ("" if one.within else "  (missed)")
            ax.text(middle, ax.get_ylim()[1], words, ha="center", va="bottom")
            misses = [f"{get_descriptor(name).symbol} {100 * value:.2f} %" for name, value in one.deviations.items()]
            words = "\n".join([*misses, f"σ/μ {one.shape.peak_stress / one.result.lame[1]:.2f}"])
            ax.text(middle, ax.get_ylim()[0], words, ha="center", va="top", fontsize="small")
        first += len(row)
    if not designs.designs:
        axes[0, 0].set_title("no structure was found")
    elif colour:
        scale = ScalarMappable(style["norm"], style["cmap"])
        fig.colorbar(scale, ax=axes[:, 0], label=label, shrink=0.8, aspect=20, extend="max")
    return fig


def _draw_targets(ax, targets, nodes):
    """What was asked for, drawn over an inflated structure with deformed nodes (n, 2).

    An outline as it is, in place of the sizes that were measured on it; else each as its descriptor says, and what is
    put together from several in place of those: a box for height and width.
    """
    (left, bottom), (right, _) = nodes.min(axis=0), nodes.max(axis=0)
    middle = (left + right) / 2
    style = {"color": COLOURS.target, "linewidth": 1.2, "zorder": 4}
    names = list(targets.asked)
    if targets.drawing is not None:
        closed = np.vstack([targets.drawing, targets.drawing[:1]])
        shift = [middle - (closed[:, 0].min() + closed[:, 0].max()) / 2, bottom]
        ax.plot(*(closed + shift).T, **style)
        names = [name for name in names if name == "axis" or name not in (*DESCRIPTORS, "outline")]
    for one in registered():  # what is put together takes the place of its parts
        if not one.is_basic and set(one.parts) <= set(names):
            names = [one.name, *(name for name in names if name not in one.parts)]
    for name in names:
        if (draw := get_descriptor(name).draw) is not None:
            draw(ax, targets.vector(name), nodes, **style)
