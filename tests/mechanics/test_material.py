"""The constitutive law: its derivatives, FElupe, MOOSE's regression value, and how it transforms."""

import felupe
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import root

from inflate_lib.mechanics.material import LAMBDA, MU, cofactor, energy, first_piola_kirchhoff, tangent_moduli


def stretched(dimension):
    """Deformation gradients (dimension, dimension) with J well above zero."""
    entries = st.lists(st.floats(-0.3, 0.3), min_size=dimension**2, max_size=dimension**2)
    return entries.map(lambda d: np.eye(dimension) + np.reshape(d, (dimension, dimension))).filter(
        lambda F: np.linalg.det(F) > 0.1
    )


gradients = stretched(3) | stretched(2)
moduli = st.sampled_from([(LAMBDA, MU), (4000.0, 6700.0), (1.0, 0.3)])


def slopes(function, F, h=1e-6):
    """Central difference quotients of `function` with respect to each component of F, last two axes."""
    columns = []
    for index in np.ndindex(F.shape):
        d = np.zeros_like(F)
        d[index] = h
        columns.append((function(F + d) - function(F - d)) / (2 * h))
    return np.moveaxis(np.reshape(columns, (*F.shape, *np.shape(function(F)))), (0, 1), (-2, -1))


@given(gradients, moduli)
@settings(max_examples=60, deadline=None)
def test_stress_and_tangent_are_derivatives(F, lame):
    P, A = first_piola_kirchhoff(F, lame), tangent_moduli(F, lame)
    assert np.allclose(P, slopes(lambda G: energy(G, lame), F), rtol=0, atol=1e-6 * np.abs(A).max())
    assert np.allclose(A, slopes(lambda G: first_piola_kirchhoff(G, lame), F), rtol=0, atol=1e-6 * np.abs(A).max())
    assert np.allclose(cofactor(F), slopes(np.linalg.det, F), rtol=0, atol=1e-8)
    assert np.allclose(cofactor(F), np.linalg.det(F) * np.linalg.inv(F).T, rtol=0, atol=1e-13)
    assert np.allclose(A, np.moveaxis(A, (-4, -3), (-2, -1)), rtol=0, atol=1e-12 * np.abs(A).max())  # has a potential


@given(stretched(3), moduli)
@settings(max_examples=40, deadline=None)
def test_stress_and_tangent_are_those_of_felupe(F, lame):
    lam, mu = lame
    theirs = felupe.NeoHookeCompressible(mu=mu, lmbda=lam)
    P = theirs.gradient([F[..., None, None], None])[0][..., 0, 0]
    A = theirs.hessian([F[..., None, None], None])[0][..., 0, 0]
    W = theirs.function([F[..., None, None], None])[0][..., 0, 0]
    assert np.allclose(first_piola_kirchhoff(F, lame), P, rtol=0, atol=1e-12 * np.abs(A).max())
    assert np.allclose(tangent_moduli(F, lame), A, rtol=0, atol=1e-12 * np.abs(A).max())
    # theirs need not be zero at F = I, as ours is: only differences mean anything
    zero = theirs.function([np.eye(3)[..., None, None], None])[0][..., 0, 0]
    assert np.isclose(energy(F, lame), W - zero, rtol=1e-11, atol=1e-12 * lam)


def test_moose_regression_value():
    """MOOSE's own test of the law: stretched to twice its length and free at the sides."""
    lame = 4000.0, 6700.0

    def sides(stretch):
        return np.diag(first_piola_kirchhoff(np.diag([2.0, *stretch]), lame))[1:] / lame[1]

    free = root(sides, [1.0, 1.0], tol=1e-12)
    assert free.success
    assert np.allclose(free.x, 0.86857457085182, rtol=0, atol=1e-13)
    P = first_piola_kirchhoff(np.diag([2.0, *free.x]), lame)
    assert np.isclose(P[0, 0], 10872.687019813, rtol=1e-12)
    assert np.abs(P - np.diag([P[0, 0], 0, 0])).max() < 1e-9


@given(stretched(2), moduli)
@settings(max_examples=30, deadline=None)
def test_plane_strain_is_the_three_dimensional_law(F, lame):
    F3 = np.eye(3)
    F3[:2, :2] = F
    assert np.isclose(energy(F, lame), energy(F3, lame), rtol=1e-12, atol=1e-12 * lame[0])
    assert np.allclose(first_piola_kirchhoff(F, lame), first_piola_kirchhoff(F3, lame)[:2, :2], rtol=1e-12, atol=1e-12)
    assert np.allclose(tangent_moduli(F, lame), tangent_moduli(F3, lame)[:2, :2, :2, :2], rtol=1e-12, atol=1e-12)


@given(stretched(3), st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_law_does_not_see_rotations(F, seed):
    Q, R = np.linalg.qr(np.random.default_rng(seed).normal(size=(2, 3, 3)))[0]
    Q, R = Q * np.sign(np.linalg.det(Q)), R * np.sign(np.linalg.det(R))
    assert np.isclose(energy(Q @ F @ R), energy(F), rtol=1e-9, atol=1e-12)  # objective and isotropic
    assert np.allclose(first_piola_kirchhoff(Q @ F @ R), Q @ first_piola_kirchhoff(F) @ R, rtol=0, atol=1e-10)


def test_small_strain_is_hookes_law():
    lam, mu = LAMBDA, MU
    one = np.eye(3)
    A = tangent_moduli(one)
    hooke = lam * np.einsum("iJ,kL->iJkL", one, one) + mu * (
        np.einsum("ik,JL->iJkL", one, one) + np.einsum("iL,kJ->iJkL", one, one)
    )
    assert np.allclose(A, hooke, rtol=0, atol=1e-13)
    assert energy(one) == 0 and np.abs(first_piola_kirchhoff(one)).max() < 1e-15


def test_arrays_of_any_shape():
    F = np.eye(3) + np.random.default_rng(0).uniform(-0.2, 0.2, (4, 5, 3, 3))
    assert energy(F).shape == (4, 5)
    assert np.allclose(first_piola_kirchhoff(F)[2, 3], first_piola_kirchhoff(F[2, 3]), rtol=1e-13)
    assert np.allclose(tangent_moduli(F)[2, 3], tangent_moduli(F[2, 3]), rtol=1e-13)
    # another J for φ′, per deformation gradient
    J = np.linalg.det(F)
    assert np.allclose(first_piola_kirchhoff(F, J=J), first_piola_kirchhoff(F), rtol=1e-12)
    assert not np.allclose(first_piola_kirchhoff(F, J=1.1 * J), first_piola_kirchhoff(F))


@pytest.mark.parametrize(("F", "message"), [(np.eye(4), "shape"), (np.ones(3), "shape"), (-np.eye(3), "J must be")])
def test_what_is_no_deformation_gradient_is_refused(F, message):
    for function in (energy, first_piola_kirchhoff, tangent_moduli):
        with pytest.raises(ValueError, match=message):
            function(F)
