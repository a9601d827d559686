"""Variants of a recipe: each changes one thing, and seeds are put together."""

import pytest

from inflate_lib.alternatives import ablation
from inflate_lib.diffusion import TrainingConfig


def test_variants_of_training_change_one_thing_and_are_recipes():
    base = {"steps": 10, "objective": "v", "ema_decay": 0.99, "vlb_weight": 0.001}
    variants = ablation.training_variants(base)
    changed = {name: {k for k in options if options[k] != base.get(k)} for (_, name), (options, _) in variants.items()}
    assert changed["of this profile"] == set() and changed["without EMA"] == {"ema_decay"}
    assert changed["ε-prediction"] == {"objective"} and changed["without the VLB term"] == {"vlb_weight"}
    assert all(options == base for (group, _), (options, n) in variants.items() if group == "data" and n)
    for options, _ in variants.values():
        TrainingConfig.from_dict(options)
    assert ("recipe", "v-prediction") in ablation.training_variants({**base, "objective": "epsilon"})


def test_seeds_are_put_together():
    import pandas as pd

    runs = pd.DataFrame({"group": ["a"] * 3, "variant": ["x", "x", "y"], "seed": [0, 1, 0]})
    runs = runs.assign(**{"R²": [0.5, 0.7, 0.1], "median error": [4.0, 2.0, 9.0], "valid": [90.0, 94.0, 50.0]})
    runs = runs.assign(buildable=[80.0, 84.0, 40.0])
    table = ablation.over_seeds(runs).set_index("variant")
    assert table.loc["x", ["seeds", "R²", "R² low", "R² high"]].tolist() == pytest.approx([2, 0.6, 0.5, 0.7])
    assert table.loc["x", "buildable"] == 82 and table.loc["y", "seeds"] == 1 and table.loc["x", "median error"] == 3
