"""MOOSE's stabilised element, which scales F in three dimensions and so leaves plane strain (``stabilize_strain``).

Where MOOSE is told ``stabilize_strain = true``, the material at each Gauss point of an element is given

    F′ = γ F,   γ = (det F̄ / det F)^(1/3),   F̄ = (1/V) ∫ F dV over the element

(its page "Stabilization", and ``ComputeLagrangianStrainBase``), with the *three-dimensional* F. As F₃₃ = 1 in plane
strain, F′₃₃ = γ: the material is stretched across the plane wherever J departs from the element's. The F-bar of two
dimensions (de Souza Neto et al. 1996) takes the square root and leaves F₃₃ alone. Of the virtual work ∫ P(F′) : ∇v dV
only the stress is changed, not the gradient of the test function, so that there is no potential and the tangent is
not symmetric. With J′ = det F′ = det F̄ and π = λ ln J′ − μ the stress in the plane is

    P = μ γ F + π γ⁻¹ F⁻ᵀ,

where mean dilatation has μ F + π γ⁻³ F⁻ᵀ (on parallelograms det F̄ is the mean of J): γ = 1 makes them equal.

That P is F′ S(F′) is certain for the MOOSE of the paper's time (``ComputeLagrangianStressPK2``); later versions have
F S(F′) instead. Whether the paper switched it on is not known. Equilibria are sought from those of mean dilatation,
with its tangent in the place of their own: as γ is near 1, each iteration leaves a small share of the residual.
"""

from functools import cached_property

import numpy as np

from inflate_lib._checks import choice
from inflate_lib.mechanics import material
from inflate_lib.mechanics.inflation import ELEMENTS, Inflation, assemble, build_system, inflate, shape_gradients, solve

ALL_ELEMENTS = (*ELEMENTS, "stabilised")

_MAX_ITERATIONS = 100  # at a load step
_TOLERANCE = 1e-12  # length of the last move


class StabilisedInflation(Inflation):
    """An inflated structure of these elements."""

    @cached_property
    def stretch_across(self) -> np.ndarray:
        """(steps, m, 4) γ = F′₃₃ at the Gauss points."""
        return _stretch_across(self.deformation_gradient, self._weights)

    @cached_property
    def first_piola_kirchhoff(self) -> np.ndarray:
        """(steps, m, 4, 2, 2) in-plane part of P(F′) at the Gauss points, in units of μ and λ."""
        P = _first_piola_kirchhoff(self.deformation_gradient, self._weights, self.lame)
        return self.stiffness[:, None, None] * P

    @property
    def _weights(self):
        return shape_gradients(self.nodes[self.cells])[1]


def inflate_with(label, element="mean-dilatation", **how) -> Inflation:
    """Inflate a structure with any of `ALL_ELEMENTS`; other parameters are those of :func:`inflate_lib.inflate`.

    Raises
    ------
    ValueError
        As `inflate` does, and where contact is asked of the stabilised element, which has no potential to add one to.
    """
    if check_element(element, how.get("contact", False)) != "stabilised":
        return inflate(label, element=element, **how)
    result = inflate(label, **how)
    system, n_steps = build_system(result.mesh, lame=result.lame), len(result.pressures)
    found, factorisations = [], result.factorisations
    for step, p in enumerate(result.pressures):
        x, spent = _equilibrium(result, system, result.deformed(step), p)
        factorisations += spent
        if x is None:
            break
        found.append(x - result.nodes)
    displacement, reason = np.full_like(result.displacement, np.nan), result.reason
    displacement[: len(found)] = np.reshape(found, (-1, *result.nodes.shape))
    if len(found) < n_steps:
        reason = reason or f"no equilibrium was found at load step {len(found) + 1} of {n_steps}"
    return StabilisedInflation(
        result.mesh, element, result.load_steps, result.pressures, displacement, len(found) == n_steps, reason,
        factorisations, result.lame,
    )  # fmt: skip


def check_element(element: str, contact: bool | float) -> str:
    """`element`, or a ValueError where there is no such element, or none with contact."""
    if choice("element", element, ALL_ELEMENTS) == "stabilised" and contact:
        raise ValueError("contact: the stabilised element has none, choose another one")
    return element


def residual(result, x, p):
    """(n, 2) ∫ P : ∇N dV minus the forces of the pressure, at deformed nodes x, of a mesh and its material."""
    mesh, total = result.mesh, np.zeros_like(x)
    gradients, weights = shape_gradients(mesh.nodes[mesh.cells])
    F = np.einsum("mai,mqaj->mqij", x[mesh.cells], gradients)
    P = result.stiffness[:, None, None] * _first_piola_kirchhoff(F, weights, result.lame)
    np.add.at(total, mesh.cells, np.einsum("mq,mqij,mqaj->mai", weights, P, gradients))
    along = np.diff(x[mesh.pressure_edges], axis=1)[:, 0]
    for ends in mesh.pressure_edges.T:
        np.add.at(total, ends, 0.5 * p * np.column_stack([-along[:, 1], along[:, 0]]))
    return total


def _equilibrium(result, system, x, p):
    """Deformed nodes in equilibrium near x, or None, and the number of factorisations."""
    last = np.inf
    for iteration in range(1, _MAX_ITERATIONS + 1):
        state = assemble(system, x, p)
        move = solve(system, state, -residual(result, x, p)) if state.J.min() > 0 else None
        if move is None:
            break
        x += move
        length = np.abs(move).max()
        if length < _TOLERANCE or (length < 1e-9 and length > 0.5 * last):  # no shorter for rounding
            return x, iteration
        last = length
    return None, iteration


def _stretch_across(F, weights):
    """γ at the Gauss points, (…, m, 4), from F in the plane, (…, m, 4, 2, 2), and their areas, (m, 4)."""
    shares = weights / weights.sum(axis=1, keepdims=True)
    return np.cbrt(_det((shares[..., None, None] * F).sum(axis=-3))[..., None] / _det(F))


def _first_piola_kirchhoff(F, weights, lame):
    """P(F′) in the plane, (…, m, 4, 2, 2); arguments as for :func:`_stretch_across`, and (λ, μ)."""
    whole = np.zeros((*F.shape[:-2], 3, 3))
    whole[..., :2, :2], whole[..., 2, 2] = F, 1.0
    whole *= _stretch_across(F, weights)[..., None, None]
    return material.first_piola_kirchhoff(whole, lame)[..., :2, :2]


def _det(F):
    return F[..., 0, 0] * F[..., 1, 1] - F[..., 0, 1] * F[..., 1, 0]
