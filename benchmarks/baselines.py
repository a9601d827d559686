"""Other ways to answer held-out targets: retrieval, an autoencoder, no descriptor at all, chance.

    python benchmarks/baselines.py [--targets 40]

asks each of them for one structure per target, and writes data/reference/baselines.csv, which the chapter "Baselines"
shows, and baselines.json beside it, with what the two trained methods had to spend.
"""

import argparse
from time import process_time

import numpy as np
import pandas as pd
from stored import store

from inflate_lib.alternatives.ablation import measures
from inflate_lib.alternatives.autoencoder import calibrate_autoencoder, run_autoencoder, train_autoencoder
from inflate_lib.alternatives.retrieval import random_structures, retrieved_structures
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.descriptors import DESCRIPTORS
from inflate_lib.experiments.calibrate import calibrate_all
from inflate_lib.experiments.run import held_out_seed, held_out_targets, run_held_out
from inflate_lib.experiments.variety import novelty
from inflate_lib.models.recipe import load_recipe
from inflate_lib.models.train import training_set
from inflate_lib.models.weights import trained_models


def options():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--profile", default="laptop", help="whose models are asked")
    parser.add_argument("--targets", type=int, help="held-out targets; all of them")
    parser.add_argument("--autoencoded", nargs="*", default=["height", "axis"], help="that one is trained for")
    parser.add_argument("--remark", default="", help="what else the machine did, for the record")
    return parser.parse_args()


def main():
    given, started = options(), process_time()
    recipe = load_recipe(given.profile)
    seed, data = recipe.seed, simulated_sevens(recipe.source, recipe.n_structures)
    models = calibrate_all(trained_models(DESCRIPTORS, recipe, data), data, recipe.n_calibration, seed)
    rows, spent, seen = [], {}, training_rows(data)
    for name, model in models.items():
        wanted, _ = held_out_targets(data, name, model, given.targets, seed)
        answers = {
            "diffusion": run_held_out(model, data, seed, n=given.targets),
            "retrieval": retrieved_structures(data, name, wanted),
            "unconditional": run_held_out(model.sampled(guidance=0.0), data, seed, n=given.targets),
            "chance": random_structures(data, name, wanted, seed),
        }
        if name in given.autoencoded:
            other, config = train_autoencoder(training_set(name, recipe, data), model.trained), model.trained.config
            told = calibrate_autoencoder(other, name, data, seed, recipe.n_calibration)
            answers["autoencoder"] = run_autoencoder(other, name, wanted, held_out_seed(seed), calibration=told)
            spent[name] = {
                "parameters, diffusion": model.trained.net.n_parameters,
                "parameters, autoencoder": other.net.n_parameters,
                "images seen, diffusion": config.training_steps(model.trained.metadata["pairs"]) * config.batch_size,
                "images seen, autoencoder": other.images_seen,
                "seconds, diffusion": round(model.trained.metadata["seconds"]),
                "seconds, autoencoder": round(other.seconds),
            }
        for method, experiment in answers.items():
            row = {"descriptor": name, "method": method} | measures(experiment, name, data, seed)
            drawn = experiment["image"].values[experiment["valid"].values]
            new = method not in ("retrieval", "chance") and len(drawn)  # those are training structures
            rows.append(row | {"novelty": float(np.median(novelty(drawn, data, seen)[0])) if new else 0.0})
            print(f"{process_time() - started:.0f} s: {rows[-1]}", flush=True)
    note = {"data": f"{data.attrs['source']}, {data.sizes['structure']} structures", "profile": given.profile}
    note |= {"sampling": dict(recipe.sampling), "remark": given.remark}
    store(pd.DataFrame(rows), "baselines", "baselines.py", **note, targets=len(wanted), spent=spent)


if __name__ == "__main__":
    main()
