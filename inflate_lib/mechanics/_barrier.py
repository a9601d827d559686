"""Compiled code of the contact between walls: which edges are near or cross, the barrier, and steps that pass no wall.

Its mathematics is that of :mod:`inflate_lib.mechanics.contact`; the march that it is part of stands in
:mod:`inflate_lib.mechanics._kernels`.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

LEFT = 0.2  # share of a gap between walls that one Newton iteration leaves at least


class Walls(NamedTuple):
    """The boundary of a mesh, edges that belong to one element only, to be kept apart."""

    edges: np.ndarray  # (k, 2) nodes of the mesh
    weights: np.ndarray  # (k,) quarter of each undeformed length times the stiffness of the barrier
    gap: float
    number: np.ndarray  # (n,) free node of each node of the mesh, -1 where clamped
    x: np.ndarray  # (n, 2) positions of all nodes
    step: np.ndarray  # (n, 2) their move in an iteration
    sweep: np.ndarray  # (k,) edges from left to right, kept between calls


@njit(cache=True, nogil=True)
def _close_pairs(x, step, edges, reach, sweep):
    """Pairs of edges (·, 2) whose boxes, of the way from x to x + step and enlarged by `reach`, have points in common.

    A sweep from left to right: an edge is held against those that begin before it ends, which are few. `sweep` is
    brought into that order, which is quick where it was nearly so before. A pair is written before it is known to be
    one, because a processor foresees counting better than branching.
    """
    count, n = 0, len(edges)
    pairs, box = np.empty((8 * n, 2), dtype=np.int64), np.empty((n, 4))  # left, right, bottom, top
    for e in range(n):
        i, j = edges[e, 0], edges[e, 1]
        for d in range(2):
            a, b, c = x[j, d], x[i, d] + step[i, d], x[j, d] + step[j, d]
            box[e, 2 * d] = min(min(x[i, d], a), min(b, c)) - 0.5 * reach
            box[e, 2 * d + 1] = max(max(x[i, d], a), max(b, c)) + 0.5 * reach
    for last in range(1, n):
        e, place = sweep[last], last
        while place > 0 and box[sweep[place - 1], 0] > box[e, 0]:
            sweep[place] = sweep[place - 1]
            place -= 1
        sweep[place] = e
    for first in range(n):
        e = sweep[first]
        right, bottom, top = box[e, 1], box[e, 2], box[e, 3]
        if count + n > len(pairs):
            pairs = np.concatenate((pairs, pairs))
        for second in range(first + 1, n):
            f = sweep[second]
            if box[f, 0] > right:
                break
            pairs[count, 0], pairs[count, 1] = e, f
            count += (box[f, 2] <= top) & (box[f, 3] >= bottom)
    return pairs[:count]


@njit(cache=True, nogil=True)
def before_edges(x, step, edges, reach, sweep):
    """The ends of these edges before one another, (·, 4) int: a node, both ends of the other edge, its own edge.

    All others stay farther apart than `reach` on the way from x to x + step, along one of the axes.
    """
    pairs, count = _close_pairs(x, step, edges, reach, sweep), 0
    rows = np.empty((4 * len(pairs), 4), dtype=np.int64)
    for pair in range(len(pairs)):
        for side in range(2):
            own, other = pairs[pair, side], pairs[pair, 1 - side]
            j, k = edges[other, 0], edges[other, 1]
            for end in range(2):
                i = edges[own, end]
                rows[count, 0], rows[count, 1], rows[count, 2], rows[count, 3] = i, j, k, own
                count += (i != j) & (i != k)
    return rows[:count]


@njit(cache=True, nogil=True)
def near_edges(x, edges, reach, sweep):
    """Where an end of an edge is nearer than `reach` to another edge: rows as of :func:`before_edges`."""
    return nearer(x, before_edges(x, np.zeros_like(x), edges, reach, sweep), reach)


@njit(cache=True, nogil=True)
def nearer(x, rows, reach):
    """Those `rows` of :func:`before_edges` whose node is nearer than `reach` to the edge."""
    found, count = np.empty_like(rows), 0
    for row in range(len(rows)):
        for a in range(4):
            found[count, a] = rows[row, a]
        count += _distance(x, rows[row, 0], rows[row, 1], rows[row, 2])[0] < reach
    return found[:count]


@njit(cache=True, nogil=True)
def crossings(x, edges, sweep):
    """Pairs of edges (·, 2) that share no node and cross one another; those that merely touch are left out."""
    pairs, count = _close_pairs(x, np.zeros_like(x), edges, 0.0, sweep), 0
    for pair in range(len(pairs)):
        e, f = pairs[pair, 0], pairs[pair, 1]
        if _separation(x, edges, e, f) < 0.0:
            pairs[count, 0], pairs[count, 1] = min(e, f), max(e, f)
            count += 1
    return pairs[:count]


@njit(cache=True, nogil=True)
def first_touch(positions, edges, gap):
    """Index of the first of several states (states, n, 2) in which edges cross or come nearer than `gap`; or -1."""
    sweep = np.arange(len(edges))
    for state in range(len(positions)):
        if come_near(positions[state], edges, gap, sweep):
            return state
    return -1


@njit(cache=True, nogil=True)
def come_near(x, edges, gap, sweep):
    """Whether edges that share no node cross, or any come nearer than `gap`."""
    for pair in _close_pairs(x, np.zeros_like(x), edges, gap, sweep):
        if _separation(x, edges, pair[0], pair[1]) < gap:
            return True
    return False


@njit(cache=True, nogil=True)
def _separation(x, edges, e, f):
    """Smallest distance of an end of one edge from the other edge, shared ends left out; -1 where the two cross."""
    i, j, k, m = edges[e, 0], edges[e, 1], edges[f, 0], edges[f, 1]
    smallest, meet = np.inf, i in (k, m) or j in (k, m)
    if not meet and _side(x, i, j, k) * _side(x, i, j, m) < 0.0 and _side(x, k, m, i) * _side(x, k, m, j) < 0.0:
        return -1.0
    for node, start, end in ((i, k, m), (j, k, m), (k, i, j), (m, i, j)):
        if node not in (start, end):
            smallest = min(smallest, _distance(x, node, start, end)[0])
    return smallest


@njit(cache=True, nogil=True)
def _side(x, i, j, k):
    """Twice the signed area of the triangle i, j, k: positive where k is on the left of the way from i to j."""
    return (x[j, 0] - x[i, 0]) * (x[k, 1] - x[i, 1]) - (x[j, 1] - x[i, 1]) * (x[k, 0] - x[i, 0])


@njit(cache=True, nogil=True, error_model="numpy")
def _distance(x, i, j, k):
    """Distance of node i from the edge from j to k, and where along the edge the nearest point is, 0 at j, 1 at k."""
    ex, ey, rx, ry = x[k, 0] - x[j, 0], x[k, 1] - x[j, 1], x[i, 0] - x[j, 0], x[i, 1] - x[j, 1]
    t = min(1.0, max(0.0, (ex * rx + ey * ry) / (ex * ex + ey * ey)))
    return np.hypot(rx - t * ex, ry - t * ey), t


@njit(cache=True, nogil=True, error_model="numpy")
def barrier(x, i, j, k, gap, theta, gradient, hessian):
    """Potential β of node i before the edge from j to k, in lengths; its first and second derivatives are written to
    `gradient` (6) and `hessian` (6, 6), the second one with its geometric part multiplied by `theta`.

    β = b(distance from the edge) − ½ b(distance from j) − ½ b(distance from k), b(d) = −gap (1 − d/gap)² ln(d/gap).
    Each term is a distance d with ∂d = n·∂r, where ∂r is the move of the node relative to the nearest point of the
    edge, and ∂²d = −2 ω τ·∂r − d ω², where ω is the turn of the edge, or of the line between the node and an end.
    """
    gradient[:], hessian[:], energy = 0.0, 0.0, 0.0
    N, T, turn = np.zeros(6), np.zeros(6), np.zeros(6)
    t = _distance(x, i, j, k)[1]
    length = np.hypot(x[k, 0] - x[j, 0], x[k, 1] - x[j, 1])
    for term in range(3):
        share, factor = (t, 1.0) if term == 0 else (term - 1.0, -0.5)
        nx = x[i, 0] - (1.0 - share) * x[j, 0] - share * x[k, 0]
        ny = x[i, 1] - (1.0 - share) * x[j, 1] - share * x[k, 1]
        d = np.hypot(nx, ny)
        if d >= gap:
            continue
        nx, ny = nx / d, ny / d
        for a, c in enumerate((1.0, share - 1.0, -share)):
            N[2 * a], N[2 * a + 1], T[2 * a], T[2 * a + 1] = c * nx, c * ny, c * ny, -c * nx
        if 0.0 < share < 1.0:  # τ along the edge: (n_y, −n_x), or its opposite, with the turn the other way
            forward = 1.0 if ny * (x[k, 0] - x[j, 0]) - nx * (x[k, 1] - x[j, 1]) > 0.0 else -1.0
            c = forward / length
            turn[0], turn[1], turn[2], turn[3], turn[4], turn[5] = 0.0, 0.0, -c * nx, -c * ny, c * nx, c * ny
        else:
            for a in range(6):
                turn[a] = -T[a] / d
        u = d / gap
        log_u, v = np.log(u), 1.0 - u
        energy -= factor * gap * v * v * log_u
        slope = factor * (2.0 * v * log_u - v * v / u)
        curvature = factor * (-2.0 * log_u + 4.0 * v / u + v * v / (u * u)) / gap
        for a in range(6):
            gradient[a] += slope * N[a]
            for b in range(6):
                geometric = turn[a] * T[b] + T[a] * turn[b] + d * turn[a] * turn[b]
                hessian[a, b] += curvature * N[a] * N[b] - theta * slope * geometric
    return energy


@njit(cache=True, nogil=True)
def forces(walls, near):
    """First derivative of the barrier's potential with respect to the positions of all nodes, (n, 2)."""
    gradient, hessian, total = np.empty(6), np.empty((6, 6)), np.zeros_like(walls.x)
    for row in near:
        barrier(walls.x, row[0], row[1], row[2], walls.gap, 1.0, gradient, hessian)
        for a in range(3):
            for d in range(2):
                total[row[a], d] += walls.weights[row[3]] * gradient[2 * a + d]
    return total


