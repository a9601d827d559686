"""What the surrogate that steers the students can tell of held-out structures, descriptor by descriptor.

    python benchmarks/surrogate.py

asks the one that is stored with the weights, and writes data/reference/surrogate.csv, which the chapter
"Ask for your own shape" shows, and surrogate.json beside it, which says where it comes from.
"""

import argparse

import numpy as np
import pandas as pd
from stored import store

from inflate_lib import paths
from inflate_lib._cache import step_version
from inflate_lib.datasets.pairs import held_out
from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.descriptors.registry import PARTS
from inflate_lib.experiments.metrics import r_squared
from inflate_lib.models.recipe import load_recipe
from inflate_lib.models.surrogate import Surrogate
from inflate_lib.models.weights import STUDENTS, SURROGATE


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--profile", default="laptop", help="whose recipe says how it is trained")
    parser.add_argument("--source", default="mnist")
    given = parser.parse_args()
    recipe, data = load_recipe(given.profile), simulated_sevens(given.source)
    surrogate = Surrogate.load(paths.PRETRAINED / given.profile / STUDENTS / f"{SURROGATE}.safetensors")
    rows = []
    unseen = np.flatnonzero(held_out(data.sizes["structure"]) & data["converged"].values)
    for name in PARTS:
        truth = descriptor_matrix(data, name)[unseen]
        told = surrogate.predict(data["image"].values[unseen], name)
        error = 100 * np.median(np.abs(told - truth)) / np.abs(truth).mean()
        rows.append({"descriptor": name, "R²": r_squared(truth, told), "median error (%)": error})
        print(rows[-1], flush=True)
    store(
        pd.DataFrame(rows),
        "surrogate",
        "surrogate.py",
        data=f"{data.attrs['source']}, {data.sizes['structure']} structures",
        held_out=len(unseen),
        tuning=recipe.tuned(),
        training_seconds=surrogate.seconds,
        learning_code=step_version("model"),
    )


if __name__ == "__main__":
    main()
