"""All compiled code of the inflation: assembly, sparse LDLᵀ factorisation, and the march through the load steps.

It is one file because numba keeps compiled code per file, and does not see that a function which it calls from another
file has changed; only contact has a file of its own (:mod:`inflate_lib.mechanics._barrier`). Loops stand in it where
NumPy has a function, because each such function adds to the seconds that the compiler takes. The mathematics of the
assembly is that of :mod:`inflate_lib.mechanics.inflation`.

A matrix has one 2 × 2 block for each pair of nodes that share an element. Eliminating a node couples all its neighbours
with one another: its elements grow together into one. So the elements themselves say where the factor L fills in
(George and Liu's quotient graph), and the node to eliminate next is the one with the fewest neighbours left (minimum
degree). On a seven this takes three fifths of the arithmetic of a band, and a third when the mesh is refined by four.

A matrix is an array (blocks, 4) of 2 × 2 blocks: those of L, column after column, then those of the diagonal.
"""

import os
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numba import njit

from inflate_lib.mechanics import _barrier

# What calls the other file is compiled anew where that was edited: numba looks at the date of this one alone.
if os.path.getmtime(_barrier.__file__) > os.path.getmtime(__file__):
    with suppress(OSError):
        os.utime(__file__)

MAX_ITERATIONS = 40  # Newton iterations of one load step
MAX_HALVINGS = 6  # of a load step that does not converge
MAX_MOVE = 0.1  # largest nodal move of one Newton iteration, in lengths of the unit square
MIN_J = 0.05  # smallest area ratio allowed on the way
TOLERANCE = 1e-11  # largest nodal move of an iteration at which a load step has converged
ROUNDED = 1e-8  # the same where rounding keeps the moves from shrinking any further
TURNED_OVER, UNCOUPLED = 1, 2  # why a load step was not reached
REUSE = 3e-5  # nodal move of an iteration from which on the tangent is kept


class Pattern(NamedTuple):
    """Where the factor of a mesh's matrix has blocks; nodes are numbered in the order of elimination.

    The block of row ``rows[k]`` in column j has number k, ``column_start[j] <= k < column_start[j + 1]``, and the
    diagonal block of node j has number ``len(rows) + j``.
    """

    order: np.ndarray  # (n,) order[j] is the node of the mesh that is eliminated j-th
    column_start: np.ndarray  # (n + 1,)
    rows: np.ndarray  # (b,) increasing in each column
    row_start: np.ndarray  # (n + 1,)
    columns: np.ndarray  # (b,) the columns of each row, increasing

    @property
    def multiplications(self):
        """Multiplications (and as many additions) of one factorisation, apart from the inverses of the pivots."""
        below = np.diff(self.column_start)
        return int(np.sum(4 * below * (below - 1) + 14 * below))


class System(NamedTuple):
    """Everything about a mesh and its material that an inflation does not change, in the order of elimination."""

    lam: float
    mu: float
    points: tuple  # 0, …, d − 1, an element's values of J; a tuple, so that the compiler knows how many there are
    pattern: Pattern
    order: np.ndarray  # (free,) mesh node of each free node
    x0: np.ndarray  # (2 free,) undeformed coordinates of the free nodes
    cells: np.ndarray  # (m, 4) free nodes of each element, -1 where clamped
    fixed: np.ndarray  # (m, 4, 2) coordinates, used where clamped
    kind: np.ndarray  # (m,) row of the tables below; one row serves all congruent elements of one rubber
    stiffness: np.ndarray  # (kinds, 4, 4) μ ∫ ∇N_a·∇N_b dV, times the relative stiffness of the rubber
    dilatation: np.ndarray  # (kinds, d, 4, 4) antisymmetric G with J = Σ x_a G_ab y_b
    weights: np.ndarray  # (kinds, d) undeformed area that belongs to each J, times the relative stiffness
    gauss: np.ndarray  # (kinds, 4, 4, 4) G at the Gauss points, whatever the element
    place: np.ndarray  # (m, 4, 4) block of each pair a >= b of an element's nodes, -1 where one is clamped
    edges: np.ndarray  # (k, 2) free nodes of the pressure edges, -1 where clamped
    edges_fixed: np.ndarray  # (k, 2, 2)
    constant: np.ndarray  # (blocks, 4) k, the part of the tangent that does not change
    pressure: np.ndarray  # (blocks, 4) H
    pinned: np.ndarray  # (free, 2) directions in which a node is held though it is free in the other; or no rows


