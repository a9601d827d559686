"""The benchmark compares like with like: every peer finds the displacements that we find."""

import sys
from pathlib import Path

import numpy as np
import pytest
from mechanics_peers import hook

from inflate_lib import build_mesh, inflate

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))
import peers


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize(
    "solver",
    [peers.felupe_as_documented, peers.felupe_tuned, peers.scikit_fem_as_documented, peers.scikit_fem_tuned],
)
def test_peers_of_the_benchmark_solve_the_same_problem(solver, n_steps):
    mesh = build_mesh(hook())
    displacement, solves = solver(mesh, n_steps)
    ours = inflate(mesh, n_steps, "q1").displacement[-1]
    assert np.abs(ours).max() > 0.04
    np.testing.assert_allclose(displacement, ours, atol=1e-6)
    assert solves >= n_steps
