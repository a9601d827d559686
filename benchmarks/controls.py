"""Ways to come nearer to a target, at equal cost: what they gain, and the processor time that they take.

    python benchmarks/controls.py [--targets 8]

asks a model for held-out targets in each way, and writes data/reference/controls.csv, which the chapter "Sharper
control" shows, and controls.json beside it, which says where it comes from. Everything runs in one thread; seconds are
those of the processor. Finished parts are kept in the cache: a script that was stopped goes on where it was.
"""

import argparse
import json
import os
import time
from dataclasses import replace

import numpy as np
import pandas as pd
import torch
from scipy.stats import spearmanr
from stored import store

from inflate_lib._cache import cached, code_version, digest, step_version
from inflate_lib.alternatives.surrogate import train_surrogate
from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.descriptors import describe, descriptor_matrix, get_descriptor
from inflate_lib.diffusion import generate
from inflate_lib.experiments.calibrate import calibrate
from inflate_lib.experiments.metrics import bootstrap, misses, r_squared
from inflate_lib.experiments.run import held_out_targets, model_digest, run_experiment
from inflate_lib.inverse.adjoint import flip_changes, sensitivities
from inflate_lib.inverse.constraints import Constraints
from inflate_lib.inverse.refine import attempt, border, refine, with_flipped
from inflate_lib.inverse.targets import Targets
from inflate_lib.mechanics.inflation import inflate
from inflate_lib.models.recipe import load_recipe
from inflate_lib.models.weights import load_model

DESCRIPTOR = "height"  # a scalar with a sensitivity
GOAL = 1e-3  # relative error at which a refinement stops
TRIES = 10, 60  # inflations that a refinement may take
NEAR = 0.02
TIMED = 32  # structures that the time per structure is measured on
PIECE = 20  # targets refined at a time, which is what a stopped script can lose


def options():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--profile", default="laptop", help="whose committed weights are asked")
    parser.add_argument("--targets", type=int, default=200, help="held-out targets")
    parser.add_argument("--source", default="mnist")
    parser.add_argument("--surrogate-steps", type=int, default=1000, help="training steps of the surrogate")
    parser.add_argument("--strength", type=float, default=2.0, help="of the surrogate's guidance")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--remark", default="", help="what else the machine did, for the record")
    parser.add_argument("--name", default="controls", help="of the files in data/reference")
    return parser.parse_args()


