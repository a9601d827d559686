"""Pictures of structures and of what is measured on them: Figs. 2, 3, 4 and 6, and the pieces they are made of.

All pictures of structures live in the unit square of the frame: x to the right, y up.
"""

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import ListedColormap
from matplotlib.patches import Rectangle
from scipy.spatial import ConvexHull

from inflate_lib.descriptors import get_descriptor
from inflate_lib.descriptors.shape import axis_height, place_axis
from inflate_lib.mechanics.mesh import boundary_loops
from inflate_lib.plotting.style import COLOURS, LEVELS, MARKERS, TEXT_WIDTH, figure, picture_axes

_LABEL_COLOURS = ListedColormap(["white", COLOURS.wall, COLOURS.void])
_LEVEL_NAMES = ("low", "medium", "high")
_ABOVE = {"loc": "lower left", "bbox_to_anchor": (-0.14, 1), "ncols": 3, "handlelength": 0.9, "columnspacing": 0.9,
          "handletextpad": 0.4, "borderaxespad": 0.1}  # fmt: skip


def draw_mesh(ax, nodes, cells, *, colour=COLOURS.wall, edge="face", linewidth=0.4, **style):
    """Draw the quadrilaterals ``cells`` (m, 4) of ``nodes`` (n, 2) into a bare frame; returns the collection."""
    polygons = PolyCollection(nodes[cells], facecolors=colour, edgecolors=edge, linewidths=linewidth, **style)
    picture_axes(ax).add_collection(polygons, autolim=True)
    ax.autoscale_view()
    return polygons


def draw_shape(ax, mesh, nodes, *, outline=None, **style):
    """A structure whose mesh has its nodes at `nodes` (n, 2): light cavity, wall, clamped edge.

    `outline` is the colour of a thin line around the wall, none by default; `style` is that of :func:`draw_mesh`. The
    stiffer of two rubbers is darker, unless the style has another colour.
    """
    if not {"colour", "array"} & set(style) and np.ptp(mesh.stiffness):
        style["colour"] = np.where(mesh.stiffness > np.min(mesh.stiffness), COLOURS.stiff, COLOURS.wall)
    pressed = {frozenset(edge) for edge in mesh.pressure_edges.tolist()}
    borders = boundary_loops(mesh.cells)
    cavity = [nodes[loop] for loop in borders if frozenset(loop[:2].tolist()) in pressed]
    ax.add_collection(PolyCollection(cavity, facecolors=COLOURS.void, linewidths=0, zorder=0.4))
    cells = draw_mesh(ax, nodes, mesh.cells, **style)
    if outline:
        lines = [nodes[loop] for loop in borders]
        ax.add_collection(PolyCollection(lines, facecolors="none", edgecolors=outline, linewidths=0.35, zorder=1.5))
    draw_clamped_edge(ax, mesh, nodes)
    return cells


def draw_inflated(ax, result, step=-1, ghost=True, **style):
    """The structure at a load step (the last one by default), over a grey ghost of the undeformed one.

    `style` is that of :func:`draw_shape`. Returns the deformed nodes.
    """
    if ghost:
        draw_mesh(ax, result.nodes, result.cells, colour=COLOURS.shadow, zorder=0.5)
    deformed = result.deformed(step)
    draw_shape(ax, result.mesh, deformed, **style)
    return deformed


def draw_pairs(ax, results, wide=0.0, columns=0, styles=None):
    """Structures in a row on one scale: undeformed above, inflated below, each pair in a column as wide as it must be.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    results : sequence of inflate_lib.Inflation
    wide : float, optional
        Width of the row in frame sides, if it is to be wider than its columns.
    columns : int, optional
        How many structures share that width, if there are fewer here.
    styles : sequence of dict, optional
        For each inflated structure that of :func:`draw_shape`.

    Returns
    -------
    list of (n, 2) arrays
        The nodes of the inflated structures where they were drawn. Undeformed ones stand on y = 0.
    """
    room = max(wide, row_width(results)) - row_width(results)
    drop = 0.12 + max((result.deformed()[:, 1].max() for result in results), default=0.0)
    left, placed = 0.0, []
    for result, style in zip(results, styles or [{}] * len(results), strict=True):
        width = _pair_width(result) + room / max(columns, len(results))
        for nodes, low, look in ((result.nodes, 0.0, {}), (result.deformed(), drop, style)):
            middle = (nodes[:, 0].min() + nodes[:, 0].max()) / 2
            nodes = nodes + [left + width / 2 - middle, -low]
            draw_shape(ax, result.mesh, nodes, **look)
        placed.append(nodes)
        left += width
    low = min((nodes[:, 1].min() for nodes in placed), default=0.0)
    high = max((result.nodes[:, 1].max() for result in results), default=0.0)
    picture_axes(ax).set(xlim=(0, max(wide, left, 1.0)), ylim=(low - 0.06, high + 0.04))
    return placed


