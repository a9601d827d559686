"""Bending: how far the tip of a structure moves sideways, and patterns of two rubbers that move it as far as they can.

The *tip* is the highest tenth of the undeformed structure; how far it moves is the mean over its nodes. (The end of the
medial axis would not do: it follows the highest point of the hull, which jumps from corner to corner of a flat top.)
Where a pixel of the wall becomes stiffer, the adjoint says how the tip moves (:mod:`inflate_lib.inverse.adjoint`); a
pattern is changed to what that says, in large steps while they help, as in evolutionary topology optimisation (Huang &
Xie 2007).
"""

from dataclasses import dataclass

import numpy as np

from inflate_lib._checks import choice, positive_number, whole_number
from inflate_lib.alternatives.patterns import RATIO
from inflate_lib.datasets.simulate import TIME_LIMIT
from inflate_lib.inverse.adjoint import sensitivities
from inflate_lib.mechanics.buildable import find_flaw
from inflate_lib.mechanics.inflation import Inflation, inflate
from inflate_lib.structures.labels import WALL

SIDES = {"left": -1, "right": 1}
_TIP = 0.1  # share of the height
_LEAST = 1e-4  # sides that a change must move the tip by


def tip(nodes: np.ndarray) -> np.ndarray:
    """(n,) bool: which of the undeformed nodes (n, 2) of a structure are its tip, the highest tenth."""
    bottom, top = nodes[:, 1].min(), nodes[:, 1].max()
    return nodes[:, 1] >= top - _TIP * (top - bottom) - 1e-9


def tip_moves(result: Inflation) -> np.ndarray:
    """(steps,) float: how far the tip of an inflated structure has moved to the right at each load step, in sides."""
    return result.displacement[:, tip(result.nodes), 0].mean(axis=1)


@dataclass(frozen=True)
class Bent:
    """A pattern of two rubbers that moves the tip.

    Attributes
    ----------
    stiff : (28, 28) bool
        Where the wall is of the stiff rubber.
    result : Inflation
    moved : float
        How far the tip moves to the right under the full pressure, in sides.
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
        A structure that can be built; that of the soft rubber alone, which need not be, where none is better.

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
    reached, wanted = direction * tip_moves(best)[-1], _wanted(best, direction)
    for _ in range(tries):
        wrong = np.flatnonzero(stiff != (wanted > 0))
        chosen = wrong[np.argsort(-np.abs(wanted[wrong]), kind="stable")][: int(np.ceil(share * len(wrong)))]
        if not len(chosen):
            break
        changed, grid = stiff.copy(), np.ones(label.shape)
        changed[chosen] ^= True
        grid[wall] = np.where(changed, ratio, 1.0)
        result = inflate(label, stiffness=grid, time_limit=TIME_LIMIT[0])
        if not find_flaw(result) and direction * tip_moves(result)[-1] > reached + _LEAST:
            stiff, best, reached = changed, result, direction * tip_moves(result)[-1]
            wanted = _wanted(best, direction)
        else:
            share /= 2
    full = np.zeros(label.shape, bool)
    full[wall] = stiff
    return Bent(full, best, float(tip_moves(best)[-1]))


def _wanted(result, direction):
    """For each pixel of the wall: above 0 where the tip would move to that side if it were stiffer."""
    there = tip(result.nodes)
    gradient = np.column_stack([direction * there / there.sum(), np.zeros(len(there))])
    return sensitivities(result, lambda nodes: gradient)
