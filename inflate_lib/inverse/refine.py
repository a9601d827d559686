"""From one drawing to a verified structure: label, constraints, inflation, flaws; and how misses are brought nearer.

A structure is made of pixels, and one pixel of its cavity more or less changes its descriptors by a tenth of a percent
or so. An inflation takes milliseconds, drawing a candidate ten times as long. So a near miss is worth some tries: a
pixel at the border of the cavity is flipped, or two that lie beside each other, the structure labelled and inflated
again, and the change kept if the largest error has become smaller and the structure can still be built. Which to try
first is what the adjoint says (:mod:`inflate_lib.inverse.adjoint`).

What is handed out will be cast. A *crumb* is a pixel of the cavity or of the wall that has at most one of its four
neighbours on its own side: a single pixel that sticks out. Those of a drawing are removed before it is refined, and no
change may leave one; pairs of pixels make up for what single ones may no longer do.
"""

from enum import StrEnum

import numpy as np
from scipy import ndimage

from inflate_lib._checks import choice
from inflate_lib.alternatives.patterns import castable, stiffness_of
from inflate_lib.datasets.simulate import TIME_LIMIT
from inflate_lib.descriptors import describe, get_descriptor
from inflate_lib.inverse.adjoint import flip_changes, sensitivities
from inflate_lib.inverse.constraints import Constraints
from inflate_lib.inverse.targets import deviations
from inflate_lib.mechanics.buildable import Flaw, find_flaw
from inflate_lib.mechanics.inflation import inflate
from inflate_lib.structures.labels import FRAME, OUTSIDE, PIXEL, VOID, WALL, label_image

_CROSS = ndimage.generate_binary_structure(2, 1)
_ORDERS = ("sensitivity", "random")
_LESS = 1e-3  # relative decrease of the largest error that a change must bring


class Rejection(StrEnum):
    """Why a drawing of a structure that could be built is no candidate for a design."""

    MAX_MATERIAL = "The wall takes more material than was allowed."
    MIN_VOID = "The cavity is narrower than was demanded."
    SYMMETRIC = "The structure is not its own mirror image."
    KEEP_OUT = "The structure reaches into the region that it had to keep out of."
    REPEATED = "The structure was drawn before."
    SMOOTH = "With smooth borders it cannot be built, does not fit into the frame, or breaks a demand."


def attempt(image, constraints):
    """Label and inflate one image under constraints.

    Parameters
    ----------
    image : (28, 28) or (2, 28, 28) array
        Of two rubbers, the second part is the map of the stiff one, which is changed where nobody could cast it
        (:func:`inflate_lib.alternatives.patterns.castable`).
    constraints : Constraints

    Returns
    -------
    reason : Flaw, Rejection or None
        Why it is rejected, the first reason found: a constraint, a flaw, the region to keep out of; None where it is
        not, and then the structure can be built (:mod:`inflate_lib.mechanics.buildable`).
    label : (28, 28) float or None
    result : Inflation or None
    """
    image, stiffness = (image, None) if np.ndim(image) == 2 else (image[0], image[1])
    try:
        label = label_image(image)
        if stiffness is not None:
            stiffness = castable(stiffness_of(image, stiffness), label)
        anywhere = Constraints(**{**constraints.as_dict(), "keep_out": None})
        if broken := anywhere.broken_by(label):
            return Rejection[broken.upper()], label, None
        result = inflate(label, time_limit=TIME_LIMIT[0], stiffness=stiffness)
    except ValueError:
        return Flaw.NO_STRUCTURE, None, None
    if flaw := find_flaw(result):
        return flaw, label, None
    if constraints.keep_out is not None:
        shift = _free_place(label, result, constraints)
        if shift is None:
            return Rejection.KEEP_OUT, label, None
        if shift:
            label = np.roll(label, shift, axis=1)
            stiffness = None if stiffness is None else np.roll(stiffness, shift, axis=1)
            result = inflate(label, time_limit=TIME_LIMIT[0], stiffness=stiffness)
            if find_flaw(result) or constraints.broken_by(label) or constraints.broken_when_inflated(result):
                return Rejection.KEEP_OUT, label, None
    return None, label, result


def _free_place(label, result, constraints):
    """The shortest shift, in pixels to the right, by which a structure keeps out of the forbidden region; or None."""
    columns = np.flatnonzero(np.any(label != OUTSIDE, axis=0))
    for shift in sorted(range(-columns[0], FRAME - columns[-1]), key=abs):
        moved = constraints.moved(shift * PIXEL)
        if not moved.broken_by(label) and not moved.broken_when_inflated(result):
            return shift
    return None


