"""Beyond the paper: patterns of two rubbers in a wall, and pictures of them (the paper's conclusion names the idea).

A structure is two images: the grey one, in which walls are encoded (:mod:`inflate_lib.structures.labels`), and beside
it a *map* of the stiff rubber, true where the wall is of it. What is asked of the map are the pixels of the
wall; a wall that grows beyond the frame takes the nearest of its edge. So image and map can be flipped and shifted
together, and stand for the flipped structure. :mod:`inflate_lib.alternatives.rubbers` has data and a model of them.
"""

import numpy as np
from scipy import ndimage

from inflate_lib._checks import choice, positive_number
from inflate_lib.structures.labels import FRAME, THICKNESS, WALL, as_grey, label_image, main_component, stages

RATIO = 4.0  # stiffness of the second rubber, in that of the first
#: Grey levels of a picture of two rubbers.
LEVELS = {0: "outside", 64: "stiff wall", 127: "soft wall", 254: "void"}
_STIFF = 64
_CRUMB = 4  # pixels that a piece of one rubber must have
FAMILIES = ("side", "half", "bands", "patches")
_DIRECTIONS = {"right": (0, 1), "left": (0, -1), "top": (-1, 0), "bottom": (1, 0)}  # (row, column)


def pattern(image: np.ndarray, family: str, rng: np.random.Generator) -> np.ndarray:
    """A map of the stiff rubber for a grey image.

    Parameters
    ----------
    image : (28, 28) array
    family : {"side", "half", "bands", "patches"}
        The wall on the right, left, upper or lower side of the digit's line; all wall in one half of the frame,
        cut through the middle of the digit; stripes of equal width, 2 to 6 pixels, in any direction; or one to three
        discs, of 3 to 6 pixels in radius, around pixels of the digit.
    rng : numpy.random.Generator

    Returns
    -------
    (28, 28) bool
        Where the wall is stiff; False far from the wall.
    """
    digit = main_component(as_grey(image))
    spots = np.argwhere(digit)
    place = np.indices((FRAME, FRAME)).transpose(1, 2, 0)
    if choice("family", family, FAMILIES) == "side":
        # The wall lies on the side of the line to which its blurred image falls off.
        slope = np.stack(np.gradient(ndimage.gaussian_filter(np.pad(digit.astype(float), 4), 1.5)), -1)[4:-4, 4:-4]
        stiff = slope @ _direction(rng) < 0
    elif family == "half":
        stiff = (place - spots.mean(axis=0)) @ _direction(rng) > 0
    elif family == "bands":
        angle, width = rng.uniform(0, np.pi), rng.uniform(2, 6)
        stiff = (place @ [np.cos(angle), np.sin(angle)] / width + rng.uniform(0, 2)) % 2 < 1
    else:
        centres = spots[rng.integers(len(spots), size=rng.integers(1, 4))]
        radii = rng.uniform(3, 6, size=len(centres))
        stiff = (np.hypot(*(place[..., None, :] - centres).transpose(3, 0, 1, 2)) < radii).any(axis=-1)
    near = ndimage.maximum_filter(digit, size=2 * THICKNESS + 1)
    return stiff & near


def _direction(rng):
    return _DIRECTIONS[rng.choice(list(_DIRECTIONS))]


def stiffness_of(
    image: np.ndarray, stiff: np.ndarray, ratio: float = RATIO, wall: int = THICKNESS, clamped: str = "bottom"
) -> np.ndarray:
    """The stiffness of each pixel of ``label_image(image)``: what :func:`inflate_lib.inflate` is told of two rubbers.

    Parameters
    ----------
    image : (28, 28) array
        Grey image.
    stiff : (28, 28) array
        Map of the stiff rubber, bool; or a grey image, which is stiff where it is brighter than half.
    ratio : float
        Stiffness of that rubber; 1 is the paper's.
    wall, clamped
        As for :func:`inflate_lib.label_image`.

    Returns
    -------
    (28, 28) float
        1 or `ratio`; the map, moved to the ground as the label image is.
    """
    positive_number("ratio", ratio)
    done = stages(image, wall=wall, clamped=clamped)
    before, after = np.argwhere(done.composite)[0], np.argwhere(done.shifted)[0]
    moved = np.pad(as_grey(stiff) > 0.5, wall, mode="edge")  # on the canvas that the wall has grown on
    moved = np.roll(moved, after - before, axis=(0, 1))
    return np.where(moved[wall:-wall, wall:-wall], ratio, 1.0)


