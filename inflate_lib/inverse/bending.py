"""Bending: how far the tip of a structure moves sideways, and patterns of two rubbers that move it as far as they can.

The *tip* is the last point of the medial axis. Where a pixel of the wall becomes stiffer, the adjoint says how the tip
moves (:mod:`inflate_lib.inverse.adjoint`); a pattern is changed pixel by pixel to what that says, in large steps while
they help, as in evolutionary topology optimisation (Huang & Xie 2007).
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from inflate_lib._checks import choice, positive_number, whole_number
from inflate_lib.alternatives.rubbers import RATIO
from inflate_lib.datasets.simulate import TIME_LIMIT
from inflate_lib.descriptors.shape import medial_axis
from inflate_lib.inverse.adjoint import sensitivities
from inflate_lib.mechanics.buildable import find_flaw
from inflate_lib.mechanics.inflation import Inflation, inflate
from inflate_lib.structures.labels import WALL

SIDES = {"left": -1, "right": 1}
_H = 1e-6  # sides, for derivatives of the axis
_LEAST = 1e-4  # sides that a change must move the tip by


def tip(nodes: np.ndarray) -> float:
    """Sideways position of the last point of the medial axis of nodes (n, 2), the first being at 0; in sides."""
    return float(medial_axis(nodes[ConvexHull(nodes).vertices])[-1, 0])


def tip_gradient(nodes: np.ndarray) -> np.ndarray:
    """Derivative of :func:`tip` with respect to nodes, (n, 2) both: 0 but for corners of the hull above the ground."""
    hull = ConvexHull(nodes).vertices
    gradient = np.zeros_like(nodes)
    for corner, node in enumerate(hull):
        if nodes[node, 1] < nodes[:, 1].min() + 2 * _H:  # clamped
            continue
        for direction in (0, 1):
            moved = np.repeat(nodes[hull][None], 2, axis=0)
            moved[:, corner, direction] += [_H, -_H]
            ahead, back = (medial_axis(polygon)[-1, 0] for polygon in moved)
            gradient[node, direction] = (ahead - back) / (2 * _H)
    return gradient


@dataclass(frozen=True)
class Bent:
    """A pattern of two rubbers that moves the tip.

    Attributes
    ----------
    stiff : (28, 28) bool
        Where the wall is of the stiff rubber.
    result : Inflation
    moved : float
        How far the tip moves when the structure is inflated, in sides, to the right.
    """

    stiff: np.ndarray
    result: Inflation
    moved: float


def bend(label: np.ndarray, side: str, ratio: float = RATIO, tries: int = 16) -> Bent:
    """The pattern of two rubbers under which the tip of a structure moves farthest to one side, as far as is found.

    Parameters
    ----------
    label : (28, 28) float
        Label image.
    side : {"left", "right"}
    ratio : float
        Stiffness of the second rubber, in that of the first.
    tries : int
        Inflations that may be spent.

    Returns
    -------
    Bent
        One rubber where no pattern is better; every pattern that is tried on the way can be built.

    Raises
    ------
    ValueError
        Where the structure of one rubber does not inflate to the full pressure.
    """
    direction = SIDES[choice("side", side, SIDES)]
    positive_number("ratio", ratio)
    whole_number("tries", tries, 0)
    wall = label == WALL
    stiff, share = np.zeros(wall.sum(), bool), 1.0
    best = inflate(label, time_limit=TIME_LIMIT[0])
    if not best.converged:
        raise ValueError(f"the structure does not inflate: {best.reason}")
    begun, reached = tip(best.nodes), tip(best.deformed())
    wanted = _wanted(best, direction)
    for _ in range(tries):
        wrong = np.flatnonzero(stiff != (wanted > 0))
        chosen = wrong[np.argsort(-np.abs(wanted[wrong]), kind="stable")][: int(np.ceil(share * len(wrong)))]
        if not len(chosen):
            break
        changed = stiff.copy()
        changed[chosen] ^= True
        grid = np.ones(label.shape)
        grid[wall] = np.where(changed, ratio, 1.0)
        result = inflate(label, stiffness=grid, time_limit=TIME_LIMIT[0])
        if not find_flaw(result) and direction * (tip(result.deformed()) - reached) > _LEAST:
            stiff, best, reached = changed, result, tip(result.deformed())
            wanted = _wanted(best, direction)
        else:
            share /= 2
    full = np.zeros(label.shape, bool)
    full[wall] = stiff
    return Bent(full, best, reached - begun)


def _wanted(result, direction):
    """For each pixel of the wall: above 0 where the tip would move to that side if it were stiffer."""
    return direction * sensitivities(result, tip_gradient)
