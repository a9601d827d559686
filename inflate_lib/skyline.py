"""Skyline (envelope) LDLᵀ factorisation of symmetric matrices with two unknowns per node, compiled with numba.

Row i of the lower triangle is stored from its first non-zero to the diagonal, row after row in one array: entry (i,
j) is ``values[offset[i] + j]``. The fill-in of the factorisation stays inside this envelope, which is narrow after a
reverse Cuthill–McKee ordering. The two rows of a node begin at the same column, so that the inner products are
taken in blocks of 2 × 2, which halves the memory traffic of the innermost loop.

numba keeps compiled code per file: what inflation.py compiled from here is not compiled again when this file changes,
so touch inflation.py after a change.
"""

import numpy as np
from numba import njit
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee


def bandwidth_order(n_nodes, cells):
    """Reverse Cuthill–McKee order of the nodes of a mesh.

    Parameters
    ----------
    n_nodes : int
    cells : (m, a) int
        Nodes that couple with one another; entries < 0 are ignored.

    Returns
    -------
    order : (n_nodes,) int
        order[k] is the node that comes k-th.
    """
    width = cells.shape[1]
    row, column = np.repeat(cells, width, axis=1).ravel(), np.tile(cells, (1, width)).ravel()
    both = (row >= 0) & (column >= 0)
    graph = coo_array((np.ones(both.sum(), dtype=np.int8), (row[both], column[both])), shape=(n_nodes, n_nodes))
    return reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True)


def envelope(n_nodes, cells):
    """Storage of the envelope: first column and offset of each row.

    Parameters
    ----------
    n_nodes : int
    cells : (m, a) int
        Nodes, already in the order of elimination; entries < 0 (clamped nodes) are ignored.

    Returns
    -------
    first : (2 n_nodes,) int
        First stored column of each row (even).
    offset : (2 n_nodes,) int
        Entry (i, j) lies at ``offset[i] + j``.
    size : int
        Number of stored entries.
    """
    lowest = np.where(cells >= 0, cells, n_nodes).min(axis=1)
    first_node = np.arange(n_nodes)
    kept = cells >= 0
    np.minimum.at(first_node, cells[kept], np.broadcast_to(lowest[:, None], cells.shape)[kept])
    first = np.repeat(2 * first_node, 2)
    length = np.arange(2 * n_nodes) - first + 1
    start = np.concatenate([[0], np.cumsum(length)])
    return first, start[:-1] - first, int(start[-1])


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def factorise(values, first, offset, inverse_pivots):
    """Overwrite the lower triangle A in `values` with L of A = L D Lᵀ, and `inverse_pivots` with 1 / D.

    Returns the number of rows done: the dimension, or less where a pivot is not positive.
    """
    n = first.size
    for i in range(0, n, 2):
        start = first[i]
        row0, row1 = offset[i], offset[i + 1]
        for j in range(start, i, 2):
            k0 = max(start, first[j])
            column0, column1 = offset[j], offset[j + 1]
            a00 = a01 = a10 = a11 = 0.0
            for k in range(k0, j):
                x0, x1 = values[row0 + k], values[row1 + k]
                y0, y1 = values[column0 + k], values[column1 + k]
                a00 += x0 * y0
                a01 += x0 * y1
                a10 += x1 * y0
                a11 += x1 * y1
            # The rows hold L D until they are complete.
            g00, g10 = values[row0 + j] - a00, values[row1 + j] - a10
            subdiagonal = values[column1 + j]
            values[row0 + j], values[row1 + j] = g00, g10
            values[row0 + j + 1] -= a01 + g00 * subdiagonal
            values[row1 + j + 1] -= a11 + g10 * subdiagonal
        b00 = b01 = b11 = 0.0
        for k in range(start, i):
            x0, x1 = values[row0 + k], values[row1 + k]
            l0, l1 = x0 * inverse_pivots[k], x1 * inverse_pivots[k]
            b00 += x0 * l0
            b01 += x1 * l0
            b11 += x1 * l1
            values[row0 + k], values[row1 + k] = l0, l1
        d0 = values[row0 + i] - b00
        if not d0 > 0.0:
            return i
        cross = values[row1 + i] - b01
        d1 = values[row1 + i + 1] - b11 - cross * cross / d0
        if not d1 > 0.0:
            return i + 1
        values[row0 + i], values[row1 + i], values[row1 + i + 1] = 1.0, cross / d0, 1.0
        inverse_pivots[i], inverse_pivots[i + 1] = 1.0 / d0, 1.0 / d1
    return n


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def solve(values, first, offset, inverse_pivots, x):
    """Overwrite the right-hand side `x` with the solution of L D Lᵀ x = b."""
    n = first.size
    for i in range(n):
        row, total = offset[i], 0.0
        for k in range(first[i], i):
            total += values[row + k] * x[k]
        x[i] -= total
    for i in range(n):
        x[i] *= inverse_pivots[i]
    for i in range(n - 1, -1, -1):
        row, xi = offset[i], x[i]
        for k in range(first[i], i):
            x[k] -= values[row + k] * xi