@njit(cache=True, nogil=True)
def on_the_way(walls, s):
    """What may come nearer than two gaps in a share `s` of the step, and a little beyond: rows of `before_edges`."""
    return before_edges(walls.x, s / (1.0 - LEFT) * walls.step, walls.edges, 2.0 * walls.gap, walls.sweep)


@njit(cache=True, nogil=True)
def share_before_touch(walls, rows, s):
    """Largest share ≤ `s` of the step with which each node of `rows` that would pass its edge keeps a share of its
    distance.

    That distance counts as the gap's at most, so that a wall may come in one iteration to where the barrier acts.
    """
    for row in rows:
        s = _share_before_edge(walls.x, walls.step, row[0], row[1], row[2], walls.gap, s)
    return s


@njit(cache=True, nogil=True, error_model="numpy")
def _share_before_edge(x, move, i, j, k, gap, s):
    """The same for one node and one edge; twice the area of their triangle is quadratic in the share, and 0 where they
    lie on a line."""
    ex, ey, rx, ry = x[k, 0] - x[j, 0], x[k, 1] - x[j, 1], x[i, 0] - x[j, 0], x[i, 1] - x[j, 1]
    fx, fy = move[k, 0] - move[j, 0], move[k, 1] - move[j, 1]
    qx, qy = move[i, 0] - move[j, 0], move[i, 1] - move[j, 1]
    height, slope, bend = ex * ry - ey * rx, ex * qy - ey * qx + fx * ry - fy * rx, fx * qy - fy * qx
    discriminant = slope * slope - 4.0 * bend * height
    if discriminant < 0.0:
        return s
    stable = -0.5 * (slope + (np.sqrt(discriminant) if slope > 0.0 else -np.sqrt(discriminant)))
    hit = np.inf
    for up, down in ((stable, bend), (height, stable)):
        root = up / down if down != 0.0 else np.inf
        if 0.0 <= root < hit:
            ax, ay, bx, by = ex + root * fx, ey + root * fy, rx + root * qx, ry + root * qy
            if 0.0 <= ax * bx + ay * by <= ax * ax + ay * ay:
                hit = root
    distance = _distance(x, i, j, k)[0]
    return min(s, hit * (1.0 - LEFT * min(1.0, gap / distance)))
