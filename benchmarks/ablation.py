"""What in the training matters: one thing changed at a time, a small budget, several seeds.

    python benchmarks/ablation.py

trains each variant of the profile's recipe (inflate_lib/alternatives/ablation.py) for some thousand steps, asks each
for all held-out targets, and writes data/reference/ablation.csv, which the chapter "Baselines and ablations" shows, and
ablation.json beside it, which says where it comes from. Every run is kept in the cache: a script that was stopped goes
on where it was.
"""

import argparse
import itertools
import time
from dataclasses import replace

import pandas as pd
from joblib import Parallel, delayed
from stored import store

from inflate_lib._cache import step_version
from inflate_lib.alternatives import ablation
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.diffusion import TrainedModel, TrainingConfig
from inflate_lib.experiments.run import held_out_targets
from inflate_lib.models.recipe import load_recipe
from inflate_lib.models.train import trained_model_file
from inflate_lib.models.weights import Model, committed_weights
from inflate_lib.structures.augmentation import PAPER_SAMPLES

PAIRS = {("pairs", "originals alone"): 0, ("pairs", "with flips and shifts"): PAPER_SAMPLES}


def options():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--profile", default="ci", help="whose recipe is varied")
    parser.add_argument("--steps", type=int, default=3000, help="training steps of each run")
    parser.add_argument("--seeds", type=int, default=3, help="runs of each variant")
    parser.add_argument("--targets", type=int, help="held-out targets; all by default")
    parser.add_argument("--descriptor", default="height")
    parser.add_argument("--source", default="mnist")
    parser.add_argument("--jobs", type=int, default=-1, help="runs side by side, one thread each")
    parser.add_argument("--only", nargs="+", metavar="VARIANT", help="these alone, by their names in the table")
    parser.add_argument("--name", default="ablation", help="of the files in data/reference")
    return parser.parse_args()


def run(variant, seed, training, n_structures, data, targets, recipe, descriptor):
    """One row: train, generate, evaluate."""
    group, name = variant
    few = data if n_structures is None else data.isel(structure=slice(0, n_structures))
    recipe = replace(recipe, training=training, seed=seed)
    if variant in PAIRS:
        recipe = replace(recipe, n_augmented=max(PAIRS[variant], len(training_rows(data))))
    wanted = descriptor, recipe, few
    model = TrainedModel.load(committed_weights(*wanted)[0] or trained_model_file(*wanted, threads=1))
    row = {"group": group, "variant": name, "seed": seed, "pairs": model.metadata["pairs"]}
    row |= {"training_seconds": model.metadata["seconds"], "held_out_loss": model.metadata["held_out_loss"]}
    return row | ablation.evaluate_variant(Model(descriptor, model, recipe.sampling), data, targets, seed, n_jobs=1)


def main():
    given = options()
    recipe = load_recipe(given.profile)
    budget = {"epochs": None, "steps": given.steps, "device": "cpu"}
    training = {k: v for k, v in recipe.training.items() if k not in ("checkpoint_every", "steps_of")} | budget
    data = simulated_sevens(given.source)
    targets, _ = held_out_targets(data, given.descriptor, n=given.targets)
    variants = ablation.training_variants(training) | dict.fromkeys(PAIRS, (training, None))
    variants = {k: v for k, v in variants.items() if v[1] is None or v[1] < data.sizes["structure"]}
    if given.only:
        if unknown := set(given.only) - {name for _, name in variants}:
            raise SystemExit(f"no variant {sorted(unknown)}; there are {[name for _, name in variants]}")
        variants = {k: v for k, v in variants.items() if k[1] in given.only}
    start, rows = time.monotonic(), []
    tasks = (
        delayed(run)(variant, seed, *variants[variant], data, targets, recipe, given.descriptor)
        for variant, seed in itertools.product(variants, range(given.seeds))
    )
    for row in Parallel(n_jobs=given.jobs, return_as="generator")(tasks):
        rows.append(row)
        print(f"{len(rows)} of {len(variants) * given.seeds}, {time.monotonic() - start:.0f} s: {row}", flush=True)
    store(
        pd.DataFrame(rows),
        given.name,
        "ablation.py",
        data=f"{data.attrs['source']}, {data.sizes['structure']} structures",
        descriptor=given.descriptor,
        targets=len(targets),
        training=TrainingConfig.from_dict(training).recipe(),
        sampling=recipe.sampling,
        n_augmented=recipe.n_augmented,
        learning_code=step_version("experiment"),
    )


if __name__ == "__main__":
    main()