class Study:
    """A model, its targets, and what it costs to ask it."""

    def __init__(self, given):
        torch.set_num_threads(1)
        self.given, self.seed, self.started = given, given.seed, time.monotonic()
        recipe = load_recipe(given.profile)
        self.model = load_model(DESCRIPTOR, given.profile).sampled()
        self.data = simulated_sevens(given.source)
        self.targets, _ = held_out_targets(self.data, DESCRIPTOR, self.model, given.targets, given.seed)
        self.surrogate = train_surrogate(self.data, given.surrogate_steps, given.seed)
        guided, n = self.model.sampled(guidance=3.0), recipe.n_calibration
        self.calibration = calibrate(guided, self.data, n, given.seed, n_jobs=1)
        self.rows = []

    def draw(self, n, guidance, calibration=None, strength=0.0):
        """An experiment with n structures per target, and the seconds that one takes."""
        calibrations = {} if calibration is None else {DESCRIPTOR: calibration}
        model = replace(self.model.sampled(guidance=guidance), calibrations=calibrations)
        if strength:
            model = model.steered(self.surrogate, strength)
        answer = run_experiment(model, self.targets, n, self.seed, n_jobs=1, extrapolate=True)
        return answer, self.clocks()[f"{guidance:g}, {strength:g}"]

    def clocks(self):
        """Seconds to generate and to simulate one structure, and to ask the surrogate about it, for each way to draw.

        All ways take turns, three times, so that none has the machine at a better time; the least of each counts.
        """

        def make(target, scratch):
            clocks = {}
            for _ in range(4):  # the first one warms up
                for guidance, strength in ((1.0, 0.0), (3.0, 0.0), (5.0, 0.0), (3.0, strongest), (1.0, strongest)):
                    clocks.setdefault(f"{guidance:g}, {strength:g}", []).append(self._clock(guidance, strength))
            least = {way: pd.DataFrame(seconds[1:]).min().to_dict() for way, seconds in clocks.items()}
            target.write_text(json.dumps(least))

        strongest = self.given.strength
        key = {
            "model": model_digest(self.model.trained),
            "sampling": self.model.sampling,
            "strength": strongest,
            "n": TIMED,
        }
        return json.loads(cached("seconds", key | {"code": self.code()}, make, ".json").read_text())

    def _clock(self, guidance, strength):
        model = self.model.sampled(sampler="ddim", guidance=guidance)
        y = np.resize(self.targets, (TIMED, 1))
        start = time.process_time()
        if strength:
            model = model.steered(self.surrogate, strength)
        images = generate(model.trained, y, self.seed, **model.sampling)
        drawn = time.process_time()
        self.surrogate.predict(images, DESCRIPTOR)
        asked = time.process_time()
        for image in images:
            reason, _, result = attempt(image, Constraints())
            if not reason:
                describe(result)
        done = time.process_time()
        clock = {"generate": drawn - start, "surrogate": asked - drawn, "simulate": done - asked}
        return {name: value / TIMED for name, value in clock.items()}

    def best(self, answer, n, ranking=None):
        """Row of the best of the first n structures of each target: by the simulation, or by a ranking (rows,)."""
        shape = len(self.targets), -1
        error = misses(DESCRIPTOR, descriptor_matrix(answer, DESCRIPTOR), answer["target"].values)
        error = np.where(answer["valid"].values, error, np.inf)
        ranking = error if ranking is None else np.where(np.isfinite(ranking), ranking, np.inf)
        first = ranking.reshape(shape)[:, :n].argmin(axis=1)
        return np.arange(len(first)) * (len(error) // len(first)) + first

    def select(self, control, answer, clock, n, by_surrogate=False):
        """Add the row of the best of n."""
        ranking = None
        if by_surrogate:
            promised = self.surrogate.predict(answer["image"].values, DESCRIPTOR)
            ranking = misses(DESCRIPTOR, promised, answer["target"].values)
        chosen = self.best(answer, n, ranking)
        achieved = np.where(answer["valid"].values, answer[DESCRIPTOR].values, np.nan)[chosen]
        seconds = clock["generate"] + clock["surrogate" if by_surrogate else "simulate"]
        buildable = answer["buildable"].values[chosen]
        self.add(control, f"best of {n}" if n > 1 else "one", achieved, buildable, n * seconds)

    def refined(self, control, answer, clock, n, order):
        """Add rows of the best of n, refined pixel by pixel."""
        chosen = self.best(answer, n)
        parts = [self._refine(answer, rows, order) for rows in np.array_split(chosen, max(1, len(chosen) // PIECE))]
        traces = [trace for part in parts for trace in part["errors"]]
        spent = [seconds for part in parts for seconds in part["seconds"]]
        for tries in TRIES:
            # A trace knows the size of the miss; its sign does not matter to R² or the error.
            achieved = self.targets[:, 0] * [1 + trace[: tries + 1][-1] for trace in traces]
            share = [min(1, tries / max(1, len(trace) - 1)) for trace in traces]
            seconds = n * (clock["generate"] + clock["simulate"]) + np.mean(np.multiply(share, spent))
            start = f"best of {n}" if n > 1 else "one"
            buildable = answer["buildable"].values[chosen]  # refinement keeps what can be built so
            self.add(control, f"{start}, then {tries} flips tried", achieved, buildable, seconds)

    def _refine(self, answer, rows, order):
        def make(target, scratch):
            found = {"errors": [], "seconds": []}
            for row in rows:
                wanted = Targets(height=float(answer["target"].values[row, 0]))
                start, trace = time.process_time(), [np.nan]
                reason, label, result = attempt(answer["label"].values[row].astype(float), Constraints())
                if answer["valid"].values[row]:
                    trace = [abs(answer[DESCRIPTOR].values[row] / wanted.height - 1)]
                    if not reason:  # what cannot be built is left as it is
                        refine(label, result, wanted, Constraints(), GOAL, max(TRIES), int(row), order, trace)
                found["errors"].append([float(error) for error in trace])
                found["seconds"].append(time.process_time() - start)
            target.write_text(json.dumps(found))

        key = {"labels": digest(answer["label"].values[rows], answer["target"].values[rows]), "order": order}
        key |= {"rows": digest(rows), "code": self.code(), "goal": GOAL, "tries": TRIES}
        return json.loads(cached("refined", key, make, ".json").read_text())

    def estimates(self, answer, n=20):
        """How well the adjoint ranks the flips of n structures: Spearman's correlation with the truth, and flips tried.

        The median over the structures.
        """

        def make(target, scratch):
            found, flips = [], 0
            for label in answer["label"].values[answer["valid"].values][:n].astype(float):
                result, pairs = inflate(label), []
                estimate = flip_changes(label, sensitivities(result, get_descriptor(DESCRIPTOR).gradient))
                for row, column in border(label):
                    reason, _, flipped = attempt(with_flipped(label, [(row, column)]), Constraints())
                    if not reason:
                        change = describe(flipped).height - describe(result).height
                        pairs.append((estimate[row, column], change))
                if len(pairs) > 1:  # a structure that cannot be built has no flips to try
                    found.append(float(spearmanr(*np.transpose(pairs)).statistic))
                flips += len(pairs)
            target.write_text(json.dumps([float(np.median(found)), flips]))

        key = {"labels": digest(answer["label"].values), "n": n, "code": self.code()}
        return json.loads(cached("flips", key, make, ".json").read_text())

    def code(self):
        return [
            step_version("alternative"),
            code_version("inflate_lib.inverse.refine", "inflate_lib.inverse.adjoint"),
        ]

    def add(self, control, effort, achieved, buildable, seconds):
        """One row, from what was achieved for each target (NaN: nothing valid), and whether it can be built."""
        wanted, valid = self.targets[:, 0], np.isfinite(achieved)
        error = np.abs(achieved / wanted - 1)

        def statistics(rows):
            good = rows[valid[rows]]
            median = 100 * np.median(error[good]) if len(good) else np.nan
            r2 = r_squared(wanted[rows, None], achieved[rows, None])
            return np.array([r2, median, 100 * np.mean(np.nan_to_num(error[rows], nan=np.inf) <= NEAR)])

        low, high = bootstrap(statistics, len(wanted), None, self.seed)
        row = {"control": control, "effort": effort, "seconds": float(seconds), "valid": float(100 * valid.mean())}
        row["buildable"] = float(100 * buildable.mean())
        measured = statistics(np.arange(len(wanted)))
        for name, *values in zip(("R²", "median", "within"), measured, low, high, strict=True):
            row |= dict(zip((name, f"{name} low", f"{name} high"), map(float, values), strict=True))
        self.rows.append(row)
        print(f"{time.monotonic() - self.started:.0f} s: {row}", flush=True)


def main():
    given = options()
    load = os.getloadavg()[0]
    study = Study(given)
    for guidance, n in ((1.0, 8), (3.0, 4), (5.0, 4)):
        answer, clock = study.draw(n, guidance)
        for few in (1, n):
            study.select(f"w = {guidance:g}", answer, clock, few)
    answer, clock = study.draw(16, 3.0, study.calibration)
    for n in (1, 4, 16):
        study.select("w = 3, calibrated", answer, clock, n)
    for n in (4, 16):
        study.select("surrogate selects", answer, clock, n, by_surrogate=True)
    for control, order in (("pixel by pixel, random", "random"), ("pixel by pixel, adjoint", "sensitivity")):
        for n in (1, 4):
            study.refined(control, answer, clock, n, order)
    correlation, flips = study.estimates(answer)
    for guidance, calibration, n in ((3.0, study.calibration, 4), (1.0, None, 8)):
        steered, clock = study.draw(n, guidance, calibration, given.strength)
        for few in (1, n):
            study.select(f"surrogate steers, w = {guidance:g}", steered, clock, few)
    for n in (1, 4, 8):
        study.refined("pixel by pixel, steered start", steered, clock, n, "sensitivity")
    store(
        pd.DataFrame(study.rows),
        given.name,
        "controls.py",
        data=f"{study.data.attrs['source']}, {study.data.sizes['structure']} structures",
        descriptor=DESCRIPTOR,
        targets=len(study.targets),
        profile=given.profile,
        sampling=study.model.sampling,
        surrogate_steps=given.surrogate_steps,
        strength=given.strength,
        goal=GOAL,
        rank_correlation=correlation,
        flips=flips,
        threads=1,
        remark=given.remark,
        milliseconds={
            way: {name: round(1e3 * value, 2) for name, value in clock.items()} for way, clock in study.clocks().items()
        },
        load_average=[round(load, 1), round(os.getloadavg()[0], 1)],
    )


if __name__ == "__main__":
    main()