class State(NamedTuple):
    """What depends on the positions; one set of arrays, written anew at each of them."""

    corners: np.ndarray  # (m, 4, 2) of each element, seen from its first one
    edge_corners: np.ndarray  # (k, 2, 2) of each pressure edge, likewise
    J: np.ndarray  # (m, d) ratio of deformed to undeformed area
    c: np.ndarray  # (m, d, 4, 2) ∂J/∂x of the element's corners
    log_j: np.ndarray  # (m, d) ln J
    pi: np.ndarray  # (m, d) what stands for λ ln J in the tangent
    slope: np.ndarray  # (m, d) w φ′
    curvature: np.ndarray  # (m, d) w φ″
    move: np.ndarray  # (4, 2) of the corners of one element
    residual: np.ndarray  # (2 free,) ∂Π/∂x
    tangent: np.ndarray  # (blocks, 4) ∂²Π/∂x², and its factor L
    inverses: np.ndarray  # (free, 4) of the factor D

    @classmethod
    def of(cls, system):
        """Room for the state of a system, with nothing in it."""
        m, d, n = len(system.cells), len(system.points), len(system.order)
        return cls(
            np.empty((m, 4, 2)), np.empty((len(system.edges), 2, 2)), np.empty((m, d)), np.empty((m, d, 4, 2)),
            np.empty((m, d)), np.empty((m, d)), np.empty((m, d)), np.empty((m, d)), np.empty((4, 2)),
            np.empty(2 * n), np.empty(system.constant.shape), np.empty((n, 4)),
        )  # fmt: skip


# --- sparse LDLᵀ -----------------------------------------------------------------------------------------------------


def pattern(n_nodes, cells):
    """Order of elimination and pattern of the factor.

    Parameters
    ----------
    n_nodes : int
    cells : (m, a) int
        Nodes that couple with one another; entries < 0 (clamped nodes) are ignored.

    Returns
    -------
    Pattern
    """
    cells = np.asarray(cells, dtype=np.int64)
    valence = np.bincount(cells[cells >= 0], minlength=1).max(initial=1)
    order, start, members = _eliminate(n_nodes, cells, valence)
    number = np.empty_like(order)
    number[order] = np.arange(n_nodes)
    rows, columns = number[members], np.repeat(np.arange(n_nodes), np.diff(start))
    row_start = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n_nodes))])
    by_column, by_row = np.sort(columns * n_nodes + rows), np.sort(rows * n_nodes + columns)
    return Pattern(order, start, by_column % n_nodes, row_start, by_row % n_nodes)


@njit(cache=True, nogil=True)
def _eliminate(n, cells, valence):
    """Minimum degree elimination on elements; the new element of the j-th node has the number m + j."""
    m = len(cells)
    elements, n_elements = np.empty((n, valence), dtype=np.int64), np.zeros(n, dtype=np.int64)
    for e in range(m):
        for node in cells[e]:
            if node >= 0:
                elements[node, n_elements[node]] = e
                n_elements[node] += 1
    order, start = np.empty(n, dtype=np.int64), np.zeros(n + 1, dtype=np.int64)
    members = np.empty(16 * n + 16, dtype=np.int64)  # of the new elements: the rows of L, column after column
    seen, merged = np.full(n, -1), np.zeros(m + n, dtype=np.bool_)
    counted, stamp, degree = np.zeros(n, dtype=np.int64), 0, np.empty(n, dtype=np.int64)
    for node in range(n):
        stamp, neighbours = stamp + 1, -1
        for e in elements[node, : n_elements[node]]:
            for other in cells[e]:
                if other >= 0 and counted[other] < stamp:
                    counted[other] = stamp
                    neighbours += 1
        degree[node] = neighbours
    for j in range(n):
        pivot = np.argmin(degree)
        order[j], degree[pivot], end = pivot, np.iinfo(np.int64).max, start[j]
        if end + n > len(members):
            shorter, members = members, np.empty(2 * len(members), dtype=np.int64)
            for k in range(end):
                members[k] = shorter[k]
        seen[pivot] = j
        for e in elements[pivot, : n_elements[pivot]]:
            merged[e] = True
            for node in cells[e] if e < m else members[start[e - m] : start[e - m + 1]]:
                if node >= 0 and seen[node] < j:
                    seen[node] = j
                    members[end] = node
                    end += 1
        start[j + 1] = end
        for node in members[start[j] : end]:
            kept, neighbours, stamp = 0, end - start[j] - 1, stamp + 1
            for k in range(start[j], end):
                counted[members[k]] = stamp
            for e in elements[node, : n_elements[node]]:
                if not merged[e]:
                    elements[node, kept] = e
                    kept += 1
                    for other in cells[e] if e < m else members[start[e - m] : start[e - m + 1]]:
                        if other >= 0 and counted[other] < stamp:
                            counted[other] = stamp
                            neighbours += 1
            elements[node, kept] = m + j
            n_elements[node], degree[node] = kept + 1, neighbours
    return order, start, members[: start[n]]


