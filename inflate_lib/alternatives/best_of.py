"""Best of n: draw n candidates for a target and keep the most promising, by simulating them all or by a surrogate.

From N candidates per target, what to expect of the best of n < N follows without drawing any lots: if candidates are
ranked, the k-th of them is the best of n that were picked at random with probability C(N − k, n − 1) / C(N, n).
"""

import json
import time
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import torch
import xarray as xr
from scipy.special import comb

from inflate_lib._cache import cached, step_version
from inflate_lib._checks import whole_number
from inflate_lib.datasets.simulate import simulate_dataset
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.diffusion import generate
from inflate_lib.experiments.metrics import bootstrap, misses
from inflate_lib.experiments.run import model_digest
from inflate_lib.models.surrogate import Surrogate


def chances(n_candidates, n):
    """Probability that each rank, the best first, is the best of n candidates picked from all, (n_candidates,)."""
    if not 1 <= n <= n_candidates:
        raise ValueError(f"n is {n}; from {n_candidates} candidates, 1 to {n_candidates} can be picked")
    rank = np.arange(1, n_candidates + 1)
    return comb(n_candidates - rank, n - 1) / comb(n_candidates, n)


def best_of(errors, ranking, n):
    """Errors to expect when of n candidates the one is kept that ranks best.

    Parameters
    ----------
    errors : (targets, candidates) float
        What each candidate misses its target by; infinite where it is not valid.
    ranking : (targets, candidates) float
        What candidates are ranked by, the smallest first; not finite: last.
    n : int

    Returns
    -------
    errors, probabilities : (targets, candidates) float
        Errors in order of rank, and the probability that it is this one.
    """
    order = np.argsort(np.where(np.isfinite(ranking), ranking, np.inf), axis=1, kind="stable")
    weights = np.broadcast_to(chances(errors.shape[1], n), errors.shape)
    return np.take_along_axis(errors, order, axis=1), weights


def _weighted_quantile(values, weights, q):
    """The smallest value up to which a share q of the weight lies."""
    values, weights = np.ravel(values), np.ravel(weights)
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return values[order][min(np.searchsorted(total, q * total[-1] * (1 - 1e-12)), len(values) - 1)]


def selection(
    candidates: xr.Dataset,
    descriptor: str,
    trained: Surrogate,
    ns: Sequence[int] = (1, 4, 16, 50),
    seconds: Mapping | None = None,
    seed: int = 0,
    n_resamples: int = 500,
) -> pd.DataFrame:
    """Error against the number of candidates, and against the time that they take.

    Parameters
    ----------
    candidates : xarray.Dataset
        Experiment with the same number of structures for each target, at least as many as the largest n.
    descriptor : str
    trained : Surrogate
    ns : sequence of int
        Numbers of candidates.
    seconds : Mapping, optional
        Of :func:`seconds_per_structure`.
    seed, n_resamples : int
        Of the bootstrap over targets.

    Returns
    -------
    pandas.DataFrame
        Columns by ("simulation" or "surrogate"), n, median, low, high, 90 % (quantile), fails (share of picks that are
        not valid), buildable (share of picks that can be built), seconds. Errors in percent of the target, for axes in
        pixels. A pick that is not valid counts as an infinite error.
    """
    whole_number("seed", seed, 0)
    whole_number("n_resamples", n_resamples, 1)
    for n in ns:
        whole_number("ns", n, 1)
    targets = np.unique(candidates["level"].values)
    shape = len(targets), candidates.sizes["structure"] // len(targets)
    target = candidates["target"].values
    error = get_descriptor(descriptor).error.factor * misses(
        descriptor, descriptor_matrix(candidates, descriptor), target
    )
    error = np.where(candidates["valid"].values, error, np.inf).reshape(shape)
    buildable, images = candidates["buildable"].values.reshape(shape), candidates["image"].values
    promised = misses(descriptor, trained.predict(images, descriptor), target).reshape(shape)
    rows = []
    for by, ranking in (("simulation", error), ("surrogate", promised)):
        for n in ns:
            ordered, weights = best_of(error, ranking, n)

            def median(rows, ordered=ordered, weights=weights):
                return _weighted_quantile(ordered[rows], weights[rows], 0.5)

            low, high = bootstrap(median, len(targets), None, seed, n_resamples)
            row = {"by": by, "n": n, "median": median(slice(None)), "low": float(low), "high": float(high)}
            row["90 %"] = _weighted_quantile(ordered, weights, 0.9)
            row["fails"] = (weights * np.isinf(ordered)).sum() / len(targets)
            row["buildable"] = (weights * best_of(buildable, ranking, n)[0]).sum() / len(targets)
            if seconds is not None:
                row["seconds"] = n * (seconds["generate"] + seconds["simulate" if by == "simulation" else "surrogate"])
            rows.append(row)
    return pd.DataFrame(rows)


def seconds_per_structure(model, trained, targets, seed=0):
    """What one candidate costs in seconds of one core: to generate it, to simulate it, to ask the surrogate.

    Measured once, on as many structures as there are targets, and kept in the cache.

    Returns
    -------
    dict
        "generate", "simulate" (in ten load steps, with everything that belongs to it) and "surrogate".
    """

    def make(target, scratch):
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            found, images = {}, None
            for name in ("generate", "simulate", "surrogate", "simulate", "surrogate"):  # twice: the first one warms up
                start = time.process_time()
                if name == "generate":
                    images = generate(model.trained, targets, seed, **model.sampling)
                elif name == "simulate":
                    simulate_dataset(images, n_jobs=1, progress_text=False)
                else:
                    trained.predict(images, model.name)
                found[name] = (time.process_time() - start) / len(targets)
        finally:
            torch.set_num_threads(threads)
        target.write_text(json.dumps(found))

    key = {
        "model": model_digest(model.trained),
        "sampling": model.sampling,
        "n": len(targets),
        "code": step_version("alternative"),
    }
    return json.loads(cached("seconds", key, make, ".json").read_text())
