"""What the paper's training would cost here: so many steps of the real configuration, timed, and projected.

    python benchmarks/training_cost.py

The same as ``inflate train --profile paper --descriptor height --steps 200``, kept in data/reference/training_cost.csv.
"""

import stored
import typer

from inflate_lib import paths
from inflate_lib.datasets import simulated_sevens
from inflate_lib.experiments import training_cost
from inflate_lib.profiles import load_profile


def main(profile: str = "paper", descriptor: str = "height", steps: int = 200):
    given = load_profile(profile).parameters(paths.NOTEBOOKS / "08_training.md")
    data = simulated_sevens(given["source"], given["n_structures"])
    cost = training_cost([descriptor], given["training"], data, given["n_augmented"], given["seed"], steps)
    cost = cost.rename(columns={"steps": "steps of the whole training", "hours": "hours for one model"})
    cost["hours for five models"] = 5 * cost["hours for one model"]
    cost.insert(1, "steps timed", steps)
    stored.store(cost.drop(columns="side by side"), "training_cost", "training_cost.py", profile=profile)


if __name__ == "__main__":
    typer.run(main)
