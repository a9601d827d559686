"""MOOSE's stabilised element: what it keeps exactly, and how little it differs from mean dilatation."""

from dataclasses import replace

import numpy as np
import pytest
from mechanics_peers import hook

from inflate_lib import describe, label_image
from inflate_lib.alternatives.reference import quarter_ring, tube
from inflate_lib.alternatives.stabilised import StabilisedInflation, inflate_with, residual
from inflate_lib.descriptors import get_descriptor
from inflate_lib.inverse import sensitivities
from inflate_lib.mechanics import material
from inflate_lib.mechanics.inflation import LAMBDA, MU, Inflation, shape_gradients
from inflate_lib.mechanics.mesh import Mesh, build_mesh
from inflate_lib.mechanics.stress import cauchy_stress, von_mises
from inflate_lib.structures.sources import load_sevens

SIZES, BOTH = ("height", "width", "hull_area"), ("stabilised", "mean-dilatation")


def held(mesh, positions, kind=StabilisedInflation):
    """A result with these deformed positions, to ask it for F and P."""
    moves = (positions - mesh.nodes)[None]
    return kind(mesh, "q1", np.ones(1), np.zeros(1), moves, True, "", 0, (LAMBDA, MU))


@pytest.fixture
def patch():
    """Nine distorted quadrilaterals."""
    number = np.arange(16).reshape(4, 4)
    cells = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], -1).reshape(-1, 4)
    nodes = np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0)), -1).reshape(-1, 2) / 3
    nodes[[5, 6, 9, 10]] += np.random.default_rng(0).uniform(-0.08, 0.08, (4, 2))
    clamped = np.ones(16, dtype=bool)
    clamped[[5, 6, 9, 10]] = False
    return Mesh(nodes, cells, np.empty((0, 2), int), clamped)


def bent(mesh, seed=0, size=0.02):
    return mesh.nodes + np.random.default_rng(seed).uniform(-size, size, mesh.nodes.shape)


def test_a_patch_carries_a_constant_stress_exactly(patch):
    """Under one F everywhere γ = 1, also F₃₃; the stress is the law's in plane strain; inner nodes feel no force."""
    F = np.array([[1.3, 0.4], [-0.1, 0.9]])
    positions = patch.nodes @ F.T
    result = held(patch, positions)
    assert np.allclose(result.stretch_across, 1, rtol=0, atol=1e-13)
    assert np.allclose(result.first_piola_kirchhoff, material.first_piola_kirchhoff(F), rtol=0, atol=1e-12)
    assert np.allclose(cauchy_stress(result), cauchy_stress(held(patch, positions, Inflation)), rtol=0, atol=1e-12)
    forces = residual(result, positions, 0.0)
    assert np.abs(forces[~patch.clamped]).max() < 1e-14 < 1e-3 < np.abs(forces[patch.clamped]).max()


def test_the_material_is_stretched_across_the_plane_until_its_volume_is_the_elements(patch):
    """det F′ is one number per element, det F̄, whatever J is; where J is less, F₃₃ is more. No plane strain."""
    result = held(patch, bent(patch))
    F, across = result.deformation_gradient[0], result.stretch_across[0]
    J = np.linalg.det(F)
    volume = across**3 * J
    assert np.ptp(J, axis=1).min() > 1e-3 and np.abs(across - 1).max() > 1e-3
    assert np.allclose(volume, volume[:, :1], rtol=1e-13)
    _, weights = shape_gradients(patch.nodes[patch.cells])
    mean = np.linalg.det(np.einsum("mq,mqij->mij", weights / weights.sum(1, keepdims=True), F))
    assert np.allclose(volume[:, 0], mean, rtol=1e-13)
    assert np.all((across > 1) == (J < mean[:, None]))


def test_stresses_are_the_law_at_the_scaled_deformation_gradient(patch):
    result = held(patch, bent(patch))
    F = np.zeros((*result.deformation_gradient.shape[:-2], 3, 3))
    F[..., :2, :2], F[..., 2, 2] = result.deformation_gradient, 1
    F *= result.stretch_across[..., None, None]
    P, J = material.first_piola_kirchhoff(F), np.linalg.det(F)
    sigma = P @ np.swapaxes(F, -1, -2) / J[..., None, None]
    assert np.allclose(result.first_piola_kirchhoff, P[..., :2, :2], rtol=0, atol=1e-13)
    assert np.allclose(cauchy_stress(result), sigma, rtol=0, atol=1e-12)
    deviator = sigma - np.trace(sigma, axis1=-2, axis2=-1)[..., None, None] / 3 * np.eye(3)
    assert np.allclose(von_mises(result), np.sqrt(1.5 * (deviator**2).sum((-1, -2))).mean(-1), rtol=0, atol=1e-12)


