"""Descriptors of a deformed structure (paper sec. 3.1, Fig. 3): height, width, bounding box, hull area, medial axis.

Beside these five there are two physical ones, which the paper leaves to future work (sec. 5): the peak von Mises stress
and the largest principal stretch, see :func:`inflate_lib.mechanics.stress.peaks`.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from inflate_lib.mechanics.stress import peaks

AXIS_POINTS = 30

#: The paper's five descriptors, each with a model of its own, and the length N of each as a vector.
DESCRIPTORS = {"height": 1, "width": 1, "box": 2, "area": 1, "axis": 2 * AXIS_POINTS}
#: The physical ones, told as they are: over MNIST's sevens their skewness is 0.5 and 0.3. Logarithms of the stress have
#: one of -0.5, and would leave less of the scaled range [0, 1] to the bulk, not more.
PHYSICAL = {"stress": 1, "stretch": 1}
#: Parts of the descriptor "joint", of which a model can be asked for any combination, and their lengths; the axis last.
PARTS = {"height": 1, "width": 1, "area": 1, **PHYSICAL, "axis": 2 * AXIS_POINTS}
JOINT = "joint"

#: Variables of a data set that each descriptor but "joint" is made of.
VARIABLES = {
    "height": ["height"],
    "width": ["width"],
    "box": ["height", "width"],
    "area": ["hull_area"],
    "axis": ["medial_axis"],
    "stress": ["peak_stress"],
    "stretch": ["peak_stretch"],
}


@dataclass(frozen=True)
class Descriptors:
    """Descriptors of one deformed shape, in lengths (areas) of the unit square.

    They are taken in the fixed frame, x to the right and y upwards, whichever edge the structure is clamped at.

    Attributes
    ----------
    height, width : float
        Extent of the deformed nodes in y and in x.
    hull_area : float
        Area of their convex hull.
    medial_axis : (30, 2) float
        Midpoints of the hull's horizontal chords at the heights k h / 30, k = 0, …, 29, from the hull's bottom upwards,
        moved so that the first is the origin.
    peak_stress, peak_stretch : float
        Largest von Mises stress, in the units of λ and μ, and largest principal stretch of any element, the mean over
        its Gauss points (:func:`inflate_lib.mechanics.stress.peaks`); NaN for a shape that is known by its nodes alone.
    """

    height: float
    width: float
    hull_area: float
    medial_axis: np.ndarray
    peak_stress: float = np.nan
    peak_stretch: float = np.nan

    @property
    def bounding_box(self):
        """(height, width)."""
        return self.height, self.width

    def vector(self, name):
        """(N,) the descriptor `name` as a model is conditioned on it."""
        return _vectors(name, lambda variable: np.reshape(getattr(self, variable), (1, -1)))[0]


def _vectors(name, values):
    """(n, N) one descriptor as a model is conditioned on it, from ``values(variable)``, (n, ·) each."""
    return np.column_stack([values(variable) for part in parts_of(name) for variable in VARIABLES[part]])


def check_name(name):
    """Return `name`, or raise a ValueError that lists the descriptors."""
    if name not in VARIABLES and name != JOINT and not ("+" in name and set(name.split("+")) <= set(PARTS)):
        raise ValueError(f"unknown descriptor {name!r}; choose one of {', '.join(VARIABLES)}, {JOINT}")
    return name


def length(name):
    """Number of components of a descriptor."""
    return sum(PARTS[part] for part in parts_of(name))


def parts_of(name):
    """The :data:`PARTS` that a descriptor is made of: ("height", "width") for "box", all of them for "joint".

    Any others that are asked for together go by a name with plus signs: "height+area".
    """
    return {"box": ("height", "width"), JOINT: tuple(PARTS)}.get(check_name(name)) or tuple(name.split("+"))


def name_of(parts):
    """The reverse of :func:`parts_of`: what parts, in any order, are called together."""
    parts = tuple(part for part in PARTS if part in parts)
    return {("height", "width"): "box", tuple(PARTS): JOINT}.get(parts) or "+".join(parts)


def joint_conditions(name, values):
    """Descriptors (n, N) as a model of the descriptor "joint" is told them, (n, 65): NaN for what is not asked for."""
    values = np.asarray(values, dtype=float)
    columns = np.isin(np.repeat(list(PARTS), list(PARTS.values())), parts_of(name))
    conditions = np.full((len(values), columns.size), np.nan)
    conditions[:, columns] = values
    return conditions


def describe(result, step=-1):
    """Descriptors of an inflated structure.

    Parameters
    ----------
    result : Inflation or (n, 2) array_like
        What :func:`inflate_lib.inflate` returned, or deformed nodes.
    step : int
        Load step, the last one by default.

    Returns
    -------
    Descriptors

    Raises
    ------
    ValueError
        Where that load step did not converge, or the nodes span no area.
    """
    if hasattr(result, "deformed"):
        n_steps = len(result.load_steps)
        if not isinstance(step, int | np.integer) or not -n_steps <= step < n_steps:
            raise ValueError(f"step must be one of the {n_steps} load steps, not {step!r}")
        nodes = result.deformed(step)
        if not np.isfinite(nodes).all():
            raise ValueError(f"the structure has no equilibrium to describe: {result.reason}")
    else:
        try:
            nodes = np.asarray(result, dtype=float)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"nodes: not an array of numbers ({error})") from None
        if nodes.ndim != 2 or nodes.shape[1] != 2 or len(nodes) < 3:
            raise ValueError(f"nodes: coordinates of shape (n, 2) of three nodes or more are needed, not {nodes.shape}")
        if not np.isfinite(nodes).all():
            raise ValueError("nodes: some coordinates are NaN or infinite")
    try:
        hull = ConvexHull(nodes)
    except QhullError:
        raise ValueError("the deformed nodes span no area, so they have no convex hull") from None
    width, height = np.ptp(nodes, axis=0)
    at_peak = peaks(result, step) if hasattr(result, "deformed") else ()
    return Descriptors(float(height), float(width), float(hull.volume), medial_axis(nodes[hull.vertices]), *at_peak)


def medial_axis(hull, points=AXIS_POINTS):
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
    left, right = hull_sides(hull)
    bottom, top = hull[:, 1].min(), hull[:, 1].max()
    height = bottom + (top - bottom) * np.arange(points) / points
    middle = 0.5 * (np.interp(height, left[:, 1], left[:, 0]) + np.interp(height, right[:, 1], right[:, 0]))
    return np.column_stack([middle - middle[0], height - bottom])


def hull_sides(hull):
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


def descriptor_matrix(data, name):
    """One descriptor of every structure in a data set, as models are conditioned on it.

    Parameters
    ----------
    data : xarray.Dataset
        From :func:`inflate_lib.simulate_dataset`.
    name : {"height", "width", "box", "area", "axis", "stress", "stretch", "joint"}

    Returns
    -------
    (n, N) float
        Box as (height, width); the medial axis point by point (x₀, y₀, x₁, y₁, …); joint as height, width, area,
        stress, stretch, axis. NaN where a structure did not converge.
    """
    return _vectors(name, lambda variable: data[variable].values.reshape(data.sizes["structure"], -1))
