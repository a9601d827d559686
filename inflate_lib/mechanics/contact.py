"""Self-contact: where the walls of an inflated structure pass through one another.

The simulation has no contact, as the paper's has none: walls that meet do not notice. Whether they did is a matter of
geometry. The boundary of the wall consists of the edges that belong to one element only; where two of them that share
no node cross, wall lies upon wall. Nothing can lie upon something else unseen, one wall wholly within another, say: as
long as no element is turned over, a place that is covered twice lies behind a border that crosses a border.
"""

import numpy as np
from numba import njit

from inflate_lib.mechanics.inflation import Inflation
from inflate_lib.mechanics.mesh import boundary_edges


def self_contact(result: Inflation, step: int = -1) -> int:
    """Number of pairs of boundary edges that cross one another in the deformed structure.

    Edges that share a node are left out, and so are edges that merely touch (an end of one lies on the other, or they
    lie along one another). Where two walls cross, there are at least two such pairs.

    Parameters
    ----------
    result : Inflation
    step : int
        Load step, the last one by default.

    Returns
    -------
    int
        0 where no wall crosses a wall, and also at a load step without an equilibrium.
    """
    return len(crossing_edges(result, step))


def first_contact(result: Inflation) -> int | None:
    """Index of the first load step at which walls cross one another, or None where they never do.

    Every load step is looked at, since walls may cross and part again, and none of the states between two of them.
    """
    step = first_crossing(result.nodes + result.displacement, boundary_edges(result.cells))
    return None if step < 0 else step


def crossing_edges(result, step=-1):
    """The pairs behind :func:`self_contact`, (k, 2, 2) int: pair, edge, node numbers of its two ends."""
    edges, positions = boundary_edges(result.cells), result.deformed(step)
    order, pairs = np.arange(len(edges)), np.empty((0, 2), dtype=np.int64)
    while (found := _find_crossings(positions, edges, pairs, order)) > len(pairs):
        pairs = np.empty((found, 2), dtype=np.int64)
    return edges[pairs[np.lexsort(pairs.T[::-1])]]


@njit(cache=True, nogil=True)
def first_crossing(positions, edges):
    """Index of the first of several states, positions (states, n, 2), in which edges (k, 2) cross; -1 for none."""
    order, none = np.arange(len(edges)), np.empty((0, 2), dtype=np.int64)
    for step in range(len(positions)):
        if _find_crossings(positions[step], edges, none, order):
            return step
    return -1


@njit(cache=True, nogil=True)
def _find_crossings(x, edges, pairs, order):
    """Number of proper crossings; the first ones are written to `pairs`, as many as it has rows.

    A sweep from left to right: an edge is held against those that begin before it ends, which are few. `order` is
    brought into that order, which is quick where it was nearly so before.
    """
    count, n = 0, len(edges)
    left, right, bottom, top = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for e in range(n):
        i, j = edges[e]
        left[e], right[e] = min(x[i, 0], x[j, 0]), max(x[i, 0], x[j, 0])
        bottom[e], top[e] = min(x[i, 1], x[j, 1]), max(x[i, 1], x[j, 1])
    for last in range(1, n):
        e, place = order[last], last
        while place > 0 and left[order[place - 1]] > left[e]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = e
    for first in range(n):
        e = order[first]
        i, j = edges[e]
        for second in range(first + 1, n):
            f = order[second]
            if left[f] > right[e]:
                break
            # NaN fails every comparison and ends at the last test
            if bottom[f] > top[e] or top[f] < bottom[e]:
                continue
            k, m = edges[f]
            if i in (k, m) or j in (k, m):
                continue
            here = _side(x, i, j, k) * _side(x, i, j, m)
            there = _side(x, k, m, i) * _side(x, k, m, j)
            if here < 0 and there < 0:
                if count < len(pairs):
                    pairs[count, 0], pairs[count, 1] = min(e, f), max(e, f)
                count += 1
    return count


@njit(cache=True, nogil=True)
def _side(x, i, j, k):
    """Twice the signed area of the triangle i, j, k: positive where k is on the left of the way from i to j."""
    return (x[j, 0] - x[i, 0]) * (x[k, 1] - x[i, 1]) - (x[j, 1] - x[i, 1]) * (x[k, 0] - x[i, 0])
