"""What training costs here: some steps of the real configuration of a model, timed, and the whole of it projected.

    python benchmarks/training_cost.py

The same as ``inflate train --profile paper --descriptor height --steps 200``, and so for each model of the profile
laptop, one after the other with all cores, kept in data/reference/training_cost.csv. Nothing else should run meanwhile.
"""

import os

import pandas as pd
import stored
import typer

from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.descriptors import DESCRIPTORS
from inflate_lib.models.recipe import load_recipe
from inflate_lib.models.train import training_cost

TIMED = {"paper": ["height"], "laptop": DESCRIPTORS}  # of the five of paper, one stands for all


def main(steps: int = 200):
    load = round(os.getloadavg()[0], 1)
    rows = []
    for profile, names in TIMED.items():
        recipe = load_recipe(profile)
        data = simulated_sevens(recipe.source, recipe.n_structures)
        for name in names:
            cost = training_cost([name], recipe, data, steps)
            cost.insert(0, "profile", profile)
            cost.insert(2, "steps timed", steps)
            rows.append(cost)
    table = pd.concat(rows).drop(columns="side by side")
    table = table.rename(columns={"steps": "steps of the whole training", "hours": "hours for the model"})
    stored.store(table, "training_cost", "training_cost.py", load_before=load)


if __name__ == "__main__":
    typer.run(main)
