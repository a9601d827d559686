"""Calibration study: how far the centroids of MNIST's sevens are from Table 1, under the default and other choices.

    python benchmarks/calibration.py [processes] [--sample 250]

writes data/reference/calibration.csv, which the appendix "Verification" reads, and calibration.json beside it, which
says where it comes from. Some minutes on an idle core; what is simulated is kept in the cache, so that a run that was
stopped goes on where it was.

Threshold, padding and element of the library were chosen with such a comparison: agreement with Table 1 is in part no
independent test of them.

The default is simulated for all sevens. Any other choice is simulated for a random sample, the same for all choices;
what it changes is regressed on the sizes under the default, and all other sevens get the predicted change and the rest
of the seven in the sample that is most like them. Then all are clustered. Intervals come from resampling the sample;
those of the change of the mean deviation hold, besides, what the paper's rounding may hide.
"""

import argparse
from dataclasses import asdict

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree
from stored import store

from inflate_lib._cache import cached, code_version, digest
from inflate_lib.alternatives.settings import SETTINGS, simulate_setting
from inflate_lib.experiments.targets import TABULATED, find_clusters, paper_targets
from inflate_lib.structures.sources import load_sevens

RESAMPLES = 100
ROUNDING = 0.005  # the paper prints two decimals
SIZES = ("height", "width", "hull_area")
COLUMNS = {"height": [0], "width": [1], "box": [0, 1], "area": [2]}
STEPS = ("structures", "mechanics", "descriptors", "alternatives.stabilised")  # what sizes depend on


def simulate(images, setting, n_jobs):
    """Height, width and hull area, (n, 3), kept in the cache."""

    def make(target, scratch):
        with open(target, "wb") as file:
            np.save(file, simulate_setting(images, setting, n_jobs))

    code = code_version(*(f"inflate_lib.{name}" for name in STEPS))
    key = {"images": digest(images), "setting": asdict(setting), "code": code}
    return np.load(cached("calibration", key, make, ".npy"))


def imputed(default, rows, sizes):
    """Sizes of all sevens, (n, 3), from those of the sample's `rows`, (k, 3), and from all under the default."""
    like = (default - default.mean(axis=0)) / default.std(axis=0)
    features = np.column_stack([np.ones(len(like)), like])
    changes = sizes - default[rows]
    slopes = np.linalg.lstsq(features[rows], changes, rcond=None)[0]
    rest = changes - features[rows] @ slopes
    return default + features @ slopes + rest[cKDTree(like[rows]).query(like)[1]]


def clustered(sizes, starts):
    """The fifteen numbers of the twelve centroids: k-means from the centroids `starts` of the default."""
    return np.concatenate([lloyd(sizes[:, COLUMNS[name]], starts[name]).ravel() for name in TABULATED])


def lloyd(values, centroids):
    """Centroids (3, N) at which k-means comes to rest."""
    if values.shape[1] == 1:  # clusters are intervals: sums are differences of running sums
        ordered = np.sort(values[:, 0])
        sums = np.concatenate([[0], np.cumsum(ordered)])
    while True:
        if values.shape[1] == 1:
            ends = np.searchsorted(ordered, (centroids[1:, 0] + centroids[:-1, 0]) / 2)
            ends = np.concatenate([[0], ends, [len(ordered)]])
            moved = (np.diff(sums[ends]) / np.diff(ends))[:, None]
        else:
            nearest = ((values[:, None] - centroids) ** 2).sum(axis=-1).argmin(axis=1)
            moved = np.stack([values[nearest == level].mean(axis=0) for level in range(len(centroids))])
        if np.array_equal(moved, centroids):
            return centroids
        centroids = moved


def main(n_jobs, n_sample):
    sevens, rng = load_sevens("mnist"), np.random.default_rng(0)
    order = rng.permutation(len(sevens.images))
    default = simulate(sevens.images[order], SETTINGS[0], n_jobs)
    starts = {name: find_clusters(default[:, columns]).centroids for name, columns in COLUMNS.items()}
    centroids, table = clustered(default, starts), paper_targets()
    printed, kinds = table.paper.to_numpy(), table.component.to_numpy()
    rounded = printed + rng.uniform(-ROUNDING, ROUNDING, (RESAMPLES, len(printed)))
    picks = rng.integers(0, n_sample, (RESAMPLES, n_sample))  # the same for all choices
    rows = []
    for setting in SETTINGS:
        sizes = (
            default[:n_sample] if setting == SETTINGS[0] else simulate(sevens.images[order[:n_sample]], setting, n_jobs)
        )
        good = np.isfinite(sizes).all(axis=1)
        here = clustered(imputed(default, np.flatnonzero(good), sizes[good]), starts)
        draws = [pick[good[pick]] for pick in picks]
        again = np.array([clustered(imputed(default, draw, sizes[draw]), starts) for draw in draws])
        residual, residuals = 100 * (here / printed - 1), 100 * (again / printed - 1)
        row = asdict(setting) | {"n_sevens": n_sample if setting != SETTINGS[0] else len(order)}
        row["n_failed"] = n_sample - int(good.sum())
        for kind in ("height", "width", "area"):
            low, high = np.percentile(residuals[:, kinds == kind].mean(axis=1), (2.5, 97.5))
            row |= {f"{kind}_percent": residual[kinds == kind].mean(), f"{kind}_low": low, f"{kind}_high": high}
        row |= {"mean_percent": np.abs(residual).mean(), "largest_percent": np.abs(residual).max()}
        row["change_percent"] = row["mean_percent"] - np.abs(100 * (centroids / printed - 1)).mean()
        change = 100 * (np.abs(again / rounded - 1) - np.abs(centroids / rounded - 1)).mean(axis=1)
        row["change_low"], row["change_high"] = np.percentile(change, (2.5, 97.5))
        rows.append(row)
        print(rows[-1], flush=True)
    store(
        pd.DataFrame(rows), "calibration", "calibration.py", data=sevens.description,
        sample=f"{n_sample} sevens at random, the same for all settings; the default: all {len(order)}",
        intervals=f"95 %, {RESAMPLES} bootstrap resamples of the sample",
    )  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("processes", type=int, nargs="?", default=1)
    parser.add_argument(
        "--sample", type=int, default=250, help="sevens that each choice but the default is simulated for"
    )
    options = parser.parse_args()
    main(options.processes, options.sample)
