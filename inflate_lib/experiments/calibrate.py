"""How a model answers: ask for descriptors of training structures, inflate what is drawn, fit a calibration."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from inflate_lib.datasets.split import training_rows
from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.experiments.run import run_experiment
from inflate_lib.models.calibration import Calibration

if TYPE_CHECKING:
    import xarray as xr

    from inflate_lib.models import Model

_N_ASKED = 300  # structures drawn to fit g


def calibrate(model, data, n=_N_ASKED, seed=0, descriptor=None, n_jobs=-1):
    """Measure how a model answers, and fit its :class:`Calibration`. Parameters are those of :func:`answers`."""
    return Calibration.fit(*answers(model, data, n, seed, descriptor, n_jobs))


def calibrate_all(
    models: Mapping, data: "xr.Dataset", n: int = _N_ASKED, seed: int = 0, n_jobs: int = -1
) -> "dict[str, Model]":
    """The same models, name → :class:`inflate_lib.models.Model`, each calibrated; as they are where n is 0."""
    if n == 0:
        return dict(models)
    return {
        name: replace(model, calibrations={name: calibrate(model, data, n, seed, n_jobs=n_jobs)})
        for name, model in models.items()
    }


def answers(model, data, n=_N_ASKED, seed=0, descriptor=None, n_jobs=-1):
    """What a model answers to the descriptors of structures that it was trained on, told as they are.

    Parameters
    ----------
    model : inflate_lib.models.Model
        A calibration is good for its sampling alone.
    data : xarray.Dataset
        All simulated structures; those of :func:`inflate_lib.datasets.split.held_out` are not used.
    n : int
        Structures to draw.
    seed : int
        Of the choice of training structures, and of the noise.
    descriptor : str, optional
        As in :func:`inflate_lib.experiments.run.run_experiment`.

    Returns
    -------
    targets, achieved : (m, N) float
        What was asked for and what was achieved, of the m ≤ n structures that are valid.
    """
    descriptor = descriptor or model.name
    known = descriptor_matrix(data, descriptor)[training_rows(data)]
    targets = known[np.random.default_rng([seed, 5]).permutation(len(known))[:n]]
    # Another seed than the experiment's: its noise must not be the noise that was calibrated on.
    answer = run_experiment(model.sampled(), targets, 1, seed + 1_000_003, descriptor, n_jobs)
    valid = answer["valid"].values
    return targets[valid], descriptor_matrix(answer, descriptor)[valid]
