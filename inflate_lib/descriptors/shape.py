"""What descriptors are measured on: the deformed nodes, their convex hull, and the inflation that they come from."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from inflate_lib._checks import numbers, whole_number

if TYPE_CHECKING:
    from inflate_lib.mechanics.inflation import Inflation

AXIS_POINTS = 30
OUTLINE_DIRECTIONS = 32  # a multiple of four: right, up, left and down are among them
_EVEN = 1e-3  # relative difference up to which increments of height count as equal


@dataclass(frozen=True)
class Shape:
    """A deformed structure, in lengths of the unit square, in the fixed frame: x to the right and y upwards.

    Attributes
    ----------
    nodes : (n, 2) float
        Deformed nodes.
    hull : (k, 2) float
        Corners of their convex hull, counter-clockwise.
    hull_area : float
    result : Inflation or None
        The inflation at this one load step; None for a shape that is known by its nodes alone.
    """

    nodes: np.ndarray
    hull: np.ndarray
    hull_area: float
    result: object = None

    @classmethod
    def of(cls, result: "Inflation | np.ndarray", step: int = -1) -> "Shape":
        """The shape of an inflation at a load step, or of nodes; see :func:`inflate_lib.describe`."""
        if hasattr(result, "deformed"):
            n_steps = len(result.load_steps)
            step = whole_number("step", step, -n_steps, n_steps - 1)
            nodes, inflation = result.deformed(step), replace(result, displacement=result.displacement[[step]])
            if not np.isfinite(nodes).all():
                raise ValueError(f"the structure has no equilibrium to describe: {result.reason}")
        else:
            nodes, inflation = check_points("nodes", result), None
        try:
            hull = ConvexHull(nodes)
        except (QhullError, ValueError):  # of fewer than three nodes as well
            raise ValueError("the deformed nodes span no area, so they have no convex hull") from None
        return cls(nodes, nodes[hull.vertices], float(hull.volume), inflation)


def medial_axis(hull: np.ndarray, points: int = AXIS_POINTS) -> np.ndarray:
    """Midpoints of the horizontal chords of a convex polygon at equal height increments (paper sec. 3.1, item v).

    Parameters
    ----------
    hull : (k, 2) float
        Corners of a convex polygon, counter-clockwise.
    points : int
        Number of chords; the increment is the polygon's height divided by it.

    Returns
    -------
    axis : (points, 2) float
        From the bottom upwards; the first point is the origin.
    """
    whole_number("points", points, 1)
    left, right = _hull_sides(hull)
    bottom, top = hull[:, 1].min(), hull[:, 1].max()
    height = bottom + (top - bottom) * np.arange(points) / points
    middle = 0.5 * (np.interp(height, left[:, 1], left[:, 0]) + np.interp(height, right[:, 1], right[:, 0]))
    return np.column_stack([middle - middle[0], height - bottom])


def _hull_sides(hull: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The left and the right side of a convex polygon, each from its lowest to its highest corner.

    Parameters
    ----------
    hull : (k, 2) float
        Corners of a convex polygon, counter-clockwise.

    Returns
    -------
    left, right : (·, 2) float
        Corners with increasing y.
    """
    x, y = hull.T
    lowest = np.lexsort((-x, y))[0]  # the right end of a flat bottom
    highest = np.lexsort((-x, -y))[0]  # the right end of a flat top
    ring = np.roll(hull, -lowest, axis=0)
    split = (highest - lowest) % len(hull)
    right, left = ring[: split + 1], np.concatenate([ring[split:], ring[:1]])[::-1]
    # A flat bottom (top) belongs to neither side: drop the far end, which has the same y.
    if len(left) > 2 and left[1, 1] <= left[0, 1]:
        left = left[1:]
    if len(left) > 2 and left[-2, 1] >= left[-1, 1]:
        left = left[:-1]
    return left, right


def check_axis(name: str, value: Any) -> np.ndarray:
    """A medial axis (30, 2) from points, or a ValueError.

    Thirty points at equal increments of height are taken as they are (the thirtieth lies one increment below the top,
    as in :func:`medial_axis`). Any other points are the corners of a line from the bottom of the shape to its top, on
    which the thirty are placed.
    """
    points = check_points(name, value)
    if len(points) < 2:
        raise ValueError(f"{name}: two points at least are needed, from the bottom to the top, not {len(points)}")
    rise = np.diff(points[:, 1])
    if not np.all(rise > 0):
        row = int(np.argmax(rise <= 0)) + 2
        raise ValueError(f"{name}: its points must rise from the bottom to the top; point {row} does not")
    points = points - points[0]
    if len(points) == AXIS_POINTS and np.ptp(rise) <= _EVEN * rise.mean():
        return points
    y = points[-1, 1] * np.arange(AXIS_POINTS) / AXIS_POINTS
    return np.column_stack([np.interp(y, points[:, 1], points[:, 0]), y])


