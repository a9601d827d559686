"""From a grey image to the structure that it stands for: the fixed preprocessing of Fig. 2.

A *label image* is a (28, 28) float array: 0 outside, 0.5 in the wall, 1 in the void that is inflated. It stands on the
bottom row of the frame, where the wall is clamped; or at another edge, if that one is to be clamped.
"""

from dataclasses import dataclass

import numpy as np

from inflate_lib._checks import choice, flag, number, whole_number

FRAME = 28  # pixels per side; the frame is the unit square
PIXEL = 1 / FRAME  # side of a pixel
THICKNESS = 2  # of the wall, in pixels
THRESHOLD = 0.5  # between dark and bright
OUTSIDE, WALL, VOID = 0.0, 0.5, 1.0  # the labels
MIN_PIXELS = 12  # a smaller main component is a speck, not a digit (the smallest MNIST seven has 23)
_WHOLE = 0.9  # share of the bright pixels that one connected piece must hold for a drawing to be one structure
_EIGHT_NEIGHBOURS = np.ones((3, 3), bool)
#: Edges of the frame that a structure can be clamped at. Number n comes to the bottom by n quarter turns of np.rot90.
_EDGES = ("bottom", "left", "top", "right")


@dataclass(frozen=True)
class _Stages:
    """The panels of Fig. 2. Where ``pad`` is on, d to f live on a canvas that is ``wall`` pixels wider on each side."""

    grey: np.ndarray  # a: (28, 28) float in [0, 1]
    component: np.ndarray  # b: (28, 28) bool, largest component of the binarised image
    filled: np.ndarray  # c: (28, 28) bool, without holes
    expanded: np.ndarray  # d: digit and wall together, 0.5
    composite: np.ndarray  # e: labels, the digit laid over the expanded shape
    shifted: np.ndarray  # f: labels, moved to the clamped edge of the frame: down, if not asked otherwise
    domains: np.ndarray  # g: (28, 28) labels within the frame, what `label_image` returns
    note: str = ""  # what of the drawing is not in the structure: smaller pieces, and holes

    def items(self):
        """Pairs of name and array, a to g."""
        return [(name, getattr(self, name)) for name in self.__dataclass_fields__ if name != "note"]


def label_image(
    image: np.ndarray, threshold: float = THRESHOLD, wall: int = THICKNESS, pad: bool = True, clamped: str = "bottom"
) -> np.ndarray:
    """Label image of the structure in a grey image (Fig. 2).

    Pieces of a drawing that do not touch its largest one are dropped, and holes are filled; ``note`` of :func:`stages`
    says where there were any.

    Parameters
    ----------
    image : array (28, 28)
        uint8 in 0..255, bool, or float in [0, 1]. A label image is its own label image.
    threshold : float
        Pixels brighter than this (on the scale from 0 to 1) belong to the digit.
    wall : int
        Thickness of the wall in pixels.
    pad : bool
        Let the wall grow beyond the frame before the structure is moved into it. ``False`` cuts the wall off at the
        border instead. A cavity that reaches the border is then closed by the ground, if that is the clamped edge,
        and open elsewhere (:func:`is_open`); it is there to study the difference.
    clamped : {"bottom", "left", "top", "right"}
        Edge of the frame that the structure is moved to.

    Returns
    -------
    array (28, 28) of float, 0 outside, 0.5 wall, 1 void.

    Raises
    ------
    ValueError
        Where the image holds no usable structure, with the reason; or an argument is out of range.
    """
    return stages(image, threshold, wall, pad, clamped).domains


def stages(
    image: np.ndarray, threshold: float = THRESHOLD, wall: int = THICKNESS, pad: bool = True, clamped: str = "bottom"
) -> _Stages:
    """Every intermediate image of :func:`label_image`, as :class:`_Stages`; same arguments, same errors."""
    whole_number("wall", wall, 1, FRAME)
    number("threshold", threshold, least=0, below=1)
    flag("pad", pad)
    from scipy import ndimage  # here and below: whoever trains elsewhere has flips and shifts, but no SciPy

    turns = turns_to_bottom(clamped)
    grey = as_grey(image)
    component = main_component(grey, threshold)
    filled = ndimage.binary_fill_holes(component)
    margin = wall if pad else 0
    digit = np.pad(filled, margin)
    expanded = WALL * ndimage.maximum_filter(digit.view(np.uint8), size=2 * wall + 1, mode="constant")
    composite = np.where(digit, VOID, expanded)
    shifted = np.rot90(_into_frame(np.rot90(composite, turns), margin), -turns)
    frame = slice(margin, margin + FRAME)
    note = _left_out(grey > threshold, component, filled)
    return _Stages(grey, component, filled, expanded, composite, shifted, shifted[frame, frame].copy(), note)


def _left_out(bright, component, filled):
    """What is dropped from the bright pixels, and what is filled, in words."""
    from scipy import ndimage

    words = []
    for name, done, pixels, neighbours in (
        ("smaller piece", "dropped", bright & ~component, _EIGHT_NEIGHBOURS),
        ("hole", "filled", filled & ~component, None),
    ):
        if pixels.any():
            n, size = ndimage.label(pixels, neighbours)[1], int(pixels.sum())
            words.append(f"{n} {name}{'s' * (n > 1)} of {size} pixel{'s' * (size > 1)} {done}")
    return ", ".join(words)