def row_width(results):
    """How wide the row of :func:`draw_pairs` is at least, in frame sides."""
    return sum(map(_pair_width, results))


def _pair_width(result):
    return 0.16 + max(np.ptp(result.nodes[:, 0]), np.ptp(result.deformed()[:, 0]))


def draw_clamped_edge(ax, mesh, nodes=None):
    """The clamped edge: a thick line along the nodes that are held, hatched like a wall on its far side."""
    nodes = mesh.nodes if nodes is None else nodes
    held = nodes[mesh.clamped]
    start, end = held.min(axis=0), held.max(axis=0)
    normal = np.argmin(end - start)  # 0 where the edge runs upwards, 1 where it runs sideways
    corner, size = start.copy(), end - start
    size[normal] = 0.03
    if start[normal] < nodes[:, normal].mean():
        corner[normal] -= 0.03
    ax.add_patch(Rectangle(corner, *size, facecolor="white", edgecolor=COLOURS.ink, hatch="//////", linewidth=0))
    ax.plot(*zip(start, end, strict=True), color=COLOURS.ink, linewidth=1.2, solid_capstyle="butt", zorder=3)


def draw_label(ax, label, grid=False):
    """A label image: wall dark, void light, outside white."""
    picture_axes(ax).imshow(label, cmap=_LABEL_COLOURS, vmin=-0.25, vmax=1.25)
    _frame(ax, label.shape)
    if grid:
        edges = np.arange(-0.5, len(label))
        ax.hlines(edges, -0.5, len(label) - 0.5, color="white", linewidth=0.15)
        ax.vlines(edges, -0.5, len(label) - 0.5, color="white", linewidth=0.15)


def plot_pipeline(stages):
    """Fig. 2: the seven stages from a grey image to labelled domains."""
    titles = (
        "grey image", "largest\ncomponent", "holes filled", "grown by\nthe wall",
        "digit laid\nover", "set on the\nbottom", "domains",
    )  # fmt: skip
    fig, axes = figure(1, 7, height=3.6)
    size = len(stages.grey)
    for ax, letter, title, (name, panel) in zip(axes, "abcdefg", titles, stages.items(), strict=True):
        if name == "domains":
            draw_label(ax, panel)
        else:
            picture_axes(ax).imshow(panel.astype(float), vmin=0, vmax=1)
        margin = (len(panel) - size) / 2  # d to f live on a wider canvas; show the frame in it
        ax.add_patch(
            Rectangle((margin - 0.5, margin - 0.5), size, size, fill=False, edgecolor=COLOURS.target, linewidth=0.9)
        )
        widest = (len(stages.composite) - size) / 2
        ax.set_xlim(margin - widest - 0.7, margin + size + widest - 0.3)
        ax.set_ylim(margin + size + widest - 0.3, margin - widest - 0.7)
        ax.set_xlabel(f"({letter}) {title}")
    return fig


def plot_padding(image, cut, kept):
    """A seven whose wall the frame would cut off, beside the structure without and with padding."""
    fig, axes = figure(1, 3, width=11, height=4.4)
    picture_axes(axes[0]).imshow(image)
    _frame(axes[0], image.shape)
    for ax, label in zip(axes[1:], (cut, kept), strict=True):
        draw_label(ax, label, grid=True)
    for ax, title in zip(axes, ("(a) grey image", "(b) cut by the frame", "(c) padded first"), strict=True):
        ax.set_xlabel(title)
    return fig


