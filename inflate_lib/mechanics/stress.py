"""Stresses and stretches of an inflated structure, and their peaks.

Stresses follow from P = μ F + φ′(J) cof F of :mod:`inflate_lib.mechanics.inflation`. Plane strain means F₃₃ = 1, which
leaves a stress across the plane. With φ′J = (P − μ F) : F / 2, the Cauchy stress is

    σ = P Fᵀ / J in the plane,   σ₃₃ = μ / J + φ′   (for one point: λ ln J / J),

and the von Mises stress is that of all of it: √(½ [(σ₁₁ − σ₂₂)² + (σ₂₂ − σ₃₃)² + (σ₃₃ − σ₁₁)²] + 3 σ₁₂²). As
σ = μ b / J + φ′ I with b = F Fᵀ and b₃₃ = 1, and pressure has no part in it, it is that of μ b / J. The stabilised
element of MOOSE has γ F in the place of F, and γ³ J in that of J.

Forces scale and shapes do not: what a stress says of a structure is σ/μ, which is what pictures and tables show.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from inflate_lib._checks import whole_number

if TYPE_CHECKING:
    from inflate_lib.mechanics.inflation import Inflation


def cauchy_stress(result: "Inflation") -> np.ndarray:
    """(steps, m, 4, 3, 3) Cauchy stress σ at the Gauss points, in the units of λ and μ; zero where none is written.

    Parameters
    ----------
    result : Inflation

    Returns
    -------
    ndarray
        NaN at load steps without equilibrium. With mean dilatation φ′ is the element's, as in the equilibrium.
    """
    F, P, gamma = result.deformation_gradient, result.first_piola_kirchhoff, result.stretch_across
    mu, J = result.lame[1] * result.stiffness, gamma**2 * area_ratio(result)
    slope = ((P - (mu * gamma)[..., None, None] * F) * F).sum((-1, -2)) / (2 * J)  # φ′
    sigma = np.zeros((*F.shape[:-2], 3, 3))
    sigma[..., :2, :2] = P @ np.swapaxes(F, -1, -2) / J[..., None, None]
    sigma[..., 2, 2] = mu * gamma / J + slope
    return sigma


def von_mises(result: "Inflation") -> np.ndarray:
    """(steps, m) von Mises stress of each element, the mean over its Gauss points, with σ₃₃; units of λ and μ."""
    F = result.deformation_gradient
    xx, yy = np.moveaxis((F**2).sum(-1), -1, 0)  # of b
    xy = (F[..., 0, :] * F[..., 1, :]).sum(-1)
    squares = ((xx - yy) ** 2 + (yy - 1) ** 2 + (1 - xx) ** 2) / 2 + 3 * xy**2
    mu = result.lame[1] * result.stiffness
    return (mu / (result.stretch_across * area_ratio(result)) * np.sqrt(squares)).mean(-1)


def von_mises_over_mu(result: "Inflation") -> np.ndarray:
    """(steps, m) σ/μ, the von Mises stress of each element in shear moduli: what does not depend on the unit.

    In a wall of several rubbers μ is that of stiffness 1.
    """
    return von_mises(result) / result.lame[1]


def largest_stretch(result: "Inflation") -> np.ndarray:
    """(steps, m) largest principal stretch in the plane of each element, the mean over its Gauss points."""
    F = result.deformation_gradient
    trace = (F**2).sum((-1, -2))  # λ₁² + λ₂²
    J = area_ratio(result)  # λ₁ λ₂
    return np.sqrt((trace + np.sqrt(np.maximum(trace**2 - 4 * J**2, 0))) / 2).mean(-1)


def peaks(result: "Inflation", step: int = -1) -> tuple[float, float]:
    """Peak von Mises stress and largest principal stretch at a load step (the last one by default), of any element.

    Each is the largest of the elements' values, and an element's value is the mean over its four Gauss points: with one
    element per pixel, a mean over a pixel of the wall. The peaks sit in the corners of the cavity and grow as the mesh
    is refined, without bound in the limit of a sharp corner: compare structures on equal meshes.

    Rubber hardly changes its volume, and J = 1 ties the one to the other: the von Mises stress at principal stretches
    s, 1/s, 1 is μ √(½ [(s² − s⁻²)² + (s⁻² − 1)² + (1 − s²)²]).

    Returns
    -------
    (float, float)
        In the units of λ and μ, and a ratio of lengths; NaN where there is no equilibrium.
    """
    n_steps = len(result.displacement)
    at = replace(result, displacement=result.displacement[[whole_number("step", step, -n_steps, n_steps - 1)]])
    return float(von_mises(at).max()), float(largest_stretch(at).max())


def area_ratio(result):
    """(steps, m, 4) J at the Gauss points; not numpy's determinant, which warns where there is no equilibrium."""
    F = result.deformation_gradient
    return F[..., 0, 0] * F[..., 1, 1] - F[..., 0, 1] * F[..., 1, 0]


#: What a picture can be coloured by: the function of ``stress``, the label of its colour bar, the value at rest.
QUANTITIES = {
    "von-mises": ("von_mises_over_mu", "von Mises stress σ/μ", 0.0),
    "stretch": ("largest_stretch", "largest stretch", 1.0),
}