@njit(cache=True, nogil=True)
def block_number(pattern, row, column):
    """Number of the block of two nodes in the order of elimination, row >= column."""
    if row == column:
        return len(pattern.rows) + row
    low, high = pattern.column_start[column], pattern.column_start[column + 1]
    while low < high:
        middle = (low + high) // 2
        if pattern.rows[middle] < row:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def factorise(pattern, blocks, inverses):
    """Overwrite a matrix in `blocks` with L of A = L D Lᵀ, and `inverses` (n, 4) with the inverses of D's 2 × 2 blocks.

    Row i of L D solves a triangular system with the rows above it. Returns the number of block rows done: all n, or
    less where a pivot is not positive definite.
    """
    start, rows, row_start, columns = pattern.column_start, pattern.rows, pattern.row_start, pattern.columns
    n, n_lower = len(inverses), len(rows)
    done = start[:-1].copy()  # end of the part of each column that is finished
    w = np.empty((n, 4))  # the row at hand
    for i in range(n):
        row = columns[row_start[i] : row_start[i + 1]]
        for j in row:
            for d in range(4):
                w[j, d] = blocks[done[j], d]
        d00, d10, d11 = blocks[n_lower + i, 0], blocks[n_lower + i, 2], blocks[n_lower + i, 3]
        for j in row:
            x00, x01, x10, x11 = w[j, 0], w[j, 1], w[j, 2], w[j, 3]
            for k in range(start[j], done[j]):
                target = rows[k]
                l00, l01, l10, l11 = blocks[k, 0], blocks[k, 1], blocks[k, 2], blocks[k, 3]
                w[target, 0] -= x00 * l00 + x01 * l01
                w[target, 1] -= x00 * l10 + x01 * l11
                w[target, 2] -= x10 * l00 + x11 * l01
                w[target, 3] -= x10 * l10 + x11 * l11
            v00, v01, v11 = inverses[j, 0], inverses[j, 1], inverses[j, 3]
            l00, l01 = x00 * v00 + x01 * v01, x00 * v01 + x01 * v11
            l10, l11 = x10 * v00 + x11 * v01, x10 * v01 + x11 * v11
            d00 -= l00 * x00 + l01 * x01
            d10 -= l10 * x00 + l11 * x01
            d11 -= l10 * x10 + l11 * x11
            k = done[j]
            blocks[k, 0], blocks[k, 1], blocks[k, 2], blocks[k, 3] = l00, l01, l10, l11
            done[j] = k + 1
        determinant = d00 * d11 - d10 * d10
        if not (d00 > 0.0 and determinant > 0.0):
            return i
        inverses[i, 0], inverses[i, 3] = d11 / determinant, d00 / determinant
        inverses[i, 1] = inverses[i, 2] = -d10 / determinant
    return n


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def solve(pattern, blocks, inverses, x):
    """Overwrite the right-hand side `x` (2 n) with the solution of L D Lᵀ x = b, given what `factorise` left."""
    start, rows, n = pattern.column_start, pattern.rows, len(inverses)
    for j in range(n):
        x0, x1 = x[2 * j], x[2 * j + 1]
        for k in range(start[j], start[j + 1]):
            i = 2 * rows[k]
            x[i] -= blocks[k, 0] * x0 + blocks[k, 1] * x1
            x[i + 1] -= blocks[k, 2] * x0 + blocks[k, 3] * x1
    for j in range(n - 1, -1, -1):
        x0, x1 = x[2 * j], x[2 * j + 1]
        y0, y1 = inverses[j, 0] * x0 + inverses[j, 1] * x1, inverses[j, 2] * x0 + inverses[j, 3] * x1
        for k in range(start[j], start[j + 1]):
            i = 2 * rows[k]
            y0 -= blocks[k, 0] * x[i] + blocks[k, 2] * x[i + 1]
            y1 -= blocks[k, 1] * x[i] + blocks[k, 3] * x[i + 1]
        x[2 * j], x[2 * j + 1] = y0, y1