def plot_gallery(labels, columns=10):
    """Many label images in a grid."""
    rows = -(-len(labels) // columns)
    fig, axes = figure(rows, columns, height=1.7 * rows, squeeze=False)
    for ax in axes.flat:
        picture_axes(ax)
    for ax, label in zip(axes.flat, labels, strict=False):
        draw_label(ax, label)
    return fig


def plot_descriptors(result, description):
    """Fig. 3: height, width, bounding box, hull area and medial axis, each drawn on the inflated structure."""
    fig, axes = figure(1, 5, height=5.2, sharex=True, sharey=True)
    deformed = result.deformed()
    left, bottom = deformed.min(axis=0)
    right, top = deformed.max(axis=0)
    h, w = description.height, description.width
    hull = deformed[ConvexHull(deformed).vertices]
    for ax in axes:
        draw_inflated(ax, result)

    _measure(axes[0], (right + 0.1, bottom), (right + 0.1, top))
    axes[0].hlines([bottom, top], left, right + 0.13, color=COLOURS.target, linewidth=0.7, linestyle=":")
    _measure(axes[1], (left, top + 0.08), (right, top + 0.08))
    axes[1].vlines([left, right], bottom, top + 0.11, color=COLOURS.target, linewidth=0.7, linestyle=":")
    axes[2].add_patch(Rectangle((left, bottom), w, h, fill=False, edgecolor=COLOURS.target, linewidth=1.6))
    axes[3].fill(*hull.T, facecolor=COLOURS.low, alpha=0.25, zorder=0.5)
    axes[3].fill(*hull.T, fill=False, edgecolor=COLOURS.target, linewidth=1.6)
    axes[4].fill(*hull.T, fill=False, edgecolor=COLOURS.target, linewidth=0.9, linestyle="--")
    draw_axis(axes[4], place_axis(description.medial_axis, hull))
    titles = (
        f"(a) $h$ = {h:.3f}", f"(b) $w$ = {w:.3f}", f"(c) $(h, w)$\n= ({h:.3f}, {w:.3f})",
        f"(d) $A$ = {description.hull_area:.3f}", "(e) medial axis",
    )  # fmt: skip
    for ax, title in zip(axes, titles, strict=True):
        ax.set_xlabel(title)
    axes[0].set_xlim(min(left, result.nodes[:, 0].min()) - 0.05, right + 0.18)
    axes[0].set_ylim(-0.05, top + 0.15)
    return fig


def plot_medial_axes(results, descriptions):
    """How medial axes come about: above, the hull of each inflated structure, some of its chords and their midpoints;
    below, the midpoints alone, with x stretched."""
    tallest = max(description.height for description in descriptions)
    widths = [0.1 + description.width for description in descriptions]
    tall = TEXT_WIDTH * (tallest + 0.1) / sum(widths)
    fig, axes = figure(
        2, len(results), height=tall + 4.2, height_ratios=[tall, 3.4], width_ratios=widths, sharey="row", squeeze=False
    )
    for (ax, stretched), result, description in zip(axes.T, results, descriptions, strict=True):
        deformed = draw_inflated(ax, result, ghost=False)
        hull = deformed[ConvexHull(deformed).vertices]
        ax.fill(*hull.T, fill=False, edgecolor=COLOURS.target, linewidth=0.9, linestyle="--")
        points = place_axis(description.medial_axis, hull)
        for x, y in points[::3]:
            half = _half_chord(hull, y, x)
            ax.plot([x - half, x + half], [y, y], color=COLOURS.ink, linewidth=0.6)
        draw_axis(ax, points)
        draw_axis(stretched, description.medial_axis)
        stretched.set_xlabel("$x$")
    widest = 1.1 * max(np.abs(description.medial_axis[:, 0]).max() for description in descriptions)
    axes[0, 0].set_ylim(-0.08, 1.02 * tallest)
    for ax in axes[1]:
        ax.set_xlim(-widest, widest)
        ax.locator_params(axis="x", nbins=2)
        ax.xaxis.set_major_formatter("{x:g}")
        ax.axvline(0, color=COLOURS.ghost, linewidth=0.6, zorder=0)
    axes[1, 0].set_ylabel("$y$")
    return fig


def _half_chord(hull, y, middle):
    """Half the length of the hull's horizontal chord at height y: the first edge that a ray to the right meets."""
    start, end = hull, np.roll(hull, -1, axis=0)
    crossed = (start[:, 1] - y) * (end[:, 1] - y) < 0
    start, end = start[crossed], end[crossed]
    x = start[:, 0] + (y - start[:, 1]) / (end[:, 1] - start[:, 1]) * (end[:, 0] - start[:, 0])
    return max(x, default=middle) - middle


def draw_axis(ax, points, colour=COLOURS.target, size=2.6, **style):
    """The points of a medial axis, (30, 2), with a line through them."""
    ax.plot(*points.T, "o-", color=colour, markersize=size, linewidth=0.8, markeredgecolor="white",
            markeredgewidth=0.3, **style)  # fmt: skip


def plot_augmentation(images, titles):
    """Fig. 4: an image and some of its variants, side by side."""
    fig, axes = figure(1, len(images), width=2.9 * len(images), height=3.3, squeeze=False)
    for ax, image, title in zip(axes[0], images, titles, strict=True):
        picture_axes(ax).imshow(image)
        ax.set_xticks([9.5, 18.5])
        ax.set_yticks([9.5, 18.5])
        ax.grid(color=COLOURS.accent, linewidth=0.4, alpha=0.7)
        ax.tick_params(length=0, labelleft=False, labelbottom=False)
        ax.set_title(title)
    return fig


def plot_variant_counts(allowed, drawn):
    """How many variants each structure is allowed and how many were drawn; both int (n,)."""
    fig, axes = figure(1, 2, width=13, height=5.0)
    for ax, counts, colour, label in zip(
        axes, (allowed, drawn), (COLOURS.ghost, COLOURS.wall), ("allowed", "drawn"), strict=True
    ):
        values, structures = np.unique(counts, return_counts=True)
        ax.bar(values, structures, width=0.9, color=colour)
        ax.axvline(counts.mean(), color=COLOURS.ink, linestyle="--", linewidth=1.2, label=f"mean {counts.mean():.1f}")
        ax.set(xlabel=f"{label} variants of a structure", ylabel="structures")
        ax.legend(loc="upper right")
    return fig


def plot_clusters(matrices, clusters):
    """Fig. 6: the k-means clusters of height, width, bounding box and hull area, with their centroids.

    ``matrices`` and ``clusters`` map the descriptors' names to arrays (n, N) and to
    :class:`inflate_lib.experiments.targets.Clusters`. The outermost two structures in a thousand lie beyond the limits
    of the panels.
    """
    fig, axes = figure(-(-len(clusters) // 2), 2, height=5.0 * -(-len(clusters) // 2), squeeze=False)
    for ax, letter, name in zip(axes.flat, "abcdefgh", clusters, strict=False):
        *above, across = (get_descriptor(part) for part in get_descriptor(name).parts)
        draw = _cluster_scatter if above else _cluster_histogram
        draw(ax, matrices[name], clusters[name])
        ax.set_xlabel(f"({letter}) {across.title} ${across.symbol}$")
        ax.set_ylabel(f"{above[0].title} ${above[0].symbol}$" if above else "structures")
    return fig


def plot_chosen_axes(axes, chosen):
    """All medial axes, (n, 30, 2), as a faint cloud with the chosen ones on top; and size against shape of them all."""
    fig, (cloud, plane) = figure(1, 2, width=14, height=7.5)
    for axis in axes[:: max(1, len(axes) // 400)]:
        cloud.plot(*axis.T, color=COLOURS.ghost, linewidth=0.4, alpha=0.3)
    height = axis_height(axes)
    lean = axes[:, :, 0].mean(axis=1) / height
    plane.plot(lean, height, ".", color=COLOURS.ghost, markersize=1.5, rasterized=True)
    for number, row in enumerate(chosen):
        style = {"marker": MARKERS[number], "color": LEVELS[number], "markeredgecolor": COLOURS.ink}
        cloud.plot(*axes[row].T, markersize=3.5, markeredgewidth=0.4, linewidth=0.8, **style)
        plane.plot(lean[row], height[row], linestyle="none", markersize=8, label=f"axis {number + 1}", **style)
    cloud.set(xlabel="$x$ (stretched)", ylabel="$y$", xlim=(-0.3, 0.3))
    plane.set(xlabel="mean of $x$, in units of the height", ylabel="height $h$", xlim=_middle(lean))
    plane.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
    return fig


def _cluster_histogram(ax, values, clusters):
    members = [values[clusters.labels == level, 0] for level in range(len(LEVELS))]
    centroids = clusters.centroids[:, 0]
    labels = [f"{name}: {centroid:.3f}" for name, centroid in zip(_LEVEL_NAMES, centroids, strict=True)]
    ax.hist(members, 40, range=_middle(values), stacked=True, color=LEVELS, label=labels)
    for centroid in centroids:
        ax.axvline(centroid, color=COLOURS.ink, linewidth=1.0)
    ax.legend(**_ABOVE)


def _cluster_scatter(ax, values, clusters):
    for level, (h, w) in enumerate(clusters.centroids):
        members, style = values[clusters.labels == level], {"color": LEVELS[level], "marker": MARKERS[level]}
        ax.plot(*members.T[::-1], linestyle="none", markersize=1.5, markeredgewidth=0, rasterized=True, **style)
        style |= {"markeredgecolor": COLOURS.ink, "label": f"({h:.3f}, {w:.3f})"}
        ax.plot(w, h, linestyle="none", markersize=7, zorder=3, **style)
    ax.set(xlim=_middle(values[:, 1]), ylim=_middle(values[:, 0]))
    ax.legend(**_ABOVE)


def _middle(values):
    """The range that all but the outermost 1 in 500 values span, with a margin."""
    low, high = np.quantile(values, [0.001, 0.999])
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def _measure(ax, start, end):
    ax.annotate("", start, end, arrowprops={"arrowstyle": "<|-|>", "color": COLOURS.target, "linewidth": 1.2,
                                            "shrinkA": 0, "shrinkB": 0})  # fmt: skip


def _frame(ax, shape):
    ax.add_patch(
        Rectangle((-0.5, -0.5), shape[1], shape[0], fill=False, edgecolor=COLOURS.ghost, linewidth=0.8, clip_on=False)
    )
