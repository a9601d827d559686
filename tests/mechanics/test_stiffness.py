"""Walls of several rubbers: scaling, symmetry, an exact solution, and an independent potential."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from mechanics_peers import hook, potential

from inflate_lib import build_mesh, inflate, label_image
from inflate_lib.alternatives.reference import incompressible_tube, quarter_ring
from inflate_lib.alternatives.stabilised import inflate_with, residual
from inflate_lib.descriptors import describe
from inflate_lib.descriptors.registry import get_descriptor
from inflate_lib.inverse.adjoint import sensitivities
from inflate_lib.mechanics import peaks, von_mises
from inflate_lib.mechanics.contact import contact_forces, self_contact
from inflate_lib.mechanics.inflation import ELEMENTS, LAMBDA, MU, PRESSURE
from inflate_lib.structures.labels import WALL
from inflate_lib.structures.sources import load_sevens

DIGITS = load_sevens("digits").images
LABEL = hook()


def patterned(seed, label=LABEL, ratio=4.0):
    """A stiffness for each pixel: 1 or `ratio`, at random."""
    return np.random.default_rng(seed).choice([1.0, ratio], label.shape)


@pytest.mark.parametrize("number", range(0, 40, 8))
def test_one_rubber_is_the_same_to_the_last_bit_however_it_is_said(number):
    label = label_image(DIGITS[number])
    one, ones = inflate(label), inflate(label, stiffness=np.ones(label.shape))
    assert np.array_equal(one.displacement, ones.displacement)
    assert np.array_equal(one.first_piola_kirchhoff, ones.first_piola_kirchhoff)
    assert np.array_equal(von_mises(one), von_mises(ones))
    assert one.factorisations == ones.factorisations


@pytest.mark.parametrize("element", ELEMENTS)
def test_twice_the_stiffness_under_twice_the_pressure_has_the_same_shape(element):
    once = inflate(LABEL, element=element, stiffness=patterned(0))
    twice = inflate(LABEL, element=element, stiffness=2 * patterned(0), pressure=2 * PRESSURE)
    assert np.array_equal(once.displacement, twice.displacement)  # a factor of two rounds nothing
    assert np.array_equal(2 * once.first_piola_kirchhoff, twice.first_piola_kirchhoff)
    assert peaks(twice) == (2 * peaks(once)[0], peaks(once)[1])


@pytest.mark.parametrize("element", ELEMENTS)
def test_equilibrium_is_stationary_in_the_independent_potential(element):
    label, p = label_image(DIGITS[5]), 0.02
    stiffness = patterned(1, label)
    result = inflate(label, element=element, pressure=p, stiffness=stiffness)
    x = torch.from_numpy(result.deformed()).requires_grad_()
    shares = torch.from_numpy(stiffness[label == WALL])
    potential(result.mesh, x, p, element == "mean-dilatation", shares).backward()
    assert np.abs(x.grad.numpy()[~result.mesh.clamped]).max() < 1e-10 * LAMBDA
    other = torch.from_numpy(result.deformed()).requires_grad_()
    potential(result.mesh, other, p, element == "mean-dilatation").backward()
    assert np.abs(other.grad.numpy()[~result.mesh.clamped]).max() > 1e-4  # one rubber is not


def test_reported_stress_carries_the_pressure():
    """The work of P on any small move is that of the pressure, whose potential PyTorch has."""
    result = inflate(LABEL, pressure=0.02, stiffness=patterned(2))
    F, P = result.deformation_gradient[-1], result.first_piola_kirchhoff[-1]
    move = np.random.default_rng(0).normal(size=result.nodes.shape) * ~result.mesh.clamped[:, None]
    h = 1e-6
    moved = replace(result, displacement=result.displacement[-1:] + h * move).deformation_gradient[0]
    work = (P * (moved - F)).sum() / h / len(LABEL) ** 2 / 4  # a quarter of a pixel for each Gauss point
    edges = result.deformed()[result.mesh.pressure_edges], move[result.mesh.pressure_edges]
    along = np.diff(edges[0], axis=1)[:, 0]
    across = edges[1].mean(axis=1)
    swept = (along[:, 1] * across[:, 0] - along[:, 0] * across[:, 1]).sum()
    assert work == pytest.approx(0.02 * swept, rel=1e-5)


def test_tube_of_two_layers_converges_to_the_exact_radius():
    """Incompressible: each layer bears the pressure of a tube of its own that moves as the whole does."""
    inner, middle, outer, inflated, ratio, mu = 0.5, 0.75, 1.0, 0.6, 4.0, 1.0
    moved = np.hypot(middle, np.sqrt(inflated**2 - inner**2))  # r² = R² + c
    pressure = incompressible_tube(inflated, mu, inner, middle) + incompressible_tube(moved, ratio * mu, middle, outer)
    errors = []
    for n in (4, 8, 16):
        mesh = quarter_ring(n, inner, outer)
        radius = np.hypot(*mesh.nodes[mesh.cells].mean(axis=1).T)
        result = inflate(
            replace(mesh, stiffness=np.where(radius > middle, ratio, 1.0)), pressure=pressure, lame=(1e6 * mu, mu)
        )
        errors.append(np.hypot(*result.deformed()[np.isclose(np.hypot(*mesh.nodes.T), inner)].T).mean() - inflated)
    assert np.all(np.abs(errors) < [2e-3, 5e-4, 1.3e-4])
    assert 3 < errors[1] / errors[2] < 5  # second order


def test_mirrored_pattern_inflates_to_the_mirrored_shape():
    label = label_image(DIGITS[7])
    stiffness = patterned(3, label)
    left = inflate(label, stiffness=stiffness)
    right = inflate(label[:, ::-1], stiffness=stiffness[:, ::-1])
    mirrored = right.deformed() * [-1, 1] + [1, 0]
    order, other = np.lexsort(left.nodes.T.round(9)), np.lexsort((right.nodes * [-1, 1] + [1, 0]).T.round(9))
    assert np.allclose(left.deformed()[order], mirrored[other], atol=1e-9)
    assert peaks(left) == pytest.approx(peaks(right), rel=1e-8)


def test_finer_elements_keep_the_rubber_of_their_pixel():
    stiffness = patterned(4)
    fine = build_mesh(LABEL, 3, stiffness=stiffness)
    pixel = (fine.nodes[fine.cells].mean(axis=1) * len(LABEL)).astype(int)
    assert np.array_equal(fine.stiffness, stiffness[len(LABEL) - 1 - pixel[:, 1], pixel[:, 0]])


def test_sensitivities_are_derivatives_with_respect_to_the_stiffness():
    stiffness, h = patterned(5), 1e-5
    gradient = get_descriptor("area").gradient
    derivative = sensitivities(inflate(LABEL, stiffness=stiffness, pressure=0.03), gradient)
    wall = np.argwhere(LABEL == WALL)
    for e in (10, 40):
        areas = []
        for change in (h, -h):
            other = stiffness.copy()
            other[tuple(wall[e])] *= 1 + change
            areas.append(describe(inflate(LABEL, stiffness=other, pressure=0.03)).hull_area)
        assert derivative[e] == pytest.approx((areas[0] - areas[1]) / (2 * h), rel=1e-4, abs=1e-8)


def test_element_of_moose_takes_two_rubbers():
    stiffness = patterned(6)
    result = inflate_with(LABEL, "stabilised", stiffness=stiffness)
    assert result.converged
    assert np.abs(residual(result, result.deformed(), PRESSURE)[~result.mesh.clamped]).max() < 1e-10 * LAMBDA
    plain = inflate(LABEL, stiffness=stiffness)
    assert np.abs(result.displacement[-1] - plain.displacement[-1]).max() < 0.02


def test_contact_keeps_walls_of_two_rubbers_apart():
    for number in range(40):
        label = label_image(DIGITS[number])
        stiffness = patterned(number, label)
        if self_contact(inflate(label, stiffness=stiffness, pressure=0.02)):
            break
    result = inflate(label, stiffness=stiffness, pressure=0.02, contact=True)
    assert result.converged
    assert not self_contact(result)
    assert np.abs(contact_forces(result)).max() > 0
    twice = inflate(label, stiffness=2 * stiffness, pressure=0.04, contact=True)
    assert np.array_equal(twice.displacement, result.displacement)


def test_what_is_no_wall_is_not_looked_at():
    stiffness = np.where(LABEL == WALL, 2.0, np.nan)
    assert np.array_equal(
        inflate(LABEL, stiffness=stiffness).displacement, inflate(LABEL, lame=(2 * LAMBDA, 2 * MU)).displacement
    )


@pytest.mark.parametrize(
    ("stiffness", "message"),
    [
        (2.0, "one for each pixel"),
        (np.ones((28, 28)), r"of shape \(12, 12\), not \(28, 28\)"),
        (np.zeros((12, 12)), "row 2, column 1 it is 0"),
        (np.where(LABEL == WALL, np.inf, 1), "it is inf"),
        (np.where(LABEL == WALL, -1.0, 1), "it is -1"),
        ([["soft"] * 12] * 12, "must be numbers"),
        (np.ma.masked_equal(np.ones((12, 12)), 1), "must be numbers"),
    ],
)
def test_wrong_stiffness_is_named(stiffness, message):
    with pytest.raises(ValueError, match=f"^stiffness.*{message}"):
        inflate(LABEL, stiffness=stiffness)


def test_a_mesh_has_its_own_stiffness():
    mesh = build_mesh(LABEL, stiffness=patterned(0))
    assert np.array_equal(inflate(mesh).displacement, inflate(LABEL, stiffness=patterned(0)).displacement)
    with pytest.raises(ValueError, match="stiffness: a mesh has its own"):
        inflate(mesh, stiffness=patterned(0))
    for wrong in (0.0, -np.ones(len(mesh.cells)), np.ones(3), "stiff"):
        with pytest.raises(ValueError, match=r"^mesh: stiffness"):
            inflate(replace(mesh, stiffness=wrong))
