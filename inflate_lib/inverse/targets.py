"""What a design is asked for: numbers, a medial axis from a file, or a drawn outline; and whether it can be had.

Targets are descriptors of the inflated shape (:mod:`inflate_lib.descriptors`), in lengths of the unit square. Whatever
contradicts itself is refused, and so is what no structure of the data set comes near.
"""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from inflate_lib._checks import positive_number
from inflate_lib.descriptors import DESCRIPTORS, describe, get_descriptor
from inflate_lib.descriptors.registry import basic, implied
from inflate_lib.descriptors.shape import check_axis, check_points
from inflate_lib.inverse.drawings import OPEN, how_measured, read_outline
from inflate_lib.mechanics.contact import first_crossing

_SAME = 1e-6  # distance of two corners, relative to the size of a drawing, up to which they are one


class Targets:
    """Wanted descriptors of the inflated shape.

    Parameters
    ----------
    drawing : (k, 2) float, optional
        The drawn outline that the others were measured on, to be shown; its lowest point is at y = 0.
    **wanted
        Name of a descriptor that is measured (:mod:`inflate_lib.descriptors`) → its value, in lengths and areas of the
        unit square; None where any will do. An axis is 30 points, or a line from the bottom of the shape to its top; a
        stress is in the unit in which μ is 0.1644 (μ times σ/μ).

    Attributes
    ----------
    vectors : dict
        Name → vector (N,) of each descriptor that is asked for.
    measured : str
        How a drawing was measured, for whoever finds it out of reach.

    Raises
    ------
    ValueError
        For an unknown name, a value that is no target, or where nothing is asked for.
    """

    def __init__(self, drawing: np.ndarray | None = None, /, **wanted: Any) -> None:
        known = {one.name: one for one in basic()}
        if unknown := [name for name in wanted if name not in known]:
            raise ValueError(f"unknown target {unknown[0]!r}; choose among {', '.join(sorted(known))}")
        self.drawing, self.measured = drawing, ""
        self.vectors = {n: one.target(wanted[n]) for n, one in known.items() if wanted.get(n) is not None}
        if not self.vectors:
            raise ValueError(f"nothing is asked for: give {', '.join(known)}, one at least")

    def __getattr__(self, name: str) -> Any:
        """The value of a descriptor that is asked for."""
        vectors = vars(self).get("vectors", {})
        if name not in vectors:
            raise AttributeError(f"there is no target {name}")
        return np.reshape(vectors[name], tuple(get_descriptor(name).sizes.values()))[()]

    @property
    def asked(self) -> tuple[str, ...]:
        """Names of the descriptors that are asked for."""
        return tuple(self.vectors)

    def vector(self, name: str) -> np.ndarray:
        """(N,) the target of one descriptor, NaN where it is not asked for; an axis says what the height is."""
        known = implied(self.vectors) | self.vectors
        nothing = {part: np.full(get_descriptor(part).length, np.nan) for part in get_descriptor(name).parts}
        return np.concatenate([known.get(part, nan) for part, nan in nothing.items()])

    def as_dict(self) -> dict:
        """Plain numbers for JSON, of what is asked for."""
        return {name: getattr(self, name).tolist() for name in self.asked}


def as_targets(targets):
    """`targets` as :class:`Targets`: one already, or a mapping from descriptor to value.

    Parameters
    ----------
    targets : Targets or Mapping
        Names of descriptors that are measured, such as "height" or "axis" (30 points, or a polyline from the bottom to
        the top of the shape), and "outline" (corners of a polygon, which gives the paper's descriptors as well).

    Raises
    ------
    ValueError
        For an unknown key, or a value that is no target.
    """
    if isinstance(targets, Targets):
        return targets
    if not isinstance(targets, Mapping):
        raise ValueError(f"targets must be a mapping such as {{'height': 1.05}}, not {type(targets).__name__}")
    given = {str(name): value for name, value in targets.items() if value is not None}
    if (outline := given.pop("outline", None)) is None:
        return Targets(**given)
    drawn = _outline_targets(outline)
    if set(given) & set(drawn.asked):
        raise ValueError(f"an outline gives {', '.join(drawn.asked)}: leave the others out")
    return Targets(drawn.drawing, **drawn.as_dict(), **given)


def _outline_targets(points):
    """Targets that a closed outline (k, 2) stands for: itself, its height, width, hull area and medial axis.

    All descriptors look at the convex hull only, so that a dent in the outline is not asked for.
    """
    points = check_points("outline", points)
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
    drawn = {name: value for name, value in shape.as_dict().items() if name in (*DESCRIPTORS, "outline")}
    return Targets(points - [0, points[:, 1].min()], **drawn)


def read_targets(
    axis: str | Path | None = None, outline: str | Path | None = None, unit: float = 1.0, **numbers: float | None
) -> Targets:
    """Targets from files, and from numbers by the names of their descriptors; None where not asked for.

    See ``_read_axis`` and :func:`inflate_lib.inverse.drawings.read_outline`.

    Raises
    ------
    ValueError
        Where a file is no such file, where nothing is asked for, or more than an outline leaves open.
    """
    positive_number("the unit of the outline", unit)
    given: dict[str, Any] = dict(numbers)
    given["axis"] = None if axis is None else _read_axis(axis)
    given["outline"] = None if outline is None else read_outline(outline, unit)
    try:
        targets = as_targets(given)
        if outline is not None:
            targets.measured = how_measured(outline, given["outline"], unit)
        return targets
    except ValueError as error:
        where = f"{outline}: " if outline is not None and str(error).startswith("outline") else ""
        raise ValueError(f"{where}{error}") from None


def _read_axis(path):
    """Medial axis (30, 2) from a CSV file: two columns x, y, with or without a heading, in sides of the frame."""
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
        return check_axis("axis", np.reshape(points, (-1, 2)))
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


def _crosses_itself(points):
    """Whether a closed polygon crosses itself, or comes back to a corner."""
    numbers = np.arange(len(points))
    if len(np.unique(points, axis=0)) < len(points):
        return True
    return first_crossing(points[None], np.column_stack([numbers, np.roll(numbers, -1)])) == 0