def turns_to_bottom(clamped):
    """Quarter turns (of ``np.rot90``) that bring an edge of the frame to the bottom, or a ValueError."""
    return _EDGES.index(choice("clamped", clamped, _EDGES))


def as_grey(image):
    """A checked image as float in [0, 1], or a ValueError that says what is wrong with it."""
    if np.ma.isMaskedArray(image):
        raise ValueError("image is a masked array; give the values behind its mask, as by image.filled(0)")
    try:
        image = np.asarray(image)
    except (TypeError, ValueError, RuntimeError) as error:  # ragged lists; tensors that NumPy cannot take
        raise ValueError(f"image is not an array of numbers ({error})") from None
    if image.shape != (FRAME, FRAME):
        raise ValueError(f"image has shape {image.shape}; a single ({FRAME}, {FRAME}) image is needed")
    if image.dtype == np.uint8:
        return image / 255
    if image.dtype == bool:
        return image.astype(float)
    if not np.issubdtype(image.dtype, np.floating):
        raise ValueError(f"image is of type {image.dtype}; give uint8 (0 to 255), bool, or float (0 to 1)")
    if not np.isfinite(image).all():
        raise ValueError("image has pixels that are NaN or infinite")
    if image.min() < 0 or image.max() > 1:
        raise ValueError(
            f"image is a float image with values from {image.min():g} to {image.max():g}; they must lie in [0, 1] "
            "(give 0 to 255 as uint8)"
        )
    return image.astype(float)


def main_component(grey, threshold=THRESHOLD):
    """Largest 8-connected component, (28, 28) bool, of the pixels of ``grey`` that are brighter than ``threshold``."""
    from scipy import ndimage

    components, n_components = ndimage.label(grey > threshold, _EIGHT_NEIGHBOURS)
    if n_components == 0:
        raise ValueError(f"image is blank: no pixel is brighter than {threshold:g} (brightest: {grey.max():.2g})")
    sizes = np.bincount(components.ravel())[1:]
    if sizes.max() < MIN_PIXELS:
        raise ValueError(
            f"image has no digit: its largest connected component has {sizes.max()} pixels, fewer than {MIN_PIXELS}"
        )
    return components == 1 + sizes.argmax()


def is_whole(image: np.ndarray) -> bool:
    """Whether one connected piece holds nearly all bright pixels of a drawing (28, 28) in [0, 1]."""
    try:
        return bool(main_component(image).sum() >= _WHOLE * (image > THRESHOLD).sum())
    except ValueError:
        return False


def joined(image: np.ndarray) -> np.ndarray:
    """A drawing (28, 28) in [0, 1] whose pieces are joined where one or two dark pixels lie between them.

    What is dark between bright pixels is filled by a closing (dilation, then erosion; Serra 1982), of 3 × 3 pixels. A
    drawing that is whole already, or is not whole after it, stays as it is.
    """
    from scipy import ndimage

    if is_whole(image):
        return image
    bright = image > THRESHOLD
    filled = np.where(ndimage.binary_closing(bright, _EIGHT_NEIGHBOURS) & ~bright, image.max(), image)
    return filled if is_whole(filled) else image


def _into_frame(composite, margin):
    """Move the structure down to the frame's bottom row; sideways only as far as it must to be inside the frame."""
    rows, columns = np.nonzero(composite)
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    if max(height, width) > FRAME:
        raise ValueError(
            f"structure does not fit: digit and wall are {width} pixels wide and {height} high, the frame is "
            f"{FRAME} by {FRAME}"
        )
    first, last = margin, margin + FRAME - 1
    down = last - rows.max()
    right = max(first - columns.min(), 0) + min(last - columns.max(), 0)
    shifted = np.zeros_like(composite)
    shifted[rows + down, columns + right] = composite[rows, columns]
    return shifted


def is_open(label: np.ndarray, clamped: str = "bottom") -> bool:
    """Whether the cavity of a structure leads out: void and outside share the side of a pixel.

    Beyond three edges of the frame is the outside. Behind the clamped one is the ground, which closes a cavity that
    reaches it. Void and outside that share a corner only lie on either side of a joint of one node (see
    :func:`point_joints`), which is closed.

    Parameters
    ----------
    label : (s, s) array_like
        Labels 0 (outside), 0.5 (wall), 1 (void).
    clamped : {"bottom", "left", "top", "right"}
        Edge of the frame that the structure is clamped at.
    """
    standing = np.rot90(np.asarray(label), turns_to_bottom(clamped))
    outside = np.pad(standing == OUTSIDE, ((1, 0), (1, 1)), constant_values=True)
    void = np.pad(standing == VOID, ((1, 0), (1, 1)))
    beside = (void[1:] & outside[:-1]) | (void[:-1] & outside[1:])
    across = (void[:, 1:] & outside[:, :-1]) | (void[:, :-1] & outside[:, 1:])
    return bool(beside.any() or across.any())


def point_joints(label: np.ndarray) -> int:
    """Number of nodes at which two wall pixels meet that share no other connection there.

    Such a joint is an artefact of the pixels: a continuum passes no force through a point, so that every finer mesh
    makes it softer, without a limit.

    Parameters
    ----------
    label : (s, s) array_like
        Labels 0 (outside), 0.5 (wall), 1 (void).
    """
    wall = np.pad(np.asarray(label) == WALL, 1)
    a, b, c, d = wall[:-1, :-1], wall[:-1, 1:], wall[1:, :-1], wall[1:, 1:]
    return int(np.sum((a & d & ~b & ~c) | (b & c & ~a & ~d)))
