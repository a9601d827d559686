"""How good are the structures of an experiment? Errors, validity, and how sure these numbers are.

Errors are those of valid structures; how many are not valid is counted beside them, with the reasons. Intervals are
percentile bootstrap intervals (Efron & Tibshirani 1993, chapter 13): the same number, computed again and again from
resamples of the structures, and the range that holds the middle 95 % of the results.
"""

from enum import StrEnum

import numpy as np
import pandas as pd

from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.experiments.metrics import bootstrap, errors, hausdorff, point_distances, r_squared
from inflate_lib.experiments.run import COMPONENTS
from inflate_lib.structures.labels import PIXEL


class Failure(StrEnum):
    """Why a structure of an experiment is not valid."""

    BLANK = "The drawing is blank."
    TOO_SMALL = "No piece of the drawing is large enough for a structure."
    TOO_LARGE = "The structure does not fit the frame."
    NO_EQUILIBRIUM = "No equilibrium was found."
    IN_PIECES = "The drawing is in several pieces."
    UNUSABLE = "The image cannot be inflated."


#: How the reasons begin that a data set gives; the rest are the numbers of the structure at hand.
FAILURES = {"image is blank": Failure.BLANK, "image has no digit": Failure.TOO_SMALL}
FAILURES |= {"structure does not fit": Failure.TOO_LARGE, "no equilibrium": Failure.NO_EQUILIBRIUM}
WITHIN = (0.02, 0.05, 0.10)  # shares of the target within which structures are counted
WITHIN_PIXELS = (0.25, 0.5, 1.0)  # the same for medial axes


# --- intervals -----------------------------------------------------------------------------------------------------


# --- tables --------------------------------------------------------------------------------------------------------


def scores(experiment, descriptor, data, by_target=False, seed=0, n_resamples=1000):
    """Everything about the accuracy and validity of an experiment, with intervals.

    Parameters
    ----------
    experiment : xarray.Dataset
        From :func:`inflate_lib.experiments.run.run_experiment`, or in the same form.
    descriptor : str
    data : xarray.Dataset
        The simulated data set; errors are also given in its standard deviations (of the box: of each component; of
        axes: in mean distances from the mean axis).
    by_target : bool
        Resample the structures of each target by themselves, for few targets with many structures; by default
        structures are resampled together with their targets.
    seed, n_resamples : int
        Of the bootstrap.

    Returns
    -------
    pandas.DataFrame
        A row per measure: measure, unit, value, low, high.
    """
    target, achieved = experiment["target"].values, descriptor_matrix(experiment, descriptor)
    valid = experiment["valid"].values
    achieved = np.where(valid[:, None], achieved, np.nan)
    columns, within, unit, near = _per_structure(experiment, descriptor, data, target, achieved)
    measures = [("R²", "1")]
    for name, (column_unit, _) in columns.items():
        measures += [(f"mean {name}", column_unit), (f"median {name}", column_unit)]
    measures += [(f"within {_limit(limit, unit)}", "%") for limit in near]
    measures += [("valid", "%"), ("self-contact", "%")]
    values = np.column_stack([column for _, column in columns.values()])
    crossing = experiment["self_contact"].values > 0

    def statistics(rows):
        good = valid[rows]
        known = values[rows[good]]
        averages = np.column_stack([_mean(known), _median(known)]).ravel()
        shares = [_share(within[rows[good]] <= limit) for limit in near]
        shares += [_share(good), _share(crossing[rows[good]])]
        return np.array([r_squared(target[rows], achieved[rows]), *averages, *(100 * share for share in shares)])

    everything = np.arange(len(target))
    low, high = bootstrap(statistics, len(target), experiment["level"].values if by_target else None, seed, n_resamples)
    table = pd.DataFrame(measures, columns=["measure", "unit"])
    return table.assign(value=statistics(everything), low=low, high=high)


def _per_structure(experiment, descriptor, data, target, achieved):
    """Errors in several units, as {name: (unit, (n,))}; the one that shares are counted by, its unit and limits."""
    typical = descriptor_matrix(data, descriptor)[data["converged"].values]
    if descriptor == "axis":
        apart = point_distances(achieved, target)
        distance = apart.mean(axis=1)
        middle = np.broadcast_to(typical.mean(axis=0), typical.shape)
        height = target[:, -1] * 30 / 29  # the last of 30 points is 29/30 of the way up
        columns = {
            "point distance": ("px", distance),
            "Hausdorff distance": ("px", hausdorff(np.nan_to_num(achieved), target)),
            "point distance / height": ("%", 100 * distance * PIXEL / height),
            "point distance / spread": ("1", distance / point_distances(typical, middle).mean()),
        }
        return columns, distance, "px", WITHIN_PIXELS
    absolute = np.abs(achieved - target)
    relative = errors(experiment, descriptor)
    columns = {
        "error": ({"area": "side²", "stress": "1", "stretch": "1"}.get(descriptor, "side"), absolute.mean(axis=1)),
        "error / target": ("%", 100 * relative),
        "error / standard deviation": ("1", (absolute / typical.std(axis=0)).mean(axis=1)),
    }
    return columns, relative, "%", WITHIN


