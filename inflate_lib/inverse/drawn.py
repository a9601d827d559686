"""A structure that was drawn by hand, in the laboratory of the book, is carried on: verified, refined, handed out."""

import json
from pathlib import Path

import numpy as np

from inflate_lib.descriptors import describe
from inflate_lib.inverse.constraints import Constraints
from inflate_lib.inverse.refine import Rejection, attempt
from inflate_lib.inverse.refine import refine as refine_structure
from inflate_lib.inverse.search import Design, Designs, Stop, check_smooth, with_smooth_borders
from inflate_lib.inverse.targets import Targets, deviations
from inflate_lib.mechanics.inflation import PRESSURE
from inflate_lib.mechanics.material import LAMBDA, MU
from inflate_lib.structures.labels import FRAME, THICKNESS

_FORMAT = "inflate-lab 1"
_PARTS = ("format", "image", "settings", "targets")
_SETTINGS = {
    "pressure": PRESSURE, "lambda": LAMBDA, "mu": MU, "wall": THICKNESS, "clamped": "bottom",
    "element": "mean-dilatation",
}  # fmt: skip


def read_drawn(path: str | Path) -> tuple[np.ndarray, Targets | None]:
    """A file of the laboratory: its drawing (28, 28), and what it was asked for, if anything.

    Raises
    ------
    ValueError
        Where the file is none of the laboratory's, or is malformed, or was made with other settings than designs have.
    """
    path = Path(path)
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read as JSON: {error}") from None
    if not isinstance(told, dict) or told.get("format") != _FORMAT:
        raise ValueError(f'{path} is none of the laboratory\'s files: its format is not "{_FORMAT}"')
    if unknown := [name for name in told if name not in _PARTS]:
        raise ValueError(f"{path}: {unknown[0]} is no part of such a file; {', '.join(_PARTS)} are")
    rows = told.get("image")
    if (
        not isinstance(rows, list)
        or len(rows) != FRAME
        or not all(isinstance(row, str) and len(row) == FRAME and set(row) <= {"0", "1"} for row in rows)
    ):
        raise ValueError(f"{path}: image must be {FRAME} rows of {FRAME} digits, 0 or 1")
    settings, targets = told.get("settings") or {}, told.get("targets") or {}
    if not isinstance(settings, dict) or not isinstance(targets, dict):
        raise ValueError(f"{path}: settings and targets must be objects")
    for name, value in settings.items():
        if name not in _SETTINGS or value != _SETTINGS[name]:
            usual = f"designs have {_SETTINGS[name]}" if name in _SETTINGS else "there is no such setting"
            raise ValueError(f"{path}: {name} is {value!r}, but {usual}; `inflate simulate` takes other settings")
    try:
        asked = Targets(**targets) if targets else None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return np.array([[float(digit) for digit in row] for row in rows]), asked


def continue_drawn(
    path: str | Path, tolerance: float = 0.01, refine: int = 60, seed: int = 0, smooth: bool = False
) -> Designs:
    """The drawing of a file as a design: inflated, refined towards its targets, ready for :func:`.save.save_designs`.

    Without targets, its own height, width and area are what it is asked for. With `smooth` it gets smooth borders, as
    in :func:`inflate_lib.design`.

    Raises
    ------
    ValueError
        As :func:`read_drawn`, and where the structure cannot be built, or not with smooth borders, with the reason.
    """
    image, targets = read_drawn(path)
    constraints = Constraints()
    reason, label, result = attempt(image, constraints)
    if reason or result is None:
        raise ValueError(f"{path}: the structure cannot be built. {reason}")
    if targets is None:
        shape = describe(result)
        targets = Targets(height=shape.height, width=shape.width, area=shape.hull_area)
    check_smooth(smooth, targets)
    before = max(deviations(targets, describe(result)).values())
    label, result, flipped = refine_structure(label, result, targets, constraints, tolerance / 2, refine, seed)
    shape = describe(result)
    miss = deviations(targets, shape)
    within = max(miss.values()) <= tolerance
    origin = {"drawn": Path(path).name, "flipped": flipped}
    one = Design(label, result, shape, miss, within, 0, origin)
    found = Designs([one], [one] if within else [], targets, constraints, tolerance, 1, None, seed)
    found.tried, found.stopped, found.sources["drawn"] = 1, Stop.DRAWN, 1
    found.refined = int(within and before > tolerance)
    if smooth:
        found.designs = with_smooth_borders(found)
        if not found.designs:
            raise ValueError(f"{path}: {Rejection.SMOOTH.value} Leave its borders as they are (--no-smooth).")
    return found