def refine(label, result, targets, constraints, goal, tries, seed=0, order="sensitivity", trace=None, crumbs=False):
    """Change a structure pixel by pixel until its largest error is at most `goal`, or the tries are used up.

    Parameters
    ----------
    label : (28, 28) float
    result : Inflation
        Of that structure, which can be built; what comes of it can be, too.
    targets : Targets
    constraints : Constraints
        Which it fulfils, and every step on the way.
    goal : float
        Largest relative error to stop at.
    tries : int
        Inflations that may be spent.
    seed : int
        Of the order in which pixels are tried, as far as that is random.
    order : {"sensitivity", "random"}
        First the pixels that promise to bring the structure nearest to its targets (``_most_promising``), or any.
    trace : list, optional
        Filled with the largest error after each try.
    crumbs : bool
        Whether crumbs may stay and arise; to measure what it costs that they may not.

    Returns
    -------
    label : (28, 28) float
        Without a crumb, where anything was changed; as it was, where that would have brought it no nearer.
    result : Inflation
    flipped : list of list of (int, int)
        Row and column of the pixels of each change, in order; with `symmetric`, each stands for its mirror image too.
    """
    choice("order", order, _ORDERS)
    rng, symmetric = np.random.default_rng(seed), constraints.symmetric
    before = best = max(deviations(targets, describe(result)).values())
    start, flipped, untried = (label, result, []), [], []
    if best > goal and not crumbs and (rough := _crumbs_of(label == VOID)).size:
        untried, best = [rough], np.inf  # whatever comes of it, only that is refined
    elif best > goal:
        untried = _changes(label, result, targets, symmetric, order, rng)
    while best > goal and tries > 0 and len(untried):
        pixels, untried = untried[0], untried[1:]
        cavity = with_flipped(label, pixels, symmetric)
        if not crumbs and _crumbs_of(cavity).size:
            continue
        tries -= 1
        reason, changed, inflated = attempt(_of_rubbers(cavity, label, result), constraints)
        error = np.inf if reason else max(deviations(targets, describe(inflated)).values())
        if not reason and error <= best * (1 - _LESS) and (crumbs or not _crumbs_of(changed == VOID).size):
            label, result, best = changed, inflated, error
            flipped.append(sorted({(int(row), int(column)) for row, column in pixels}))
            untried = _changes(label, result, targets, symmetric, order, rng) if best > goal else []
        if trace is not None:
            trace.append(min(best, before))
    return (label, result, flipped) if best < before else start


def stiff_part(label, result):
    """(28, 28) bool: where the wall of a structure is of the stiff rubber; None where all of it is of the soft one."""
    if not np.any(result.mesh.stiffness > 1):
        return None
    stiff = np.zeros(label.shape, bool)
    stiff[label == WALL] = result.mesh.stiffness > 1
    return stiff


def _of_rubbers(cavity, label, result):
    """A changed cavity, with the map of the stiff rubber where there are two; new wall is of what is nearest."""
    stiff = stiff_part(label, result)
    if stiff is None:
        return cavity
    nearest = ndimage.distance_transform_edt(label != WALL, return_distances=False, return_indices=True)
    return np.stack([cavity, stiff[tuple(nearest)]])


def _changes(label, result, targets, symmetric, order, rng):
    """(m, 2, 2) the changes to try, in that order: two pixels that lie beside each other, or one twice."""
    pixels, void = border(label), label == VOID
    at = np.zeros(label.shape, bool)
    at[tuple(pixels.T)] = True
    changes = [np.stack([pixels, pixels], axis=1)]
    for axis in (0, 1):  # the border of the cavity keeps clear of the border of the frame
        first = np.argwhere(at & np.roll(at, -1, axis) & (void == np.roll(void, -1, axis)))
        changes.append(np.stack([first, first + np.eye(2, dtype=int)[axis]], axis=1))
    changes = rng.permutation(np.concatenate(changes))
    return changes if order == "random" else _most_promising(changes, label, result, targets, symmetric)


def _crumbs_of(void):
    """(k, 2) pixels to flip, so that a cavity (28, 28) bool has no crumb; those that it has, and what they uncover."""
    smooth = void.copy()
    for _ in range(FRAME):
        beside = ndimage.convolve(smooth.astype(np.uint8), _CROSS.astype(np.uint8), mode="constant") - smooth
        rough = np.where(smooth, beside <= 1, beside >= 3)
        if not rough.any():
            break
        smooth ^= rough
    return np.argwhere(smooth ^ void)


def _most_promising(changes, label, result, targets, symmetric=False):
    """`changes` (m, 2, 2) in the order of the largest error to expect from each, the smallest first.

    Descriptors that have a gradient are expected to change as :func:`.inverse.adjoint.flip_changes` says; all others,
    to stay.
    """
    shape, mirror = describe(result), _mirror_columns(label)
    gradients = {name: get_descriptor(name).gradient for name in targets.asked}
    stays = [miss for name, miss in deviations(targets, shape).items() if gradients[name] is None]
    expected = np.full(len(changes), max(stays, default=0.0))
    first, second = changes[:, 0], changes[:, 1]
    for name, gradient in gradients.items():
        if gradient is None:
            continue
        change = flip_changes(label, sensitivities(result, gradient))
        if symmetric:  # of both pixels; one in the middle is its own mirror image
            change = change + np.where(mirror == np.arange(FRAME), 0, change[:, mirror.clip(0, FRAME - 1)])
        change = change[tuple(first.T)] + np.where(np.all(first == second, axis=1), 0, change[tuple(second.T)])
        expected = np.maximum(expected, np.abs((shape.vector(name) + change) / targets.vector(name) - 1))
    return changes[np.argsort(expected, kind="stable")]


def border(label):
    """(k, 2) rows and columns of the pixels on either side of the border of the cavity."""
    void = label == VOID
    return np.argwhere(ndimage.binary_dilation(void, _CROSS) & ~ndimage.binary_erosion(void, _CROSS))


def with_flipped(label, pixels, symmetric=False):
    """The cavity of a structure, (28, 28) bool, with `pixels` (k, 2) flipped; where `symmetric`, mirror images too."""
    rows, columns = np.transpose(pixels)
    flipped = np.zeros(label.shape, bool)
    flipped[rows, columns] = True
    if symmetric:
        flipped[rows, _mirror_columns(label)[columns]] = True
    return (label == VOID) ^ flipped


def _mirror_columns(label):
    """(28,) the column that each column of a structure changes places with when it is mirrored where it stands."""
    columns = np.flatnonzero(np.any(label != OUTSIDE, axis=0))
    return columns[0] + columns[-1] - np.arange(FRAME)
