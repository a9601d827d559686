"""Peaks of stress and stretch: exact where the deformation is uniform, and what must leave them as they are."""

import numpy as np
import pytest
from mechanics_peers import hook

from inflate_lib import describe, inflate
from inflate_lib.mechanics.inflation import LAMBDA, MU, PRESSURE, Inflation
from inflate_lib.mechanics.mesh import Mesh
from inflate_lib.mechanics.stress import peaks, von_mises, von_mises_over_mu


def stretched(*gradients, lame=(LAMBDA, MU)):
    """One square element with a uniform deformation gradient, (2, 2), at each load step."""
    nodes = np.array([(0, 0), (1, 0), (1, 1), (0, 1.0)])
    mesh = Mesh(nodes, np.array([[0, 1, 2, 3]]), np.empty((0, 2), int), np.array([True, False, False, False]))
    moves = np.stack([nodes @ (np.array(F) - np.eye(2)).T for F in gradients])
    steps = np.arange(1, len(moves) + 1) / len(moves)
    return Inflation(mesh, "q1", steps, np.zeros(len(moves)), moves, True, "", 0, lame)


def test_peaks_are_those_of_uniform_stretch():
    """A square under plane strain, pulled to 1.5 times its length: the stretch and the stress are exact."""
    pulled = stretched(np.diag([1.2, 1]), np.diag([1.5, 1]))
    b = np.array([2.25, 1, 1])
    deviator = MU / 1.5 * (b - b.mean())
    assert peaks(pulled) == pytest.approx((np.sqrt(1.5 * (deviator**2).sum()), 1.5))
    assert peaks(pulled, 0)[1] == pytest.approx(1.2)


@pytest.mark.parametrize("s", [1.0, 1.1, 1.6, 2.5])
def test_without_a_change_of_volume_the_stretch_gives_the_stress(s):
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    stress, stretch = peaks(stretched(turn @ np.diag([s, 1 / s]) @ turn))
    assert stretch == pytest.approx(s, rel=1e-7)
    squares = (s**2 - s**-2) ** 2 + (s**-2 - 1) ** 2 + (1 - s**2) ** 2
    assert stress == pytest.approx(MU * np.sqrt(squares / 2), abs=1e-9)


def test_a_stiffer_rubber_at_a_higher_pressure_is_stretched_alike_and_stressed_more():
    """Forces scale, shapes do not: with λ, μ and p four times as large the stress is, too, and nothing else."""
    soft = describe(inflate(hook(), 3, pressure=2 * PRESSURE))
    stiff = describe(inflate(hook(), 3, pressure=8 * PRESSURE, lame=(4 * LAMBDA, 4 * MU)))
    assert stiff.peak_stress == pytest.approx(4 * soft.peak_stress, rel=1e-9)
    assert stiff.peak_stretch == pytest.approx(soft.peak_stretch, rel=1e-9) and soft.peak_stretch > 1.05
    assert stiff.height == pytest.approx(soft.height, rel=1e-9)


def test_stress_over_the_shear_modulus_knows_no_unit():
    """Pascal or the paper's unit: σ/μ, which pictures and tables show, is the same."""
    ours = inflate(hook(), 1)
    pascal = inflate(hook(), 1, pressure=1e5 * PRESSURE, lame=(1e5 * LAMBDA, 1e5 * MU))
    assert np.allclose(von_mises_over_mu(pascal), von_mises_over_mu(ours), rtol=1e-9)
    assert von_mises_over_mu(ours).max() == pytest.approx(peaks(ours)[0] / MU)


def test_a_mirrored_structure_has_the_same_peaks():
    one, other = (inflate(label, 2, pressure=0.02) for label in (hook(), hook()[:, ::-1]))
    assert peaks(other) == pytest.approx(peaks(one), rel=1e-9)
    assert peaks(one, 0)[0] < peaks(one)[0] == von_mises(one)[-1].max()


def test_a_shape_without_material_has_no_peaks():
    result = inflate(hook(), 2, pressure=0.02)
    by_nodes, whole = describe(result.deformed()), describe(result)
    assert np.isnan([by_nodes.peak_stress, by_nodes.peak_stretch]).all() and np.isnan(by_nodes.vector("stress")).all()
    assert np.array_equal(by_nodes.vector("axis"), whole.vector("axis"))
    assert (whole.peak_stress, whole.peak_stretch) == peaks(result)
    assert describe(result, 0).peak_stress == peaks(result, 0)[0]
