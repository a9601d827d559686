"""Training the models of the experiments (sec. 4.1), one per descriptor: each an expensive step, kept on disk.

Its key is made from its parameters and inputs, so that every notebook can call for what it needs and finds it done if
another one needed it before.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
import xarray as xr
from joblib import Parallel, delayed, effective_n_jobs

from inflate_lib._cache import cached, digest, step_version
from inflate_lib.datasets.pairs import TrainingSet
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.diffusion import ranks, storage, train
from inflate_lib.diffusion.training import choose_device
from inflate_lib.models.recipe import Recipe
from inflate_lib.models.remote import train_and_test


def training_set(descriptor: str, recipe: Recipe, data) -> TrainingSet:
    """What a recipe trains the model of a descriptor on, of simulated structures."""
    return TrainingSet(data, descriptor, recipe.n_augmented, recipe.seed)


def pack(path: Path, names: Sequence[str], recipe: Recipe, data, profile: str | None = None) -> None:
    """Write all that several models are trained from into one file, for :mod:`inflate_lib.models.remote`.

    Parameters
    ----------
    path : path_like
    names : sequence of str
        Descriptors.
    recipe, data
        See :func:`trained_model_file`.
    profile : str, optional
        Its name, for the header of the weights.
    """
    storage.check_files([path], "pack")
    arrays, models = {}, {}
    for name in names:
        pairs = training_set(name, recipe, data)
        about = pairs.about | {"mean": pairs.mean, "profile": profile, "sampling": dict(recipe.sampling)}
        models[name] = {"config": recipe.config(name).as_dict(), "about": about}
        of = {"seen": pairs.originals[1], "mirrored": pairs.mirrored, "unseen": pairs.unseen[1]}
        arrays |= {f"{name}.{part}": descriptors for part, descriptors in of.items()}
    arrays |= {"images": pairs.originals[0], "variants": pairs.variants.astype(np.int32), "unseen": pairs.unseen[0]}
    tensors = {name: torch.from_numpy(np.array(array, order="C")) for name, array in arrays.items()}  # copies
    storage.write(path, "pack", tensors, models)


def trained_model_file(
    descriptor: str, recipe: Recipe, data, threads: int | None = None, log: Path | None = None
) -> Path | None:
    """Train the model of one descriptor, or find it trained in the cache.

    Under ``torchrun`` all processes call this, and train together.

    Parameters
    ----------
    descriptor : str
    recipe : Recipe
    data : xarray.Dataset
        Simulated structures.
    threads : int, optional
        CPU threads.
    log : path_like, optional
        Folder for ``history.csv`` and TensorBoard events.

    Returns
    -------
    Path or None
        A safetensors file for :meth:`inflate_lib.diffusion.TrainedModel.load`; None in all processes but the first. A
        killed training goes on from its last checkpoint.
    """
    config, pairs = recipe.config(descriptor), training_set(descriptor, recipe, data)

    def make(target, scratch):
        ranks.share(True)  # now the other processes train as well
        told = pairs.about | {"mean": pairs.mean}
        what = f"training {descriptor}"
        train_and_test(pairs.pairs, pairs.unseen, config, told, scratch, what, threads, log).save(target)

    if ranks.rank() > 0:
        while ranks.share():
            train(*pairs.pairs, config, threads=threads)
        return None
    matrix = descriptor_matrix(data, descriptor)
    descriptors_now = digest(matrix, get_descriptor(descriptor).mirrored(matrix))
    key = pairs.about | {"training": config.recipe(), "descriptors": descriptors_now, "code": step_version("model")}
    path = cached("model", key, make, ".safetensors")
    ranks.share(False)
    return path


def train_models(
    names: Sequence[str], recipe: Recipe, data: xr.Dataset, log: Path | None = None
) -> dict[str, Path | None]:
    """Train several models, or find them trained in the cache: :func:`trained_model_file` for each, side by side.

    Small networks leave a second CPU thread idle most of the time, so that two models on two cores finish sooner than
    one after the other; a large GPU holds all five. Under ``torchrun`` one follows the other. Each logs to its own
    folder in ``log``.

    Returns
    -------
    dict
        Name of the descriptor → path of its file.
    """

    def one(name, threads):
        return trained_model_file(name, recipe, data, threads, log and Path(log) / name)

    return dict(zip(names, _side_by_side(one, names, recipe.training), strict=True))


def training_cost(names: Sequence[str], recipe: Recipe, data, steps: int = 200) -> pd.DataFrame:
    """A dry run: train for some steps, side by side as :func:`train_models` does, and project the cost. Keeps nothing.

    Returns
    -------
    pandas.DataFrame
        A row per model: seconds per step (median over the run), images per second, steps and hours of the whole
        training, and how many models train at a time.
    """

    def one(name, threads):
        whole = recipe.config(name)
        config = replace(whole, steps=steps, epochs=None, log_every=max(1, steps // 10))
        images, conditions = training_set(name, recipe, data).pairs
        model = train(images, conditions, config, progress=f"dry run {name}", threads=threads)
        return model.metadata["seconds_per_step"], whole.training_steps(len(images))

    measured = pd.DataFrame(_side_by_side(one, names, recipe.training), columns=["seconds per step", "steps"])
    measured.insert(0, "descriptor", list(names))
    measured["images per second"] = recipe.config(names[0]).batch_size / measured["seconds per step"]
    measured["hours"] = measured["seconds per step"] * measured["steps"] / 3600
    measured["side by side"] = _jobs(names, recipe.training)
    return measured


def _side_by_side(task, names, training):
    """``task(name, threads)`` for each name, as many at a time as the device bears."""
    jobs = _jobs(names, training)
    # No more than PyTorch was given (OMP_NUM_THREADS): of notebooks that run side by side, threads wait for each other.
    threads = max(1, min(effective_n_jobs(-1) // (jobs * ranks.world()), torch.get_num_threads()))
    return Parallel(n_jobs=jobs)(delayed(task)(name, threads) for name in names)


def _jobs(names, training):
    alone = choose_device(training.get("device", "auto")).type == "mps" or ranks.world() > 1
    return 1 if alone else min(len(names), effective_n_jobs(-1))
