"""The models of the experiments (sec. 4.1): one per descriptor, trained, found in the cache, or committed.

Each function here is one expensive step, kept on disk under a key made from its parameters and inputs, so that
every notebook can call for what it needs and finds it done if another one needed it before. What the models are asked
for, and what comes of it, is in ``generation`` and ``evaluation``.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from joblib import Parallel, delayed, effective_n_jobs

from inflate_lib import augmentation, datasets, descriptors, diffusion, paths
from inflate_lib.augmentation import apply_variants, augment, augment_descriptors
from inflate_lib.cache import RETRAIN, cached, code_version, digest
from inflate_lib.descriptors import check_name, descriptor_matrix
from inflate_lib.diffusion import TrainedModel, TrainingConfig, ranks, train
from inflate_lib.diffusion.training import choose_device
from inflate_lib.remote import train_and_test, write_pack


def training_pairs(data, descriptor, n_augmented, seed=0):
    """Augmented images and descriptors to train on (paper sec. 3.2).

    Parameters
    ----------
    data : xarray.Dataset
        Simulated structures, all of them; those that did not converge and those of
        :func:`inflate_lib.datasets.held_out` are left out.
    descriptor : str
        "height", "width", "box", "area" or "axis".
    n_augmented : int
        Number of pairs; where flips and shifts do not give as many, all that they give.
    seed : int
        Of the draw among flips and shifts.

    Returns
    -------
    images : (m, 28, 28) uint8
    conditions : (m, N) float
    """
    seen = _part(data, ~_held_out(data))
    images = seen["image"].values
    variants = _variants(images, n_augmented, seed)
    conditions = augment_descriptors(descriptor_matrix(seen, descriptor), descriptor, variants)
    return apply_variants(images, variants), conditions


def pack(path: Path, names: Sequence[str], training, data, n_augmented, seed=0, profile=None):
    """Write all that several models are trained from into one file, for :mod:`inflate_lib.remote`.

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
    models = {
        name: {
            "config": training_config(name, training, seed),
            "about": _about(name, data, n_augmented) | {"mean": _mean(name, data), "profile": profile},
            "seen": descriptor_matrix(seen, name),
            "unseen": descriptor_matrix(unseen, name),
        }
        for name in names
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
        ranks.share(True)  # now the other processes train as well
        pairs, rest = training_pairs(data, descriptor, n_augmented, seed), _part(data, _held_out(data))
        unseen = rest["image"].values, descriptor_matrix(rest, descriptor)
        told = about | {"mean": _mean(descriptor, data)}
        train_and_test(pairs, unseen, config, told, scratch, f"training {descriptor}", threads, log).save(target)

    if ranks.rank() > 0:
        while ranks.share():
            train(*training_pairs(data, descriptor, n_augmented, seed), config, threads=threads)
        return None
    descriptors_now = digest(descriptor_matrix(data, descriptor))
    code = code_version(diffusion, augmentation)
    key = about | {"training": config.recipe(), "descriptors": descriptors_now, "code": code}
    path = cached("model", key, make, ".safetensors")
    ranks.share(False)
    return path


def committed_weights(descriptor, training, data, n_augmented=augmentation.PAPER_SAMPLES, seed=0):
    """Find weights in ``data/pretrained`` that were trained as asked, on these very data.

    The images must be the same to the last bit; the descriptors, whose last digits depend on the processor, must agree
    in their mean to six digits. Parameters are those of :func:`trained_model_file`.

    Returns
    -------
    path : Path or None
        The safetensors file.
    why_not : str
        What differs where the recipe is the same and yet the weights are not taken.

    Raises
    ------
    ValueError
        A file there is damaged, or not one of this library.
    """
    recipe = training_config(descriptor, training, seed).recipe()
    about, mean, why_not = _about(descriptor, data, n_augmented), _mean(descriptor, data), ""
    for path in sorted(paths.PRETRAINED.glob(f"*/{descriptor}.safetensors")):
        model = TrainedModel.load(path)
        if model.config.recipe() != recipe:
            continue
        differs = [name for name, value in about.items() if model.metadata.get(name) != value]
        if not differs and np.allclose(model.metadata["mean"], mean, rtol=1e-6, atol=1e-9):
            return path, ""
        why_not = f"{_name(path)} is of another {', '.join(differs) or 'simulation'}"
    return None, why_not


def trained_models(names: Sequence[str], training, data, n_augmented=augmentation.PAPER_SAMPLES, seed=0):
    """The models of several descriptors: committed weights where there are any, else trained, or found in the cache.

    A line of text says which. With the environment variable ``INFLATE_RETRAIN`` (``inflate reproduce --retrain``)
    committed weights are not considered. Parameters are those of :func:`trained_model_file`.

    Returns
    -------
    dict
        Name of the descriptor → :class:`inflate_lib.diffusion.TrainedModel`.
    """
    found = {}
    for name in names if RETRAIN not in os.environ else ():
        path, why_not = committed_weights(name, training, data, n_augmented, seed)
        if path is not None:
            found[name] = path
        elif why_not:
            print(why_not)
    for folder in sorted({path.parent for path in found.values()}):
        print(f"weights from {_name(folder)}: {', '.join(name for name in found if found[name].parent == folder)}")
    if missing := [name for name in names if name not in found]:
        print(f"trained for this run: {', '.join(missing)}")
        found |= train_models(missing, training, data, n_augmented, seed)
    return {name: TrainedModel.load(found[name]) for name in names}


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
    threads = max(1, effective_n_jobs(-1) // (jobs * ranks.world()))
    return Parallel(n_jobs=jobs)(delayed(task)(name, threads) for name in names)


def _jobs(names, training):
    alone = choose_device(training.get("device", "auto")).type == "mps" or ranks.world() > 1
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
    steps_of = {check_name(name): steps for name, steps in options.pop("steps_of", {}).items()}
    if descriptor in steps_of:
        options["steps"] = steps_of[descriptor]
    options["parts"] = list(descriptors.PARTS.values()) if descriptor == descriptors.JOINT else []
    return TrainingConfig.from_dict(options)


def _part(data, which):
    """The structures of a part that inflate."""
    return data.isel(structure=np.flatnonzero(data["converged"].values & which))


def _variants(images, n_augmented, seed):
    """As many flips and shifts as are wanted, or all."""
    return augment(images, min(n_augmented, len(augment(images))), seed=seed)


def _held_out(data):
    return datasets.held_out(data.sizes["structure"])


def _about(descriptor, data, n_augmented):
    """What a model was trained on, exactly."""
    check_name(descriptor)
    return {
        "descriptor": descriptor,
        "source": data.attrs.get("source", "unknown"),
        "structures": int(data["converged"].sum()),
        "data": digest(data["image"].values, data["converged"].values),
        "held_out": "index % 10 == 9",
        "n_augmented": n_augmented,
    }


def _mean(descriptor, data):
    return np.nanmean(descriptor_matrix(data, descriptor), axis=0).tolist()


def _name(path):
    """A path as a reader of the book should see it."""
    return path.relative_to(paths.ROOT) if path.is_relative_to(paths.ROOT) else path
