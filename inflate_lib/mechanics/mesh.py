"""From a label image to a finite-element mesh of the wall (paper sec. 3).

Every wall pixel (label 0.5) becomes one quadrilateral, or ``refine × refine`` of them. The frame is the unit
square; its bottom edge is y = 0, where the structure is clamped if not asked otherwise. Edges between wall and void
carry the pressure.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from inflate_lib._checks import numbers, whole_number
from inflate_lib.structures.labels import OUTSIDE, VOID, WALL, is_open, turns_to_bottom


@dataclass(frozen=True)
class Mesh:
    """Quadrilateral mesh of a wall.

    Attributes
    ----------
    nodes : (n, 2) float
        Undeformed coordinates in lengths of the unit square.
    cells : (m, 4) int
        Node numbers of each quadrilateral, counter-clockwise.
    pressure_edges : (k, 2) int
        Node numbers of each edge between wall and void, with the cavity on the left-hand side, so that the edges
        run counter-clockwise around the cavity.
    clamped : (n,) or (n, 2) bool
        Nodes that cannot move: those on the clamped edge. With two columns, directions (x, y) in which a node cannot
        move, as on the symmetry lines of a verification problem.
    stiffness : (m,) float, or float
        Of each quadrilateral, what λ and μ are multiplied by: 1 where the wall is of one rubber.
    """

    nodes: np.ndarray
    cells: np.ndarray
    pressure_edges: np.ndarray
    clamped: np.ndarray
    stiffness: np.ndarray | float = 1.0


def build_mesh(
    label: np.ndarray, refine: int = 1, clamped: str = "bottom", stiffness: np.ndarray | None = None
) -> Mesh:
    """Mesh the wall of a label image.

    Parameters
    ----------
    label : (s, s) array_like
        Labels 0 (outside), 0.5 (wall), 1 (void), as :func:`inflate_lib.label_image` makes them.
    refine : int
        Sub-elements per pixel and direction.
    clamped : {"bottom", "left", "top", "right"}
        Edge of the image whose nodes cannot move. The ground behind it may close the cavity.
    stiffness : (s, s) array_like, optional
        Of each pixel, what λ and μ are multiplied by, in walls of several rubbers; what is no wall is not looked at.

    Returns
    -------
    Mesh

    Raises
    ------
    ValueError
        Where the labels are no label image, nothing is clamped, the wall falls into several pieces, or the cavity is
        missing or open; or where a pixel of the wall has no positive stiffness.
    """
    label = _check_label(label, clamped)
    whole_number("refine", refine, 1)
    relative = np.ones_like(label) if stiffness is None else _check_stiffness(stiffness, label)
    if refine > 1:
        label, relative = (np.kron(image, np.ones((refine, refine))) for image in (label, relative))
    size = len(label)

    # Lattice point (r, c) is the upper left corner of pixel (r, c); row 0 is the top of the picture.
    row, column = np.nonzero(label == WALL)
    corner = row * (size + 1) + column
    lattice_cells = corner[:, None] + np.array([size + 1, size + 2, 1, 0])  # counter-clockwise from lower left
    lattice_edges = _cavity_edges(label)

    used = np.zeros((size + 1) ** 2, dtype=bool)
    used[lattice_cells] = True
    number = np.cumsum(used) - 1
    lattice_row, lattice_column = np.divmod(np.flatnonzero(used), size + 1)
    x, y = lattice_column, size - lattice_row
    held = {"bottom": y == 0, "left": x == 0, "top": y == size, "right": x == size}[clamped]
    relative = 1.0 if stiffness is None else relative[row, column]
    return Mesh(np.column_stack([x, y]) / size, number[lattice_cells], number[lattice_edges], held, relative)


def check_mesh(mesh):
    """Return a mesh that was made by hand, or raise a ValueError that says why it cannot be inflated."""
    nodes, n = np.asarray(mesh.nodes), len(mesh.nodes)
    if nodes.dtype != float or nodes.shape != (n, 2) or not np.isfinite(nodes).all():
        raise ValueError("mesh: nodes must be finite coordinates in double precision, of shape (n, 2)")
    for name, width in (("cells", 4), ("pressure_edges", 2)):
        found = np.asarray(getattr(mesh, name))
        if found.ndim != 2 or found.shape[1] != width or not np.issubdtype(found.dtype, np.integer):
            raise ValueError(f"mesh: {name} must be node numbers of shape (·, {width}), not {found.shape}")
        if found.size and not 0 <= found.min() <= found.max() < n:
            raise ValueError(f"mesh: {name} has numbers outside 0 … {n - 1}")
    x, y = np.moveaxis(nodes[mesh.cells], -1, 0)
    twice_area = (x[:, 2] - x[:, 0]) * (y[:, 3] - y[:, 1]) - (x[:, 3] - x[:, 1]) * (y[:, 2] - y[:, 0])
    if not len(mesh.cells) or not np.all(twice_area > 0):
        raise ValueError("mesh: cells must be quadrilaterals with corners in counter-clockwise order, at least one")
    if len(np.unique(mesh.cells)) < n:
        raise ValueError("mesh: some nodes belong to no cell")
    clamped = np.asarray(mesh.clamped)
    if clamped.dtype != bool or clamped.shape not in ((n,), (n, 2)):
        raise ValueError(f"mesh: clamped must be bool of shape ({n},) or ({n}, 2), not {clamped.shape}")
    if clamped.all() or not clamped.any():
        raise ValueError("mesh: some nodes must be clamped, and some free")
    stiffness = numbers("mesh: stiffness", mesh.stiffness, "a positive number, or one for each cell")
    if stiffness.shape not in ((), (len(mesh.cells),)) or not np.all(stiffness > 0):
        raise ValueError(f"mesh: stiffness must be a positive number, or one for each of {len(mesh.cells)} cells")
    return mesh


def _check_label(label, clamped="bottom"):
    """Return `label` as a float array, or raise a ValueError that says why it cannot be inflated."""
    turns = turns_to_bottom(clamped)
    label = numbers("label", label, "an array of 0 (outside), 0.5 (wall) and 1 (void)")
    if label.ndim != 2 or label.shape[0] != label.shape[1] or label.size == 0:
        raise ValueError(f"label: a square image is needed, not an array of shape {label.shape}")
    wall, void = label == WALL, label == VOID
    if not np.all(wall | void | (label == OUTSIDE)):
        raise ValueError("label: values must be 0 (outside), 0.5 (wall) or 1 (void); make them with label_image(image)")
    if not wall.any():
        raise ValueError("label: there is no wall (0.5)")
    if not void.any():
        raise ValueError("label: there is no void (1) to put under pressure")
    if not np.rot90(wall, turns)[-1].any():
        raise ValueError(f"label: nothing is clamped, because no wall reaches the {clamped} edge of the image")
    pieces = ndimage.label(wall)[1]  # connected by edges: two pixels that share a corner only would make a hinge
    if pieces > 1:
        raise ValueError(f"label: the wall falls into {pieces} pieces that share no edge")
    if is_open(label, clamped):
        raise ValueError("label: the cavity is open, because a void pixel (1) touches the outside (0) or the frame")
    return label


def _check_stiffness(stiffness, label):
    """Return `stiffness` as a float array, or raise a ValueError that says what is wrong with it."""
    wanted = "numbers, one for each pixel of the label image"
    stiffness = numbers("stiffness", stiffness, wanted, finite=False)
    if stiffness.shape != label.shape:
        raise ValueError(f"stiffness must be {wanted}, of shape {label.shape}, not {stiffness.shape}")
    bad = (label == WALL) & ~((stiffness > 0) & np.isfinite(stiffness))
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise ValueError(
            f"stiffness must be positive wherever there is wall; in row {row}, column {column} it is "
            f"{stiffness[row, column]:g} (1 is the material itself)"
        )
    return stiffness


def _cavity_edges(label):
    """Edges between void and wall as pairs of lattice points, counter-clockwise around the void."""
    size = len(label)
    void, wall = label == VOID, np.pad(label == WALL, 1)
    lattice = np.arange((size + 1) ** 2).reshape(size + 1, size + 1)
    upper_left, upper_right = lattice[:-1, :-1], lattice[:-1, 1:]
    lower_left, lower_right = lattice[1:, :-1], lattice[1:, 1:]
    sides = (  # where the wall is beyond a side of a pixel, and the ends of that side
        (wall[2:, 1:-1], lower_left, lower_right),
        (wall[1:-1, 2:], lower_right, upper_right),
        (wall[:-2, 1:-1], upper_right, upper_left),
        (wall[1:-1, :-2], upper_left, lower_left),
    )
    return np.concatenate([np.column_stack([start[void & there], end[void & there]]) for there, start, end in sides])


def boundary_edges(cells):
    """Edges that belong to one quadrilateral only.

    Parameters
    ----------
    cells : (m, 4) int
        Node numbers, in order around each quadrilateral.

    Returns
    -------
    (k, 2) int
        Node numbers of the two ends of each edge, the smaller first.
    """
    starts, base = np.asarray(cells, dtype=np.int64), np.max(cells) + 1
    ends = starts[:, [1, 2, 3, 0]]
    codes = np.sort(np.ravel(np.minimum(starts, ends) * base + np.maximum(starts, ends)))
    differs = np.concatenate([[True], codes[1:] != codes[:-1], [True]])
    return np.column_stack(np.divmod(codes[differs[1:] & differs[:-1]], base))


def boundary_loops(cells):
    """Closed lines around quadrilaterals: their outer border, and the border of each hole.

    Where two quadrilaterals meet at a corner only, a loop goes on along the other one, so that it keeps to one hole, or
    to the outside. It may then pass through a node twice.

    Parameters
    ----------
    cells : (m, 4) int
        Node numbers, counter-clockwise around each quadrilateral.

    Returns
    -------
    list of (k,) int
        Node numbers in order, the last joined to the first, with the quadrilaterals on the left-hand side.
    """
    border = {tuple(edge) for edge in boundary_edges(cells).tolist()}
    cell_of, leaving = {}, {}  # edges as (start, end)
    for cell, corners in enumerate(cells.tolist()):
        for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
            if (min(start, end), max(start, end)) in border:
                cell_of[start, end] = cell
                leaving.setdefault(start, []).append((start, end))
    following = {}
    for edge, cell in cell_of.items():
        ways = leaving[edge[1]]
        following[edge] = next((way for way in ways if cell_of[way] != cell), ways[0])
    loops = []
    while following:
        edge, loop = next(iter(following)), []
        while edge in following:
            loop.append(edge[0])
            edge = following.pop(edge)
        loops.append(np.array(loop))
    return loops
