"""What a second rubber is worth: what it reaches, how its model draws, how far tips bend, what it costs.

    python benchmarks/rubbers.py

Ten minutes of a core, besides the simulation of three data sets of sevens (five minutes, kept in the cache). Writes
data/reference/rubbers_*.csv:

- reach: the sevens of one rubber, and the same with patterns of two, by family: what can be built, how far tips move.
- model: held-out structures of one and of two rubbers, asked of the joint model of each by one drawing.
- beyond: targets that no seven of one rubber meets, axes of held-out sevens with patterns that bend them most, and half
  the stress of the sevens at the same height, by the best of eight drawings of each model.
- bending: how far the tip of a seven can be moved sideways: of one rubber, by patterns of the data sets, by patterns
  that the sensitivities lead to.
- cost: the solver, one rubber and two, in one run.

And the reach of two rubbers, a table beside the weights of their model, by which targets are refused.
"""

import argparse
import time
import warnings
from dataclasses import replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import pandas as pd
import xarray as xr
from stored import seconds, store
from threadpoolctl import threadpool_limits

from inflate_lib import build_mesh, describe, inflate, label_image, paths
from inflate_lib.alternatives.ablation import measures
from inflate_lib.alternatives.all_digits import MET, nearest_miss, reachable_area, sizes_of
from inflate_lib.alternatives.patterns import FAMILIES, RATIO, rubber_picture, stiffness_of
from inflate_lib.alternatives.rubbers import FILE, calibrated, load_rubber_model, rubber_experiment, simulated_rubbers
from inflate_lib.datasets.pairs import held_out
from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.descriptors.registry import JOINT
from inflate_lib.experiments.calibrate import calibrate
from inflate_lib.experiments.run import held_out_seed, held_out_targets, run_experiment
from inflate_lib.experiments.variety import diversity
from inflate_lib.inverse.bending import SIDES, bend, tip_moves
from inflate_lib.mechanics.inflation import MU
from inflate_lib.models.reach import save_reach
from inflate_lib.models.weights import load_model

ASKED = ("height", "width", "area", "axis")
SEEDS = (0, 1)  # of the data sets that the model of two rubbers was trained on
NEAR = 0.05
KINDS = ("one rubber", "two rubbers")


def options():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--profile", default="laptop", help="whose committed weights")
    parser.add_argument("--targets", type=int, default=200, help="held-out structures asked for, by each descriptor")
    parser.add_argument("--beyond", type=int, default=60, help="targets of each kind that one rubber does not meet")
    parser.add_argument("--drawings", type=int, default=8, help="for each of these")
    parser.add_argument("--bent", type=int, default=200, help="sevens whose patterns are sought")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=("reach", "model", "beyond", "bending", "cost"))
    return parser.parse_args()