def support_function(points: np.ndarray) -> np.ndarray:
    """Outline of the convex hull of points as its support function (Schneider 2014, section 1.7).

    H(θ) is how far the hull reaches in the direction (cos θ, sin θ) from the point of the ground below its middle: the
    distance of the supporting line with this normal. The hull is where all of these half planes overlap.

    Parameters
    ----------
    points : (n, 2) float

    Returns
    -------
    (32,) float
        H at θ = 2π k / 32, k = 0, …, 31.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    normals = outline_normals()
    return (normals @ (points - [(low[0] + high[0]) / 2, low[1]]).T).max(axis=1)


def outline_normals() -> np.ndarray:
    """(32, 2) the directions of :func:`support_function`, exact in the quarters."""
    angle = 2 * np.pi * np.arange(OUTLINE_DIRECTIONS) / OUTLINE_DIRECTIONS
    return np.round(np.column_stack([np.cos(angle), np.sin(angle)]), 15)


def outline_corners(supports: np.ndarray) -> np.ndarray:
    """Corners (32, 2) of the polygon whose sides have the outward normals and distances of a support function (32,)."""
    normals = outline_normals()
    pairs = np.stack([normals, np.roll(normals, -1, axis=0)], axis=1)
    return np.linalg.solve(pairs, np.column_stack([supports, np.roll(supports, -1)])[:, :, None])[:, :, 0]


def outline_height(supports: np.ndarray) -> np.ndarray:
    """Height of the shapes of support functions (…, 32)."""
    up = OUTLINE_DIRECTIONS // 4
    return supports[..., up] + supports[..., 3 * up]


def mirror_outline(supports: np.ndarray) -> np.ndarray:
    """Support functions (…, 32) of shapes mirrored left to right: H(θ) → H(π − θ)."""
    return supports[..., (OUTLINE_DIRECTIONS // 2 - np.arange(OUTLINE_DIRECTIONS)) % OUTLINE_DIRECTIONS]


def check_outline(name: str, value: Any) -> np.ndarray:
    """A support function (32,): as it is, or of points (k, 2), the corners of an outline; or a ValueError."""
    supports = np.asarray(value, dtype=object if isinstance(value, str) else None)
    if supports.shape != (OUTLINE_DIRECTIONS,):
        points = check_points(name, value)
        if len(points) < 3 or np.linalg.matrix_rank(points - points[:1]) < 2:
            raise ValueError(
                f"{name}: three points that are not on one line are needed, these {len(points)} enclose nothing"
            )
        return support_function(points)
    supports = numbers(name, value, f"{OUTLINE_DIRECTIONS} finite numbers")
    half = OUTLINE_DIRECTIONS // 2
    if not np.all(supports + np.roll(supports, half) > 0):
        raise ValueError(f"{name}: a support function of no shape; its width must be positive in each direction")
    return supports


def check_points(name: str, value: Any) -> np.ndarray:
    """Points (k, 2), or a ValueError."""
    points = numbers(name, value, "points of shape (k, 2)", finite=False)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"{name}: points of shape (k, 2) are needed")
    if not np.isfinite(points).all():
        raise ValueError(f"{name}: some coordinates are NaN or infinite")
    return points


def area_gradient(corners: np.ndarray) -> np.ndarray:
    """Derivative of the area of polygons (…, k, 2), counter-clockwise, with respect to their corners."""
    across = (np.roll(corners, -1, axis=-2) - np.roll(corners, 1, axis=-2)) / 2
    return np.stack([across[..., 1], -across[..., 0]], axis=-1)


def axis_height(axis: np.ndarray) -> np.ndarray:
    """Height of the shape that a medial axis (…, k, 2) belongs to: the axis ends one increment below the top."""
    points = axis.shape[-2]
    return axis[..., -1, 1] * points / (points - 1)


def place_axis(axis: np.ndarray, hull: np.ndarray) -> np.ndarray:
    """A medial axis (k, 2), whose first point is the origin, put back where it was in the hull that it came from."""
    base = hull[np.isclose(hull[:, 1], hull[:, 1].min(), atol=1e-9), 0]
    return axis + [(base.min() + base.max()) / 2, hull[:, 1].min()]


def mirror_axis(axes: np.ndarray) -> np.ndarray:
    """Medial axes mirrored left to right: (…, 60), point by point, or (…, 30, 2); the first point is the origin."""
    mirrored = np.array(axes, float)
    if mirrored.shape[-1] == 2:
        mirrored[..., 0] *= -1
    else:
        mirrored[..., 0::2] *= -1
    return mirrored