def castable(stiffness: np.ndarray, label: np.ndarray) -> np.ndarray:
    """The same stiffness, changed where a rubber could not be cast: crumbs, and parts that meet in a corner only.

    A *crumb* is a piece of fewer than four pixels; it becomes of the other rubber. Corners are filled up with the stiff
    one.

    Parameters
    ----------
    stiffness : (28, 28) float
        From :func:`stiffness_of`.
    label : (28, 28) float
        The label image.

    Returns
    -------
    (28, 28) float
    """
    wall = label == WALL
    stiff = wall & (stiffness > 1)
    stiff &= ~_crumbs(stiff)
    while True:  # stiff parts only grow
        corners, grown = _in_corners(stiff) | _in_corners(wall & ~stiff), _crumbs(wall & ~stiff)
        for row, column in np.ndindex(2, 2):
            grown[row : row + FRAME - 1, column : column + FRAME - 1] |= corners
        if not (grown & wall & ~stiff).any():
            return np.where(stiff, np.max(stiffness), 1.0)
        stiff |= grown & wall


def _crumbs(part):
    """(28, 28) bool: the pieces of a part, connected by sides, that are too small."""
    pieces, _ = ndimage.label(part)
    return part & (np.bincount(pieces.ravel()) < _CRUMB)[pieces]


def _in_corners(part):
    """(27, 27) bool: between which four pixels a part touches itself in the corner alone."""
    a, b, c, d = part[:-1, :-1], part[:-1, 1:], part[1:, :-1], part[1:, 1:]
    return (a & d & ~b & ~c) | (b & c & ~a & ~d)


def rubber_picture(image: np.ndarray, stiff: np.ndarray) -> np.ndarray:
    """A structure of two rubbers as one picture, (28, 28) uint8: grey levels 0, 64, 127, 254, which are ``LEVELS``."""
    return picture_of(label_image(image), stiffness_of(image, stiff, 2.0) > 1)


def picture_of(label: np.ndarray, stiff: np.ndarray | None = None) -> np.ndarray:
    """A label image as a picture, (28, 28) uint8; `stiff` (28, 28) bool is where its wall is of a stiff rubber."""
    picture = np.rint(254 * label).astype(np.uint8)
    return picture if stiff is None else np.where(stiff & (label == WALL), np.uint8(_STIFF), picture)


def is_picture(image: np.ndarray) -> bool:
    """Whether an image is a picture of two rubbers: of their grey levels alone, and with a stiff wall."""
    levels = set(np.unique(_as_levels(image)).tolist())
    return _STIFF in levels and levels <= {*LEVELS, 255}


def from_picture(picture: np.ndarray, wall: int = THICKNESS) -> tuple[np.ndarray, np.ndarray]:
    """Image and map of a structure of two rubbers, from a picture as of :func:`rubber_picture`.

    Raises
    ------
    ValueError
        Where a pixel has another grey level, or a stiff one is not where the wall around the void is.
    """
    levels = _as_levels(picture)
    if strange := sorted(set(np.unique(levels).tolist()) - {*LEVELS, 255}):
        meant = ", ".join(f"{level} ({name})" for level, name in LEVELS.items())
        raise ValueError(f"picture of two rubbers: its grey levels must be {meant}; it has {strange[0]} as well")
    stiff = levels == _STIFF
    image = np.where(stiff, 127, levels).astype(np.uint8)
    composite = stages(image, wall=wall).composite[wall:-wall, wall:-wall]
    if astray := int(np.sum(stiff & (composite != WALL))):
        raise ValueError(
            f"picture of two rubbers: {astray} pixels of level {_STIFF} are not in the wall, "
            f"which is {wall} pixels thick around the void"
        )
    return image, stiff


def _as_levels(picture):
    return np.rint(255 * as_grey(picture)).astype(np.uint8)
