"""The inflated shape, drawn: the outline in an SVG file or a picture."""

import reprlib
from pathlib import Path

import numpy as np
from scipy import ndimage

from inflate_lib._checks import positive_number
from inflate_lib.inverse import _svg

_MAX_SIZE = 2000  # pixels of a drawing, per side
_SVG = (".svg", ".svgz")
OPEN = 0.01  # gap, relative to the size of a drawing, up to which it counts as closed


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
    positive_number("the unit of the outline", unit)
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} is no file" if path.exists() else f"{path} does not exist")
    points = _svg_points(path) if path.suffix.lower() in _SVG else _picture_points(path)
    return points * [1, -1] / unit


def how_measured(path: str | Path, points: np.ndarray, unit: float) -> str:
    """A sentence that says what the unit of a drawing was taken to be; the arguments and result of `read_outline`."""
    path, (width, height) = Path(path), np.ptp(points, axis=0) * unit
    drawn = "user units" if path.suffix.lower() in _SVG else "pixels"
    text = (
        f"The outline in {path} is {width:.5g} {drawn} wide and {height:.5g} high, and {unit:.5g} of them were taken "
        "as a side of the frame (--outline-unit, which is --size-mm where it is not given)"
    )
    if drawn == "user units" and not np.isnan(per_mm := _svg.units_per_millimetre(path)):
        text += f"; by the size that the file gives itself a millimetre is {per_mm:.5g} of them"
    return f"{text}."


def _svg_points(path):
    """Corners of the one closed curve that an SVG file paints, in user units, y downwards."""
    try:
        curves = _svg.painted_curves(path)
    except ImportError as error:
        raise RuntimeError(f"{path}: an outline as SVG needs {error.name}: pip install 'inflate-lib[design]'") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    except RecursionError:
        raise ValueError(f"{path}: its groups are nested too deeply") from None
    if not curves:
        raise ValueError(f"{path}: the outline is empty; there is no path, polygon, circle, … in it that is painted")
    if len(curves) > 1:
        names = reprlib.repr([name for name, _ in curves]).replace("'", "")
        raise ValueError(f"{path}: {len(curves)} separate curves are painted, {names}; one outline is needed")
    ((_, points),) = curves
    if np.linalg.norm(points[-1] - points[0]) > OPEN * np.ptp(points, axis=0).max():
        raise ValueError(f"{path}: the outline is open; close it, so that it has an inside")
    return points[:-1]


def _picture_points(path):
    """Corners of the border of the one shape in a picture, in pixels, y downwards."""
    from skimage.measure import find_contours

    from inflate_lib.io.pictures import read_pages

    pages, _ = read_pages(path)
    if len(pages) > 1:
        raise ValueError(f"{path} holds {len(pages)} pictures; one outline is needed")
    (grey,) = pages
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
