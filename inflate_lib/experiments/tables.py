"""How good are the structures of an experiment? Errors, validity, what can be built, and how sure these numbers are.

Errors are those of valid structures; how many are not valid, and how many of those that are cannot be built, is counted
beside them, with the reasons. Intervals are those of :func:`inflate_lib.experiments.metrics.bootstrap`.
"""

from collections.abc import Iterable
from enum import StrEnum

import numpy as np
import pandas as pd
import xarray as xr

from inflate_lib._checks import whole_number
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.experiments.metrics import bootstrap, errors, r_squared
from inflate_lib.mechanics.buildable import Flaw


class _Failure(StrEnum):
    """Why a structure of an experiment is not valid."""

    BLANK = "The drawing is blank."
    TOO_SMALL = "No piece of the drawing is large enough for a structure."
    TOO_LARGE = "The structure does not fit the frame."
    NO_EQUILIBRIUM = "No equilibrium was found."
    IN_PIECES = "The drawing is in several pieces."
    UNUSABLE = "The image cannot be inflated."


#: How the reasons begin that a data set gives; the rest are the numbers of the structure at hand.
_FAILURES = {"image is blank": _Failure.BLANK, "image has no digit": _Failure.TOO_SMALL}
_FAILURES |= {"structure does not fit": _Failure.TOO_LARGE, "no equilibrium": _Failure.NO_EQUILIBRIUM}


