"""The benchmark compares like with like: every peer finds the displacements that we find."""

import sys
from pathlib import Path

import numpy as np
import pytest
from mechanics_peers import hook

from inflate_lib import build_mesh, inflate

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))
import opponents
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


def _searched(*hits, designs=0):
    """A record of benchmarks/opponents.py: after each second so many hits, and the designs in the end."""
    states = [[float(second), n, 0.001 if n else 0.02] for second, n in enumerate(hits)]
    return {"states": states, "errors": [0.001] * designs, "apart": 0.5 if designs > 1 else None, "tried": 8}


def test_opponents_are_compared_target_by_target():
    """Four targets: met by both, by one alone, by the other alone, by neither."""
    model = [_searched(0, 1, 3, designs=3), _searched(0, 0, 0), _searched(0, 0, 1, designs=1), _searched(0, 0, 0)]
    training = [_searched(0, 9, designs=9), _searched(0, 2, designs=2), _searched(0, 0, 0), _searched(0, 0, 0)]
    found = opponents.paired({"model": model, "training": training})
    assert (found["both"], found["neither"], found["only"]) == (1, 1, {"model": 1, "training": 1})
    assert found["p"] == 1 and found["more designs"][0] == pytest.approx((6 + 2 - 1 + 0) / 4)
    assert found["fewer designs"] == 1
    row = opponents.row_of("box", "model", model, np.array([0.0, 0.1, 0.2, 0.3]), 4)
    assert (row["n"], row["met"], row["met at a quarter"], row["met at half"]) == (4, 2, 1, 2)
    assert 0 < row["met low"] < 0.5 < row["met high"] < 1 and row["designs"] == 1
    assert (row["novelty"], row["copies"]) == (pytest.approx(15), 25)
