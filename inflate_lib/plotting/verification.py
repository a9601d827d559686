"""Pictures of the appendix: errors against refinement, the mesh study, and walls that cross walls."""

import numpy as np

from inflate_lib.descriptors.registry import basic
from inflate_lib.mechanics.contact import contact_forces
from inflate_lib.plotting.structures import draw_inflated, draw_mesh
from inflate_lib.plotting.style import COLOURS, figure, logarithmic

_ELEMENT_STYLES = {
    "q1": ("plain", "s--", COLOURS.target),
    "mean-dilatation": ("mean dilatation", "o-", COLOURS.wall),
    "stabilised": ("MOOSE's", "d-.", COLOURS.ink),
    "q2": ("biquadratic, graded (FElupe)", "^:", COLOURS.medium),
}


def plot_tube(result, exact_radii, refinements, errors):
    """A quarter of the tube before and after, with its exact radii, and errors against refinement.

    `errors` maps elements to (refinements,) largest relative errors of the deformed radius.
    """
    fig, (picture, plot) = figure(1, 2, height=7.5)
    draw_mesh(picture, result.nodes, result.cells, colour=COLOURS.shadow)
    draw_mesh(picture, result.deformed(), result.cells, edge="white", linewidth=0.5)
    angle = np.linspace(0, np.pi / 2, 200)
    for radius in exact_radii:
        picture.plot(radius * np.cos(angle), radius * np.sin(angle), "--", color=COLOURS.target, linewidth=1.2)
    picture.set_xlabel("inflated over undeformed (grey);\nexact radii dashed")
    for element, values in errors.items():
        name, style, colour = _ELEMENT_STYLES[element]
        plot.loglog(refinements, values, style, color=colour, markersize=4, label=name)
    n = np.array(refinements, dtype=float)
    plot.loglog(n, 0.6 * errors["mean-dilatation"][0] * (n[0] / n) ** 2, color=COLOURS.ink, lw=0.8, label="slope −2")
    plot.set_xticks(refinements, [str(n) for n in refinements])
    plot.minorticks_off()
    plot.set_xlabel("elements through the wall")
    plot.set_ylabel("largest relative error of a radius")
    plot.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2)
    return fig


def plot_mesh_study(table):
    """Sizes of the errors of height, width and hull area in percent (columns ``…_error``) over refinement, on
    logarithmic axes, a line for each structure."""
    sizes = [one for one in basic() if f"{one.variable}_error" in table]
    fig, axes = figure(1, len(sizes), height=7.0, sharex=True, sharey=True)
    for ax, one in zip(axes, sizes, strict=True):
        for (structure, element), rows in table.groupby(["structure", "element"]):
            name, style, colour = _ELEMENT_STYLES[element]
            error = rows[f"{one.variable}_error"].replace(0, np.nan)  # the truth itself
            label = name if structure == table["structure"].min() else None
            ax.plot(rows["refine"], error.abs(), style, color=colour, linewidth=0.9, markersize=4, label=label)
        logarithmic(ax)
        ax.set_xticks([1, 2, 4, 6, 8], ["1", "2", "4", "6", "8"])
        ax.set_xlabel("elements per pixel side")
        ax.set_title(one.title)
    axes[0].set_ylabel("|difference from the truth| (%)")
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return fig


def plot_contact(results, steps, titles):
    """Load steps of inflated structures side by side on one scale, with the nodes that contact acts on."""
    fig, axes = figure(1, len(results), height=5.4, sharex=True, sharey=True)
    for ax, result, step, title in zip(axes, results, steps, titles, strict=True):
        x, forces = draw_inflated(ax, result, step, ghost=False), contact_forces(result, step)
        acts = np.linalg.norm(forces, axis=1) > 0
        ax.plot(*x[acts].T, "o", color=COLOURS.target, markersize=3, zorder=4)
        ax.set_title(title)
    return fig


def plot_crossings(results, pairs, titles, columns=3):
    """Inflated structures with the boundary edges that cross one another drawn on top; `pairs` from crossing_edges."""
    rows = -(-len(results) // columns)
    fig, axes = figure(rows, columns, height=6.0 * rows, squeeze=False)
    for ax in axes.flat[len(results) :]:
        ax.set_axis_off()
    for ax, result, crossing, title in zip(axes.flat, results, pairs, titles, strict=False):
        deformed = draw_inflated(ax, result, ghost=False)
        for ends in crossing.reshape(-1, 2):
            ax.plot(*deformed[ends].T, color=COLOURS.target, linewidth=2, zorder=4)
        ax.set_title(title)
    return fig