class Study:
    """Data, models, and the tables."""

    def __init__(self, given):
        self.given, self.started = given, time.monotonic()
        self.one = simulated_sevens("mnist")
        self.two = [simulated_rubbers("mnist", seed=seed) for seed in SEEDS]
        self.data = dict(zip(KINDS, (self.one, self.two[0]), strict=True))
        self.models = dict(
            zip(KINDS, (load_model(JOINT, given.profile), load_rubber_model(given.profile)), strict=True)
        )
        whole = xr.concat([one.drop_vars(["family", "stiff"]) for one in self.two], "structure")
        save_reach(some(whole), (paths.PRETRAINED / given.profile / FILE).parent)

    def note(self):
        return {"data": "MNIST sevens", "ratio": RATIO, "profile": self.given.profile, "seed": self.given.seed}

    def say(self, row):
        print(f"{time.monotonic() - self.started:.0f} s: {row}", flush=True)

    # --- the data sets ---------------------------------------------------------------------------------------------

    @cached_property
    def moved(self):
        """How far tips move to the right: of one rubber, and of each data set of two; NaN where it cannot be built."""
        with threadpool_limits(1):
            return [tips(data) for data in (self.one, *self.two)]

    def reach(self):
        stress = self.typical_stress()
        parts = {"one rubber": self.one, "two rubbers": self.two[0]}
        rows = []
        for (name, data), moved in zip(parts.items(), self.moved, strict=False):
            rows.append(self.reached(name, data, moved, stress))
        both = xr.concat([one["family"] for one in self.two], "structure").values
        data, moved = xr.concat(self.two, "structure"), np.concatenate(self.moved[1:])
        for family in FAMILIES:
            here = np.flatnonzero(both == family)
            plain = self.moved[0][here % len(self.moved[0])]
            rows.append(self.reached(family, data.isel(structure=here), moved[here], stress, plain))
        store(pd.DataFrame(rows), "rubbers_reach", "rubbers.py", **self.note())

    def reached(self, name, part, moved, stress, plain=None):
        plain = self.moved[0] if plain is None else plain
        built = part["buildable"].values
        share = part["peak_stress"].values / stress(part["height"].values)
        row = {
            "rubbers": name,
            "structures": len(moved),
            "inflated": int(part["converged"].sum()),
            "buildable %": 100 * float(built.mean()),
            "height": float(np.nanmedian(part["height"])),
            "width": float(np.nanmedian(part["width"])),
            "reach": reachable_area(sizes_of(part)) if name in self.data else np.nan,
            "moved": float(np.nanmedian(np.abs(moved))),
            "moved 99 %": float(np.nanpercentile(np.abs(moved), 99)),
            "moved most": float(np.nanmax(np.abs(moved))),
            "pattern moves": float(np.nanmedian(np.abs(moved - plain))),
            "peak stretch": float(np.nanmedian(part["peak_stretch"])),
            "peak stress": float(np.nanmedian(part["peak_stress"]) / MU),
            "stress 1 %": float(np.percentile(share[built], 1)),
            "half stress %": 100 * float(np.mean(share[built] <= 0.5)),
        }
        self.say(row)
        return row

    def typical_stress(self):
        """Peak stress of sevens of one rubber as a function of their height: the median, in bins of height."""
        known = self.one["converged"].values
        height, stress = (self.one[name].values[known] for name in ("height", "peak_stress"))
        edges = np.quantile(height, np.linspace(0, 1, 21))
        middle = [np.median(stress[(height >= a) & (height <= b)]) for a, b in pairwise(edges)]
        centres = (edges[1:] + edges[:-1]) / 2
        return lambda h: np.interp(h, centres, middle)

    # --- the models ------------------------------------------------------------------------------------------------

    def ask(self, kind, model, targets, n, seed, asked):
        if kind == "two rubbers":
            return rubber_experiment(model, targets, n, seed, asked)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".* lie outside the (training data|range of the training data)")
            return run_experiment(model, targets, n, seed, asked, extrapolate=True)

    def calibrated(self, kind, asked, n=300):
        model = self.models[kind].sampled()
        if kind == "two rubbers":
            return calibrated(model, self.data[kind], asked, n, self.given.seed)
        return replace(model, calibrations={asked: calibrate(model, self.one, n, self.given.seed, asked)})

    def model(self, n_various=5, n_each=12):
        rows, given = [], self.given
        for asked in ASKED:
            fitted = {kind: self.calibrated(kind, asked) for kind in KINDS}
            for of, data in self.data.items():
                targets, _ = held_out_targets(data, asked, self.models["one rubber"], given.targets, given.seed)
                for kind, model in fitted.items():
                    drawn = self.ask(kind, model, targets, 1, held_out_seed(given.seed), asked)
                    several = self.ask(kind, model, targets[:n_various], n_each, given.seed, asked)
                    row = {"targets of": of, "targets": asked, "model": kind.split()[0]}
                    row |= measures(drawn, asked, data, given.seed)
                    row |= {"unit": get_descriptor(asked).error.unit}
                    row |= {"variety": self.variety(several, asked, data)}
                    row |= {"variety with pattern": self.variety(several, asked, data, pictures=True)}
                    rows.append(row)
                    self.say(row)
        store(pd.DataFrame(rows), "rubbers_model", "rubbers.py", **self.note(), n=given.targets)

    def variety(self, drawn, asked, data, pictures=False):
        """Mean distance of drawings for a target, over that of structures that come nearest to it; with the pattern."""
        if pictures:
            if "stiff" not in drawn or "stiff" not in data:
                return np.nan
            drawn, data = (one.assign(image=(one["image"].dims, as_pictures(one))) for one in (drawn, data))
        return float(diversity(drawn, asked, data, n_resamples=1)["ratio"].mean())

    # --- beyond one rubber -----------------------------------------------------------------------------------------

    def beyond(self):
        given, rows = self.given, []
        axes, _ = held_out_targets(self.two[0], "width+axis", None, None, given.seed)
        axes = np.concatenate([axes, held_out_targets(self.two[1], "width+axis", None, None, given.seed)[0]])
        everything = descriptor_matrix(self.one, "width+axis")
        built = self.one["buildable"].values
        known = everything[built]
        limits = np.median(known[:, 0]), np.percentile(np.abs(known[:, -2]), 75)

        def in_question(values):
            return (values[:, 0] <= limits[0]) & (np.abs(values[:, -2]) >= limits[1])

        chosen = axes[in_question(axes)]
        near = np.array([nearest(known, target) for target in chosen])
        share = {"narrow and leaning %": 100 * float(in_question(axes).mean())}
        share |= {"of one rubber %": 100 * float(in_question(everything).mean())}
        share |= {"not met %": 100 * float(np.mean(near > MET)), "n": len(chosen)}
        self.say(share)
        pick = np.random.default_rng(given.seed).permutation(np.flatnonzero(near > MET))[: given.beyond]
        self.best("width and leaning axis", "width+axis", chosen[pick], near[pick], rows)

        kept = held_out(len(built)) & built
        some_rows = np.random.default_rng(given.seed).permutation(np.flatnonzero(kept))[: given.beyond // 2]
        found = [bend(label, side) for label in self.one["label"].values[some_rows] for side in SIDES]
        targets = np.array([describe(one.result).vector("axis") for one in found])
        known = descriptor_matrix(self.one, "axis")[built]
        near = np.array([nearest(known, target, "axis") for target in targets])
        self.best("axis of a bent seven", "axis", targets, near, rows)

        stress = self.typical_stress()
        heights = np.random.default_rng(given.seed).permutation(
            held_out_targets(self.one, "height", None, None, given.seed)[0][:, 0]
        )[: given.beyond]
        targets = np.column_stack([heights, stress(heights) / 2])
        known = descriptor_matrix(self.one, "height+stress")[built]
        self.best("height at half the stress", "height+stress", targets, nearest_miss(known, targets), rows)
        store(pd.DataFrame(rows), "rubbers_beyond", "rubbers.py", **self.note(), met=MET, near=NEAR, **share)

    def best(self, group, asked, targets, of_one, rows):
        """Rows of the nearest structure in the data sets, and of the best of some drawings."""
        two = np.concatenate([descriptor_matrix(one, asked)[training(one)] for one in self.two])
        of_two = np.array([nearest(two, target, asked) for target in targets])
        rows += [self.met(group, "nearest seven of one rubber", 1, of_one)]
        rows += [self.met(group, "nearest training structure of two rubbers", 1, of_two)]
        for kind in KINDS:
            drawn = self.ask(kind, self.models[kind].sampled(), targets, self.given.drawings, self.given.seed, asked)
            miss = misses(asked, descriptor_matrix(drawn, asked), drawn["target"].values)
            miss = np.where(drawn["buildable"].values, miss, np.inf).reshape(len(targets), -1).min(axis=1)
            rows.append(self.met(group, f"model of {kind}", self.given.drawings, miss))
            rows[-1] |= {name: 100 * float(drawn[name].values.mean()) for name in ("valid", "buildable")}
        for row in rows[-4:]:
            self.say(row)

    def met(self, group, name, n, miss):
        return {
            "group": group,
            "from": name,
            "n": n,
            "targets": len(miss),
            "met 2 %": 100 * float(np.mean(miss <= MET)),
            "met 5 %": 100 * float(np.mean(miss <= NEAR)),
            "median error": 100 * float(np.median(miss)),
        }  # infinite where no drawing can be built

    # --- bending ---------------------------------------------------------------------------------------------------

    def bending(self):
        given = self.given
        built = np.flatnonzero(self.one["buildable"].values)
        rows = np.sort(np.random.default_rng(given.seed).permutation(built)[: given.bent])
        with threadpool_limits(1):
            found = [bend(label, side) for label in self.one["label"].values[rows] for side in SIDES]
        sought = np.array([one.moved for one in found]).reshape(-1, 2)
        plain, *random = (moved[rows] for moved in self.moved)
        table = [
            self.bent("one rubber", plain[:, None]),
            self.bent("patterns of the data sets", np.column_stack([plain, *random])),
            self.bent("patterns sought", sought),
        ]
        store(pd.DataFrame(table), "rubbers_bending", "rubbers.py", **self.note(), tries=16,
              both_sides=100 * float(np.mean((sought[:, 0] < 0) & (sought[:, 1] > 0))))  # fmt: skip

    def bent(self, name, moved):
        left, right = np.nanmin(moved, axis=1), np.nanmax(moved, axis=1)
        row = {"by": name, "sevens": len(moved), "to the left": float(np.median(left))}
        row |= {"to the right": float(np.median(right)), "range": float(np.median(right - left))}
        row |= {"range 95 %": float(np.percentile(right - left, 95))}
        row |= {"farthest": float(np.median(np.maximum(-left, right)))}
        row |= {"farthest 99 %": float(np.percentile(np.maximum(-left, right), 99))}
        self.say(row)
        return row

    # --- cost ------------------------------------------------------------------------------------------------------

    def cost(self, n=200, repeats=5):
        data = self.two[0]
        meshes = {name: [] for name in ("one rubber", "one rubber, a number per pixel", "two rubbers")}
        for row in np.flatnonzero(data["converged"].values)[:n]:
            label = label_image(data["image"].values[row])
            stiffness = stiffness_of(data["image"].values[row], data["stiff"].values[row])
            for name, told in zip(meshes, (None, np.ones(label.shape), stiffness), strict=True):
                meshes[name].append(build_mesh(label, stiffness=told))
        times, solves = np.zeros((repeats, len(meshes), n)), np.zeros((len(meshes), n))
        with threadpool_limits(1):
            for mesh in (group[0] for group in meshes.values()):
                inflate(mesh)  # compiles
            for repeat in range(repeats):
                for k in range(n):
                    for s, group in enumerate(meshes.values()):
                        times[repeat, s, k], result = seconds(inflate, group[k])
                        solves[s, k] = result.factorisations
        each = np.median(times, axis=0)
        mean = each.mean(axis=1)
        table = pd.DataFrame({"solver": list(meshes), "ms": 1e3 * mean, "ratio": mean / mean[0]})
        table["ratio, median"] = np.median(each / each[0], axis=1)
        table["factorisations"] = solves.mean(axis=1)
        timed = f"processor time on one core, interleaved; median of {repeats} repeats, mean over {n} sevens"
        store(table, "rubbers_cost", "rubbers.py", **self.note(), times=timed)


def tips(data):
    """How far the tip of each structure that can be built moves to the right, in sides; of the others NaN."""
    moved, stiff = np.full(data.sizes["structure"], np.nan), data.get("stiff")
    for i in np.flatnonzero(data["buildable"].values):
        image = data["image"].values[i]
        stiffness = None if stiff is None else stiffness_of(image, stiff.values[i])
        moved[i] = tip_moves(inflate(label_image(image), stiffness=stiffness))[-1]
    return moved


def training(data):
    """Rows that a model was trained on, and that can be built."""
    return data["buildable"].values & ~held_out(data.sizes["structure"])


def misses(asked, achieved, targets):
    """The largest error among the parts that are asked for together, as designs are judged."""
    start, found = 0, []
    for part in get_descriptor(asked).parts:
        one = get_descriptor(part)
        here = slice(start, start := start + one.length)
        found.append(one.error.share(achieved[..., here], targets[..., here]))
    return np.max(found, axis=0)


def nearest(known, target, asked="width+axis"):
    """How far the nearest of some structures, or of their mirror images, is from a target."""
    mirrored = get_descriptor(asked).mirrored(known)
    return min(float(np.nanmin(misses(asked, values, target[None]))) for values in (known, mirrored))


def as_pictures(data):
    """Structures as pictures that tell the rubbers apart, (n, 28, 28) float in [0, 1]; black where there is none."""
    found = np.zeros(data["image"].shape, np.float32)
    for i in np.flatnonzero(data["converged"].values):
        found[i] = rubber_picture(data["image"].values[i], data["stiff"].values[i]) / np.float32(255)
    return found


def some(data, n=4000):
    """Structures for the table of what is reached: the extreme ones, and as many others as there is room for."""
    data = data.isel(structure=np.flatnonzero(data["converged"].values))
    values = np.column_stack([descriptor_matrix(data, name) for name in (*ASKED[:3], "stress", "stretch")])
    ends = np.concatenate([values.argmin(axis=0), values.argmax(axis=0)])
    others = np.random.default_rng(0).permutation(len(values))[:n]
    return data.isel(structure=np.unique(np.concatenate([ends, others])))


def main():
    given = options()
    study = Study(given)
    for name in given.only:
        getattr(study, name)()


if __name__ == "__main__":
    main()
