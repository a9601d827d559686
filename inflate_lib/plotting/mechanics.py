"""Pictures of the mechanics: meshes, load steps, verification, and the distributions of a simulated data set."""

import numpy as np
from matplotlib import colormaps
from matplotlib.animation import FuncAnimation
from matplotlib.colors import ListedColormap

from inflate_lib.descriptors.registry import basic
from inflate_lib.plotting.structures import draw_clamped_edge, draw_inflated, draw_mesh, draw_shape
from inflate_lib.plotting.style import COLOURS, TEXT_WIDTH, figure, picture_axes

#: Light to dark, with every colour-vision deficiency and in grey; its lightest part would not be seen on white.
STRETCH_MAP = ListedColormap(colormaps["YlGnBu"](np.linspace(0.2, 1, 256)))
_SIZES = tuple(f"{one.title} ${one.symbol}$" for one in basic() if one.is_size)
_HELD_FRAMES = 5  # of an animation, on its last state


def plot_mesh(mesh):
    """Mesh of a structure: cells of the wall, pressure edges with arrows into the wall, clamped nodes."""
    fig, ax = figure(1, 1, width=9, height=10.5)
    draw_mesh(ax, mesh.nodes, mesh.cells, colour=COLOURS.void, edge=COLOURS.ghost, linewidth=0.5)
    start, end = mesh.nodes[mesh.pressure_edges[:, 0]], mesh.nodes[mesh.pressure_edges[:, 1]]
    ax.plot(*np.stack([start, end], 1).transpose(2, 1, 0), color=COLOURS.target, linewidth=1.4)
    ax.plot([], [], color=COLOURS.target, label="pressure edges, force on the wall")
    middle, along = (start + end) / 2, end - start
    into_wall = np.column_stack([along[:, 1], -along[:, 0]])  # the cavity is on the left-hand side
    # tails in the cavity, heads on the wall
    ax.quiver(*(middle - 0.6 * into_wall).T, *(0.55 * into_wall).T, color=COLOURS.target, angles="xy",
              scale_units="xy", scale=1, width=0.004, headwidth=4, headlength=4)  # fmt: skip
    ax.plot(*mesh.nodes[mesh.clamped].T, "^", color=COLOURS.ink, markersize=4, label="clamped nodes")
    draw_clamped_edge(ax, mesh)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.02))
    return fig


def plot_load_steps(result, steps=(1, 3, 5, 7, 9)):
    """The structure before inflation and at some load steps (indices), with the undeformed shape behind."""
    fig, axes = figure(1, len(steps) + 1, height=4.0, sharex=True, sharey=True)
    draw_shape(axes[0], result.mesh, result.nodes)
    axes[0].set_xlabel("$t$ = 0")
    for ax, step in zip(axes[1:], steps, strict=True):
        draw_inflated(ax, result, step)
        ax.set_xlabel(f"$t$ = {result.load_steps[step]:.1f}")
    everything = np.concatenate([result.nodes, *(result.deformed(step) for step in steps)])
    _fit(axes, everything)
    return fig


def plot_response(values, curves, label="time $t$, pressure $0.01\\,t$"):
    """Height, width and hull area over t, or what `label` says; `curves` maps names to (steps, 3) values."""
    fig, axes = figure(1, 3, height=5.2, sharex=True)
    styles = ("-", "--", ":", "-.")
    for column, (ax, title) in enumerate(zip(axes, _SIZES, strict=True)):
        for (name, sizes), style, marker in zip(curves.items(), styles, "os^v", strict=False):
            ax.plot(values, sizes[:, column], style, marker=marker, markersize=3, label=name)
        ax.set_xlabel(label)
        ax.set_ylabel(title)
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(curves))
    return fig


def plot_field(results, values, titles, label):
    """Deformed shapes side by side, each cell coloured by a value, (m,) per shape, on one common scale."""
    fig, axes = figure(1, len(results), width=5.4 * len(results), height=6.4, sharex=True, sharey=True, squeeze=False)
    axes = axes[0]
    low, high = np.percentile(np.concatenate(values), [1, 99])  # a single cell must not eat the whole scale
    for ax, result, field, title in zip(axes, results, values, titles, strict=True):
        style = {"colour": None, "array": field, "cmap": STRETCH_MAP, "outline": COLOURS.ink}
        cells = draw_shape(ax, result.mesh, result.deformed(), **style)
        cells.set_clim(low, high)
        ax.set_title(title)
    _fit(axes, np.concatenate([result.deformed() for result in results]))
    fig.colorbar(cells, ax=axes, label=label, shrink=0.8, aspect=30, extend="both")
    return fig


def plot_refinement(refinements, plain, mean_dilatation):
    """Height, width and hull area, (refinements, 3), of both elements over the number of elements per pixel side."""
    fig, axes = figure(1, 3, height=5.2, sharex=True)
    for column, (ax, title) in enumerate(zip(axes, _SIZES, strict=True)):
        ax.plot(refinements, plain[:, column], "s--", color=COLOURS.target, label="plain")
        ax.plot(refinements, mean_dilatation[:, column], "o-", color=COLOURS.wall, label="mean dilatation")
        ax.set_xscale("log", base=2)
        ax.set_xticks(refinements, [str(n) for n in refinements])
        ax.minorticks_off()
        ax.set_xlabel("elements per pixel side")
        ax.set_ylabel(title)
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return fig


