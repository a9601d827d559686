"""What in the training matters? The same targets, asked again after a training with one thing changed.

``benchmarks/ablation.py`` trains so, for a small budget, for the table that the book shows.
"""

import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import pandas as pd

from inflate_lib.descriptors import get_descriptor
from inflate_lib.diffusion import TrainingConfig
from inflate_lib.experiments.calibrate import calibrate
from inflate_lib.experiments.run import held_out_seed, run_experiment
from inflate_lib.experiments.tables import scores

if TYPE_CHECKING:
    pass

_N_CALIBRATION = 150  # structures drawn to calibrate a model
_FEWER = 2000  # structures, besides all
MEASURES = ("R²", "median error", "valid", "buildable")
_PAPER = {
    "objective": "epsilon",
    "timestep_draws": 1,
    "ema_decay": 0.0,
    "learning_rate": 1.0e-4,
    "learning_rate_decay": "constant",
    "warmup_steps": 0,
}


def training_variants(training: Mapping) -> dict:
    """Ways of training, (group, name) → (options of ``TrainingConfig``, number of structures; None: all)."""
    plain = TrainingConfig.from_dict(training)
    changes = {("recipe", "of this profile"): {}}
    if plain.ema_decay > 0:
        changes["recipe", "without EMA"] = {"ema_decay": 0.0}
    if plain.objective == "v":
        changes["recipe", "ε-prediction"] = {"objective": "epsilon"}
    else:
        changes["recipe", "v-prediction"] = {"objective": "v"}
    if plain.vlb_weight > 0:
        changes["recipe", "without the VLB term"] = {"vlb_weight": 0.0}
    if plain.timestep_draws > 1:
        changes["recipe", "t drawn uniformly"] = {"timestep_draws": 1}
    changes["recipe", "paper's loss and optimiser"] = _PAPER
    # What the paper leaves open.
    other = "add" if plain.conditioning == "scale-shift" else "scale-shift"
    changes["network", f"context enters by {other}"] = {"conditioning": other}
    changes["network", "attention at 7 × 7"] = {"attention": True}
    changes["network", "two residual blocks per scale"] = {"blocks": 2}
    variants = {names: ({**training, **change}, None) for names, change in changes.items()}
    return variants | {("data", f"{_FEWER} structures"): (training, _FEWER)}


def evaluate_variant(model, data, targets, seed=0, n_calibration=_N_CALIBRATION, descriptor=None, n_jobs=-1):
    """Measures of one model on given targets; those outside the range that it was trained on count as well.

    It is calibrated anew, unless it does not listen enough for that, or `n_calibration` is 0.
    """
    descriptor, model = descriptor or model.name, model.sampled()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".* lie outside the (training data|range of the training data)")
        if n_calibration:
            with suppress(ValueError):
                calibration = calibrate(model, data, n_calibration, seed, descriptor, n_jobs)
                model = replace(model, calibrations={descriptor: calibration})
        experiment = run_experiment(model, targets, 1, held_out_seed(seed), descriptor, n_jobs, extrapolate=True)
    return measures(experiment, descriptor, data, seed)


def measures(experiment, descriptor, data, seed=0):
    """R², median error and shares of valid and of buildable structures, each with low and high, as a flat dict."""
    table = scores(experiment, descriptor, data, seed=seed).set_index("measure")
    row, of = {}, {"median error": f"median {get_descriptor(descriptor).error.name}"}
    for name in MEASURES:
        value = table.loc[of.get(name, name)]
        row |= {name: value["value"], f"{name} low": value["low"], f"{name} high": value["high"]}
    return row


def over_seeds(runs):
    """Runs of ``benchmarks/ablation.py``, one row per run → one per variant: mean over the seeds, lowest, highest."""
    rows = []
    for (group, name), part in runs.groupby(["group", "variant"], sort=False):
        row = {"group": group, "variant": name, "seeds": len(part)}
        for measure in MEASURES:
            row |= {measure: part[measure].mean(), f"{measure} low": part[measure].min()}
            row[f"{measure} high"] = part[measure].max()
        rows.append(row)
    return pd.DataFrame(rows)
