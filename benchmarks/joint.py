"""One model for all descriptors beside one model for each: on the targets of each, and on several targets at once.

    python benchmarks/joint.py [--targets 8]

asks the committed models of a profile for the descriptors of held-out structures, and writes data/reference/joint.csv,
which the chapter "Ask for your own shape" shows, and joint.json beside it, which says where it comes from. Finished
parts are kept in the cache: a script that was stopped goes on where it was.

"One target" is judged as in the model card. For "several targets" a structure misses by the largest of its relative
errors, that of an axis being the mean distance of its points over the height. There a single model is told what it
understands, the rest is left to luck and choice; what is not valid misses by any measure. "Outline" asks the joint
model for outlines, told the outline, or what an outline could be reduced to, or both: one drawing each, judged by its
distance from the outline.

All are asked as for designs, quickly: by their students.
"""

import argparse
import time
import warnings

import numpy as np
import pandas as pd
import xarray as xr
from stored import store

from inflate_lib._cache import cached, digest, step_version
from inflate_lib.alternatives.ablation import evaluate_variant
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.datasets.storage import load_dataset, save_dataset
from inflate_lib.descriptors import DESCRIPTORS, descriptor_matrix, get_descriptor
from inflate_lib.descriptors.registry import JOINT, PARTS, columns
from inflate_lib.diffusion import generate
from inflate_lib.experiments.metrics import bootstrap
from inflate_lib.experiments.run import held_out_targets, judge, model_digest
from inflate_lib.inverse.search import models_in_order
from inflate_lib.models.calibration import Calibration
from inflate_lib.models.recipe import load_recipe
from inflate_lib.models.weights import load_model

TOGETHER = (
    ("height", "width"),
    ("height", "area"),
    ("height", "width", "area"),
    ("area", "axis"),
    ("height", "stress"),
    ("stress", "axis"),
)
REDUCED = ("height", "width", "area", "axis")
TOLD = (REDUCED, ("outline",), (*REDUCED, "outline"))
NEAR = 0.05
PIECE = 200  # structures drawn and inflated at a time, which is what a stopped script can lose
COLUMNS = {name: columns(name, PARTS) for name in PARTS}  # of what the joint model is told


def options():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--profile", default="laptop", help="whose committed weights are asked")
    parser.add_argument("--targets", type=int, default=200, help="held-out targets")
    parser.add_argument("--outlines", type=int, default=100, help="held-out outlines, no more than targets")
    parser.add_argument("--candidates", type=int, default=4, help="for each of several targets at once")
    parser.add_argument("--source", default="mnist")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--name", default="joint", help="of the files in data/reference")
    return parser.parse_args()