def test_rigid_motions_need_no_force_and_turned_states_turned_forces(patch):
    turn, result = np.array([[0.6, -0.8], [0.8, 0.6]]), held(patch, patch.nodes)
    assert np.abs(residual(result, patch.nodes @ turn.T + [3, -2], 0.0)).max() < 1e-13
    forces, turned = (residual(result, x, 0.0) for x in (bent(patch), bent(patch) @ turn.T + [3, -2]))
    assert np.abs(forces).max() > 1e-2 and np.allclose(turned, forces @ turn.T, rtol=0, atol=1e-12)


def test_there_is_no_potential():
    """The derivative of the residual, from difference quotients along two moves, is not symmetric."""
    mesh, h = build_mesh(hook()), 1e-6
    x, result = bent(mesh, size=0.005), held(mesh, mesh.nodes)
    u, v = np.random.default_rng(1).normal(size=(2, *mesh.nodes.shape))
    across, back = (
        np.sum(other * (residual(result, x + h * move, 0.05) - residual(result, x - h * move, 0.05))) / (2 * h)
        for move, other in ((u, v), (v, u))
    )
    assert abs(across - back) > 1e-3 * abs(across)


@pytest.mark.parametrize("pressure", [0.01, [0.02, 0.01]])
def test_equilibrium_is_one_of_its_own_stress_and_near_that_of_mean_dilatation(pressure):
    label = hook()
    result, other = (inflate_with(label, name, n_steps=2, pressure=pressure) for name in BOTH)
    assert result.converged and result.element == "stabilised" and result.factorisations > other.factorisations
    forces = residual(result, result.deformed(), result.pressures[-1])
    assert np.abs(forces[~result.mesh.clamped]).max() < 1e-12
    moved = np.abs(result.displacement[-1] - other.displacement[-1]).max()
    assert 1e-6 < moved < 0.02 * np.abs(other.displacement[-1]).max()
    one = inflate_with(label, "stabilised", n_steps=1, pressure=result.pressures[-1])
    assert np.allclose(one.displacement[-1], result.displacement[-1], rtol=0, atol=1e-9)  # the way does not matter


def test_refinement_brings_plane_strain_back():
    """F₃₃ ≠ 1 is an error of the element, not of the model."""
    how = {"n_steps": 1, "pressure": 0.03}
    coarse, fine = (inflate_with(hook(), "stabilised", refine=n, **how).stretch_across for n in (1, 4))
    assert 0 < np.abs(fine - 1).mean() < 0.4 * np.abs(coarse - 1).mean()


def test_sevens_differ_little_from_mean_dilatation():
    """A tenth of a percent: no choice between the two decides what a structure does."""
    labels = [label_image(image) for image in load_sevens("digits").images[:2]]
    for label in labels:
        ours, mean = (describe(inflate_with(label, name, n_steps=1)) for name in BOTH)
        assert max(abs(getattr(ours, size) / getattr(mean, size) - 1) for size in SIZES) < 5e-3


def test_what_needs_a_potential_refuses_it():
    with pytest.raises(ValueError, match="element"):
        sensitivities(inflate_with(hook(), "stabilised", n_steps=1), get_descriptor("height").gradient)
    with pytest.raises(ValueError, match="contact: the stabilised element has none"):
        inflate_with(hook(), "stabilised", contact=True)


def test_a_pressure_beyond_what_it_bears_is_reported():
    result = inflate_with(hook(), "stabilised", n_steps=4, pressure=5.0)
    assert not result.converged and "no equilibrium" in result.reason
    failed = np.isnan(result.displacement).any(axis=(1, 2))
    assert failed[-1] and np.all(np.diff(failed.astype(int)) >= 0)
    assert replace(result, converged=True).stretch_across.shape == (4, len(result.cells), 4)


def test_it_converges_to_the_tube_with_second_order():
    exact, errors = tube(0.07, (LAMBDA, MU)), []
    for n in (8, 16):
        mesh = quarter_ring(n)
        radius = np.hypot(*inflate_with(mesh, "stabilised", n_steps=2, pressure=0.07).deformed().T)
        errors.append(np.abs(radius - exact(np.hypot(*mesh.nodes.T))).max())
    assert 1.9 < np.log2(errors[0] / errors[1]) < 2.1 and errors[1] < 2e-4