def plot_difference_steps(steps, errors):
    """Error of a difference quotient over its step, on logarithmic axes; `errors` maps names to (steps,) values."""
    fig, ax = figure(1, 1, width=9.5, height=7)
    for (name, values), marker, style in zip(errors.items(), "os^", ("-", "--", ":"), strict=False):
        ax.loglog(steps, values, marker=marker, linestyle=style, markersize=4, label=name)
    first = next(iter(errors.values()))
    ax.loglog(steps[:4], 3 * first[0] * (steps[:4] / steps[0]) ** 2, color=COLOURS.ink, linewidth=0.8, label="slope 2")
    ax.set_xlabel("step of the difference quotient")
    ax.set_ylabel("relative error")
    fig.legend(loc="outside upper center")
    return fig


def plot_distributions(data):
    """Histograms of height, width and hull area of a data set, and a scatter of height over width."""
    sizes = [one for one in basic() if one.is_size and one.variable in data]
    fig, axes = figure(1, len(sizes) + 1, height=5.0)
    for ax, one in zip(axes, sizes, strict=False):
        values = data[one.variable].values[data.converged.values]
        ax.hist(values, 40, color=COLOURS.wall, histtype="stepfilled")
        ax.axvline(values.mean(), color=COLOURS.target, linestyle="--", linewidth=1.2)
        ax.set_title(f"mean {values.mean():.3f}", color=COLOURS.target)
        ax.set_xlabel(f"{one.title} ${one.symbol}$")
        ax.set_ylabel("structures")
    axes[-1].plot(data.width, data.height, ".", color=COLOURS.wall, markersize=1.5, alpha=0.4, rasterized=True)
    axes[-1].set_xlabel("width $w$")
    axes[-1].set_ylabel("height $h$")
    return fig


def plot_inflated_gallery(results, titles, columns=6):
    """Inflated structures over their undeformed selves, on one common scale."""
    points = np.concatenate([np.zeros((1, 2)), *(np.vstack([one.nodes, one.deformed()]) for one in results)])
    wide, high = np.ptp(points, axis=0) + 0.1
    rows = max(1, -(-len(results) // columns))
    height = rows * (TEXT_WIDTH / columns * high / wide + 0.7)
    fig, axes = figure(rows, columns, height=height, sharex=True, sharey=True, squeeze=False)
    for ax in axes.flat:
        picture_axes(ax)
    for ax, result, title in zip(axes.flat, results, titles, strict=False):
        draw_inflated(ax, result)
        ax.set_title(title)
    _fit(axes.flat, points)
    return fig


def _fit(axes, points, margin=0.04):
    (left, bottom), (right, top) = points.min(axis=0) - margin, points.max(axis=0) + margin
    for ax in axes:
        ax.set_xlim(left, right)
        ax.set_ylim(min(bottom, -margin), top)


def plot_inflation(result, values, label, step):
    """The undeformed structure beside the deformed one, coloured by `values`, (steps, m), over its undeformed self."""
    fig, axes = figure(1, 2, width=15, height=8, sharex=True, sharey=True)
    draw_mesh(axes[0], result.nodes, result.cells)
    axes[0].set_title("undeformed")
    cells = _draw_coloured(axes[1], result, values, step)
    axes[1].set_title(_when(result, step))
    for ax in axes:
        draw_clamped_edge(ax, result.mesh)
    _fit(axes, np.concatenate([result.nodes, result.deformed(step)]))
    fig.colorbar(cells, ax=axes, label=label, shrink=0.8, aspect=30, extend="both")
    return fig


def animate_inflation(result, values, label, steps):
    """Figure and animation of the first `steps` load steps, after the undeformed state; the last one is held.

    `values` is (steps + 1, m), the undeformed state first.
    """
    fig, ax = figure(1, 1, width=10, height=9)
    fullest = int(np.argmax(np.abs(result.pressures[:steps])))  # sets the colours; a history may end at rest
    cells = _draw_coloured(ax, result, values[1:], fullest)
    draw_clamped_edge(ax, result.mesh)
    _fit([ax], np.concatenate([result.nodes, *result.displacement[:steps] + result.nodes]))
    fig.colorbar(cells, ax=ax, label=label, shrink=0.8, aspect=30, extend="both")
    title = ax.set_title(_when(result, steps - 1))
    fig.draw_without_rendering()
    fig.set_layout_engine("none")  # laid out once; again for each frame would take most of the time

    def draw(frame):
        step = min(frame, steps) - 1
        cells.set_verts((result.deformed(step) if step >= 0 else result.nodes)[result.cells])
        cells.set_array(values[step + 1])
        title.set_text(_when(result, step))
        return [cells, title]

    return fig, FuncAnimation(fig, draw, frames=steps + 1 + _HELD_FRAMES)


def _when(result, step):
    time, pressure = (result.load_steps[step], result.pressures[step]) if step >= 0 else (0.0, 0.0)
    return f"$t$ = {time:.3g}, pressure {pressure:.3g}"


def _draw_coloured(ax, result, values, step):
    """One load step over the undeformed shape, coloured cell by cell on a scale that one cell cannot eat."""
    draw_mesh(ax, result.nodes, result.cells, colour=COLOURS.shadow)
    nodes = result.deformed(step)
    cells = draw_mesh(ax, nodes, result.cells, colour=None, array=values[step], cmap=STRETCH_MAP)
    cells.set_clim(*np.percentile(values[step], [1, 99]))
    return cells
