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
F S(F′) instead. Whether the paper switched it on is not known. Plain NumPy, starting from the mean dilatation element.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from inflate_lib.mechanics import material
from inflate_lib.mechanics.mesh import Mesh

_MAX_ITERATIONS = 50  # of Newton's method at a load step
_TOLERANCE = 1e-10  # length of the last move
_MAX_MOVE = 0.05  # of a node in one iteration
_MIN_J = 0.05  # that no Gauss point may fall below on the way


def stretch_across(F, weights):
    """γ = F′₃₃ at the Gauss points, (…, m, 4), from F in the plane, (…, m, 4, 2, 2), and their areas, (m, 4)."""
    return np.cbrt(_det(_mean(F, weights))[..., None] / _det(F))


def first_piola_kirchhoff(F, weights, lame):
    """P(F′) in the plane, (…, m, 4, 2, 2); arguments as for :func:`stretch_across`, and (λ, μ)."""
    whole = np.zeros((*F.shape[:-2], 3, 3))
    whole[..., :2, :2], whole[..., 2, 2] = F, 1.0
    whole *= stretch_across(F, weights)[..., None, None]
    return material.first_piola_kirchhoff(whole, lame)[..., :2, :2]


def correct(mesh, gradients, weights, positions, pressures, lame):
    """Move equilibria of the mean dilatation element to those of this one, by Newton's method.

    Parameters
    ----------
    mesh : Mesh
    gradients, weights : (m, 4, 4, 2), (m, 4) float
        From :func:`inflate_lib.mechanics.inflation.shape_gradients`.
    positions : (steps, n, 2) float
        Deformed nodes at each load step.
    pressures : (steps,) float
    lame : (float, float)

    Returns
    -------
    positions : (reached, n, 2) float
        Of the load steps that an equilibrium was found for, up to the first without one.
    factorisations : int
    """
    element = _Element(mesh, gradients, weights, lame)
    found, factorisations, shift = [], 0, 0.0
    for start, p in zip(positions, pressures, strict=True):
        x, spent = _newton(element, start + shift, p)
        factorisations += spent
        if x is None:
            break
        found.append(x)
        shift = x - start
    return np.reshape(found, (-1, *mesh.nodes.shape)), factorisations


@dataclass(frozen=True)
class _Element:
    """The equations of a mesh of these elements."""

    mesh: Mesh
    gradients: np.ndarray
    weights: np.ndarray
    lame: tuple[float, float]

    @cached_property
    def free(self):
        """Numbers 2 i + d of the unknowns."""
        held = np.reshape(self.mesh.clamped, (len(self.mesh.nodes), -1))
        return np.flatnonzero(~np.broadcast_to(held, self.mesh.nodes.shape).ravel())

    def F(self, x):
        return np.einsum("mai,mqaj->mqij", x[self.mesh.cells], self.gradients)

    def residual(self, x, p):
        """(n, 2) ∫ P : ∇N dV minus the forces of the pressure."""
        P, residual = first_piola_kirchhoff(self.F(x), self.weights, self.lame), np.zeros_like(x)
        np.add.at(residual, self.mesh.cells, np.einsum("mq,mqij,mqaj->mai", self.weights, P, self.gradients))
        along = np.diff(x[self.mesh.pressure_edges], axis=1)[:, 0]
        for ends in self.mesh.pressure_edges.T:
            np.add.at(residual, ends, 0.5 * p * np.column_stack([-along[:, 1], along[:, 0]]))
        return residual

    def tangent(self, x, p):
        """(2 n, 2 n) derivative of the residual. With ∂(ln J) = g·∂x at a Gauss point and ∂(ln J′) = ḡ·∂x,

        ∂P = μ γ ∂F − π/γ F⁻ᵀ ∂Fᵀ F⁻ᵀ + (μ γ F − π/γ F⁻ᵀ) (ḡ − g)·∂x / 3 + λ/γ F⁻ᵀ ḡ·∂x.
        """
        (lam, mu), F, w = self.lame, self.F(x), self.weights
        mean, gamma = _mean(F, w), stretch_across(F, w)
        inverse, mean_inverse = (material.cofactor(one) / _det(one)[..., None, None] for one in (F, mean))  # F⁻ᵀ
        pi = lam * np.log(_det(mean))[:, None] - mu
        g = np.einsum("mqij,mqaj->mqai", inverse, self.gradients)
        g_mean = np.einsum("mij,maj->mai", mean_inverse, _mean(self.gradients, w))
        turned = np.einsum("mq,mqij,mqaj->mqai", w * mu * gamma / 3, F, self.gradients)
        turned -= (w * pi / gamma / 3)[..., None, None] * g
        blocks = np.einsum("mqai,mbk->maibk", turned + (lam * w / gamma)[..., None, None] * g, g_mean)
        blocks -= np.einsum("mqai,mqbk->maibk", turned, g) + np.einsum("mq,mqak,mqbi->maibk", w * pi / gamma, g, g)
        stiff = np.einsum("mq,mqaj,mqbj->mab", mu * w * gamma, self.gradients, self.gradients)
        blocks[:, :, 0, :, 0] += stiff
        blocks[:, :, 1, :, 1] += stiff
        unknowns = (2 * self.mesh.cells[..., None] + [0, 1]).reshape(-1, 8)
        rows, columns, values = [np.repeat(unknowns, 8, axis=1)], [np.tile(unknowns, 8)], [blocks]
        for ends in self.mesh.pressure_edges.T:
            for of, sign in zip(self.mesh.pressure_edges.T, (-1, 1), strict=True):
                rows += [2 * ends, 2 * ends + 1]
                columns += [2 * of + 1, 2 * of]
                values += [np.full(len(of), -0.5 * p * sign), np.full(len(of), 0.5 * p * sign)]
        rows, columns, values = (np.concatenate([np.ravel(one) for one in part]) for part in (rows, columns, values))
        return sparse.csc_array((values, (rows, columns)), shape=(x.size, x.size))


def _newton(element, x, p):
    """Deformed nodes in equilibrium near x, or None, and the number of factorisations."""
    free = element.free
    for iteration in range(1, _MAX_ITERATIONS + 1):
        move = np.zeros_like(x)
        factors = splu(element.tangent(x, p)[free][:, free].tocsc())
        move.ravel()[free] = -factors.solve(element.residual(x, p).ravel()[free])
        length = np.abs(move).max()
        if not np.isfinite(length):
            return None, iteration
        s = min(1.0, _MAX_MOVE / max(length, _MAX_MOVE))
        while s > 1e-6 and _det(element.F(x + s * move)).min() < _MIN_J:
            s /= 2
        x = x + s * move
        if s == 1 and length < _TOLERANCE:
            return x, iteration
    return None, iteration


def _mean(values, weights):
    """Element means, (…, m, ·, ·), of values at the Gauss points, (…, m, 4, ·, ·)."""
    shares = weights / weights.sum(axis=1, keepdims=True)
    return (shares[..., None, None] * values).sum(axis=-3)


def _det(F):
    return F[..., 0, 0] * F[..., 1, 1] - F[..., 0, 1] * F[..., 1, 0]
