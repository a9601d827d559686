"""The best of n candidates, chosen by the simulation or by a surrogate of it.

    python benchmarks/best_of.py [--targets 8]

draws candidates for held-out targets of each descriptor, and writes data/reference/best_of_n.csv, which the chapter
"The best of many" shows, and best_of_n.json beside it.
"""

import argparse

import pandas as pd
from stored import store

from inflate_lib.alternatives.best_of import seconds_per_structure, selection
from inflate_lib.alternatives.surrogate import train_surrogate
from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.descriptors import DESCRIPTORS
from inflate_lib.experiments.calibrate import calibrate_all
from inflate_lib.experiments.run import held_out_targets, run_experiment
from inflate_lib.models.recipe import load_recipe
from inflate_lib.models.weights import trained_models


def options():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--profile", default="laptop", help="whose models are asked")
    parser.add_argument("--targets", type=int, default=40, help="held-out targets of each descriptor")
    parser.add_argument("--candidates", type=int, default=50, help="for each of them")
    parser.add_argument("--surrogate-steps", type=int, default=6000, help="training steps of the surrogate")
    parser.add_argument("--remark", default="", help="what else the machine did, for the record")
    return parser.parse_args()


def main():
    given = options()
    recipe = load_recipe(given.profile)
    seed, data = recipe.seed, simulated_sevens(recipe.source, recipe.n_structures)
    models = calibrate_all(trained_models(DESCRIPTORS, recipe, data), data, recipe.n_calibration, seed)
    surrogate = train_surrogate(data, given.surrogate_steps, seed)
    targets = {name: held_out_targets(data, name, model, given.targets, seed)[0] for name, model in models.items()}
    cost = seconds_per_structure(models["height"], surrogate, targets["height"], seed)
    numbers, tables = [n for n in (1, 2, 4, 8, 16, 32, 50) if n <= given.candidates], []
    for name, model in models.items():
        candidates = run_experiment(model, targets[name], given.candidates, seed + 1)
        table = selection(candidates, name, surrogate, numbers, cost, seed)
        tables.append(table.assign(descriptor=name))
        print(tables[-1], flush=True)
    store(
        pd.concat(tables),
        "best_of_n",
        "best_of.py",
        data=f"{data.attrs['source']}, {data.sizes['structure']} structures",
        profile=given.profile,
        sampling=dict(recipe.sampling),
        targets=given.targets,
        candidates=given.candidates,
        surrogate_steps=given.surrogate_steps,
        milliseconds={name: round(1e3 * value, 2) for name, value in cost.items()},
        remark=given.remark,
    )


if __name__ == "__main__":
    main()
