"""How a model answers: ask for descriptors of training structures, inflate what is drawn, fit a calibration.

It is stored with the weights by :func:`calibrate_weights`, which ``inflate train --out`` calls for what it has trained.
"""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import xarray as xr

from inflate_lib._cache import digest
from inflate_lib._checks import whole_number, workers
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.descriptors.registry import name_of
from inflate_lib.diffusion.randomness import seed_for
from inflate_lib.experiments.run import run_experiment
from inflate_lib.models.calibration import Calibration
from inflate_lib.models.reach import save_reach
from inflate_lib.models.recipe import Recipe
from inflate_lib.models.weights import STUDENTS, Model, with_judge

_N_ASKED = 300  # structures drawn to fit g


def calibrate(model, data, n=_N_ASKED, seed=0, descriptor=None, n_jobs=-1):
    """Measure how a model answers, and fit its :class:`Calibration`. Parameters are those of :func:`answers`."""
    return Calibration.fit(*answers(model, data, n, seed, descriptor, n_jobs))


def calibrate_all(
    models: Mapping, data: xr.Dataset, n: int = _N_ASKED, seed: int = 0, n_jobs: int = -1
) -> dict[str, Model]:
    """The same models, name → :class:`inflate_lib.models.Model`, each calibrated; as they are where n is 0.

    A model that came with its calibration, see :func:`inflate_lib.models.trained_models`, keeps it: nothing is drawn.
    """
    whole_number("n", n, 0)
    whole_number("seed", seed, 0)
    workers(n_jobs)
    return {
        name: replace(model, calibrations={name: calibrate(model, data, n, seed, n_jobs=n_jobs)})
        if n and name not in model.calibrations
        else model
        for name, model in models.items()
    }


def calibrate_weights(
    folder: Path, data: xr.Dataset, recipe: Recipe, names: Sequence[str] | None = None
) -> dict[str, Model]:
    """Measure how the models in a folder answer, and write what :func:`.weights.load_model` needs beside them.

    Into the header of each file go the recipe's ways of sampling and the calibrations for each, and ``reach.npz``
    beside them holds what the structures reach. The weights stay as they are. A joint model is calibrated for every
    combination of height, width and area, and for each other part alone, as far as it follows them.
    Students, in a folder ``students``, are calibrated for what they answer: all ways but the first.

    Parameters
    ----------
    folder : path_like
        With ``<descriptor>.safetensors`` files of one recipe, as ``inflate train --out`` leaves them.
    data : xarray.Dataset
        All simulated structures that the models were trained on.
    recipe : inflate_lib.models.recipe.Recipe
        Its sampling and seed, and its number of structures for :func:`calibrate`; 0 for none.
    names : sequence of str, optional
        Only these models; all in the folder by default.

    Returns
    -------
    dict
        Name of each model → :class:`inflate_lib.models.Model`, calibrated.

    Raises
    ------
    ValueError
        There are no weights in the folder, or they were trained on other data, or a model of a single descriptor
        hardly follows it.
    """
    folder, models = Path(folder), {}
    if names is None:
        names = sorted(file.stem for file in folder.glob("*.safetensors"))
    ways = recipe.ways()
    for file in (folder / f"{name}.safetensors" for name in names):
        student = folder / STUDENTS / file.name
        if not student.is_file():
            models[file.stem] = _calibrate_file(file, data, recipe, ways)
            continue
        others = {purpose: way for purpose, way in ways.items() if purpose != "quick"}
        quick = _calibrate_file(student, data, replace(recipe, sampling=ways.get("quick", recipe.sampling)), others)
        models[file.stem] = _calibrate_file(file, data, recipe, {})
        models[file.stem].others.update(quick.others | {"quick": replace(quick, others={})})
    if not models:
        raise ValueError(f"{folder} holds no weights (*.safetensors); inflate train --out {folder} puts them there")
    save_reach(data, folder)
    return models


def _calibrate_file(file, data, recipe, others):
    """One of the files of :func:`calibrate_weights`, with ways of sampling for other purposes."""
    trained = with_judge(file)
    if trained.metadata.get("data") != digest(data["image"].values, data["converged"].values):
        raise ValueError(f"{file} was trained on other data: {trained.metadata.get('structures')} structures")
    model = _calibrated(Model(file.stem, trained, recipe.sampling), data, recipe)
    made = {purpose: _calibrated(model.sampled(**way), data, recipe) for purpose, way in others.items()}
    trained.metadata |= _as_header(model, recipe)
    trained.metadata["samplers"] = {purpose: _as_header(other, recipe) for purpose, other in made.items()}
    trained.save(file, half=True)
    return replace(model, others=made)


def _calibrated(model, data, recipe):
    """Calibrated for all that a model can be, as far as it follows; the model of one descriptor must."""
    joint, found = get_descriptor(model.name).any_part, {}
    for asked in _combinations(model.name) if joint else (model.name,):
        with suppress(ValueError) if joint else nullcontext():
            if recipe.n_calibration:
                found[asked] = calibrate(model, data, recipe.n_calibration, recipe.seed, asked)
    return replace(model, calibrations=found)


def _as_header(model, recipe):
    how = {"n": recipe.n_calibration, "seed": recipe.seed}
    fits = {asked: fit.as_dict() | how for asked, fit in model.calibrations.items()}
    return {"sampling": dict(model.sampling), "calibration": fits}


def answers(model, data, n=_N_ASKED, seed=0, descriptor=None, n_jobs=-1):
    """What a model answers to the descriptors of structures that it was trained on, told as they are.

    Parameters
    ----------
    model : inflate_lib.models.Model
        A calibration is good for its sampling alone.
    data : xarray.Dataset
        All simulated structures; those of :func:`inflate_lib.datasets.pairs.held_out` are not used.
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
    targets = questions(data, descriptor, n, seed)
    # No experiment's noise may be the noise that was calibrated on.
    answer = run_experiment(model.sampled(), targets, 1, seed_for(seed, "calibration"), descriptor, n_jobs)
    valid = answer["valid"].values
    return targets[valid], descriptor_matrix(answer, descriptor)[valid]


def questions(data, descriptor, n, seed):
    """Descriptors (m, N) of m ≤ n training structures, for which a model is asked to see how it answers."""
    known = descriptor_matrix(data, descriptor)[training_rows(data)]
    return known[np.random.default_rng([seed, 5]).permutation(len(known))[:n]]


def _combinations(joint):
    """What a joint model is calibrated for: every combination of the sizes among its parts, and each other part."""
    parts = get_descriptor(joint).parts
    sizes = [part for part in parts if get_descriptor(part).is_size]
    together = [name_of(some) for k in range(1, len(sizes) + 1) for some in combinations(sizes, k)]
    return together + [part for part in parts if part not in sizes]