# --- assembly ---------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def assemble_constant(pattern, cells, kind, stiffness, edges):
    """The parts of the tangent that do not change, and where an element's blocks belong.

    Returns `constant`, the blocks of k (stiffness of μ/2 F:F), `pressure`, those of H (second derivative of the
    cavity's area), and `place`, all as in :class:`System`.
    """
    n_blocks = len(pattern.rows) + len(pattern.order)
    constant, pressure = np.zeros((n_blocks, 4)), np.zeros((n_blocks, 4))
    place = np.full((len(cells), 4, 4), -1)
    for e in range(len(cells)):
        for a in range(4):
            for b in range(a + 1):
                i, j = cells[e, a], cells[e, b]
                if i >= 0 and j >= 0:
                    place[e, a, b] = k = block_number(pattern, max(i, j), min(i, j))
                    constant[k, 0] += stiffness[kind[e], a, b]
                    constant[k, 3] += stiffness[kind[e], a, b]
    for edge in edges:  # A = ½ Σ (x_i y_j − x_j y_i)
        i, j = edge
        if i >= 0 and j >= 0:
            k = block_number(pattern, max(i, j), min(i, j))
            half = 0.5 if i > j else -0.5
            pressure[k, 1] += half
            pressure[k, 2] -= half
    return constant, pressure, place


