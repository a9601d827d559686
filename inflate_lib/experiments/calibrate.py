"""How a model answers: ask for descriptors of training structures, inflate what is drawn, fit a calibration."""

import numpy as np

from inflate_lib.datasets.split import held_out
from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.models.calibration import Calibration

N_ASKED = 300  # structures drawn to fit g


def calibrate(model, descriptor, data, sampling=None, seed=0, n=N_ASKED, n_jobs=-1):
    """Measure how a model answers, and fit its :class:`Calibration`. Parameters are those of :func:`answers`."""
    return Calibration.fit(*answers(model, descriptor, data, sampling, seed, n, n_jobs))


def calibrate_all(models, data, sampling=None, seed=0, n=N_ASKED, n_jobs=-1):
    """Calibrations of several models, name → :class:`Calibration`; None for each where n is 0."""
    return {
        name: calibrate(model, name, data, sampling, seed, n, n_jobs) if n else None for name, model in models.items()
    }


def answers(model, descriptor, data, sampling=None, seed=0, n=N_ASKED, n_jobs=-1):
    """What a model answers to the descriptors of structures that it was trained on.

    Parameters
    ----------
    model : inflate_lib.diffusion.TrainedModel
    descriptor : str
    data : xarray.Dataset
        All simulated structures; those of :func:`inflate_lib.datasets.split.held_out` are not used.
    sampling : Mapping, optional
        As in :func:`inflate_lib.experiments.run.run_experiment`; a calibration is good for this sampling alone.
    seed : int
        Of the choice of training structures, and of the noise.
    n : int
        Structures to draw.

    Returns
    -------
    targets, achieved : (m, N) float
        What was asked for and what was achieved, of the m ≤ n structures that are valid.
    """
    from inflate_lib.experiments.run import run_experiment

    seen = data["converged"].values & ~held_out(data.sizes["structure"])
    known = descriptor_matrix(data.isel(structure=np.flatnonzero(seen)), descriptor)
    targets = known[np.random.default_rng([seed, 5]).permutation(len(known))[:n]]
    # Another seed than the experiment's: its noise must not be the noise that was calibrated on.
    answer = run_experiment(model, descriptor, targets, 1, sampling, seed + 1_000_003, n_jobs)
    valid = answer["valid"].values
    return targets[valid], descriptor_matrix(answer, descriptor)[valid]
