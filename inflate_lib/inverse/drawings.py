"""The inflated shape, drawn: the outline in an SVG file or a picture."""

import io
from pathlib import Path

import numpy as np
from scipy import ndimage

from inflate_lib._checks import positive_number

_MAX_SIZE = 2000  # pixels of a drawing, per side


PIECES = 32  # straight pieces that stand for one curved segment of an SVG path


_OPEN = 0.01  # gap, relative to the size of a drawing, up to which it counts as closed


def read_outline(path: str | Path, unit: float) -> np.ndarray:
    """Corners (k, 2) of a drawn outline, y upwards, in lengths of the unit square.

    Parameters
    ----------
    path : path_like
        ``.svg`` with one closed shape (curves are followed by short straight pieces), or a picture in two colours, the
        background being that of its corners; a line drawn around the shape and a filled shape mean the same.
    unit : float
        Units of the drawing (user units of the SVG, pixels of the picture) in one side of the unit square, which is the
        28-pixel frame of the undeformed structure.

    Raises
    ------
    ValueError
        Naming the file, where it cannot be read, or holds no shape or several.
    """
    path = Path(path)
    positive_number("the unit of the outline", unit)
    if not path.is_file():
        raise ValueError(f"{path} does not exist")
    points = _svg_points(path) if path.suffix.lower() == ".svg" else _picture_points(path)
    return points * [1, -1] / unit


def _svg_points(path):
    """Corners of the one closed curve in an SVG file, in user units, y downwards."""
    from xml.etree import ElementTree

    try:
        import svgelements
    except ImportError:
        raise RuntimeError(f"{path}: an outline as SVG needs svgelements: pip install 'inflate-lib[design]'") from None
    try:
        root = ElementTree.parse(path).getroot()
        for name in ("width", "height", "viewBox"):  # they would turn user units into pixels of a screen
            root.attrib.pop(name, None)
        drawing = svgelements.SVG.parse(io.BytesIO(ElementTree.tostring(root)))
        shapes = [shape for shape in drawing.elements() if isinstance(shape, svgelements.Shape)]
        drawn = [svgelements.Path(*shape.segments(transformed=True)) for shape in shapes]
        curves = [list(curve) for shape in drawn for curve in shape.as_subpaths() if len(curve) > 1]
        curves = [[segment for segment in curve if not isinstance(segment, svgelements.Move)] for curve in curves]
    except (ElementTree.ParseError, ValueError, TypeError, AttributeError, KeyError, IndexError, OSError) as error:
        raise ValueError(f"{path} cannot be read as an SVG file: {error}") from None
    if not curves:
        raise ValueError(f"{path}: the outline is empty; there is no path, polygon, circle, … in it")
    if len(curves) > 1:
        raise ValueError(f"{path}: {len(curves)} separate curves; one outline is needed")
    points = [curves[0][0].start]
    for segment in curves[0]:
        straight = isinstance(segment, svgelements.Line | svgelements.Close)
        points += [segment.end] if straight else [segment.point(t) for t in np.arange(1, PIECES + 1) / PIECES]
    points = np.array([(point.x, point.y) for point in points], dtype=float)
    if np.linalg.norm(points[-1] - points[0]) > _OPEN * np.ptp(points, axis=0).max():
        raise ValueError(f"{path}: the outline is open; close it, so that it has an inside")
    return points[:-1]


def _picture_points(path):
    """Corners of the border of the one shape in a picture, in pixels, y downwards."""
    from skimage.measure import find_contours

    from inflate_lib.io.pictures import read_picture

    grey = np.asarray(read_picture(path))
    if max(grey.shape) > _MAX_SIZE:
        raise ValueError(f"{path} is {grey.shape[1]} × {grey.shape[0]} pixels; {_MAX_SIZE} per side are enough")
    bright = grey > 127
    corners = bright[[0, 0, -1, -1], [0, -1, 0, -1]]
    if corners.any() != corners.all():
        raise ValueError(f"{path}: its four corners must be background, all dark or all bright")
    shape = ndimage.binary_fill_holes(bright != corners[0])
    pieces = ndimage.label(shape, np.ones((3, 3)))[1]
    if pieces == 0:
        raise ValueError(f"{path}: the outline is empty; all of the picture has one colour")
    if pieces > 1:
        raise ValueError(f"{path}: {pieces} separate shapes; one outline is needed")
    (border,) = find_contours(np.pad(shape, 1).astype(float), 0.5, fully_connected="high")
    return border[:-1, ::-1] - 0.5  # from centres of padded pixels to edges of pixels