def scores(
    experiment: xr.Dataset,
    descriptor: str,
    data: xr.Dataset,
    by_target: bool = False,
    seed: int = 0,
    n_resamples: int = 1000,
) -> pd.DataFrame:
    """Everything about the accuracy of an experiment, and how much of it is valid and buildable, with intervals.

    Parameters
    ----------
    experiment : xarray.Dataset
        From :func:`inflate_lib.experiments.run.run_experiment`, or in the same form.
    descriptor : str
    data : xarray.Dataset
        The simulated data set; errors are also given in its standard deviations (of the box: of each component; of
        axes: in mean distances from the mean axis), and its share of buildable structures stands beside that of the
        experiment.
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
    whole_number("seed", seed, 0)
    whole_number("n_resamples", n_resamples, 1)
    target, achieved = experiment["target"].values, descriptor_matrix(experiment, descriptor)
    valid = experiment["valid"].values
    achieved = np.where(valid[:, None], achieved, np.nan)
    one, typical = get_descriptor(descriptor), descriptor_matrix(data, descriptor)[data["converged"].values]
    columns, within = one.error.in_units(achieved, target, typical, one.unit), one.error.of(achieved, target)
    measures = [("R²", "1")]
    for name, (column_unit, _) in columns.items():
        measures += [(f"mean {name}", column_unit), (f"median {name}", column_unit)]
    measures += [(f"within {one.error.limit(limit)}", "%") for limit in one.error.limits]
    measures += [("valid", "%"), ("buildable", "%")]
    values = np.column_stack([column for _, column in columns.values()])
    buildable = experiment["buildable"].values

    def statistics(rows):
        good = valid[rows]
        known = values[rows[good]]
        averages = np.column_stack([_average(known), _average(known, np.median)]).ravel()
        shares = [_average(within[rows[good]] <= limit) for limit in one.error.limits]
        shares += [_average(good), _average(buildable[rows])]
        return np.array([r_squared(target[rows], achieved[rows]), *averages, *(100 * share for share in shares)])

    everything = np.arange(len(target))
    low, high = bootstrap(statistics, len(target), experiment["level"].values if by_target else None, seed, n_resamples)
    table = pd.DataFrame(measures, columns=["measure", "unit"])
    table = table.assign(value=statistics(everything), low=low, high=high)
    table.loc[len(table)] = ["buildable, data set", "%", 100 * float(data["buildable"].mean()), np.nan, np.nan]
    return table


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


def accuracy(experiment: xr.Dataset, descriptor: str) -> pd.DataFrame:
    """How close the structures of an experiment come to their targets, target by target.

    Parameters
    ----------
    experiment : xarray.Dataset
        From :func:`inflate_lib.experiments.run.run_experiment`.
    descriptor : str

    Returns
    -------
    pandas.DataFrame
        A row per target and one for all: the target, the shares of valid structures (one closed structure that
        converges) and of buildable ones (:mod:`inflate_lib.mechanics.buildable`), mean and standard deviation of what
        was achieved, mean and median error (percent; for axes: pixels), share within 5 percent (axes: within one
        pixel), and in the last row R², the coefficient of determination of achieved against target.
    """
    valid, buildable = experiment["valid"].values, experiment["buildable"].values
    target = experiment["target"].values
    level, achieved = experiment["level"].values, descriptor_matrix(experiment, descriptor)
    one, error = get_descriptor(descriptor), errors(experiment, descriptor)
    unit, factor, near = one.error.unit, one.error.factor, one.error.near

    def row(name, here):
        error_here = error[here & valid]
        return {
            "target": name,
            "valid": valid[here].mean(),
            "buildable": buildable[here].mean(),
            f"mean error ({unit})": factor * _average(error_here),
            f"median error ({unit})": factor * _average(error_here, np.median),
            f"within {one.error.limit(near).replace(' %', '%')}": _average(error_here <= near),
        }

    rows = []
    for k in np.unique(level):
        here = level == k
        reached = pd.DataFrame(achieved[here & valid])
        spread = {}
        for column, name in enumerate(() if one.is_line else one.components):
            spread |= {f"mean {name}": reached[column].mean(), f"std {name}": reached[column].std()}
        rows.append(row(_words(one, target[here][0], k), here) | spread)
    everything = row("all", np.ones(len(level), dtype=bool))
    everything["R²"] = r_squared(target[valid], achieved[valid])
    return pd.DataFrame([*rows, everything]).reindex(columns=[*rows[0], "R²"])


def failure_reasons(experiments: Iterable[xr.Dataset]) -> pd.Series:
    """Why structures are not valid, counted over several experiments, or data sets (valid: what converges).

    Returns
    -------
    pandas.Series
        :class:`_Failure` → number, the most frequent first; empty where all are valid.
    """
    reasons = [reason for one in experiments for reason in one["reason"].values[~_valid(one)]]
    return pd.Series([_failure(str(reason)) for reason in reasons], dtype=object).value_counts()


def flaws(experiments: Iterable[xr.Dataset]) -> pd.Series:
    """Why valid structures cannot be built, counted over several experiments, or data sets (valid: what converges).

    Returns
    -------
    pandas.Series
        :class:`inflate_lib.mechanics.Flaw` → number, the most frequent first; empty where all can be built.
    """
    found = [flaw for one in experiments for flaw in one["flaw"].values[_valid(one) & ~one["buildable"].values]]
    return pd.Series([Flaw[flaw.upper()] for flaw in found], dtype=object).value_counts()


def _valid(one):
    """Which structures of an experiment are valid; of a data set, which converge."""
    return one.get("valid", one["converged"]).values


def _failure(reason):
    """What kind of failure a reason tells of; a structure that could be inflated and yet is not valid has none."""
    if not reason:
        return _Failure.IN_PIECES
    return next((kind for begin, kind in _FAILURES.items() if reason.startswith(begin)), _Failure.UNUSABLE)


def _average(values, average=np.mean):
    """Mean, or another average, over rows; NaN, without a warning, of nothing."""
    return average(values, axis=0) if len(values) else np.full(values.shape[1:], np.nan)[()]


def _words(descriptor, target, number):
    """A target as a table shows it."""
    if descriptor.is_line:
        return f"{descriptor.name} {number + 1}"
    values = ", ".join(f"{value:.3f}" for value in target)
    return f"({values})" if len(target) > 1 else values
