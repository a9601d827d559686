"""How far structures are from what was asked for, and how sure such numbers are.

Intervals are percentile bootstrap intervals (Efron & Tibshirani 1993, chapter 14): the same number, computed again and
again from resamples of the structures, and the range that holds the middle 95 % of the results."""

from collections.abc import Callable

import numpy as np
import xarray as xr

from inflate_lib._checks import share, whole_number
from inflate_lib.descriptors import descriptor_matrix, get_descriptor


def errors(experiment: xr.Dataset, descriptor: str) -> np.ndarray:
    """Distance of what was achieved from what was asked for, one number per structure.

    Parameters
    ----------
    experiment : xarray.Dataset
        From :func:`inflate_lib.experiments.run.run_experiment`.
    descriptor : str

    Returns
    -------
    (n,) float
        Scalars: relative error ``|achieved − target| / target``. Box: the mean of its two relative errors. Axis: mean
        distance of the thirty points, in pixels. NaN where the structure did not converge.
    """
    return misses(descriptor, descriptor_matrix(experiment, descriptor), experiment["target"].values)


def misses(descriptor, achieved, target):
    """:func:`errors` of descriptors that are given as arrays, achieved and target (n, N)."""
    return get_descriptor(descriptor).error.of(achieved, target)


def r_squared(target: np.ndarray, achieved: np.ndarray) -> float:
    """Coefficient of determination of achieved (n, N) against target (n, N), components weighted by their variance.

    1 − Σ|achieved − target|² / Σ|target − mean target|², over the rows without NaN; NaN where targets do not differ.
    """
    known = np.isfinite(achieved).all(axis=1)
    target, achieved = target[known], achieved[known]
    if not len(target) or not np.ptp(target, axis=0).any():  # the mean of equal numbers may differ from them
        return np.nan
    return 1 - ((achieved - target) ** 2).sum() / ((target - target.mean(axis=0)) ** 2).sum()


def bootstrap(
    statistic: Callable,
    n: int,
    groups: np.ndarray | None = None,
    seed: int = 0,
    n_resamples: int = 1000,
    level: float = 0.95,
) -> tuple[np.ndarray, np.ndarray]:
    """Percentile bootstrap interval of a statistic of n structures.

    Parameters
    ----------
    statistic : callable
        ``statistic(rows)`` with row numbers (n,) → a number, or an array of them.
    n : int
    groups : (n,) array_like, optional
        Rows are drawn anew within each group, for targets that are fixed; by default all rows are one group.
    seed, n_resamples : int
    level : float
        Share of the resamples that the interval holds.

    Returns
    -------
    low, high : float arrays of the statistic's shape
        NaN where too few resamples give a number.
    """
    for name, value, least in (("n", n, 0), ("seed", seed, 0), ("n_resamples", n_resamples, 1)):
        whole_number(name, value, least)
    share("level", level)
    rng = np.random.default_rng(seed)
    groups = np.zeros(n, dtype=int) if groups is None else np.asarray(groups)
    parts = [np.flatnonzero(groups == group) for group in np.unique(groups)]
    values = []
    for _ in range(n_resamples):
        values.append(statistic(np.concatenate([part[rng.integers(len(part), size=len(part))] for part in parts])))
    values = np.sort(np.asarray(values, dtype=float), axis=0)  # NaN last
    known = np.isfinite(values).all(axis=0)
    low, high = np.quantile(np.where(known, values, 0.0), [(1 - level) / 2, (1 + level) / 2], axis=0)
    return np.where(known, low, np.nan), np.where(known, high, np.nan)


def scatter_between_samples(statistic: Callable, n: int, seed: int = 0, n_splits: int = 5) -> np.ndarray:
    """How far a statistic of n structures is from that of n others, on average, found by halving the n at hand.

    The mean of n/2 has twice the variance of a mean of n, and a difference of two independent samples twice that of
    either; so the halves of a sample differ by √2 times as much as two whole samples do, and are divided by that.

    Parameters
    ----------
    statistic : callable
        ``statistic(rows)`` with row numbers → an array.
    n : int
    seed : int
        Of the cuts into two halves.
    n_splits : int
        Cuts to average over.

    Returns
    -------
    array of the statistic's shape
        Mean absolute difference.
    """
    rng, halves = np.random.default_rng(seed), []
    for _ in range(n_splits):
        one, other = np.array_split(rng.permutation(n), 2)
        halves.append(np.abs(np.asarray(statistic(one)) - np.asarray(statistic(other))))
    return np.mean(halves, axis=0) / np.sqrt(2)
