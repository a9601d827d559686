"""How an inflated structure would change with its pixels: the adjoint of the equilibrium, one linear solve for all.

Relax the label image: let pixel e of the wall carry the share s_e of its energy W_e,

    Π(x; s) = Σ_e s_e W_e(x) − p A(x).

The structure itself has s = 1. Equilibrium is R = ∂Π/∂x = 0, so a descriptor h(x) follows s by

    dh/ds_e = −λ·∂R/∂s_e = −λ·∂W_e/∂x,   where K λ = ∂h/∂x,

and the symmetric K = ∂R/∂x is the tangent that Newton's method has at hand. These derivatives are exact; what they say
of a pixel that is flipped as a whole is a first estimate (:func:`flip_changes`), good for choosing what to try first.
That the pressure then acts on another side of the pixel plays next to no part: the wall is nearly incompressible, and
a pressure does as much work on one side of such an element as on the other.
"""

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from inflate_lib.mechanics.inflation import Inflation, equilibrium, solve
from inflate_lib.structures.labels import THICKNESS, VOID, WALL

_SQUARE = np.ones((2 * THICKNESS + 1, 2 * THICKNESS + 1))  # that the cavity is grown by to get the wall


def sensitivities(result: Inflation, gradient: Callable[[np.ndarray], np.ndarray], step: int = -1) -> np.ndarray:
    """Derivatives of a quantity, such as a descriptor, with respect to the share of each element's energy.

    Parameters
    ----------
    result : Inflation
    gradient : callable
        ``gradient(nodes)`` → (n, 2), ∂h/∂x at deformed nodes (n, 2): the attribute of that name of a
        :class:`inflate_lib.descriptors.Descriptor`.
    step : int
        Load step, which must have converged.

    Returns
    -------
    (m,) float
        dh/ds_e.

    Raises
    ------
    ValueError
        Without an equilibrium, or where that is not stable, so that K is not positive definite.
    """
    deformed = result.deformed(step)
    if not np.isfinite(deformed).all():
        raise ValueError(f"the structure has no equilibrium to differentiate: {result.reason}")
    load = gradient(deformed)
    system, state = equilibrium(result, step)
    adjoint = solve(system, state, load)
    if adjoint is None:
        raise ValueError("the equilibrium is not stable: its tangent is not positive definite")
    adjoint = adjoint[result.cells]

    forces = system.stiffness[system.kind] @ state.corners + np.einsum("mq,mqai->mai", state.slope, state.c)
    return -np.sum(adjoint * forces, axis=(1, 2))


def flip_changes(label, sensitivity):
    """Estimated change of a descriptor for each pixel of the cavity that might be flipped.

    A flip changes the wall in up to 5 × 5 pixels, because the wall follows from the cavity. Their derivatives are added
    up; a pixel that is no wall yet takes those of the nearest one that is, as evolutionary topology optimisation does
    (Huang & Xie 2007). Not seen is that a flip may move the whole structure within the frame, nor that new nodes may
    reach beyond the old ones.

    Parameters
    ----------
    label : (28, 28) float
    sensitivity : (m,) float
        From :func:`sensitivities` of this structure, one element per pixel.

    Returns
    -------
    (28, 28) float
    """
    wall, cavity = label == WALL, label == VOID
    nearest = tuple(ndimage.distance_transform_edt(~wall, return_distances=False, return_indices=True))
    change = np.zeros(label.shape)
    change[wall] = sensitivity
    change = change[nearest]
    covers = ndimage.convolve(cavity.astype(float), _SQUARE, mode="constant")  # void pixels that make this one a wall
    gained = ndimage.convolve(change * (covers < 0.5), _SQUARE, mode="constant")
    lost = ndimage.convolve(change * (wall & (covers < 1.5)), _SQUARE, mode="constant")
    return np.where(cavity, change - lost, gained - change)
