"""The paper's experiments (sec. 4): train one model per descriptor, ask for targets, inflate what comes out, compare.

Each function here is one expensive step, kept on disk under a key made from its parameters and inputs, so that
every notebook can call for what it needs and finds it done if another one needed it before.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from joblib import Parallel, delayed, effective_n_jobs
from sklearn.metrics import r2_score

from inflate_lib import augmentation, datasets, descriptors, diffusion, inflation, material, mesh, skyline, structures
from inflate_lib.augmentation import apply_variants, augment, augment_descriptors
from inflate_lib.cache import cached, code_version, digest
from inflate_lib.descriptors import check_name, descriptor_matrix
from inflate_lib.diffusion import TrainedModel, TrainingConfig, generate, train

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
    kept = data["converged"].values & ~datasets.held_out(data.sizes["structure"])
    data = data.isel(structure=np.flatnonzero(kept))
    images = data["image"].values
    possible = len(augment(images))
    variants = augment(images, min(n_augmented, possible), seed=seed)
    conditions = augment_descriptors(descriptor_matrix(data, descriptor), descriptor, variants)
    return apply_variants(images, variants), conditions


def trained_model_file(descriptor, training, data, n_augmented=augmentation.PAPER_SAMPLES, seed=0, threads=None):
    """Train the model of one descriptor, or find it trained.

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

    Returns
    -------
    Path
        A safetensors file for :meth:`inflate_lib.diffusion.TrainedModel.load`. A killed training goes on from its
        last checkpoint.
    """
    check_name(descriptor)
    config = TrainingConfig.from_dict({**training, "seed": seed})

    def make(target, scratch):
        images, conditions = training_pairs(data, descriptor, n_augmented, seed)
        model = train(images, conditions, config, scratch, progress=f"training {descriptor}", threads=threads)
        model.metadata = {
            "descriptor": descriptor,
            "source": data.attrs.get("source", "unknown"),
            "structures": int(data["converged"].sum()),
            "pairs": len(images),
        }
        model.save(target)

    key = {
        "descriptor": descriptor,
        "training": config.as_dict(),
        "n_augmented": n_augmented,
        "data": digest(data["image"].values, descriptor_matrix(data, descriptor)),
        "code": code_version(diffusion, augmentation),
    }
    return cached("model", key, make, ".safetensors")


def trained_models(names: Sequence[str], training, data, n_augmented=augmentation.PAPER_SAMPLES, seed=0):
    """Train several models side by side, one CPU thread each (on a GPU one after the other).

    Small networks leave a second thread idle most of the time, so that two models on two cores finish sooner than
    one after the other. Parameters are those of :func:`trained_model_file`.

    Returns
    -------
    dict
        Name of the descriptor → :class:`inflate_lib.diffusion.TrainedModel`.
    """
    device = diffusion.training.choose_device(training.get("device", "auto")).type
    jobs = min(len(names), effective_n_jobs(-1)) if device == "cpu" else 1
    threads = max(1, effective_n_jobs(-1) // jobs)
    paths = Parallel(n_jobs=jobs)(
        delayed(trained_model_file)(name, dict(training), data, n_augmented, seed, threads) for name in names
    )
    return {name: TrainedModel.load(path) for name, path in zip(names, paths, strict=True)}


def run_experiment(model, descriptor, targets, n_per_target=50, sampling: Mapping | None = None, seed=0, n_jobs=-1):
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
    targets = np.asarray(targets, dtype=float).reshape(-1, descriptors.DESCRIPTORS[check_name(descriptor)])
    sampling = dict(sampling or {})
    if n_per_target < 1:
        raise ValueError(f"n_per_target must be at least 1, not {n_per_target!r}")
    level = np.repeat(np.arange(len(targets)), n_per_target)

    def make(target, scratch):
        images = generate(model, targets[level], seed=seed, **sampling)
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
        "n_per_target": n_per_target,
        "sampling": sampling,
        "seed": seed,
        "code": code_version(diffusion, structures, mesh, skyline, material, inflation, descriptors, __name__),
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
