"""What a maker demands of a structure besides its targets; each demand is checked on the structure that is handed out.

Lengths and areas are those of the unit square, the 28-pixel frame of the undeformed structure; a structure is made of
pixels, so that a length counts in whole pixels, rounded up.
"""

from dataclasses import dataclass, replace

import numpy as np
from matplotlib.path import Path
from matplotlib.transforms import Bbox
from scipy import ndimage

from inflate_lib._checks import flag, number, numbers, positive_number
from inflate_lib.mechanics.inflation import Inflation
from inflate_lib.mechanics.mesh import boundary_loops
from inflate_lib.structures.labels import FRAME, MIN_PIXELS, OUTSIDE, PIXEL, THICKNESS, VOID, WALL, main_component

_ROUNDING = 1e-9  # pixels; so that 2/28 is two pixels and not three


@dataclass(frozen=True)
class Constraints:
    """Demands of a maker; by default there are none.

    Attributes
    ----------
    min_void : float
        Least width of the cavity: a square of this side can be moved through all of it (corners of the cavity, one
        pixel deep, excepted), without leaving the cavity.
    max_material : float
        Largest area of the wall.
    symmetric : bool
        The structure is its own mirror image, left to right.
    keep_out : (float, float, float, float), optional
        Left, bottom, right and top of a rectangle that the structure touches neither undeformed nor at any load step.
        The clamped edge is at y = 0.
    """

    min_void: float = 0.0
    max_material: float = np.inf
    symmetric: bool = False
    keep_out: tuple[float, float, float, float] | None = None

    def __post_init__(self):
        for name, least in (("min_void", 0), ("max_material", PIXEL**2)):
            if getattr(self, name) != np.inf:  # no limit
                number(name, getattr(self, name), least=least)
        if self.min_void > 1:
            raise ValueError(f"min_void {self.min_void:.4g} is more than the frame, which is 1 wide")
        flag("symmetric", self.symmetric)
        if self.keep_out is not None:
            wanted = "four numbers: left, bottom, right, top"
            left, bottom, right, top = numbers("keep_out", self.keep_out, wanted, 4).tolist()
            if not (left < right and bottom < top):
                raise ValueError(f"keep_out must have left < right and bottom < top, not {self.keep_out!r}")
            object.__setattr__(self, "keep_out", (left, bottom, right, top))

    def check(self) -> None:
        """Raise a ValueError where no structure can do as demanded, whatever its targets.

        A cavity holds a square of `min_void`, one pixel at least, which has to fit in with its wall; at the clamped
        edge one pixel does. Of all cavities the square has the least wall for its area (Brunn and Minkowski).
        """
        around = 2 * THICKNESS
        cavity = max(pixels(self.min_void), 1)
        side, foot = cavity + around, 1 + around
        if side > FRAME:
            raise ValueError(f"min_void {self.min_void:.4g}: with its wall such a cavity does not fit into the frame")
        area = max(cavity**2, MIN_PIXELS)
        least = PIXEL**2 * np.ceil((area**0.5 + around) ** 2 - area)
        if self.max_material < least * (1 - _ROUNDING):
            raise ValueError(f"max_material {self.max_material:.4g} of the frame: the least wall has {least:.4g} of it")
        if self.keep_out is not None:
            free = np.ones((FRAME, FRAME), bool)
            free[_rows_columns(self.keep_out)] = False
            if not (_holds(free, side) and _holds(free[-foot:], foot)):
                raise ValueError(f"keep_out {self.keep_out}, in sides of the frame, leaves no room for a structure")

    def as_dict(self) -> dict:
        """What is demanded, in plain values."""
        none, names = Constraints(), self.__dataclass_fields__
        return {name: getattr(self, name) for name in names if getattr(self, name) != getattr(none, name)}

    def moved(self, distance: float) -> "Constraints":
        """The same demands on a structure that will yet move to the right by `distance`."""
        if self.keep_out is None:
            return self
        left, bottom, right, top = self.keep_out
        return replace(self, keep_out=(left - distance, bottom, right - distance, top))

    def broken_by(self, label: np.ndarray) -> str:
        """Name of the first demand that a label image breaks, or an empty text."""
        if self.max_material < PIXEL**2 * np.sum(label == WALL) * (1 - _ROUNDING):
            return "max_material"
        if self.min_void > 0 and not _wide_enough(label == VOID, pixels(self.min_void)):
            return "min_void"
        if self.symmetric and not _is_symmetric(label):
            return "symmetric"
        if self.keep_out is not None and np.any(label[_rows_columns(self.keep_out)] != OUTSIDE):
            return "keep_out"
        return ""

    def broken_when_inflated(self, result: Inflation) -> str:
        """Name of the first demand that a structure breaks at a load step, or an empty text."""
        if self.keep_out is not None:
            left, bottom, right, top = self.keep_out
            box = Bbox([[left, bottom], [right, top]])
            steps = [result.nodes, *(result.nodes + result.displacement)]
            for loop in boundary_loops(result.cells):
                closed = np.append(loop, loop[0])
                if any(Path(nodes[closed]).intersects_bbox(box) for nodes in steps):
                    return "keep_out"
        return ""


