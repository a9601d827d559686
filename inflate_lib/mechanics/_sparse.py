"""Sparse LDLᵀ factorisation of the symmetric matrices of a mesh, in blocks of 2 × 2, compiled with numba.

A matrix has one 2 × 2 block for each pair of nodes that share an element. Eliminating a node couples all its neighbours
with one another: its elements grow together into one. So the elements themselves say where the factor L fills in
(George and Liu's quotient graph), and the node to eliminate next is the one with the fewest neighbours left (minimum
degree). On a seven this takes three fifths of the arithmetic of a band, and a third when the mesh is refined by four.

A matrix is an array (blocks, 4) of 2 × 2 blocks: those of L, column after column, then those of the diagonal.

numba keeps compiled code per file: what inflation.py compiled from here is not compiled again when this file changes,
so touch inflation.py after a change.
"""

from typing import NamedTuple

import numpy as np
from numba import njit


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
    def n_blocks(self):
        """Number of blocks, those of the diagonal included."""
        return len(self.rows) + len(self.order)

    @property
    def multiplications(self):
        """Multiplications (and as many additions) of one factorisation, apart from the inverses of the pivots."""
        below = np.diff(self.column_start)
        return int(np.sum(4 * below * (below - 1) + 14 * below))


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
    return Pattern(*_eliminate(n_nodes, cells, valence))


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
            members = np.concatenate((members, np.empty_like(members)))
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

    number = np.empty(n, dtype=np.int64)
    number[order] = np.arange(n)
    # Sorted by counting: columns into rows, and rows back into columns.
    total = start[n]
    row_start, columns, rows = np.zeros(n + 1, dtype=np.int64), np.empty(total, np.int64), np.empty(total, np.int64)
    for k in range(total):
        row_start[number[members[k]] + 1] += 1
    row_start = np.cumsum(row_start)
    end_of_row, end_of_column = row_start[:-1].copy(), start[:-1].copy()
    for j in range(n):
        for k in range(start[j], start[j + 1]):
            row = number[members[k]]
            columns[end_of_row[row]] = j
            end_of_row[row] += 1
    for row in range(n):
        for k in range(row_start[row], row_start[row + 1]):
            column = columns[k]
            rows[end_of_column[column]] = row
            end_of_column[column] += 1
    return order, start, rows, row_start, columns


@njit(cache=True, nogil=True)
def block_number(pattern, row, column):
    """Number of the block of two nodes in the order of elimination, row >= column."""
    if row == column:
        return len(pattern.rows) + row
    start, end = pattern.column_start[column], pattern.column_start[column + 1]
    return start + np.searchsorted(pattern.rows[start:end], row)


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
