"""Measured descriptors: of one shape, of a data set, and as models are told them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from inflate_lib.descriptors.registry import basic, get_descriptor
from inflate_lib.descriptors.shape import Shape

if TYPE_CHECKING:
    import xarray as xr

    from inflate_lib.mechanics.inflation import Inflation


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
    outline : (32,) float
        Support function of the hull: how far it reaches in the directions 2π k / 32, k = 0, …, 31, from the point of
        the ground below its middle.
    peak_stress, peak_stretch : float
        Largest von Mises stress, in the units of λ and μ, and largest principal stretch of any element, the mean over
        its Gauss points (:func:`inflate_lib.mechanics.stress.peaks`); NaN for a shape that is known by its nodes alone.
    others : Mapping
        Values of the descriptors that were registered besides, by their variable.
    """

    height: float
    width: float
    hull_area: float
    medial_axis: np.ndarray
    outline: np.ndarray
    peak_stress: float = np.nan
    peak_stretch: float = np.nan
    others: Mapping = field(default_factory=dict)

    @property
    def bounding_box(self) -> tuple[float, float]:
        """(height, width)."""
        return self.height, self.width

    def vector(self, name: str) -> np.ndarray:
        """(N,) the descriptor `name` as a model is conditioned on it."""
        values = {**vars(self), **self.others}
        return _vectors(name, lambda variable: np.reshape(values[variable], (1, -1)))[0]

    def as_dict(self) -> dict[str, Any]:
        """Name of each descriptor that is measured → its value in plain numbers."""
        values = {**vars(self), **self.others}
        return {one.name: np.asarray(values[one.variable]).tolist() for one in basic()}


def describe(result: "Inflation | np.ndarray", step: int = -1) -> Descriptors:
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
    shape = Shape.of(result, step)
    values = {one.variable: one.of(shape) for one in basic()}
    values = {name: value if value.ndim else float(value) for name, value in values.items()}
    own: dict[str, Any] = {one.name: values.pop(one.name) for one in fields(Descriptors) if one.name in values}
    return Descriptors(**own, others=values)


def descriptor_matrix(data: "xr.Dataset", name: str) -> np.ndarray:
    """One descriptor of every structure in a data set, as models are conditioned on it.

    Parameters
    ----------
    data : xarray.Dataset
        From :func:`inflate_lib.simulate_dataset`.
    name : {"height", "width", "box", "area", "axis", "outline", "stress", "stretch", "joint"}
        Or a descriptor that was registered.

    Returns
    -------
    (n, N) float
        Box as (height, width); the medial axis point by point (x₀, y₀, x₁, y₁, …); joint as height, width, area,
        stress, stretch, axis, outline. NaN where a structure did not converge.

    Raises
    ------
    ValueError
        For an unknown descriptor, or one that the data set was simulated without.
    """

    def values(variable):
        if variable not in data:
            raise ValueError(f"the data set has no variable {variable}: register {name} before it is simulated")
        return data[variable].values.reshape(data.sizes["structure"], -1)

    return _vectors(name, values)


def _vectors(name, values):
    """(n, N) one descriptor as a model is conditioned on it, from ``values(variable)``, (n, ·) each."""
    return np.column_stack([values(get_descriptor(part).variable) for part in get_descriptor(name).parts])
