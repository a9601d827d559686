"""The skyline factorisation against dense linear algebra, on matrices with the pattern of a mesh."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_peers import random_label

from inflate_lib import build_mesh, skyline


def random_matrix(seed):
    """(matrix, first, offset, values): symmetric positive definite, assembled over the cells of a random mesh."""
    rng = np.random.default_rng(seed)
    mesh = build_mesh(random_label(seed, pixels=10))
    free = np.flatnonzero(~mesh.clamped)
    order = free[skyline.bandwidth_order(len(free), renumbered(mesh, free))]
    cells, n = renumbered(mesh, order), 2 * len(free)
    matrix = np.diag(10.0 ** rng.uniform(-3, 0, n))
    for cell in cells:
        unknowns = (2 * cell[cell >= 0][:, None] + [0, 1]).ravel()
        root = rng.normal(size=(len(unknowns), len(unknowns)))
        matrix[np.ix_(unknowns, unknowns)] += root @ root.T
    first, offset, size = skyline.envelope(len(free), cells)
    return matrix, first, offset, packed(matrix, first, offset, size)


def renumbered(mesh, order):
    """Cells in the order of elimination, -1 for clamped nodes."""
    number = np.full(len(mesh.nodes), -1)
    number[order] = np.arange(len(order))
    return number[mesh.cells]


def packed(matrix, first, offset, size):
    values = np.full(size, np.nan)
    for i, (start, shift) in enumerate(zip(first, offset, strict=True)):
        values[shift + start : shift + i + 1] = matrix[i, start : i + 1]
    return values


seeds = st.integers(0, 2**32 - 1)


@given(seeds)
@settings(max_examples=60, deadline=None)
def test_solution_is_that_of_the_dense_matrix(seed):
    matrix, first, offset, values = random_matrix(seed)
    outside = np.tril(matrix)[np.arange(len(matrix)) < first[:, None]]
    assert not outside.any()  # the envelope holds every entry
    assert not np.isnan(values).any()  # and no entry twice
    solution = np.random.default_rng(seed).normal(size=len(matrix))
    x, inverse_pivots = matrix @ solution, np.empty(len(matrix))
    assert skyline.factorise(values, first, offset, inverse_pivots) == len(matrix)
    skyline.solve(values, first, offset, inverse_pivots, x)
    assert np.abs(matrix @ (x - solution)).max() <= 1e-10 * np.abs(matrix @ solution).max()
    assert np.allclose(x, np.linalg.solve(matrix, matrix @ solution), rtol=1e-7, atol=1e-7)


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_factors_multiply_to_the_matrix(seed):
    matrix, first, offset, values = random_matrix(seed)
    inverse_pivots = np.empty(len(matrix))
    skyline.factorise(values, first, offset, inverse_pivots)
    lower = np.zeros_like(matrix)
    for i, (start, shift) in enumerate(zip(first, offset, strict=True)):
        lower[i, start : i + 1] = values[shift + start : shift + i + 1]
    assert np.array_equal(np.diag(lower), np.ones(len(matrix)))
    assert np.allclose(lower / inverse_pivots @ lower.T, matrix, rtol=0, atol=1e-11 * np.abs(matrix).max())
    assert np.isclose(-np.log(inverse_pivots).sum(), np.linalg.slogdet(matrix)[1], rtol=1e-9)


@given(seeds, st.floats(1e-3, 1))
@settings(max_examples=30, deadline=None)
def test_indefinite_matrix_is_noticed(seed, share):
    matrix, first, offset, values = random_matrix(seed)
    lowest = np.linalg.eigvalsh(matrix)
    shift = lowest[0] + share * (lowest[1] - lowest[0]) + 1e-6  # moves the lowest eigenvalue below zero
    values = packed(matrix - shift * np.eye(len(matrix)), first, offset, len(values))
    assert skyline.factorise(values, first, offset, np.empty(len(matrix))) < len(matrix)


def test_not_a_number_is_noticed():
    matrix, first, offset, values = random_matrix(0)
    values[len(values) // 2] = np.nan
    assert skyline.factorise(values, first, offset, np.empty(len(matrix))) < len(matrix)


@given(seeds)
@settings(max_examples=60, deadline=None)
def test_order_is_a_permutation_that_narrows(seed):
    rng = np.random.default_rng(seed)
    mesh = build_mesh(random_label(seed))
    shuffle = rng.permutation(len(mesh.nodes))
    cells = shuffle[mesh.cells]
    order = skyline.bandwidth_order(len(mesh.nodes), cells)
    assert np.array_equal(np.sort(order), np.arange(len(mesh.nodes)))
    number = np.argsort(order)
    assert skyline.envelope(len(mesh.nodes), number[cells])[2] <= skyline.envelope(len(mesh.nodes), cells)[2]


def test_clamped_nodes_take_no_room():
    cells = np.array([[0, 1, -1, -1], [1, 2, -1, -1]])
    first, offset, size = skyline.envelope(3, cells)
    assert first.tolist() == [0, 0, 0, 0, 2, 2]
    assert size == 1 + 2 + 3 + 4 + 3 + 4
    assert (offset + np.arange(6)).tolist() == [0, 2, 5, 9, 12, 16]  # where the diagonal lies


@pytest.mark.parametrize("n", [1, 2])
def test_smallest_systems(n):
    cells = np.arange(n)[None]
    first, offset, size = skyline.envelope(n, cells)
    matrix = 4 * np.eye(2 * n) + 1
    values, inverse_pivots, x = packed(matrix, first, offset, size), np.empty(2 * n), np.arange(2.0 * n)
    assert skyline.factorise(values, first, offset, inverse_pivots) == 2 * n
    skyline.solve(values, first, offset, inverse_pivots, x)
    assert np.allclose(matrix @ x, np.arange(2 * n))