@njit(cache=True, nogil=True)
def _gather(x, cells, fixed, out):
    """Deformed corners (m, 4, 2) of each element, seen from its first one: small numbers, so that little is rounded."""
    for e in range(len(cells)):
        for d in range(2):
            i = cells[e, 0]
            start = x[2 * i + d] if i >= 0 else fixed[e, 0, d]
            for a in range(cells.shape[1]):
                i = cells[e, a]
                out[e, a, d] = (x[2 * i + d] if i >= 0 else fixed[e, a, d]) - start


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def move_to(system, state, x):
    """Corners at the positions `x`, and J, ln J and ∂J/∂x; the first corner of each element is the origin."""
    _gather(x, system.cells, system.fixed, state.corners)
    _gather(x, system.edges, system.edges_fixed, state.edge_corners)
    corners, J, c = state.corners, state.J, state.c
    for e in range(len(corners)):
        for q in range(len(system.points)):
            G, value = system.dilatation[system.kind[e], q], 0.0
            for a in range(4):
                cx = cy = 0.0
                for b in range(1, 4):
                    cx += G[a, b] * corners[e, b, 1]
                    cy -= G[a, b] * corners[e, b, 0]  # G is antisymmetric
                c[e, q, a, 0], c[e, q, a, 1] = cx, cy
                value += corners[e, a, 0] * cx
            J[e, q] = value
            state.log_j[e, q] = np.log(value)


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def residual(system, state, p):
    """Gradient of the potential, r = k x + Σ w φ′ c − p ∂A/∂x, of the unknowns that are not held."""
    r, c, corners, slope = state.residual, state.c, state.corners, state.slope
    r[:] = 0.0
    for k in range(len(system.edges)):
        dx = state.edge_corners[k, 1, 0] - state.edge_corners[k, 0, 0]
        dy = state.edge_corners[k, 1, 1] - state.edge_corners[k, 0, 1]
        for end in range(2):
            node = system.edges[k, end]
            if node >= 0:
                r[2 * node] -= 0.5 * p * dy
                r[2 * node + 1] += 0.5 * p * dx
    for e in range(len(corners)):
        kind = system.kind[e]
        for q in range(len(system.points)):
            slope[e, q] = system.weights[kind, q] * (system.lam * state.log_j[e, q] - system.mu) / state.J[e, q]
        for a in range(4):
            i = system.cells[e, a]
            if i >= 0:
                fx = fy = 0.0
                for b in range(1, 4):
                    k_ab = system.stiffness[kind, a, b]
                    fx += k_ab * corners[e, b, 0]
                    fy += k_ab * corners[e, b, 1]
                for q in range(len(system.points)):
                    fx += slope[e, q] * c[e, q, a, 0]
                    fy += slope[e, q] * c[e, q, a, 1]
                r[2 * i] += fx
                r[2 * i + 1] += fy
    for i in range(len(system.pinned)):
        for d in range(2):
            if system.pinned[i, d]:
                r[2 * i + d] = 0.0


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def tangent(system, state, p, theta):
    """Blocks of the tangent; π stands for λ ln J and is blended with μ by `theta` (θ = 0: convex but for −p H)."""
    blocks, c, slope, curvature, mu = state.tangent, state.c, state.slope, state.curvature, system.mu
    for k in range(len(blocks)):
        for d in range(4):
            blocks[k, d] = system.constant[k, d] - p * system.pressure[k, d]
    for e in range(len(c)):
        kind = system.kind[e]
        for q in range(len(system.points)):
            w, j, blended = system.weights[kind, q], state.J[e, q], mu + theta * (state.pi[e, q] - mu)
            slope[e, q] = w * (blended - mu) / j
            curvature[e, q] = w * (system.lam - blended + mu) / (j * j)
        for a in range(4):
            for b in range(a + 1):
                k = system.place[e, a, b]
                if k < 0:
                    continue
                xx = xy = yx = yy = 0.0
                for q in range(len(system.points)):
                    gx, gy = curvature[e, q] * c[e, q, a, 0], curvature[e, q] * c[e, q, a, 1]
                    bx, by, g = c[e, q, b, 0], c[e, q, b, 1], slope[e, q] * system.dilatation[kind, q, a, b]
                    xx += gx * bx
                    xy += gx * by + g
                    yx += gy * bx - g
                    yy += gy * by
                if system.cells[e, a] < system.cells[e, b]:
                    xy, yx = yx, xy  # only the lower triangle is kept
                blocks[k, 0] += xx
                blocks[k, 1] += xy
                blocks[k, 2] += yx
                blocks[k, 3] += yy
    _pin(system.pattern, system.pinned, blocks)


