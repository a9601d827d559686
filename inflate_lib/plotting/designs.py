"""The contact sheet of an inverse design: every structure before and after inflation, with what was asked for."""

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from inflate_lib.descriptors import DESCRIPTORS, get_descriptor
from inflate_lib.descriptors.registry import registered
from inflate_lib.mechanics import stress
from inflate_lib.mechanics.stress import QUANTITIES
from inflate_lib.plotting.mechanics import STRETCH_MAP
from inflate_lib.plotting.structures import draw_inflated, draw_label, same_scale
from inflate_lib.plotting.style import COLOURS, TEXT_WIDTH, figure, picture_axes


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
    rows = -(-max(1, len(designs.designs)) // columns)
    width = max(6.0, TEXT_WIDTH * columns / 6)
    fig, axes = figure(2 * rows, columns, width=width, height=6.6 * rows, height_ratios=[1, 1.5] * rows, squeeze=False)
    for ax in axes.flat:
        picture_axes(ax)
    if not designs.designs:
        axes[0, 0].set_title("no structure was found")
        return fig
    styles = [{}] * len(designs.designs)
    if colour:
        function, label, at_rest = QUANTITIES[colour]
        values = [getattr(stress, function)(one.result)[-1] for one in designs.designs]
        norm = Normalize(at_rest, np.concatenate(values).max())
        common = {"colour": None, "edge": "face", "norm": norm, "cmap": STRETCH_MAP}
        styles = [common | {"array": array} for array in values]
    for number, (one, style) in enumerate(zip(designs.designs, styles, strict=True)):
        row, column = divmod(number, columns)
        above, below = axes[2 * row, column], axes[2 * row + 1, column]
        draw_label(above, one.label)
        above.set_title(f"{number + 1}" + ("" if one.within else "  (missed)"), loc="left")
        nodes = draw_inflated(below, one.result, ghost=False, **style)
        _draw_targets(below, designs.targets, nodes)
        misses = [f"{get_descriptor(name).symbol} {100 * value:.2f} %" for name, value in one.deviations.items()]
        lines = [", ".join(misses[start : start + 2]) for start in range(0, len(misses), 2)]
        below.set_xlabel("\n".join([*lines, f"σ/μ {one.shape.peak_stress / one.result.lame[1]:.2f}"]), fontsize=7)
    same_scale(axes[1::2])
    if colour:
        fig.colorbar(ScalarMappable(norm, STRETCH_MAP), ax=axes[1::2], label=label, shrink=0.8, aspect=20)
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
    if targets.outline is not None:
        closed = np.vstack([targets.outline, targets.outline[:1]])
        shift = [middle - (closed[:, 0].min() + closed[:, 0].max()) / 2, bottom]
        ax.plot(*(closed + shift).T, **style)
        names = [name for name in names if get_descriptor(name).is_line or name not in DESCRIPTORS]
    for one in registered():  # what is put together takes the place of its parts
        if not one.is_basic and set(one.parts) <= set(names):
            names = [one.name, *(name for name in names if name not in one.parts)]
    for name in names:
        if (draw := get_descriptor(name).draw) is not None:
            draw(ax, targets.vector(name), nodes, **style)
