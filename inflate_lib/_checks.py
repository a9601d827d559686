"""Checks of arguments; each error names the argument and what was given for it."""

import math
import reprlib
from collections.abc import Collection
from typing import Any

import numpy as np


def _is_whole_number(value: Any) -> bool:
    """Whether a value is an integer, of Python or NumPy, and not a truth value."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def whole_number(name: str, value: Any, least: int, most: int | None = None, optional: bool = False) -> int:
    """`value` as an int, or a ValueError where it is none from `least` to `most`; `optional` lets None through."""
    if optional and value is None:
        return value  # type: ignore[return-value]  # nobody goes on with it
    if _is_whole_number(value) and least <= value and (most is None or value <= most):
        return int(value)
    bounds = f"of at least {least}" if most is None else f"from {least} to {most}"
    raise ValueError(f"{name} must be a whole number {bounds}, not {value!r}")


def number(name: str, value: Any, least: float = -math.inf, below: float = math.inf) -> float:
    """`value` as a number of Python, or a ValueError where it is not one of at least `least` and less than `below`."""
    if _is_number(value) and least <= value < below:
        return _plain(value)
    bounds = [f"at least {least:.4g}"] * (least > -math.inf) + [f"less than {below:.4g}"] * (below < math.inf)
    wanted = f"a number of {' and '.join(bounds)}" if bounds else "a finite number"
    raise ValueError(f"{name} must be {wanted}, not {value!r}{_hint(value)}")


def numbers(name: str, values: Any, wanted: str, count: int | None = None, finite: bool = True) -> np.ndarray:
    """`values` as an array of floats, or a ValueError where they are not what is `wanted`, `count` numbers in a row.

    Truth values, text and complex numbers are no numbers, and what a mask hides is not guessed.
    """
    try:
        typed = hasattr(values, "dtype")  # an array, a tensor, a column of a table
        found = np.asarray(values) if typed else np.array(values, dtype=object)
        fits = found.dtype.kind in "iuf" if typed else all(map(_is_number, found.flat))
        fits = fits and not np.ma.isMaskedArray(values) and (count is None or found.shape == (count,))
        if fits and (np.isfinite(found := found.astype(float)).all() or not finite):
            return found
    except (TypeError, ValueError, RuntimeError, OverflowError):  # ragged; tensors that NumPy cannot take; 10**400
        pass
    raise ValueError(f"{name} must be {wanted}, not {' '.join(reprlib.repr(values).split())}")


def workers(value: Any) -> int:
    """`value` as a number of processes or threads, `n_jobs`, or a ValueError where it is none; -1 is one per core."""
    if _is_whole_number(value) and value != 0:
        return int(value)
    raise ValueError(f"n_jobs must be 1, 2, … processes or -1 for one per core, not {value!r}")


def share(name: str, value: Any) -> float:
    """`value` as a number of Python, or a ValueError where it is none from 0 to 1, both included."""
    if _is_number(value) and 0 <= value <= 1:
        return _plain(value)
    raise ValueError(f"{name} must be between 0 and 1, not {value!r}{_hint(value)}")


def positive_number(name: str, value: Any, unit: str = "", finite: bool = True) -> float:
    """`value` as a number of Python, or a ValueError where it is not greater than zero; `unit` is its unit."""
    if _is_number(value) and value > 0 and (value < math.inf or not finite):
        return _plain(value)
    wanted = f"a positive number of {unit}" if unit else "a positive number"
    raise ValueError(f"{name} must be {wanted}, not {value!r}{_hint(value)}")


def choice(name: str, value: Any, among: Collection[str]) -> str:
    """`value`, or a ValueError where it is none of the names `among` which there is a choice."""
    if isinstance(value, str) and value in among:
        return value
    raise ValueError(f"{name} must be one of {', '.join(among)}, not {value!r}")


def flag(name: str, value: Any) -> bool:
    """`value`, or a ValueError where it is neither True nor False."""
    if isinstance(value, bool):
        return value
    raise ValueError(f"{name} must be true or false, not {value!r}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def _plain(value: Any) -> float:
    return value.item() if isinstance(value, np.generic) else value


def _hint(value: Any) -> str:
    """What to do about a number in powers of ten that came as text."""
    try:
        float(value if isinstance(value, str) else "")
    except ValueError:
        return ""
    return "" if "e" not in value.lower() else " (YAML reads 1e-3 as text: write 1.0e-3)"
