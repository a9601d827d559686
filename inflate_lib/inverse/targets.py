"""What a design is asked for: numbers, a medial axis from a file, or a drawn outline; and whether it can be had.

Targets are descriptors of the inflated shape (:mod:`inflate_lib.descriptors`), in lengths of the unit square. Whatever
contradicts itself is refused, and so is what no structure of the data set comes near.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from inflate_lib._checks import positive_number
from inflate_lib.descriptors import AXIS_POINTS, PHYSICAL, axis_height, basic, describe, get_descriptor
from inflate_lib.inverse.drawings import OPEN, how_measured, read_outline
from inflate_lib.mechanics.contact import first_crossing
from inflate_lib.models.reach import AGREE, SIZES

_NUMBERS = (*SIZES, *PHYSICAL)
_SAME = 1e-6  # distance of two corners, relative to the size of a drawing, up to which they are one


@dataclass(frozen=True)
class Targets:
    """Wanted descriptors of the inflated shape; None where any will do.

    Attributes
    ----------
    height, width, area : float, optional
        Area is that of the convex hull. In lengths and areas of the unit square.
    stress, stretch : float, optional
        Peak von Mises stress, in the unit in which μ is 0.1644 (μ times σ/μ), and largest principal stretch, at least
        1, as in :func:`inflate_lib.mechanics.stress.peaks`.
    axis : (30, 2) float, optional
        Medial axis, the first point at the origin.
    outline : (k, 2) float, optional
        The drawing that the others were measured on, to be shown; its lowest point is at y = 0.
    others : Mapping
        Descriptors that were registered besides, name → number, or (N,) numbers.
    measured : str
        How a drawing was measured, for whoever finds it out of reach.
    """

    height: float | None = None
    width: float | None = None
    area: float | None = None
    axis: np.ndarray | None = None
    outline: np.ndarray | None = None
    stress: float | None = None
    stretch: float | None = None
    others: Mapping = field(default_factory=dict)
    measured: str = ""

    def __post_init__(self):
        object.__setattr__(self, "others", {name: _vector(name, value) for name, value in self.others.items()})
        for name in _NUMBERS:
            if getattr(self, name) is not None:
                object.__setattr__(self, name, float(positive_number(name, getattr(self, name))))
        if self.stretch is not None and self.stretch < 1:
            raise ValueError(f"stretch is the largest ratio of lengths, at least 1, not {self.stretch:g}")
        if self.axis is not None:
            object.__setattr__(self, "axis", _check_axis(self.axis))
        if not self.asked:
            raise ValueError(f"nothing is asked for: give {', '.join(_NUMBERS)}, an axis or an outline, one at least")

    @property
    def asked(self) -> tuple[str, ...]:
        """Names of the descriptors that are asked for."""
        return (*(name for name in (*_NUMBERS, "axis") if getattr(self, name) is not None), *self.others)

    @property
    def vectors(self) -> dict[str, np.ndarray]:
        """Name → vector (N,) of each descriptor that is asked for."""
        return {name: self.vector(name) for name in self.asked}

    def vector(self, name: str) -> np.ndarray:
        """(N,) the target of one descriptor, NaN where it is not asked for; an axis says what the height is."""
        return np.concatenate([self._of_part(part) for part in get_descriptor(name).parts])

    def as_dict(self) -> dict:
        """Plain numbers for JSON, of what is asked for."""
        wanted = {**vars(self), **self.others}
        return {name: np.asarray(wanted[name]).tolist() for name in self.asked}

    def _of_part(self, name):
        value = (vars(self) | self.others).get(name)
        if name == "height" and value is None and self.axis is not None:
            value = axis_height(self.axis)
        return np.full(get_descriptor(name).length, np.nan) if value is None else np.ravel(value)


def as_targets(targets):
    """`targets` as :class:`Targets`: one already, or a mapping from descriptor to value.

    Parameters
    ----------
    targets : Targets or Mapping
        Keys "height", "width", "area", "axis" (30 points, or a polyline from the bottom to the top of the shape), and
        "outline" (corners of a polygon, which gives all four); "stress", "stretch" and descriptors that were registered
        go with any of them.

    Raises
    ------
    ValueError
        For an unknown key, or a value that is no target.
    """
    if isinstance(targets, Targets):
        return targets
    if not isinstance(targets, Mapping):
        raise ValueError(f"targets must be a mapping such as {{'height': 1.05}}, not {type(targets).__name__}")
    known = {"outline", *(one.name for one in basic())}
    if unknown := [name for name in targets if name not in known]:
        raise ValueError(f"unknown target {unknown[0]!r}; choose among {', '.join(sorted(known))}")
    given = {name: value for name, value in targets.items() if value is not None}
    own = {one.name for one in fields(Targets)}
    others = {name: given.pop(name) for name in list(given) if name not in own}
    if "outline" not in given:
        return Targets(**given, others=others)
    physical = {name: given.pop(name) for name in PHYSICAL if name in given}
    if len(given) > 1:
        raise ValueError("an outline gives height, width, area and axis: leave the others out")
    return replace(_outline_targets(given["outline"]), **physical, others=others)


def _outline_targets(points):
    """Targets that a closed outline stands for: its height, width, hull area and medial axis.

    All descriptors look at the convex hull only, so that a dent in the outline is not asked for.

    Parameters
    ----------
    points : (k, 2) array_like
        Corners in order, y upwards, in lengths of the unit square; the last is joined to the first.

    Raises
    ------
    ValueError
        Where it is empty, spans no area, or crosses itself.
    """
    points = _points("outline", points)
    size = np.ptp(points, axis=0).max() if len(points) else 0.0
    points = points[np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1) > _SAME * size]
    if len(points) < 3:
        raise ValueError(f"outline: it is empty; {len(points)} distinct points enclose nothing")
    if _crosses_itself(points):  # perhaps only where its end misses its beginning
        near = np.linalg.norm(points - points[0], axis=1) <= OPEN * size
        points = points[: len(points) - int(np.argmin(near[::-1]))]
    if _crosses_itself(points):
        raise ValueError("outline: it crosses itself; draw the border of the inflated shape as one simple closed curve")
    try:
        shape = describe(points)
    except ValueError:
        raise ValueError("outline: it is empty; its points lie on one line") from None
    return Targets(shape.height, shape.width, shape.hull_area, shape.medial_axis, points - [0, points[:, 1].min()])


def read_targets(
    height: float | None = None,
    width: float | None = None,
    area: float | None = None,
    axis: str | Path | None = None,
    outline: str | Path | None = None,
    unit: float = 1.0,
    stress: float | None = None,
    stretch: float | None = None,
) -> Targets:
    """Targets from numbers and files; None where not asked for.

    See :func:`_read_axis` and :func:`inflate_lib.inverse.drawings.read_outline`.

    Raises
    ------
    ValueError
        Where a file is no such file, where nothing is asked for, or more than an outline leaves open.
    """
    given: dict[str, Any] = {"height": height, "width": width, "area": area, "stress": stress, "stretch": stretch}
    given["axis"] = None if axis is None else _read_axis(axis)
    given["outline"] = None if outline is None else read_outline(outline, unit)
    try:
        targets = as_targets(given)
        return targets if outline is None else replace(targets, measured=how_measured(outline, given["outline"], unit))
    except ValueError as error:
        where = f"{outline}: " if outline is not None and str(error).startswith("outline") else ""
        raise ValueError(f"{where}{error}") from None


def _check_axis(points):
    """A medial axis (30, 2) from points, or a ValueError.

    Thirty points at equal increments of height are taken as they are (the thirtieth lies one increment below the top,
    as in :func:`inflate_lib.descriptors.medial_axis`). Any other points are the corners of a line from the bottom of
    the shape to its top, on which the thirty are placed.
    """
    points = _points("axis", points)
    if len(points) < 2:
        raise ValueError(f"axis: two points at least are needed, from the bottom to the top, not {len(points)}")
    rise = np.diff(points[:, 1])
    if not np.all(rise > 0):
        row = int(np.argmax(rise <= 0)) + 2
        raise ValueError(f"axis: its points must rise from the bottom to the top; point {row} does not")
    points = points - points[0]
    if len(points) == AXIS_POINTS and np.ptp(rise) <= AGREE * rise.mean():
        return points
    y = points[-1, 1] * np.arange(AXIS_POINTS) / AXIS_POINTS
    return np.column_stack([np.interp(y, points[:, 1], points[:, 0]), y])


def _read_axis(path):
    """Medial axis (30, 2) from a CSV file: two columns x, y, with or without a heading, in lengths of the unit square.

    Raises
    ------
    ValueError
        Naming the file and the line, where it is something else; see also :func:`_check_axis`.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [(number, row) for number, row in enumerate(csv.reader(file), start=1) if any(map(str.strip, row))]
    except (OSError, ValueError, csv.Error) as error:
        raise ValueError(f"{path} cannot be read as a CSV file: {error}") from None
    if rows and [word.strip().lower() for word in rows[0][1]] == ["x", "y"]:
        del rows[0]
    points = []
    for number, row in rows:
        try:
            x, y = (float(word) for word in row)
        except ValueError:
            raise ValueError(f"{path}, line {number}: two numbers x,y are needed, not {','.join(row)!r}") from None
        points.append((x, y))
    try:
        return _check_axis(np.reshape(points, (-1, 2)))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def deviations(targets, shape):
    """How far a shape misses each target, relative to the target.

    Parameters
    ----------
    targets : Targets
    shape : Descriptors

    Returns
    -------
    dict
        Name → ``|achieved − target| / target``; for the axis the mean distance of its points over the height that
        the axis belongs to.
    """
    return {
        name: float(get_descriptor(name).error.share(shape.vector(name), targets.vector(name)))
        for name in targets.asked
    }


def _vector(name, value):
    """The target (N,) of a descriptor that was registered, or a ValueError."""
    components = get_descriptor(name).length
    try:
        vector = np.ravel(np.asarray(value, dtype=float))
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.size != components or not np.isfinite(vector).all():
        raise ValueError(f"{name} must be {components} finite number{'s' * (components > 1)}, not {value!r}")
    return vector


def _points(name, points):
    try:
        points = np.array(points, dtype=float)
    except (TypeError, ValueError, RuntimeError):
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"{name}: points of shape (k, 2) are needed")
    if not np.isfinite(points).all():
        raise ValueError(f"{name}: some coordinates are NaN or infinite")
    return points


def _crosses_itself(points):
    """Whether a closed polygon crosses itself, or comes back to a corner."""
    numbers = np.arange(len(points))
    if len(np.unique(points, axis=0)) < len(points):
        return True
    return first_crossing(points[None], np.column_stack([numbers, np.roll(numbers, -1)])) == 0
