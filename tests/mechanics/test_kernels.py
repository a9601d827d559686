"""The sparse factorisation against dense linear algebra, on matrices with the pattern of a mesh."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_peers import places, random_label

from inflate_lib import build_mesh
from inflate_lib.mechanics import _kernels


def random_matrix(seed):
    """(matrix, pattern, blocks): symmetric positive definite, assembled over the cells of a random mesh."""
    rng = np.random.default_rng(seed)
    mesh = build_mesh(random_label(seed, pixels=10))
    free = np.flatnonzero(~mesh.clamped)
    pattern = _kernels.pattern(len(free), renumbered(mesh, free))
    cells, n = renumbered(mesh, free[pattern.order]), 2 * len(free)
    matrix = np.diag(10.0 ** rng.uniform(-3, 0, n))
    for cell in cells:
        unknowns = (2 * cell[cell >= 0][:, None] + [0, 1]).ravel()
        root = rng.normal(size=(len(unknowns), len(unknowns)))
        matrix[np.ix_(unknowns, unknowns)] += root @ root.T
    return matrix, pattern, packed(matrix, pattern)


def renumbered(mesh, order):
    """Cells in the order of elimination, -1 for clamped nodes."""
    number = np.full(len(mesh.nodes), -1)
    number[order] = np.arange(len(order))
    return number[mesh.cells]


def packed(matrix, pattern):
    n = len(pattern.order)
    rows, columns = places(pattern)
    return matrix.reshape(n, 2, n, 2).transpose(0, 2, 1, 3)[rows, columns].reshape(-1, 4)


def factorised(pattern, blocks):
    """Number of block rows done, the blocks of L, the inverses of D."""
    blocks, inverses = blocks.copy(), np.empty((len(pattern.order), 4))
    return _kernels.factorise(pattern, blocks, inverses), blocks, inverses


seeds = st.integers(0, 2**32 - 1)


@given(seeds)
@settings(max_examples=60, deadline=None)
def test_solution_is_that_of_the_dense_matrix(seed):
    matrix, pattern, blocks = random_matrix(seed)
    done, lower, inverses = factorised(pattern, blocks)
    assert done == len(pattern.order)
    solution = np.random.default_rng(seed).normal(size=len(matrix))
    x = matrix @ solution
    _kernels.solve(pattern, lower, inverses, x)
    assert np.abs(matrix @ (x - solution)).max() <= 1e-10 * np.abs(matrix @ solution).max()
    assert np.allclose(x, np.linalg.solve(matrix, matrix @ solution), rtol=1e-7, atol=1e-7)


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_factors_multiply_to_the_matrix(seed):
    matrix, pattern, blocks = random_matrix(seed)
    _, lower, inverses = factorised(pattern, blocks)
    n = len(pattern.order)
    L, D = np.zeros((n, n, 2, 2)), np.zeros((n, n, 2, 2))
    rows, columns = places(pattern)
    L[rows, columns] = lower.reshape(-1, 2, 2)
    L[np.arange(n), np.arange(n)] = np.eye(2)
    D[np.arange(n), np.arange(n)] = np.linalg.inv(inverses.reshape(-1, 2, 2))
    L, D = (a.transpose(0, 2, 1, 3).reshape(2 * n, 2 * n) for a in (L, D))
    assert np.allclose(L @ D @ L.T, matrix, rtol=0, atol=1e-11 * np.abs(matrix).max())


@given(seeds, st.floats(1e-3, 1))
@settings(max_examples=30, deadline=None)
def test_indefinite_matrix_is_noticed(seed, share):
    matrix, pattern, _ = random_matrix(seed)
    lowest = np.linalg.eigvalsh(matrix)
    shift = lowest[0] + share * (lowest[1] - lowest[0]) + 1e-6  # moves the lowest eigenvalue below zero
    assert factorised(pattern, packed(matrix - shift * np.eye(len(matrix)), pattern))[0] < len(pattern.order)


def test_not_a_number_is_noticed():
    _, pattern, blocks = random_matrix(0)
    blocks[len(blocks) // 2] = np.nan
    assert factorised(pattern, blocks)[0] < len(pattern.order)


@given(seeds)
@settings(max_examples=60, deadline=None)
def test_pattern_is_that_of_the_elimination_and_no_larger(seed):
    """Eliminate the graph node by node, in dense boolean algebra; the pattern must hold the fill and nothing else."""
    mesh = build_mesh(random_label(seed))
    n = len(mesh.nodes)
    pattern = _kernels.pattern(n, mesh.cells)
    assert np.array_equal(np.sort(pattern.order), np.arange(n))
    filled = np.zeros((n, n), dtype=bool)
    for cell in np.argsort(pattern.order)[mesh.cells]:
        filled[np.ix_(cell, cell)] = True
    for j in range(n):
        below = j + 1 + np.flatnonzero(filled[j + 1 :, j])
        filled[np.ix_(below, below)] = True
    columns, rows = np.nonzero(np.triu(filled, 1))
    assert np.array_equal(rows, pattern.rows)
    assert np.array_equal(np.cumsum(np.bincount(columns, minlength=n)), pattern.column_start[1:])
    columns_of_rows, rows_of_columns = np.nonzero(np.tril(filled, -1))
    assert np.array_equal(rows_of_columns, pattern.columns)
    assert np.array_equal(np.cumsum(np.bincount(columns_of_rows, minlength=n)), pattern.row_start[1:])


def test_order_fills_in_less_than_that_of_superlu():
    """SuperLU's multiple minimum degree on the same graph; ours is a plain minimum degree and may be a little worse."""
    from scipy.sparse import coo_array, identity
    from scipy.sparse.linalg import splu

    ours = theirs = 0
    for seed in range(8):
        mesh = build_mesh(random_label(seed), refine=2)
        n = len(mesh.nodes)
        pairs = np.repeat(mesh.cells, 4, axis=1).ravel(), np.tile(mesh.cells, (1, 4)).ravel()
        graph = coo_array((np.ones(len(pairs[0])), pairs), shape=(n, n)).tocsc() + 100 * identity(n)
        options = {"SymmetricMode": True}
        lu = splu(graph.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        ours += len(_kernels.pattern(n, mesh.cells).rows) + n
        theirs += lu.L.nnz
    assert ours < 1.1 * theirs


def test_operations_are_counted():
    """The multiplications of a dense matrix of n block rows: n³ · 4/3 to leading order, here exactly."""
    n = 7
    pattern = _kernels.pattern(n, np.arange(n)[None])
    assert len(pattern.rows) == n * (n - 1) // 2
    inner = sum(i * (i - 1) // 2 for i in range(n))  # products of two blocks, 8 multiplications each
    assert pattern.multiplications == 8 * inner + 14 * len(pattern.rows)


def test_clamped_nodes_take_no_room():
    pattern = _kernels.pattern(3, np.array([[0, 1, -1, -1], [1, 2, -1, -1]]))
    assert len(pattern.rows) == 2
    assert len(pattern.order) == 3


@pytest.mark.parametrize("n", [1, 2])
def test_smallest_systems(n):
    pattern = _kernels.pattern(n, np.arange(n)[None])
    matrix = 4 * np.eye(2 * n) + 1
    done, lower, inverses = factorised(pattern, packed(matrix, pattern))
    x = np.arange(2.0 * n)
    assert done == n
    _kernels.solve(pattern, lower, inverses, x)
    assert np.allclose(matrix @ x, np.arange(2 * n))
