"""Where a model answers high or low: held-out targets in tenths, told through a straight calibration and a bent one.

    python benchmarks/tails.py

asks the committed models for all held-out structures in their range, twice with the same noise: through the line of
least squares that the same answers give, and through the calibration that lies with the weights. It writes the median
deviation of each tenth of the targets to data/reference/tails.csv, which the chapter "Accuracy" shows, and tails.json.
"""

import argparse
from dataclasses import replace

import numpy as np
import pandas as pd
from stored import store

from inflate_lib._cache import step_version
from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.experiments.calibrate import answers
from inflate_lib.experiments.metrics import bootstrap, r_squared
from inflate_lib.experiments.run import run_held_out
from inflate_lib.models.calibration import Calibration
from inflate_lib.models.recipe import load_recipe
from inflate_lib.models.weights import load_model

PARTS = 10


def straight(targets, achieved):
    """The line of least squares through the answers (n, 1) of a scalar, as a calibration."""
    mean = targets.mean(axis=0)
    slope, offset = np.polyfit((targets - mean)[:, 0], (achieved - mean)[:, 0], 1)
    return Calibration(mean, np.eye(1), np.array([offset]), np.array([[slope]]))


def rows(experiment, name, way):
    """A row for each tenth of the targets, the smallest first, and one for all: median deviation in percent."""
    valid = experiment["valid"].values
    target, achieved = experiment["target"].values[valid], descriptor_matrix(experiment, name)[valid]
    deviation = 100 * (achieved / target - 1)[:, 0]
    order = np.argsort(target[:, 0], kind="stable")
    parts = dict(enumerate(np.array_split(order, PARTS), 1)) | {"all": order}
    for part, chosen in parts.items():
        one = deviation[chosen]
        low, high = bootstrap(lambda found, one=one: np.median(one[found]), len(one))
        row = {"descriptor": name, "calibration": way, "part": part, "n": len(one)}
        row |= {"from": target[chosen].min(), "to": target[chosen].max(), "median": np.median(one)}
        row |= {"median low": float(low), "median high": float(high), "above": 100 * np.mean(one > 0)}
        yield row | {"error": np.median(np.abs(one)), "R²": r_squared(target[chosen], achieved[chosen])}


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--profile", default="laptop")
    parser.add_argument("--descriptors", nargs="+", default=["height", "width", "area"])
    given = parser.parse_args()
    recipe = load_recipe(given.profile)
    data, found = simulated_sevens(recipe.source), []
    for name in given.descriptors:
        model = load_model(name, given.profile)
        line = straight(*answers(model, data, recipe.n_calibration, recipe.seed, n_jobs=1))
        for way, one in {"straight": replace(model, calibrations={name: line}), "bent": model}.items():
            found += rows(run_held_out(one, data, recipe.seed, n_jobs=1), name, way)
    store(
        pd.DataFrame(found),
        "tails",
        "tails.py",
        data=f"{data.attrs['source']}, {data.sizes['structure']} structures",
        profile=given.profile,
        answers=recipe.n_calibration,
        sampling=recipe.sampling,
        learning_code=step_version("experiment"),
    )


if __name__ == "__main__":
    main()
