"""Accuracy, variety and novelty of what a model draws, against what it costs: one way of sampling beside another.

    python benchmarks/sampler.py                the models as they were trained
    python benchmarks/sampler.py --students     those into which guidance was distilled
    python benchmarks/sampler.py --steered      the same, corrected while they draw by the surrogate that tuned them

The first writes data/reference/sampler.csv, the others sampler_students.csv, which the chapter "Training" shows, each
with a note beside it that says where it comes from. Rows that a run does not measure stay as they are: those of other
descriptors and ways, and of students before they were tuned. Every drawing is kept in the cache: a script that was
stopped goes on where it was.

Each way is calibrated by itself and judged on all held-out targets in range, one drawing each; that of the paper, of a
thousand steps, is not calibrated, as there, and judged on a hundred. Variety is the mean
distance of a hundred drawings for one target, as a share of that of as many real structures nearest to the target;
novelty the median distance to the nearest training structure, as a share of that of held-out real structures; both are
means over three targets, at a fifth, a half and four fifths of the training structures (by size, for a line). Students
are judged on targets of training structures besides: by these, the recipe chooses how they are asked.
"""

import argparse
import json
import time
from dataclasses import replace

import numpy as np
import pandas as pd
from stored import seconds, store

from inflate_lib import paths
from inflate_lib._cache import step_version
from inflate_lib.alternatives.ablation import measures
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.descriptors import DESCRIPTORS, descriptor_matrix, get_descriptor
from inflate_lib.diffusion import generate
from inflate_lib.experiments.calibrate import calibrate
from inflate_lib.experiments.run import held_out_seed, held_out_targets, run_experiment
from inflate_lib.experiments.variety import diversity, novelty
from inflate_lib.models.recipe import load_recipe
from inflate_lib.models.surrogate import Surrogate
from inflate_lib.models.weights import STUDENTS, SURROGATE, load_model

EIGHT, SECOND = {"steps": 8}, {"sampler": "dpm-solver++"}
WAYS = {f"{steps} steps": {"steps": steps} for steps in (25, 16, 8, 6, 4)}
WAYS |= {
    "w = 5": EIGHT | {"guidance": 5.0},
    "second order": EIGHT | SECOND,
    "second order, w = 5": EIGHT | SECOND | {"guidance": 5.0},
    "second order, w = 5, 12 steps": SECOND | {"steps": 12, "guidance": 5.0},
    "second order, w = 5, 5 steps": SECOND | {"steps": 5, "guidance": 5.0},
}
MAIN = tuple(WAYS)
WAYS |= {
    "10 steps": {"steps": 10},
    "5 steps": {"steps": 5},
    "η = 0": EIGHT | {"eta": 0.0},
    "η = 0.5": EIGHT | {"eta": 0.5},
    "w = 1": EIGHT | {"guidance": 1.0},
    "w = 2": EIGHT | {"guidance": 2.0},
    "w = 8": EIGHT | {"guidance": 8.0},
    "w = 5, 4 steps": {"steps": 4, "guidance": 5.0},
    "guided for t/T in 0.2–0.9": EIGHT | {"guided_from": 0.2, "guided_to": 0.9},
    "guided for t/T in 0.4–1": EIGHT | {"guided_from": 0.4},
    "crowded near the noise": EIGHT | {"crowding": 0.7},
    "crowded near the image": EIGHT | {"crowding": 1.5},
    "second order, η = 0": EIGHT | SECOND | {"eta": 0.0},
    "second order, η = 0, w = 2, 16 steps": SECOND | {"steps": 16, "eta": 0.0, "guidance": 2.0},
}
PAPER = "as the paper, 100 targets"  # a thousand steps each: for one descriptor, and only where it is asked for
WAYS[PAPER] = {"sampler": "ancestral", "guidance": 1.0}
FOR_STUDENTS = {name: way for name, way in WAYS.items() if name.startswith("second order, w = 5")}
FOR_STUDENTS |= {
    "second order, w = 8": EIGHT | SECOND | {"guidance": 8.0},
    "second order, w = 8, 12 steps": SECOND | {"steps": 12, "guidance": 8.0},
    "second order, w = 8, 5 steps": SECOND | {"steps": 5, "guidance": 8.0},
}
FOR_STUDENTS["second order, w = 2.5, 12 steps"] = SECOND | {"steps": 12, "guidance": 2.5}
STEERED = {name: FOR_STUDENTS[name] for name in ("second order, w = 5", "second order, w = 2.5, 12 steps")}
ALIKE = 100  # drawings for one target
TIMED = 32  # structures drawn to time a way


def options():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--profile", default="laptop", help="whose committed weights are asked")
    parser.add_argument("--students", action="store_true", help="in the few ways that suit models told their guidance")
    parser.add_argument("--steered", action="store_true", help="the same, steered by the surrogate that tuned them")
    parser.add_argument("--descriptors", nargs="+", default=list(DESCRIPTORS), choices=DESCRIPTORS)
    parser.add_argument("--thorough", nargs="*", default=["height", "axis"], help="asked in every way, the rest in few")
    parser.add_argument("--only", nargs="+", metavar="WAY", help="these ways alone, by their names in the table")
    parser.add_argument("--known", type=int, default=600, help="training targets that students are judged on besides")
    parser.add_argument("--targets", type=int, help="held-out targets (default: all in range)")
    parser.add_argument("--source", default="mnist")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    given.students |= given.steered
    return given