def side_by_side(tables, digits=3):
    """Tables of :func:`scores` in the columns of one, each cell "value [low, high]".

    Parameters
    ----------
    tables : Mapping
        Name of a column → table; all with the same measures.
    digits : int
        Significant digits.
    """
    first = next(iter(tables.values()))
    wide = first[["measure", "unit"]].copy()
    for name, table in tables.items():
        wide[name] = [with_interval(*row, digits) for row in table[["value", "low", "high"]].to_numpy()]
    return wide


def with_interval(value, low, high, digits=3):
    """A number and its interval in words: "0.83 [0.78, 0.87]"."""
    if not np.isfinite(value):
        return "–"
    if not np.isfinite([low, high]).all():
        return f"{value:.{digits}g}"
    return f"{value:.{digits}g} [{low:.{digits}g}, {high:.{digits}g}]".replace("-", "−")


def score(table, measure):
    """One value of a table of :func:`scores`."""
    return float(table.set_index("measure").loc[measure, "value"])


def accuracy(experiment, descriptor):
    """How close the structures of an experiment come to their targets, target by target.

    Parameters
    ----------
    experiment : xarray.Dataset
        From :func:`inflate_lib.experiments.run.run_experiment`.
    descriptor : str

    Returns
    -------
    pandas.DataFrame
        A row per target and one for all: the target, the share of valid structures (one closed structure that
        converges), mean and standard deviation of what was achieved, mean and median error (percent; for axes:
        pixels), share within 5 percent (axes: within one pixel), and in the last row R², the coefficient of
        determination of achieved against target.
    """
    valid, target = experiment["valid"].values, experiment["target"].values
    level, achieved = experiment["level"].values, descriptor_matrix(experiment, descriptor)
    error = errors(experiment, descriptor)
    unit, scale, near = ("px", 1, 1) if descriptor == "axis" else ("%", 100, 0.05)

    def row(name, here):
        error_here = error[here & valid]
        return {
            "target": name,
            "valid": valid[here].mean(),
            f"mean error ({unit})": scale * _mean(error_here),
            f"median error ({unit})": scale * _median(error_here),
            f"within {near} px" if descriptor == "axis" else f"within {near:.0%}": _share(error_here <= near),
        }

    rows = []
    for k in np.unique(level):
        here = level == k
        reached = pd.DataFrame(achieved[here & valid])
        spread = {}
        for column, name in enumerate(COMPONENTS.get(descriptor, [])):
            spread |= {f"mean {name}": reached[column].mean(), f"std {name}": reached[column].std()}
        rows.append(row(_words(descriptor, target[here][0], k), here) | spread)
    everything = row("all", np.ones(len(level), dtype=bool))
    everything["R²"] = r_squared(target[valid], achieved[valid])
    return pd.DataFrame([*rows, everything]).reindex(columns=[*rows[0], "R²"])


def failure_reasons(experiments):
    """Why structures are not valid, counted over several experiments.

    Returns
    -------
    pandas.Series
        :class:`Failure` → number, the most frequent first; empty where all are valid.
    """
    reasons = [reason for one in experiments for reason in one["reason"].values[~one["valid"].values]]
    return pd.Series([_failure(str(reason)) for reason in reasons], dtype=object).value_counts()


def _failure(reason):
    """What kind of failure a reason tells of; a structure that could be inflated and yet is not valid has none."""
    if not reason:
        return Failure.IN_PIECES
    return next((kind for begin, kind in FAILURES.items() if reason.startswith(begin)), Failure.UNUSABLE)


def _limit(limit, unit):
    return f"{limit:g} px" if unit == "px" else f"{100 * limit:.0f} %"


def _mean(values):
    """Mean over rows; NaN, without a warning, of nothing."""
    return values.mean(axis=0) if len(values) else np.full(values.shape[1:], np.nan)


def _median(values):
    return np.median(values, axis=0) if len(values) else np.full(values.shape[1:], np.nan)


def _share(flags):
    return flags.mean() if len(flags) else np.nan


def _words(descriptor, target, number):
    """A target as a table shows it."""
    if descriptor == "axis":
        return f"axis {number + 1}"
    values = ", ".join(f"{value:.3f}" for value in target)
    return f"({values})" if len(target) > 1 else values