def from_millimetres(size_mm, min_void=0.0, max_material=None, symmetric=False, keep_out=None):
    """Constraints of a frame with sides of `size_mm`, from millimetres and square millimetres."""
    positive_number("size_mm", size_mm, "millimetres")
    number("min_void", min_void, least=0)
    area = np.inf if max_material is None else positive_number("max_material", max_material) / size_mm**2
    wanted = "four numbers: left, bottom, right, top"
    region = None if keep_out is None else numbers("keep_out", keep_out, wanted, 4) / size_mm
    return Constraints(min_void / size_mm, area, symmetric, region)


def pixels(length):
    """A length in pixels, rounded up to whole ones."""
    return int(np.ceil(length * FRAME - _ROUNDING))


def _rows_columns(rectangle):
    """Slices of a label image that hold every pixel which a rectangle (left, bottom, right, top) reaches into."""
    left, bottom, right, top = rectangle
    columns = slice(max(int(np.floor(left * FRAME + _ROUNDING)), 0), max(pixels(right), 0))
    return slice(max(FRAME - pixels(top), 0), max(FRAME - int(np.floor(bottom * FRAME + _ROUNDING)), 0)), columns


def _holds(free, side):
    """Whether a square of `side` pixels fits somewhere into pixels that are free (n, m) bool."""
    return bool(ndimage.binary_erosion(free, np.ones((side, side))).any())


def _wide_enough(void, width):
    """Whether a square of `width` pixels can be moved through all of a cavity (n, n) bool, its corners excepted.

    The places that such a square covers (the opening of the cavity) must hang together, and what they leave uncovered
    must not be deeper than one pixel.
    """
    square = np.ones((width, width), bool)
    middles = ndimage.binary_erosion(void, square)  # one for each place of the square
    covered = ndimage.binary_dilation(middles, square)  # SciPy mirrors the square: the opening, whatever its width
    one_piece = ndimage.label(middles)[1] == 1
    return one_piece and bool(np.all(ndimage.binary_dilation(covered, np.ones((3, 3), bool))[void]))


def _is_symmetric(label):
    """Whether a label image is its own mirror image, about an axis anywhere."""
    columns = np.flatnonzero(np.any(label != OUTSIDE, axis=0))
    body = label[:, columns[0] : columns[-1] + 1]
    return np.array_equal(body, body[:, ::-1])


def mirrored(image):
    """Three mirror-symmetric images made from one: its left half, its right half, and both, each with its reflection.

    Parameters
    ----------
    image : (28, 28) float

    Returns
    -------
    list of (28, 28) bool
        Fewer where halves are blank.
    """
    try:
        digit = main_component(image)
    except ValueError:
        return []
    columns = np.flatnonzero(digit.any(axis=0))
    body = digit[:, columns[0] : columns[-1] + 1]
    width = body.shape[1]
    left = np.arange(width) < (width + 1) // 2
    halves = [body & left, body & left[::-1], body]
    images = []
    for half in halves:
        image = np.zeros_like(digit)
        image[:, columns[0] : columns[-1] + 1] = half | half[:, ::-1]
        images.append(image)
    return images
