"""What a model of all ten digits is worth: asked for what sevens reach, and for what they do not; and how to train it.

    python benchmarks/digits_model.py --train FOLDER
    python benchmarks/digits_model.py

The first line trains the joint model of a profile on all training digits of MNIST, with the digit as one more part of
its condition (half an hour of a core; a run that was stopped goes on from its checkpoints in FOLDER), calibrates it,
and writes its weights and what the digits reach into data/pretrained/<profile>/digits. The second asks three questions
of it, told a seven or no digit, beside the joint model that knows sevens alone, both drawing as the experiments of the
paper are made (*faithful*), and writes data/reference/digits_model.csv:

- held-out sevens: how accurate, valid, buildable, various and new is what is drawn for their descriptors, and how many
  of the drawings show a seven? The sevens are those that neither model has seen.
- targets that no seven meets: heights and widths from the region that other digits reach, axes of held-out digits. How
  many are met by the best of some drawings?
"""

import argparse
import time
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from sklearn.neighbors import KNeighborsClassifier
from stored import store

from inflate_lib import paths
from inflate_lib.alternatives import open_parts, simulated_digits
from inflate_lib.alternatives.ablation import measures
from inflate_lib.alternatives.all_digits import MET, met_targets, nearest_miss, sizes_of, stored_digits
from inflate_lib.alternatives.digits_model import FILE, held_out_digits, load_digits_model, told_digit, train_digits
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.datasets.simulate import simulate_dataset, simulated_sevens
from inflate_lib.descriptors import DESCRIPTORS, descriptor_matrix, get_descriptor
from inflate_lib.descriptors.registry import JOINT, PARTS
from inflate_lib.experiments.calibrate import calibrate
from inflate_lib.experiments.metrics import bootstrap
from inflate_lib.experiments.run import held_out_seed, held_out_targets, run_experiment
from inflate_lib.experiments.variety import diversity, novelty
from inflate_lib.models.reach import save_reach
from inflate_lib.models.recipe import load_recipe
from inflate_lib.models.weights import Model, load_model
from inflate_lib.structures import load_digits

ASKED = ("height", "width", "area", "axis")
NOT_LOADED = ["label", "reason"]


def options():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--train", type=Path, metavar="FOLDER", help="train the model, with checkpoints there")
    parser.add_argument("--profile", default="laptop", help="whose recipe, and whose committed weights")
    parser.add_argument("--targets", type=int, default=200, help="held-out sevens asked for, by each descriptor")
    parser.add_argument("--beyond", type=int, default=100, help="targets that no seven meets, of each kind")
    parser.add_argument("--drawings", type=int, default=8, help="for each of these")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def train(given):
    """Train the model of all digits, calibrate it, and write weights and reach where `load_digits_model` looks."""
    recipe = load_recipe(given.profile)
    data = open_parts(simulated_digits("all", "mnist", n_jobs=1)).drop_vars(NOT_LOADED).load()
    trained = train_digits(data, recipe, given.train, threads=1)
    seen = data.isel(structure=np.flatnonzero(~held_out_digits(data["digit"].values)))
    model, fits = Model(JOINT, told_digit(trained), recipe.sampling), {}
    for asked in DESCRIPTORS:
        with suppress(ValueError):  # it does not listen enough
            fit = calibrate(model, seen, recipe.n_calibration, recipe.seed, asked, n_jobs=1)
            fits[asked] = fit.as_dict() | {"n": recipe.n_calibration, "seed": recipe.seed}
    trained.metadata |= {"profile": given.profile, "digits": "all", "calibration": fits}
    file = paths.PRETRAINED / given.profile / FILE
    trained.save(file, half=True)
    save_reach(covering(data), file.parent)


def covering(data, tolerance=0.05):
    """Some of the structures, so few that each other one is within the tolerance of one of them in every descriptor.

    That is the distance on the way to what counts as out of reach at which a target may be judged by another structure.
    """
    data = data.isel(structure=np.flatnonzero(data["converged"].values))
    known = {name: descriptor_matrix(data, name).astype(np.float32) for name in PARTS}
    chosen = np.empty(0, int)
    for row in np.random.default_rng(0).permutation(data.sizes["structure"]):
        near = chosen
        for name in PARTS:  # those that are near in one descriptor are looked at in the next
            near = near[get_descriptor(name).error.share(known[name][near], known[name][row]) <= tolerance]
        if not len(near):
            chosen = np.append(chosen, row)
    return data.isel(structure=np.sort(chosen))