@njit(cache=True, nogil=True)
def _pin(pattern, pinned, blocks):
    """Hold single unknowns: their rows and columns become those of the identity."""
    n_lower = len(pattern.rows)
    for column in range(len(pinned)):
        for k in range(pattern.column_start[column], pattern.column_start[column + 1]):
            row = pattern.rows[k]
            for d in range(4):
                if pinned[row, d // 2] or pinned[column, d % 2]:
                    blocks[k, d] = 0.0
        for d in range(4):
            if pinned[column, d // 2] or pinned[column, d % 2]:
                blocks[n_lower + column, d] = 1.0 if d in (0, 3) else 0.0


# --- march ------------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def march(system, state, pressures, allowed, walls, acting, start, last_pressure):
    """Follow the equilibrium through the load steps.

    Newton's method on Π, with two changes to the tangent. Mixed integration points (Magisano et al. 2017): λ ln J is
    replaced by its linear extrapolation from the last iterate. And once the moves are shorter than REUSE, a factorised
    tangent is used again as long as that shrinks the next move to a tenth or less, which makes the first move under a
    new pressure Euler's predictor. The residual, and so the solution, is that of Π. A load step that fails is
    approached in halves. After `allowed` factorisations it gives up, so that every structure ends in bounded time.

    With `walls` that are `acting`, the potential of the barrier between them is part of Π, and no iteration carries a
    node through an edge. Where they are not, the march ends before the first load step at which walls come near. Where
    they are None, what only they need is left out of the compiled code. The march begins from `start` (2 free), the
    equilibrium at `last_pressure`.

    Returns positions (steps + 1, 2 free), the number of load steps reached, the number of factorisations, and why the
    next one was not: 0, or TURNED_OVER, or UNCOUPLED, where walls come near whose nodes the pattern does not couple;
    then the last row of the positions is where that happened.
    """
    positions = np.empty((len(pressures) + 1, len(system.x0)))
    x, factorisations, converged = start.copy(), 0, False
    for target in range(len(pressures)):
        p, halvings = pressures[target], 0
        while True:  # sub-steps from last_pressure to pressures[target]
            trial = x.copy()
            converged, spent, coupled = _newton(
                system, state, trial, p, converged, allowed - factorisations, walls, acting
            )
            factorisations += spent
            if not coupled:
                positions[-1] = trial
                return positions, target, factorisations, UNCOUPLED
            if converged:
                x, last_pressure = trial, p
                if p == pressures[target]:
                    break
                p = pressures[target]
            else:
                halvings += 1
                if halvings > MAX_HALVINGS or factorisations >= allowed:
                    return positions, target, factorisations, 0
                p = 0.5 * (last_pressure + p)
        _gather(x, system.cells, system.fixed, state.corners)
        if _turned_over(state.corners, system.kind, system.gauss):
            return positions, target, factorisations, TURNED_OVER
        if walls is not None:
            spread(system, x, walls.x)
            if not acting and _barrier.come_near(walls.x, walls.edges, walls.gap, walls.sweep):
                positions[-1] = x
                return positions, target, factorisations, UNCOUPLED
        for i in range(len(x)):
            positions[target, i] = x[i]
    return positions, len(pressures), factorisations, 0


@njit(cache=True, nogil=True)
def _newton(system, state, x, p, factorised, allowed, walls, acting):
    """Move `x` to equilibrium under the pressure p, with the tangent that `state` has where it is `factorised` already.

    Returns whether that succeeded, so that a factorised tangent is left, the number of factorisations, and whether the
    pattern couples all that is near one another.
    """
    factorisations, last_length, step = 0, 0.0, state.residual
    if walls is not None:
        near = rows = np.empty((0, 4), dtype=np.int64)
        slack = 0.0  # all but the rows must move by so much to come near
    for iteration in range(MAX_ITERATIONS):
        move_to(system, state, x)
        if iteration == 0:
            for e in range(len(state.pi)):
                for q in range(len(system.points)):
                    state.pi[e, q] = system.lam * state.log_j[e, q]
        residual(system, state, p)
        if walls is not None:  # noqa: SIM102 - Numba leaves out what stands under this condition alone
            if acting:
                spread(system, x, walls.x)
                if iteration == 0:
                    rows, slack = _barrier.on_the_way(walls, 0.0), walls.gap
                near = _barrier.nearer(walls.x, rows, walls.gap)
                if not _couples(system.pattern, walls.number, near):
                    return False, factorisations, False
                push(system, state, walls, near)
        theta, fresh = 1.0, not factorised
        while not factorised:
            if factorisations >= allowed or theta < 0.0:
                return False, factorisations, True
            tangent(system, state, p, theta)
            if walls is not None:
                stiffen(system, state, walls, near, theta)
            factorisations += 1
            factorised = factorise(system.pattern, state.tangent, state.inverses) == len(state.inverses)
            if not factorised:
                theta = 0.5 * theta if theta > 0.25 else theta - 0.25  # 1, 0.5, 0.25, 0
        solve(system.pattern, state.tangent, state.inverses, step)
        length = 0.0
        for i in range(len(step)):
            if not np.isfinite(step[i]):
                return False, factorisations, True
            step[i] = -step[i]
            length = max(length, abs(step[i]))
        s = min(1.0, MAX_MOVE / max(length, MAX_MOVE))
        if walls is not None:  # noqa: SIM102
            if acting:
                spread(system, step, walls.step)
                slack -= 2.0 * s * length
                if slack < 0.0:
                    rows, slack = _barrier.on_the_way(walls, s), walls.gap
                if length > 0.01 * walls.gap:
                    s = _barrier.share_before_touch(walls, rows, s)
        if length > REUSE:  # shorter moves turn no element inside out, and are the last but a few
            s = _share_of_step(system, state, step, s)
        for i in range(len(x)):
            x[i] += s * step[i]
        shrinkage = length / last_length if last_length > 0.0 else 1.0
        whole = s == 1.0 and theta == 1.0  # θ = 1: positive definite, so stable
        stalled = fresh and length <= ROUNDED and shrinkage > 0.5
        if whole and (length <= TOLERANCE or stalled):
            return True, factorisations, True
        factorised = whole and length <= REUSE and shrinkage <= 0.1
        last_length = length
    return False, factorisations, True


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _share_of_step(system, state, step, longest):
    """Largest share s ≤ `longest` of a step along which every J stays above MIN_J; π is extrapolated along it."""
    s, move = longest, state.move
    for e in range(len(state.J)):
        for d in range(2):
            for a in range(4):
                i = system.cells[e, a]
                move[a, d] = step[2 * i + d] if i >= 0 else 0.0
            for a in range(3, -1, -1):
                move[a, d] -= move[0, d]
        for q in range(len(system.points)):
            G, c, slope, bend = system.dilatation[system.kind[e], q], state.c[e, q], 0.0, 0.0
            for a in range(4):
                cx = 0.0
                for b in range(1, 4):
                    cx += G[a, b] * move[b, 1]
                slope += c[a, 0] * move[a, 0] + c[a, 1] * move[a, 1]
                bend += move[a, 0] * cx
            s = _share_of_descent(state.J[e, q] - MIN_J, slope, bend, s)
            state.pi[e, q] = slope
    for e in range(len(state.J)):
        for q in range(len(system.points)):
            state.pi[e, q] = system.lam * (state.log_j[e, q] + s * state.pi[e, q] / state.J[e, q])
    return s


@njit(cache=True, nogil=True)
def _share_of_descent(height, slope, bend, s):
    """Largest share ≤ s up to which height + s·slope + s²·bend stays positive."""
    discriminant = slope * slope - 4 * bend * height
    if discriminant >= 0 and (slope < 0 or bend < 0):
        below = np.sqrt(discriminant) - slope  # the smallest positive root, in the form that does not cancel
        if below > 0:
            s = min(s, 2 * height / below)
    return s


@njit(cache=True, nogil=True)
def _turned_over(corners, kind, gauss):
    """Whether J ≤ 0 at a Gauss point, which a mean over the element does not show."""
    for e in range(len(corners)):
        for q in range(4):
            G, J = gauss[kind[e], q], 0.0
            for a in range(4):
                for b in range(1, 4):
                    J += corners[e, a, 0] * G[a, b] * corners[e, b, 1]
            if not J > 0.0:
                return True
    return False


# --- contact ----------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def spread(system, free, full):
    """Write the free nodes' values, (2 free,), into those of all nodes, (n, 2)."""
    for i in range(len(system.order)):
        full[system.order[i], 0], full[system.order[i], 1] = free[2 * i], free[2 * i + 1]


@njit(cache=True, nogil=True)
def _couples(pattern, number, near):
    """Whether a matrix of the pattern has a block for each two nodes of each row of `near`."""
    for row in near:
        for a in range(3):
            for b in range(a):
                i, j = max(number[row[a]], number[row[b]]), min(number[row[a]], number[row[b]])
                if j >= 0:
                    k = block_number(pattern, i, j)
                    if k == pattern.column_start[j + 1] or pattern.rows[k] != i:
                        return False
    return True


@njit(cache=True, nogil=True)
def push(system, state, walls, near):
    """Add the first derivative of the barrier's potential to the residual."""
    total = _barrier.forces(walls, near)
    for i in range(len(system.order)):
        for d in range(2):
            if not len(system.pinned) or not system.pinned[i, d]:
                state.residual[2 * i + d] += total[system.order[i], d]


@njit(cache=True, nogil=True)
def stiffen(system, state, walls, near, theta):
    """Add the second derivative of the barrier's potential to the tangent."""
    gradient, hessian = np.empty(6), np.empty((6, 6))
    for row in near:
        _barrier.barrier(walls.x, row[0], row[1], row[2], walls.gap, theta, gradient, hessian)
        for a in range(3):
            for b in range(3):
                i, j = walls.number[row[a]], walls.number[row[b]]
                if i >= j >= 0:
                    k = block_number(system.pattern, i, j)
                    for d in range(4):
                        state.tangent[k, d] += walls.weights[row[3]] * hessian[2 * a + d // 2, 2 * b + d % 2]
    _pin(system.pattern, system.pinned, state.tangent)
