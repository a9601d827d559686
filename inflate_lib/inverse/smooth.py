"""From pixels to curves that one would cut: the borders of a structure as smooth closed lines, and a mesh between them.

The cavity's border is a level line of the cavity, blurred by a Gaussian; the level is that which keeps its area. All
else follows from distances to it. The wall reaches as far as its thickness t, so that it is as thick everywhere; where
two parts of it meet in a crease, a disc of radius r is to fit in from outside: a point is outside where it is nearer
than r to a point farther than t + r from the cavity (a morphological closing). A foot leads down to the ground.

φ, the smaller of the distance to the cavity and the distance to the outer border, is positive in the wall alone. A
lattice is laid over the frame; its points next to φ = 0 are moved there, what is still cut of its cells is cut along
φ = 0 (marching squares), and every piece, of n corners, is divided into n quadrilaterals. Their corners on the borders
lie on the curves.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from matplotlib.path import Path
from scipy import ndimage
from scipy.spatial import cKDTree

from inflate_lib._checks import positive_number, whole_number
from inflate_lib.descriptors import describe
from inflate_lib.inverse.constraints import Constraints
from inflate_lib.inverse.targets import Targets, deviations
from inflate_lib.mechanics.buildable import find_flaw
from inflate_lib.mechanics.inflation import Inflation, inflate
from inflate_lib.mechanics.mesh import Mesh, boundary_edges, boundary_loops
from inflate_lib.structures.labels import FRAME, THICKNESS, VOID, WALL, point_joints

_BLUR = 1.0  # standard deviation of the Gaussian, in pixels; less where the cavity would fall apart
_ROUND = 0.5  # r, in pixels
_FINE = 8  # samples of the blurred cavity per pixel
_DENSE = 0.04  # pixels between the points that stand for a curve
_NEAR = 0.3  # distance from the curve, in sides of a lattice cell, up to which a point of the lattice is moved to it
_STEP = 1e-4  # pixels, for the gradient of φ
_SMALL = 2e-3  # change for the derivatives of the correction, relative
_DAMPING = 0.03  # of its first step
_ROUNDS = 8


@dataclass(frozen=True)
class Plan:
    """A division of the plane into quadrilaterals, in lengths of the unit square: the frame, with a rim of a pixel.

    Attributes
    ----------
    points : (n, 2) float
    quads : (m, 4) int
        Corners, counter-clockwise.
    wall : (m,) bool
        Which of them are wall; the others are the cavity and what is outside.
    cavity : (m,) bool
        Which of them are the cavity.
    """

    points: np.ndarray
    quads: np.ndarray
    wall: np.ndarray
    cavity: np.ndarray

    def mesh(self) -> Mesh:
        """The wall as a mesh, clamped at y = 0, with the pressure on the border of the cavity."""
        used, cells = np.unique(self.quads[self.wall], return_inverse=True)
        number = np.full(len(self.points), -1)
        number[used] = np.arange(len(used))
        cavity = self.quads[self.cavity]
        sides = np.stack([cavity, np.roll(cavity, -1, axis=1)], axis=-1).reshape(-1, 2)
        border = {tuple(edge) for edge in boundary_edges(cavity).tolist()}
        edges = np.array([side for side in sides.tolist() if (min(side), max(side)) in border])
        nodes = self.points[used]
        return Mesh(nodes, cells.reshape(-1, 4), number[edges], nodes[:, 1] < 1e-9)


def pixel_plan(label: np.ndarray) -> Plan:
    """The pixels of a label image (28, 28), and a rim around them; a ValueError where no solid can be made of them."""
    if point_joints(label):  # there a solid would have no thickness
        raise ValueError("label: parts of the wall hold together in a single node, of which no solid can be made")
    cells = np.pad(np.asarray(label), 1)[::-1]
    x = (np.arange(FRAME + 3) - 1) / FRAME
    points = np.column_stack([np.tile(x, FRAME + 3), np.repeat(x, FRAME + 3)])
    return Plan(points, _lattice_cells(FRAME + 2), (cells == WALL).ravel(), (cells == VOID).ravel())


def smooth_cavity(label: np.ndarray, swell: float = 0.0) -> np.ndarray:
    """(n, 2) the border of the cavity of a label image (28, 28) as a smooth closed line, counter-clockwise, in pixels.

    Its area is that of the pixels, or larger by the share `swell`.

    Raises
    ------
    ValueError
        Where the cavity has parts that hang together in a corner of pixels only, which no smooth line encloses.
    """
    from skimage.measure import find_contours

    cavity = np.kron(np.pad(np.asarray(label) == VOID, 2)[::-1], np.ones((_FINE, _FINE)))
    for blur in _BLUR * 0.8 ** np.arange(6):
        grey = ndimage.gaussian_filter(cavity, blur * _FINE)
        level = np.sort(grey, axis=None)[-int((1 + swell) * cavity.sum())]
        if len(lines := find_contours(grey, level)) == 1:
            line = (lines[0][:-1, ::-1] + 0.5) / _FINE - 2
            return line if _area(line) > 0 else line[::-1]
    raise ValueError("label: no single smooth line goes around its cavity, whose parts meet in corners of pixels only")


def smooth_plan(
    cavity: np.ndarray, base: tuple[float, float], thickness: float = THICKNESS, per_pixel: int = 2
) -> Plan:
    """A structure with smooth borders.

    Parameters
    ----------
    cavity : (n, 2) float
        Border of its cavity, counter-clockwise, in pixels, from :func:`smooth_cavity`; lifted, where the wall below it
        would be thinner than `thickness`, and moved sideways, where the structure would leave the frame.
    base : (float, float)
        Between where the structure meets the ground, x in pixels; its foot is as wide as the structure is there.
    thickness : float
        Of the wall, in pixels.
    per_pixel : int
        Cells of the lattice per pixel and direction; elements are about half as long.

    Raises
    ------
    ValueError
        Where the structure does not fit into the frame, or an argument is none.
    """
    positive_number("thickness", thickness, "pixels")
    whole_number("per_pixel", per_pixel, 1, 8)
    low, (left, right) = cavity[:, 1].min(), (cavity[:, 0].min(), cavity[:, 0].max())
    shift = max(thickness - left, 0.0) + min(FRAME - thickness - right, 0.0)
    cavity = cavity + [shift, max(thickness - low, 0.0)]
    borders = _Borders(cavity, (base[0] + shift, base[1] + shift), thickness)
    plan = _cut(borders.phi, per_pixel)
    reach = plan.points[plan.quads[plan.wall]].reshape(-1, 2)
    if reach.min() < -1e-6 or reach.max() > FRAME + 1e-6:
        raise ValueError("the smooth structure does not fit into the frame")
    inside = borders.from_cavity(plan.points)[plan.quads].max(axis=1) < thickness / 2
    return replace(plan, points=plan.points / FRAME, cavity=~plan.wall & inside)


class _Borders:
    """Signed distances, in pixels, to the borders of a smooth structure."""

    def __init__(self, cavity, base, thickness):
        from skimage.measure import find_contours

        self.thickness, self.foot = thickness, None
        self.cavity, self.inside = _Curve([cavity]), Path(cavity)
        lines = np.arange(-4, FRAME + 4.1, 0.25)
        grid = np.stack(np.meshgrid(lines, lines), axis=-1)
        away = self.from_cavity(grid.reshape(-1, 2)).reshape(grid.shape[:2])
        level = find_contours(away, thickness + _ROUND)
        self.far = _Curve([line[:-1, ::-1] / 4 + lines[0] for line in level])
        top = cavity[:, 1].min() + 1  # of the foot
        x = np.arange(0, FRAME, _DENSE)
        parts, _ = ndimage.label(self.from_outside(np.column_stack([x, np.full_like(x, top)])) > 0)
        under = np.isin(parts, np.setdiff1d(parts[(x > base[0]) & (x < base[1])], [0]))
        if under.any():
            self.foot = x[under].min(), x[under].max(), top

    def from_cavity(self, points):
        """Distance from the cavity, negative in it."""
        return self.cavity.distance(points) * np.where(self.inside.contains_points(points), -1, 1)

    def from_outside(self, points):
        """Distance from the outer border, positive inside of it."""
        away = self.from_cavity(points)
        far = self.far.distance(points)
        inside = np.where(away < self.thickness + _ROUND, far, -far) - _ROUND
        if self.foot is not None:
            left, right, top = self.foot
            x, y = points.T
            inside = np.maximum(inside, np.minimum.reduce([x - left, right - x, top - y]))
        return np.maximum(inside, self.thickness - away)

    def phi(self, points):
        return np.minimum(self.from_cavity(points), self.from_outside(points))


class _Curve:
    """Closed lines, as points that lie close to one another."""

    def __init__(self, lines):
        lines = [_dense(line) for line in lines]
        self.points = np.concatenate(lines)
        ahead = np.concatenate([np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0) for line in lines])
        self.along = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        self.tree = cKDTree(self.points)

    def distance(self, points):
        """From the line through the points that is nearest."""
        away, nearest = self.tree.query(points)
        between = np.sum((points - self.points[nearest]) * self.along[nearest], axis=1)
        return np.sqrt(np.maximum(away**2 - np.minimum(np.abs(between), _DENSE / 2) ** 2, 0))


def _dense(line):
    """The points of a closed line at equal distances of about _DENSE."""
    closed = np.vstack([line, line[:1]])
    run = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = np.linspace(0, run[-1], max(8, int(run[-1] / _DENSE)), endpoint=False)
    return np.column_stack([np.interp(at, run, values) for values in closed.T])


def _lattice_cells(n):
    """(n², 4) corners of the cells of a lattice of (n + 1)² points, row by row, counter-clockwise."""
    row, column = np.divmod(np.arange(n**2), n)
    return (row * (n + 1) + column)[:, None] + np.array([0, 1, n + 2, n + 1])


def _cut(phi: Callable[[np.ndarray], np.ndarray], per_pixel: int) -> Plan:
    """The frame and its rim in pieces that lie on one side of φ = 0, all of them divided into quadrilaterals."""
    n = (FRAME + 2) * per_pixel
    x = np.arange(n + 1) / per_pixel - 1
    points = np.column_stack([np.tile(x, n + 1), np.repeat(x, n + 1)])
    above = points[:, 1] > -1e-9
    value = np.where(above, phi(points), -1.0)
    near = np.flatnonzero(above & (np.abs(value) < _NEAR / per_pixel))
    points[near], moved = _to_zero(phi, points[near], value[near])
    sign = np.sign(value).astype(int)
    sign[near[moved]] = 0

    cells = _lattice_cells(n)
    signs, ground = sign[cells], ~above[cells[:, 0]]
    centre = phi(points[cells].mean(axis=1)) > 0
    full = (signs >= 0).all(axis=1) & ((signs > 0).any(axis=1) | centre) & ~ground
    crossed = (signs * np.roll(signs, -1, axis=1) < 0).any(axis=1)
    empty = ((signs <= 0).all(axis=1) & ~full) | (ground & ~crossed)
    pieces, extra, cuts = [*cells[full].tolist(), *cells[empty].tolist()], [], {}
    wall = [True] * int(full.sum()) + [False] * int(empty.sum())

    def cut(i, j):
        i, j = min(i, j), max(i, j)
        if (i, j) not in cuts:
            share = value[i] / (value[i] - value[j])
            cuts[i, j] = len(points) + len(extra)
            extra.append(points[i] + share * (points[j] - points[i]))
        return cuts[i, j]

    for number in np.flatnonzero(~full & ~empty):
        ring = []
        corners = cells[number].tolist()
        for i, j in zip(corners, corners[1:] + corners[:1], strict=True):
            crosses = sign[i] * sign[j] < 0 and (not ground[number] or abs(points[i, 1] + points[j, 1]) < 1e-9)
            ring += [(i, sign[i]), (cut(i, j), 0)] if crosses else [(i, sign[i])]
        if ground[number]:
            pieces.append([i for i, _ in ring])
            wall.append(False)
            continue
        start = next(k for k, (_, side) in enumerate(ring) if side == 0)
        ring = [*ring[start:], *ring[: start + 1]]
        zeros = [k for k, (_, side) in enumerate(ring) if side == 0]
        runs = [ring[a : b + 1] for a, b in pairwise(zeros) if b > a + 1]
        pieces += [[i for i, _ in run] for run in runs]
        wall += [run[1][1] > 0 for run in runs]
        if len(zeros) > 3:  # what is left in the middle
            pieces.append([ring[k][0] for k in zeros[:-1]])
            wall.append(bool(centre[number]))
    points = np.concatenate([points, np.reshape(extra, (-1, 2))])
    points, quads, of = _divided(points, pieces)
    wall = np.array(wall)[of]
    both = np.intersect1d(quads[wall], quads[~wall])
    both = both[points[both, 1] > 1e-9]
    for _ in range(2):
        points[both], _ = _to_zero(phi, points[both], phi(points[both]))
    for k in (0, 1):  # the last points are the middles of the pieces, whose corners have moved
        around = np.bincount(of, points[quads[:, 0], k] + points[quads[:, 1], k])
        points[len(points) - len(pieces) :, k] = around / (2 * np.bincount(of))
    return Plan(points, quads, wall, np.zeros(len(quads), bool))


def _to_zero(phi, points, value):
    """Points moved to φ = 0 by a step of Newton, and which; those on the ground stay there, where they cannot."""
    shifts = _STEP * np.eye(2)
    slope = np.column_stack([phi(points + shift) - phi(points - shift) for shift in shifts]) / (2 * _STEP)
    slope[np.abs(points[:, 1]) < 1e-9, 1] = 0
    steep = np.sum(slope**2, axis=1)
    moved = steep > 0.25
    return points - np.where(moved, value / np.maximum(steep, 0.25), 0)[:, None] * slope, moved


def _divided(points, pieces):
    """Points, quadrilaterals (m, 4), and the piece that each is of: pieces of n corners, each in n quadrilaterals."""
    sizes = np.array([len(piece) for piece in pieces])
    here = np.concatenate(pieces)
    first = np.repeat(np.cumsum(sizes) - sizes, sizes)
    place = np.arange(len(here)) - first
    size = np.repeat(sizes, sizes)
    ahead = here[first + (place + 1) % size]
    sides, side = np.unique(np.sort(np.column_stack([here, ahead]), axis=1), axis=0, return_inverse=True)
    of = np.repeat(np.arange(len(pieces)), sizes)
    centres = np.column_stack([np.bincount(of, points[here, k]) for k in (0, 1)]) / sizes[:, None]
    side = side.ravel() + len(points)
    centre = of + len(points) + len(sides)
    quads = np.column_stack([here, side, centre, side[first + (place - 1) % size]])
    return np.concatenate([points, points[sides].mean(axis=1), centres]), quads, of


def _area(line):
    """Signed area inside a closed line (n, 2), positive where it runs counter-clockwise."""
    (x, y), (u, v) = line.T, np.roll(line, -1, axis=0).T
    return float(np.sum(x * v - u * y) / 2)


def _fields(points: np.ndarray, middle: float, symmetric: bool) -> np.ndarray:
    """(k, n, 2) displacements of points (n, 2), in pixels, by which a cavity is corrected: all that are quadratic.

    The first is a change of size, with the wall. Where `symmetric`, those that keep what is symmetric about
    x = `middle` so.
    """
    x, y = (points[:, 0] - middle) / FRAME, points[:, 1] / FRAME
    even, odd, none = [x * x, y * y], [x * y], np.zeros(len(points))
    aside, up = (odd, even) if symmetric else (odd + even + [y], odd + even + [x])
    fields = [(x, y), (x, -y), *((u, none) for u in aside), *((none, v) for v in up)]
    return FRAME * np.moveaxis(np.array(fields), 1, 2)


def smoothed(
    label: np.ndarray, targets: Targets, constraints: Constraints, goal: float
) -> tuple[Plan, Inflation] | None:
    """A structure with smooth borders that inflates to the targets, from one of pixels; None where there is none.

    What smoothing changes is undone by another size of all of it, by a wider or narrower cavity, and by displacing that
    (``_fields``), which the wall follows; it becomes no thinner than asked. How much, is found by the method of
    Levenberg and Marquardt.

    Parameters
    ----------
    label : (28, 28) float
    targets : Targets
        Without stress and stretch, whose peaks are those of a mesh of pixels.
    constraints : Constraints
    goal : float
        Largest relative error to stop at.

    Returns
    -------
    (Plan, Inflation) or None
        The nearest that was found, which can be built and fulfils the demands.
    """
    columns = np.flatnonzero(label[-1] == WALL)
    base, names = (columns[0], columns[-1] + 1), targets.asked
    wanted = [targets.vector(name) for name in names]
    scale = np.concatenate([np.full(v.size, np.abs(v).max() * np.sqrt(v.size)) for v in wanted])

    def fields(points):
        return _fields(points, sum(base) / 2, constraints.symmetric)

    def tried(amounts):
        """Largest error, misses, plan and inflation of the structure with the cavity swollen and displaced."""
        try:
            line = smooth_cavity(label, amounts[0])
            line = line + np.tensordot(amounts[1:], fields(line), 1)
            plan = smooth_plan(line, base, THICKNESS * max(1.0, 1 + amounts[1]))
            result = inflate(plan.mesh(), 1)
            shape = describe(result)
        except ValueError:  # it does not fit into the frame, falls apart, or has no equilibrium
            return np.inf, np.full(len(scale), np.inf), None, None
        return max(deviations(targets, shape).values()), misses(shape), plan, result

    def misses(shape):
        return np.concatenate([shape.vector(name) - v for name, v in zip(names, wanted, strict=True)]) / scale

    def derivatives(result, miss):
        """Of the misses, (n, k): each point of the mesh moves and turns with the border of the cavity next to it."""
        mesh, nodes, changed = result.mesh, FRAME * result.nodes, []
        ends = nodes[mesh.pressure_edges]
        along = ends[:, 1] - ends[:, 0]
        length = np.linalg.norm(along, axis=1)
        _, near = cKDTree(ends.mean(axis=1)).query(nodes)
        moves = fields(ends.reshape(-1, 2)).reshape(-1, *ends.shape)
        turns = ((moves[:, :, 1] - moves[:, :, 0]) * (along @ [[0, 1], [-1, 0]])).sum(axis=-1)[:, near] / length[
            near
        ] ** 2
        across = (nodes - ends.mean(axis=1)[near]) @ [[0, 1], [-1, 0]]
        moves = moves.mean(axis=2)[:, near] + turns[..., None] * across
        moves[0] = fields(nodes)[0]  # the wall changes its size with the cavity
        outwards = (along / length[:, None]) @ [[0, -1], [1, 0]]
        moves = np.concatenate([[(label == VOID).sum() / length.sum() * outwards[near]], moves])
        moves[:, mesh.clamped, 1] = 0
        for move in moves:
            other = inflate(replace(mesh, nodes=mesh.nodes + _SMALL / FRAME * move), 1)
            changed.append((misses(describe(other)) - miss) / _SMALL if other.converged else 0 * miss)
        return np.transpose(changed)

    here = np.zeros(1 + len(fields(np.zeros((1, 2)))))
    best = now = tried(here)
    damping, slopes = _DAMPING, None
    for _ in range(_ROUNDS):
        if best[0] <= goal or now[2] is None:
            break
        slopes = derivatives(now[3], now[1]) if slopes is None else slopes
        system = np.vstack([slopes, damping * np.eye(len(here))])
        change = np.linalg.lstsq(system, np.concatenate([-now[1], 0 * here]))[0]
        found = tried(here + change)
        if np.linalg.norm(found[1]) < np.linalg.norm(now[1]):
            slopes = slopes if found[0] < now[0] / 2 else None
            here, now, damping = here + change, found, damping / 3
            best = min(best, now, key=lambda one: one[0])
        else:
            damping *= 4
    _, _, plan, result = best
    if plan is None:
        return None
    result = inflate(plan.mesh())
    return None if find_flaw(result) or _breaks(constraints, plan, result) else (plan, result)


def _breaks(constraints, plan, result):
    """Whether a smooth structure breaks a demand; a disc stands for the square that has to pass through the cavity."""
    x, y = np.moveaxis(result.nodes[result.cells], -1, 0)
    twice = (x[:, 2] - x[:, 0]) * (y[:, 3] - y[:, 1]) - (x[:, 3] - x[:, 1]) * (y[:, 2] - y[:, 0])
    if twice.sum() / 2 > constraints.max_material:
        return True
    if constraints.min_void > 0:
        (loop,) = boundary_loops(plan.quads[plan.cavity])
        lines = (np.arange(FRAME * _FINE) + 0.5) / _FINE
        grid = np.stack(np.meshgrid(lines, lines), axis=-1).reshape(-1, 2)
        inside = Path(FRAME * plan.points[loop]).contains_points(grid).reshape(len(lines), -1)
        radius = constraints.min_void * FRAME / 2
        middles = ndimage.distance_transform_edt(inside) >= radius * _FINE - 1
        if ndimage.label(middles)[1] != 1:
            return True
        if ndimage.distance_transform_edt(~middles)[inside].max() > (radius + 1) * _FINE + 1:  # corners, a pixel deep
            return True
    return bool(constraints.broken_when_inflated(result))