class Study:
    """The models, and the structures that they are asked for."""

    def __init__(self, given):
        self.given, self.started, self.rows = given, time.monotonic(), []
        self.recipe = load_recipe(given.profile)
        self.models = {
            name: load_model(name, given.profile).made_for("steered").sampled() for name in (*DESCRIPTORS, JOINT)
        }
        self.data = simulated_sevens(given.source)

    def ways(self, single=None):
        """The models, not calibrated: the single one, then the joint model."""
        return [self.models[name] for name in (single, JOINT) if name]

    def one(self, name):
        """Rows of one descriptor: its own model, where it has one, and the joint model, on the same targets."""
        single = name if name in DESCRIPTORS else None
        targets, _ = held_out_targets(
            self.data, name, self.models[single or JOINT], self.given.targets, self.given.seed
        )
        for model in self.ways(single):
            measured = evaluate_variant(
                model, self.data, targets, self.given.seed, self.recipe.n_calibration, name, n_jobs=1
            )
            measured["unit"] = get_descriptor(name).error.unit
            self.add("one target", name, model, 1, measured)

    def several(self, parts):
        """Rows of several descriptors at once: the single model that takes most of them, and the joint model."""
        single = next(one.name for one in models_in_order() if set(one.parts) <= set(parts))
        joint, rows = descriptor_matrix(self.data, JOINT), self.rows_asked()
        for model in self.ways(single):
            drawn = self.answers(model, parts, rows, self.given.candidates)
            target = np.repeat(joint[rows], self.given.candidates, axis=0)
            achieved = descriptor_matrix(drawn, JOINT)
            misses = [
                get_descriptor(part).error.share(achieved[:, COLUMNS[part]], target[:, COLUMNS[part]]) for part in parts
            ]
            worst = np.where(drawn["valid"].values, np.max(misses, axis=0), np.inf).reshape(len(rows), -1)
            buildable = drawn["buildable"].values.reshape(worst.shape)
            for n in sorted({1, self.given.candidates}):
                best = np.arange(len(rows)), worst[:, :n].argmin(axis=1)
                measured = self.measured(worst[best]) | {"buildable": 100 * float(buildable[best].mean())}
                self.add("several targets", " and ".join(parts), model, n, measured)

    def outlines(self):
        """Rows of the joint model, asked for outlines in three ways."""
        rows, model = self.rows_asked()[: self.given.outlines], self.models[JOINT]
        wanted = descriptor_matrix(self.data, "outline")[rows]
        for parts in TOLD:
            drawn = self.answers(model, parts, rows, 1)
            miss = get_descriptor("outline").error.of(descriptor_matrix(drawn, "outline"), wanted)
            measured = self.measured(np.where(drawn["valid"].values, miss, np.inf), percent=1) | {"unit": "px"}
            measured["buildable"] = 100 * float(drawn["buildable"].values.mean())
            self.add("outline", " and ".join(parts), model, 1, measured)

    def rows_asked(self):
        """Held-out structures, all of whose descriptors the joint model has seen the like of."""
        return held_out_targets(self.data, JOINT, self.models[JOINT], self.given.targets, self.given.seed)[1]

    def answers(self, model, parts, rows, n):
        """n drawings for the descriptors of each of some structures; of a joint model for some parts of them."""
        told = descriptor_matrix(self.data, model.name)
        if model.name == JOINT:
            asked = np.concatenate([COLUMNS[part] for part in parts])
            told[:, np.setdiff1d(np.arange(told.shape[1]), asked)] = np.nan
        known = np.random.default_rng([self.given.seed, 5]).permutation(training_rows(self.data))
        calibration = self.calibration(model, told[known[: self.recipe.n_calibration]])
        wanted = told[rows]
        columns = np.isfinite(wanted).all(axis=0)
        if calibration:
            wanted[:, columns] = calibration.told(wanted[:, columns])
        return self.drawn(model, np.repeat(wanted, n, axis=0), self.given.seed)

    def calibration(self, model, told):
        """What a model has to be told; None for one that does not listen enough."""
        drawn = self.drawn(model, told, self.given.seed + 1_000_003)
        columns, valid = np.isfinite(told).all(axis=0), drawn["valid"].values
        try:
            return Calibration.fit(told[valid][:, columns], descriptor_matrix(drawn, model.name)[valid][:, columns])
        except ValueError:
            return None

    def drawn(self, model, told, seed):
        """One structure for each row that a model is told, inflated and judged, piece by piece.

        `run_experiment` has whole targets only; here most of what the joint model could be told is NaN.
        """

        def make(target, scratch):
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "[0-9]+ of [0-9]+ conditions lie outside")  # calibrated ones may
                images = generate(model.trained, piece, seed=seed, start=start, **model.sampling)
            save_dataset(judge(images, JOINT, piece, n_jobs=1), target)

        pieces = []
        for start in range(0, len(told), PIECE):
            piece = told[start : start + PIECE]
            key = {"model": model_digest(model.trained), "told": digest(piece)}
            key |= {"sampling": model.sampling, "seed": seed}
            key |= {"start": start, "code": step_version("experiment")}
            pieces.append(load_dataset(cached("joint", key, make, ".nc")))
        return xr.concat(pieces, "structure", data_vars="minimal", combine_attrs="drop_conflicts")

    def measured(self, worst, percent=100):
        """Median of the largest relative errors, or of distances, and how many are near, with intervals."""

        def statistics(rows):
            return np.array([percent * np.median(worst[rows]), 100 * np.mean(worst[rows] <= NEAR)])

        low, high = bootstrap(statistics, len(worst), seed=self.given.seed)
        row = {"unit": "%", "valid": 100 * np.mean(np.isfinite(worst))}
        for name, *values in zip(("median error", "within"), statistics(np.arange(len(worst))), low, high, strict=True):
            row |= dict(zip((name, f"{name} low", f"{name} high"), map(float, values), strict=True))
        return row

    def add(self, group, targets, model, n, measured):
        row = {"group": group, "targets": targets, "model": model.name, "guidance": model.sampling["guidance"], "n": n}
        row |= measured
        self.rows.append(row)
        print(f"{time.monotonic() - self.started:.0f} s: {row}", flush=True)


def main():
    given = options()
    study = Study(given)
    for name in dict.fromkeys((*DESCRIPTORS, *PARTS)):
        study.one(name)
    for parts in TOGETHER:
        study.several(parts)
    study.outlines()
    store(
        pd.DataFrame(study.rows),
        given.name,
        "joint.py",
        data=f"{study.data.attrs['source']}, {study.data.sizes['structure']} structures",
        targets=given.targets,
        profile=given.profile,
        sampling=study.models[JOINT].sampling,
        n_calibration=study.recipe.n_calibration,
        near=NEAR,
    )


if __name__ == "__main__":
    main()
