"""From one drawing to a verified structure: label, constraints, inflation; and how a near miss is brought nearer.

A structure is made of pixels, and one pixel of its cavity more or less changes its descriptors by a tenth of a percent
or so. An inflation takes milliseconds, drawing a candidate ten times as long. So a near miss is worth some tries: a
pixel at the border of the cavity is flipped, the structure labelled and inflated again, and the change kept if the
largest error has become smaller.
"""

import numpy as np
from scipy import ndimage

from inflate_lib.constraints import PIXEL, Constraints
from inflate_lib.contact import first_contact
from inflate_lib.datasets import TIME_LIMIT
from inflate_lib.descriptors import describe
from inflate_lib.design_targets import errors
from inflate_lib.inflation import inflate
from inflate_lib.structures import FRAME, OUTSIDE, VOID, label_image

CROSS = ndimage.generate_binary_structure(2, 1)
LESS = 1e-3  # relative decrease of the largest error that a change must bring


def attempt(image, constraints):
    """Label and inflate one image under constraints.

    Returns
    -------
    reason : str
        Why it is rejected; empty where it is not.
    label : (28, 28) float or None
    result : Inflation or None
    """
    try:
        label = label_image(image)
        anywhere = Constraints(**{**constraints.as_dict(), "keep_out": None})
        if broken := anywhere.broken_by(label):
            return f"break {broken}", label, None
        result = inflate(label, time_limit=TIME_LIMIT[0])
    except ValueError:
        return "are no structure", None, None
    if not result.converged:
        return "find no equilibrium", label, None
    if first_contact(result) is not None:
        return "have walls that cross when inflated", label, None
    if constraints.keep_out is not None:
        shift = free_place(label, result, constraints)
        if shift is None:
            return "break keep_out", label, None
        if shift:
            label = np.roll(label, shift, axis=1)
            result = inflate(label, time_limit=TIME_LIMIT[0])
            if not result.converged or constraints.broken_by(label) or constraints.broken_when_inflated(result):
                return "break keep_out", label, None
    return "", label, result


def free_place(label, result, constraints):
    """The shortest shift, in pixels to the right, by which a structure keeps out of the forbidden region; or None."""
    columns = np.flatnonzero(np.any(label != OUTSIDE, axis=0))
    for shift in sorted(range(-columns[0], FRAME - columns[-1]), key=abs):
        moved = constraints.moved(shift * PIXEL)
        if not moved.broken_by(label) and not moved.broken_when_inflated(result):
            return shift
    return None


def refine(label, result, targets, constraints, goal, tries, seed=0):
    """Change a structure pixel by pixel until its largest error is at most `goal`, or the tries are used up.

    Parameters
    ----------
    label : (28, 28) float
    result : Inflation
        Of that structure.
    targets : Targets
    constraints : Constraints
        Which it fulfils, and every step on the way.
    goal : float
        Largest relative error to stop at.
    tries : int
        Inflations that may be spent.
    seed : int
        Of the order in which pixels are tried.

    Returns
    -------
    label : (28, 28) float
    result : Inflation
    flipped : list of (int, int)
        Row and column of the pixels, in order; with `symmetric`, each stands for its mirror image as well.
    """
    rng, flipped = np.random.default_rng(seed), []
    best = max(errors(targets, describe(result)).values())
    untried = list(rng.permutation(border(label)))
    while best > goal and tries > 0 and untried:
        row, column = (int(i) for i in untried.pop())
        tries -= 1
        reason, changed, inflated = attempt(with_flipped(label, row, column, constraints.symmetric), constraints)
        if reason:
            continue
        error = max(errors(targets, describe(inflated)).values())
        if error <= best * (1 - LESS):
            label, result, best = changed, inflated, error
            flipped.append((row, column))
            untried = list(rng.permutation(border(label)))
    return label, result, flipped


def border(label):
    """(k, 2) rows and columns of the pixels on either side of the border of the cavity."""
    void = label == VOID
    return np.argwhere(ndimage.binary_dilation(void, CROSS) & ~ndimage.binary_erosion(void, CROSS))


def with_flipped(label, row, column, symmetric=False):
    """The cavity of a structure, (28, 28) bool, with one pixel flipped; where `symmetric`, with its mirror image."""
    void = label == VOID
    columns = np.flatnonzero(np.any(label != OUTSIDE, axis=0))
    mirror = columns[0] + columns[-1] - column if symmetric else column
    void[row, [column, mirror]] = not void[row, column]
    return void
