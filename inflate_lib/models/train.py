"""The models of the experiments (sec. 4.1): one per descriptor, trained, found in the cache, or committed.

Each function here is one expensive step, kept on disk under a key made from its parameters and inputs, so that
every notebook can call for what it needs and finds it done if another one needed it before. What the models are asked
for, and what comes of it, is in ``generation`` and ``evaluation``.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd
from joblib import Parallel, delayed, effective_n_jobs

from inflate_lib._cache import cached, digest, step_version
from inflate_lib.datasets.pairs import _about, _held_out, _mean, _part, _variants, training_pairs
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.diffusion import TrainingConfig, _ranks, train
from inflate_lib.diffusion.training import choose_device
from inflate_lib.models.remote import train_and_test, write_pack
from inflate_lib.structures import augmentation


def pack(path: Path, names: Sequence[str], training, data, n_augmented, seed=0, profile=None):
    """Write all that several models are trained from into one file, for :mod:`inflate_lib.models.remote`.

    Parameters
    ----------
    path : path_like
    names : sequence of str
        Descriptors.
    training, data, n_augmented, seed
        See :func:`trained_model_file`.
    profile : str, optional
        Its name, for the header of the weights.
    """
    seen, unseen = _part(data, ~_held_out(data)), _part(data, _held_out(data))
    images = seen["image"].values
    models = {}
    for name in names:
        matrix = descriptor_matrix(seen, name)
        models[name] = {
            "config": training_config(name, training, seed),
            "about": _about(name, data, n_augmented) | {"mean": _mean(name, data), "profile": profile},
            "seen": matrix,
            "mirrored": get_descriptor(name).mirrored(matrix),
            "unseen": descriptor_matrix(unseen, name),
        }
    write_pack(path, images, _variants(images, n_augmented, seed), unseen["image"].values, models)


def trained_model_file(
    descriptor, training, data, n_augmented=augmentation.PAPER_SAMPLES, seed=0, threads=None, log=None
):
    """Train the model of one descriptor, or find it trained in the cache.

    Under ``torchrun`` all processes call this, and train together.

    Parameters
    ----------
    descriptor : str
    training : Mapping
        As in :func:`training_config`.
    data : xarray.Dataset
        Simulated structures.
    n_augmented, seed : int
        See :func:`training_pairs`; the seed also starts the training.
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
    config = training_config(descriptor, training, seed)
    about = _about(descriptor, data, n_augmented)

    def make(target, scratch):
        _ranks.share(True)  # now the other processes train as well
        pairs, rest = training_pairs(data, descriptor, n_augmented, seed), _part(data, _held_out(data))
        unseen = rest["image"].values, descriptor_matrix(rest, descriptor)
        told = about | {"mean": _mean(descriptor, data)}
        train_and_test(pairs, unseen, config, told, scratch, f"training {descriptor}", threads, log).save(target)

    if _ranks.rank() > 0:
        while _ranks.share():
            train(*training_pairs(data, descriptor, n_augmented, seed), config, threads=threads)
        return None
    matrix = descriptor_matrix(data, descriptor)
    descriptors_now = digest(matrix, get_descriptor(descriptor).mirrored(matrix))
    key = about | {"training": config.recipe(), "descriptors": descriptors_now, "code": step_version("model")}
    path = cached("model", key, make, ".safetensors")
    _ranks.share(False)
    return path


def train_models(
    names: Sequence[str], training, data, n_augmented=augmentation.PAPER_SAMPLES, seed=0, log: Path | None = None
):
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
        return trained_model_file(name, training, data, n_augmented, seed, threads, log and Path(log) / name)

    return dict(zip(names, _side_by_side(one, names, training), strict=True))


def training_cost(names: Sequence[str], training, data, n_augmented=augmentation.PAPER_SAMPLES, seed=0, steps=200):
    """A dry run: train for some steps, side by side as :func:`train_models` does, and project the cost. Keeps nothing.

    Returns
    -------
    pandas.DataFrame
        A row per model: seconds per step (median over the run), images per second, steps and hours of the whole
        training, and how many models train at a time.
    """

    def one(name, threads):
        whole = training_config(name, training, seed)
        config = replace(whole, steps=steps, epochs=None, log_every=max(1, steps // 10))
        images, conditions = training_pairs(data, name, n_augmented, seed)
        model = train(images, conditions, config, progress=f"dry run {name}", threads=threads)
        return model.metadata["seconds_per_step"], whole.training_steps(len(images))

    measured = pd.DataFrame(_side_by_side(one, names, training), columns=["seconds per step", "steps"])
    measured.insert(0, "descriptor", list(names))
    measured["images per second"] = training_config(names[0], training, seed).batch_size / measured["seconds per step"]
    measured["hours"] = measured["seconds per step"] * measured["steps"] / 3600
    measured["side by side"] = _jobs(names, training)
    return measured


def _side_by_side(task, names, training):
    """``task(name, threads)`` for each name, as many at a time as the device bears."""
    jobs = _jobs(names, training)
    threads = max(1, effective_n_jobs(-1) // (jobs * _ranks.world()))
    return Parallel(n_jobs=jobs)(delayed(task)(name, threads) for name in names)


def _jobs(names, training):
    alone = choose_device(training.get("device", "auto")).type == "mps" or _ranks.world() > 1
    return 1 if alone else min(len(names), effective_n_jobs(-1))


def training_config(descriptor, training, seed=0):
    """The training configuration of one descriptor's model.

    Parameters
    ----------
    descriptor : str
    training : Mapping
        Options of :class:`inflate_lib.diffusion.TrainingConfig`; ``steps_of``, where it is there, gives some
        descriptors a number of steps of their own: ``{"area": 20000}``.
    seed : int
    """
    options = {**training, "seed": seed}
    steps_of = options.pop("steps_of", {})
    for name in steps_of:
        get_descriptor(name)  # refuses a name that is none
    if descriptor in steps_of:
        options["steps"] = steps_of[descriptor]
    one = get_descriptor(descriptor)
    options["parts"] = [get_descriptor(part).length for part in one.parts] if one.any_part else []
    return TrainingConfig.from_dict(options)
