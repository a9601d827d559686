"""The paper's experiments (sec. 4): train one model per descriptor, ask for targets, inflate what comes out, compare.

Each function here is one expensive step, kept on disk under a key made from its parameters and inputs, so that
every notebook can call for what it needs and finds it done if another one needed it before.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from joblib import Parallel, delayed, effective_n_jobs
from sklearn.metrics import r2_score

from inflate_lib import (
    augmentation,
    datasets,
    descriptors,
    diffusion,
    inflation,
    material,
    mesh,
    paths,
    sparse,
    structures,
)
from inflate_lib.augmentation import apply_variants, augment, augment_descriptors
from inflate_lib.cache import RETRAIN, cached, code_version, digest
from inflate_lib.descriptors import check_name, descriptor_matrix
from inflate_lib.diffusion import TrainedModel, TrainingConfig, generate, ranks, train
from inflate_lib.diffusion.training import choose_device, simple_loss

PIXEL = 1 / 28  # in lengths of the unit square
WHOLE = 0.9  # share of the bright pixels that one connected piece must hold for a drawing to be one structure

#: What one component of each descriptor is called in tables.
COMPONENTS = {"height": ["h"], "width": ["w"], "box": ["h", "w"], "area": ["A"]}


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
    data = data.isel(structure=np.flatnonzero(data["converged"].values & ~_held_out(data)))
    images = data["image"].values
    possible = len(augment(images))
    variants = augment(images, min(n_augmented, possible), seed=seed)
    conditions = augment_descriptors(descriptor_matrix(data, descriptor), descriptor, variants)
    return apply_variants(images, variants), conditions


def trained_model_file(
    descriptor, training, data, n_augmented=augmentation.PAPER_SAMPLES, seed=0, threads=None, log=None
):
    """Train the model of one descriptor, or find it trained in the cache.

    Under ``torchrun`` all processes call this, and train together.

    Parameters
    ----------
    descriptor : str
    training : Mapping
        Options of :class:`inflate_lib.diffusion.TrainingConfig`, but for the seed.
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
    config = _config(descriptor, training, seed)
    about = _about(descriptor, data, n_augmented)

    def make(target, scratch):
        ranks.share(True)  # now the other processes train as well
        images, conditions = training_pairs(data, descriptor, n_augmented, seed)
        model = train(images, conditions, config, scratch, f"training {descriptor}", threads, log)
        unseen = data.isel(structure=np.flatnonzero(data["converged"].values & _held_out(data)))
        if unseen.sizes["structure"]:
            loss = simple_loss(model, unseen["image"].values, descriptor_matrix(unseen, descriptor))
            model.metadata["held_out_loss"] = loss
        model.metadata |= about | {"pairs": len(images), "mean": _mean(descriptor, data)}
        model.save(target)

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
    recipe = _config(descriptor, training, seed).recipe()
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
        whole = _config(name, training, seed)
        config = replace(whole, steps=steps, epochs=None, log_every=max(1, steps // 10))
        images, conditions = training_pairs(data, name, n_augmented, seed)
        model = train(images, conditions, config, progress=f"dry run {name}", threads=threads)
        return model.metadata["seconds_per_step"], whole.training_steps(len(images))

    measured = pd.DataFrame(_side_by_side(one, names, training), columns=["seconds per step", "steps"])
    measured.insert(0, "descriptor", list(names))
    measured["images per second"] = _config(names[0], training, seed).batch_size / measured["seconds per step"]
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


def _config(descriptor, training, seed):
    """The training configuration of one descriptor's model."""
    parts = list(descriptors.PARTS.values()) if descriptor == descriptors.JOINT else []
    return TrainingConfig.from_dict({**training, "seed": seed, "parts": parts})


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


def run_experiment(
    model, descriptor, targets, n_per_target=50, sampling: Mapping | None = None, seed=0, n_jobs=-1, calibration=None
):
    """Generate structures for each target, inflate and describe them (paper sec. 2.3).

    Parameters
    ----------
    model : TrainedModel
    descriptor : str
    targets : (k, N) array_like
        Wanted descriptors, in lengths or areas of the unit square.
    n_per_target : int
        Structures generated for each target.
    sampling : Mapping, optional
        Options of :func:`inflate_lib.diffusion.generate`: sampler, steps, eta, guidance.
    seed : int
        Of the noise.
    n_jobs : int
        Processes of the simulation.
    calibration : inflate_lib.calibration.Calibration, optional
        Turns each target into what the model has to be told to reach it; by default that is the target itself.

    Returns
    -------
    xarray.Dataset
        As :func:`inflate_lib.simulate_dataset` gives it, one row per structure, target after target, with the variables
        ``level`` (number of the target), ``target`` (structure, component) and ``valid`` besides: the drawing is one
        structure, not a broken one of which the largest piece was taken, and it converged. Images that give no
        structure keep their row.

    Raises
    ------
    ValueError
        For targets of the wrong shape, or options that the sampler does not have.
    """
    lengths = descriptors.DESCRIPTORS | {descriptors.JOINT: sum(descriptors.PARTS.values())}
    targets = np.asarray(targets, dtype=float).reshape(-1, lengths[check_name(descriptor)])
    sampling = dict(sampling or {})
    if n_per_target < 1:
        raise ValueError(f"n_per_target must be at least 1, not {n_per_target!r}")
    level = np.repeat(np.arange(len(targets)), n_per_target)
    told = targets if calibration is None else calibration.told(targets)
    if model.config.parts:  # one model for all descriptors
        told = descriptors.joint_conditions(descriptor, told)

    def make(target, scratch):
        images = generate(model, told[level], seed=seed, **sampling)
        data = datasets.simulate_dataset(images, n_jobs=n_jobs, folder=scratch)
        data["level"] = ("structure", level, {"long_name": "number of the target"})
        about = {"long_name": f"target {descriptor}", "units": "1"}
        data["target"] = (("structure", "component"), targets[level], about)
        valid = data["converged"].values & [_is_whole(image) for image in images]
        data["valid"] = ("structure", valid, {"long_name": "one structure that converges"})
        data.attrs |= {"descriptor": descriptor, "seed": seed} | {f"sampling_{k}": v for k, v in sampling.items()}
        datasets.save_dataset(data, target)

    weights = [value.numpy() for _, value in sorted(model.net.state_dict().items())]
    key = {
        "descriptor": descriptor,
        "model": digest(*weights, model.condition_min, model.condition_max),
        "objective": model.config.objective,
        "targets": digest(targets),
        "told": digest(told),
        "n_per_target": n_per_target,
        "sampling": sampling,
        "seed": seed,
        "code": code_version(diffusion, structures, mesh, sparse, material, inflation, descriptors, __name__),
    }
    return datasets.load_dataset(cached("experiment", key, make, ".nc"))


def errors(experiment, descriptor):
    """Distance of what was achieved from what was asked for, one number per structure.

    Parameters
    ----------
    experiment : xarray.Dataset
        From :func:`run_experiment`.
    descriptor : str

    Returns
    -------
    (n,) float
        Height, width, area: relative error |achieved − target| / target. Box: the mean of its two relative errors.
        Axis: mean distance of the thirty points, in pixels. NaN where the structure is not valid.
    """
    target, achieved = experiment["target"].values, descriptor_matrix(experiment, descriptor)
    if descriptor == "axis":
        apart = (achieved - target).reshape(len(target), -1, 2)
        return np.linalg.norm(apart, axis=-1).mean(axis=1) / PIXEL
    return np.abs(achieved / target - 1).mean(axis=1)


def accuracy(experiment, descriptor):
    """How close the structures of an experiment come to their targets.

    Parameters
    ----------
    experiment : xarray.Dataset
        From :func:`run_experiment`.
    descriptor : str

    Returns
    -------
    pandas.DataFrame
        A row per target and one for all: the target, the share of valid structures (one closed structure that
        converges), mean and standard deviation of what was achieved, mean and median error (percent; for axes:
        pixels), share within 5 percent (axes: within one pixel), and in the last row R², the coefficient of
        determination of achieved against target.
    """
    valid, target = experiment["valid"].values, experiment["target"].values
    level, achieved = experiment["level"].values, descriptor_matrix(experiment, descriptor)
    error = errors(experiment, descriptor)
    unit, scale, near = ("px", 1, 1) if descriptor == "axis" else ("%", 100, 0.05)

    def row(name, here):
        error_here = pd.Series(error[here & valid])  # pandas: the mean of nothing is NaN, without a warning
        return {
            "target": name,
            "valid": valid[here].mean(),
            f"mean error ({unit})": scale * error_here.mean(),
            f"median error ({unit})": scale * error_here.median(),
            f"within {near} px" if descriptor == "axis" else f"within {near:.0%}": (error_here <= near).mean(),
        }

    rows = []
    for k in np.unique(level):
        here = level == k
        reached = pd.DataFrame(achieved[here & valid])
        spread = {}
        for column, name in enumerate(COMPONENTS.get(descriptor, [])):
            spread |= {f"mean {name}": reached[column].mean(), f"std {name}": reached[column].std()}
        rows.append(row(_words(descriptor, target[here][0], k), here) | spread)
    everything = row("all", np.ones(len(level), dtype=bool))
    if valid.sum() > 1:
        everything["R²"] = r2_score(target[valid], achieved[valid], multioutput="variance_weighted")
    return pd.DataFrame([*rows, everything]).reindex(columns=[*rows[0], "R²"])


def _is_whole(image):
    """Whether one connected piece holds nearly all bright pixels of a generated image."""
    bright = image > structures.THRESHOLD
    try:
        return structures.main_component(image).sum() >= WHOLE * bright.sum()
    except ValueError:
        return False


def _words(descriptor, target, number):
    """A target as a table shows it."""
    if descriptor == "axis":
        return f"axis {number + 1}"
    values = ", ".join(f"{value:.3f}" for value in target)
    return f"({values})" if len(target) > 1 else values