class Study:
    """The two models, and what they are asked for."""

    def __init__(self, given):
        self.given, self.rows, self.started = given, [], time.monotonic()
        self.recipe, self.sevens = load_recipe(given.profile), simulated_sevens("mnist")
        self.models = {
            "sevens": load_model(JOINT, given.profile),
            "digits, told seven": load_digits_model(7, given.profile),
            "digits": load_digits_model(profile=given.profile),
        }
        self.table, found = stored_digits(), load_digits("all", "mnist")
        self.images, seen = found.images, ~held_out_digits(found.labels)
        self.classifier = KNeighborsClassifier(3, algorithm="brute").fit(flat(found.images[seen]), found.labels[seen])
        some = np.random.default_rng(given.seed).permutation(np.flatnonzero(~seen))[:1000]
        self.recognised = float(np.mean(self.classifier.predict(flat(found.images[some])) == found.labels[some]))

    def ask(self, model, targets, n, seed, asked):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".* lie outside the (training data|range of the training data)")
            return run_experiment(model, targets, n, seed, asked, n_jobs=1, extrapolate=True)

    def held_out(self, asked, n_various=5, n_each=12):
        """Rows of what is drawn for one descriptor of sevens that were kept from training."""
        targets, _ = held_out_targets(self.sevens, asked, self.models["sevens"], self.given.targets, self.given.seed)
        for name, model in self.models.items():
            plain = model.sampled()
            fit = calibrate(plain, self.sevens, self.recipe.n_calibration, self.given.seed, asked, n_jobs=1)
            plain = replace(plain, calibrations={asked: fit})
            drawn = self.ask(plain, targets, 1, held_out_seed(self.given.seed), asked)
            several = self.ask(plain, targets[:n_various], n_each, self.given.seed, asked)
            images = drawn["image"].values
            away, _ = novelty(images, self.sevens, training_rows(self.sevens))
            self.add("held-out sevens", asked, name, 1, {
                **measures(drawn, asked, self.sevens, self.given.seed),
                "unit": get_descriptor(asked).error.unit,
                "variety": float(diversity(several, asked, self.sevens, n_resamples=1)["ratio"].mean()),
                "nearest distance": float(np.median(away)),
                "sevens %": 100 * float(np.mean(self.classifier.predict(flat(images)) == 7)),
            })  # fmt: skip

    def beyond(self):
        """Rows of what is drawn for targets that no seven meets."""
        draw, n = np.random.default_rng([self.given.seed, 1]), self.given.beyond
        sevens = sizes_of(self.table.where(self.table.digit == 7))
        grid = met_targets(sizes_of(self.table))
        grid = draw.permutation(grid[nearest_miss(sevens, grid) > MET])[:n]
        self.best("box", grid, nearest_miss(sevens, grid))
        apart = self.table.axis_apart.values
        rows = draw.permutation(np.flatnonzero(held_out_digits(self.table.digit.values) & (apart > MET)))[:n]
        there = simulate_dataset(self.images[rows], n_jobs=1)
        self.best("axis", descriptor_matrix(there, "axis"), apart[rows])

    def best(self, asked, targets, of_sevens):
        """Rows of the best of some drawings for each target, after one of the nearest structure among all sevens."""
        self.add("beyond sevens", asked, "nearest seven", 1, self.met(of_sevens))
        for name in ("sevens", "digits"):
            drawn = self.ask(self.models[name], targets, self.given.drawings, self.given.seed, asked)
            miss = get_descriptor(asked).error.share(descriptor_matrix(drawn, asked), drawn["target"].values)
            miss = np.where(drawn["valid"].values, miss, np.inf).reshape(len(targets), -1)
            rates = {name: 100 * float(drawn[name].values.mean()) for name in ("valid", "buildable")}
            self.add("beyond sevens", asked, name, self.given.drawings, self.met(miss.min(axis=1)) | rates)

    def met(self, miss):
        """How many targets are missed by no more than 2 and 5 %, and the median error, in percent, with intervals."""

        def statistics(rows):
            return 100 * np.array([np.mean(miss[rows] <= MET), np.mean(miss[rows] <= 0.05), np.median(miss[rows])])

        ends = statistics(np.arange(len(miss))), *bootstrap(statistics, len(miss), seed=self.given.seed)
        row = {"unit": "%"}
        for name, *values in zip(("met 2 %", "met 5 %", "median error"), *ends, strict=True):
            row |= dict(zip((name, f"{name} low", f"{name} high"), map(float, values), strict=True))
        return row

    def add(self, group, asked, model, n, measured):
        self.rows.append({"group": group, "targets": asked, "model": model, "n": n} | measured)
        print(f"{time.monotonic() - self.started:.0f} s: {self.rows[-1]}", flush=True)


def flat(images):
    """Images as rows of numbers in [0, 1]."""
    images = np.asarray(images)
    return images.reshape(len(images), -1) / np.float32(255 if images.dtype == np.uint8 else 1)


def main():
    given = options()
    if given.train:
        train(given)
        return
    study = Study(given)
    for asked in ASKED:
        study.held_out(asked)
    study.beyond()
    store(
        pd.DataFrame(study.rows),
        "digits_model",
        "digits_model.py",
        data="MNIST training digits",
        targets=given.targets,
        profile=given.profile,
        sampling=dict(study.models["digits"].sampling),
        n_calibration=study.recipe.n_calibration,
        met=MET,
        recognised=study.recognised,
    )


if __name__ == "__main__":
    main()