def evaluations(model, target):
    """How often the network is asked for one structure."""
    asked = []
    hook = model.trained.net.register_forward_hook(lambda *_: asked.append(1))
    draw(model, target[None])
    hook.remove()
    return len(asked)


def three_targets(data, descriptor):
    """Real descriptors at a fifth, a half and four fifths of the training structures, along their main direction."""
    known = descriptor_matrix(data, descriptor)[training_rows(data)]
    score = (known - known.mean(axis=0)) @ np.linalg.svd(known - known.mean(axis=0), full_matrices=False)[2][0]
    order = np.argsort(score * np.sign(score[known[:, -1].argmax()]))
    return known[order[[len(order) // 5, len(order) // 2, 4 * len(order) // 5]]]


def main():
    given, started, rows = options(), time.monotonic(), []
    weights = f"{given.profile}/{STUDENTS}" if given.students else given.profile
    recipe, data = load_recipe(given.profile), simulated_sevens(given.source)
    known = training_rows(data)
    unseen = np.setdiff1d(np.flatnonzero(data["converged"].values), known)
    ways = STEERED if given.steered else FOR_STUDENTS if given.students else WAYS
    judge = Surrogate.load(paths.PRETRAINED / weights / f"{SURROGATE}.safetensors") if given.steered else None
    if unknown := set(given.only or ()) - set(ways):
        raise SystemExit(f"no way {sorted(unknown)}; there are {list(ways)}")
    yardstick = np.median(novelty(data["image"].values[unseen], data, known)[0])
    for descriptor in given.descriptors:
        model = load_model(descriptor, weights).sampled(**WAYS["25 steps"], sampler="ddim", eta=1.0, guidance=3.0)
        targets, _ = held_out_targets(data, descriptor, model, given.targets, given.seed)
        usual = [name for name in ways if given.students or name in MAIN or descriptor in given.thorough]
        for name in given.only or [name for name in usual if name != PAPER]:
            way, n_calibration = model.sampled(**ways[name]), 0 if name == PAPER else recipe.n_calibration
            way = way.steered(judge) if judge else way
            row = {"descriptor": descriptor, "way": name, "evaluations": evaluations(way, targets[0])}
            if given.students:
                tuned = "tuned" if "tuning" in model.trained.metadata else "distilled"
                row["student"] = "steered" if given.steered else tuned
            wanted = targets
            if name == PAPER:
                wanted, _ = held_out_targets(data, descriptor, model, 100, given.seed)
            if n_calibration:
                fit = calibrate(way, data, n_calibration, given.seed, n_jobs=1)
                way = replace(way, calibrations={descriptor: fit})

            def ask(targets, n, seed, way=way):
                return run_experiment(way, targets, n, seed, n_jobs=1, extrapolate=True)

            row |= measures(ask(wanted, 1, held_out_seed(given.seed)), descriptor, data, given.seed)
            if given.students:
                chosen = np.random.default_rng(given.seed).choice(known, given.known, replace=False)
                told = descriptor_matrix(data, descriptor)[np.sort(chosen)]
                seen = measures(ask(told, 1, held_out_seed(given.seed + 2)), descriptor, data, given.seed + 2)
                row |= {f"{name}, training": seen[name] for name in ("R²", "median error")}
            row["unit"] = get_descriptor(descriptor).error.unit
            three = three_targets(data, descriptor)
            alike = ask(three, ALIKE, given.seed + 1)
            row["variety"] = diversity(alike, descriptor, data, n_resamples=10)["ratio"].mean()
            far = novelty(alike["image"].values, data, known)[0].reshape(len(three), ALIKE)
            row["novelty"] = np.median(far, axis=1).mean() / yardstick
            some = {"targets": np.repeat(three, TIMED // len(three) + 1, axis=0)[:TIMED]}
            spent, _ = seconds(lambda way=way, some=some: draw(way, some["targets"]))
            rows.append(row | {"ms": 1000 * spent / TIMED})
            print(f"{time.monotonic() - started:.0f} s: {rows[-1]}", flush=True)
    table, remark, name = pd.DataFrame(rows), "", "sampler_students" if given.students else "sampler"
    if (before := paths.REFERENCE / f"{name}.csv").is_file():
        kept, key = pd.read_csv(before), ["descriptor", "way", *(["student"] if given.students else [])]
        kept = kept[~kept.set_index(key).index.isin(table.set_index(key).index)]
        table = pd.concat([kept, table])
        date = json.loads(before.with_suffix(".json").read_text(encoding="utf-8"))["date"]
        remark = f"{len(kept)} of the rows were measured before, by {date}" if len(kept) else ""
    store(
        table,
        name,
        "sampler.py",
        data=f"{data.attrs['source']}, {data.sizes['structure']} structures",
        weights=f"data/pretrained/{weights}",
        unless_said="DDIM, η = 1, w = 3, 8 steps; second order: SDE-DPM-Solver++(2M)",
        n_calibration=recipe.n_calibration,
        novelty_of_held_out=float(yardstick),
        learning_code=step_version("experiment"),
        remark=remark,
    )


def draw(model, targets):
    """The drawing alone, to time it."""
    return generate(model.trained, targets, seed=0, **model.sampling)


if __name__ == "__main__":
    main()
