"""The constitutive law: compressible neo-Hookean, as in MOOSE's ``ComputeNeoHookeanStress`` (paper sec. 3).

With J = det F, and d = 3 dimensions, or 2 in plane strain (no stretch out of the plane, so that the in-plane part of
every formula stands by itself):

    W(F)   = μ/2 (F:F − d) + φ(J),   φ(J) = λ/2 ln² J − μ ln J
    P      = ∂W/∂F = μ F + φ′(J) cof F = μ (F − F⁻ᵀ) + λ ln J F⁻ᵀ
    A_iJkL = ∂P_iJ/∂F_kL = μ δ_ik δ_JL + λ F⁻ᵀ_iJ F⁻ᵀ_kL + (μ − λ ln J) F⁻ᵀ_iL F⁻ᵀ_kJ

All functions take arrays of deformation gradients, (…, 2, 2) or (…, 3, 3), and Lamé parameters (λ, μ).
"""

import numpy as np

LAMBDA, MU = 16.44, 0.1644  # Lamé parameters (paper sec. 3)


def energy(F, lame=(LAMBDA, MU)):
    """Stored energy W per undeformed volume.

    Parameters
    ----------
    F : (…, d, d) array_like
        Deformation gradients, d = 2 (plane strain) or 3.
    lame : (float, float)
        Lamé parameters (λ, μ).

    Returns
    -------
    (…) float, in the units of λ and μ.

    Raises
    ------
    ValueError
        Where `F` is of another shape, or turns the material inside out (J ≤ 0).
    """
    lam, mu = lame
    F, _, J = _checked(F)
    return mu / 2 * (np.sum(F * F, axis=(-2, -1)) - F.shape[-1]) + lam / 2 * np.log(J) ** 2 - mu * np.log(J)


def first_piola_kirchhoff(F, lame=(LAMBDA, MU), J=None):
    """First Piola–Kirchhoff stress P, force per undeformed area.

    Parameters
    ----------
    F : (…, d, d) array_like
        Deformation gradients, d = 2 (plane strain; the in-plane components of P come back) or 3.
    lame : (float, float)
        Lamé parameters (λ, μ).
    J : (…) array_like, optional
        Volume ratio at which φ′ is taken instead of det F: the mean-dilatation element puts its mean here.

    Returns
    -------
    (…, d, d) float, in the units of λ and μ.

    Raises
    ------
    ValueError
        Where `F` is of another shape, or a volume ratio is not positive.
    """
    lam, mu = lame
    F, cofactor, J = _checked(F, J)
    return mu * F + ((lam * np.log(J) - mu) / J)[..., None, None] * cofactor


def tangent_moduli(F, lame=(LAMBDA, MU)):
    """Tangent moduli A = ∂P/∂F, indexed A[…, i, J, k, L] = ∂P_iJ/∂F_kL.

    Parameters, units and errors as for :func:`energy`.

    Returns
    -------
    (…, d, d, d, d) float
    """
    lam, mu = lame
    F, cofactor, J = _checked(F)
    inverse = cofactor / J[..., None, None]  # F⁻ᵀ
    identity = np.eye(F.shape[-1])
    return (
        mu * np.einsum("ik,JL->iJkL", identity, identity)
        + lam * np.einsum("...iJ,...kL->...iJkL", inverse, inverse)
        + np.einsum("...,...iL,...kJ->...iJkL", mu - lam * np.log(J), inverse, inverse)
    )


def cofactor(F):
    """cof F = J F⁻ᵀ, (…, d, d): the derivative of J = det F. Exists for every F; no division."""
    F = np.asarray(F, dtype=float)
    if F.shape[-2:] == (2, 2):
        return np.stack([np.stack([F[..., 1, 1], -F[..., 1, 0]], -1), np.stack([-F[..., 0, 1], F[..., 0, 0]], -1)], -2)
    if F.shape[-2:] == (3, 3):
        return np.stack([np.cross(F[..., (i + 1) % 3, :], F[..., (i + 2) % 3, :]) for i in range(3)], -2)
    raise ValueError(f"F has shape {F.shape}; deformation gradients are (…, 2, 2) or (…, 3, 3)")


def _checked(F, J=None):
    """F as float, its cofactor, and its volume ratio, det F unless another one is given."""
    F = np.asarray(F, dtype=float)
    cof = cofactor(F)
    J = np.sum(F[..., 0, :] * cof[..., 0, :], axis=-1) if J is None else np.asarray(J, dtype=float)
    if np.any(J <= 0):
        raise ValueError(f"F: the volume ratio J must be positive everywhere; its least value is {np.min(J):.3g}")
    return F, cof, J
