"""Ask a model for targets and see what comes (paper sec. 2.3): targets → images → label, inflate, describe.

An *experiment* is a simulated data set that also knows what each structure was meant for: ``target``, ``level`` (the
number of the target) and ``valid``; only what is valid is ``buildable``. Structures from elsewhere, such as real ones,
can be judged in the same form.
"""

import warnings
from pathlib import Path

import numpy as np
import xarray as xr

from inflate_lib import _progress, paths
from inflate_lib._cache import cached, digest, step_version
from inflate_lib._checks import numbers, whole_number, workers
from inflate_lib._files import draft
from inflate_lib.datasets import simulate
from inflate_lib.datasets.pairs import held_out
from inflate_lib.datasets.storage import load_dataset, save_dataset
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.descriptors.registry import PARTS, added_version, columns
from inflate_lib.diffusion import generate, storage
from inflate_lib.diffusion.randomness import seed_for
from inflate_lib.models import Model
from inflate_lib.structures.labels import is_whole

PIECE = 128  # structures generated at a time, which is what a killed run can lose


def run_experiment(
    model: Model,
    targets: np.ndarray,
    n_per_target: int = 50,
    seed: int = 0,
    descriptor: str | None = None,
    n_jobs: int = -1,
    extrapolate: bool = False,
) -> xr.Dataset:
    """Generate structures for each target, inflate and describe them (paper sec. 2.3).

    Parameters
    ----------
    model : inflate_lib.models.Model
        With its sampling and its calibrations.
    targets : (k, N) array_like
        Wanted descriptors, in lengths or areas of the unit square.
    n_per_target : int
        Structures generated for each target.
    seed : int
        Of the noise. Each descriptor has noise of its own; models that are asked for the same one share it.
    descriptor : str, optional
        What is asked for, where it is not all that the model was trained for: a part of those of the joint model.
    n_jobs : int
        Processes of the simulation.
    extrapolate : bool
        Generate for targets outside the range of the training data as well, with a warning.

    Returns
    -------
    xarray.Dataset
        As :func:`judge` gives it, one row per structure, target after target.

    Raises
    ------
    ValueError
        For targets of the wrong shape, or outside the range of the training data without `extrapolate`; for options
        that the sampler does not have.
    """
    whole_number("n_per_target", n_per_target, 1)
    whole_number("seed", seed, 0)
    workers(n_jobs)
    descriptor = descriptor or model.name
    targets = check_targets(model.trained, descriptor, targets, extrapolate)
    level = np.repeat(np.arange(len(targets)), n_per_target)
    told = model.told(descriptor, targets)
    noise = seed_for(seed, descriptor)
    stored = _stored(model, told[level], noise)

    def draw(scratch):
        if stored is not None:
            return stored[0]
        drawn = _draw(model, told[level], noise, scratch)
        return np.concatenate(list(_progress.track(drawn, len(level), f"generating structures ({descriptor})")))

    key = {"model": model_digest(model.trained), "objective": model.trained.config.objective, "told": digest(told)}
    key |= {"sampling": model.sampling, "seed": seed}
    if model.sampling.get("steering"):
        key["judge"] = getattr(model.trained.judge, "fingerprint", None)
    if stored is not None:
        key["images"] = digest(stored[0])
        print(f"structures from {stored[1]}: {descriptor}")
    found = judge_once("experiment", draw, descriptor, targets, level, key, n_jobs)
    return found.assign_attrs({"seed": seed} | {f"sampling_{k}": v for k, v in model.sampling.items()})


def judge_once(step, draw, descriptor, targets, level, key, n_jobs=-1):
    """:func:`judge` what ``draw(scratch)`` draws for targets, and keep it in the cache.

    `step` is what the drawing runs through (``inflate_lib._cache.STEPS``), and `key` what else it depends on.
    """

    def make(target, scratch):
        save_dataset(judge(draw(scratch), descriptor, targets, level, n_jobs, scratch), target)

    key = {"descriptor": descriptor, "targets": digest(targets, level), **key}
    key["code"] = step_version(step) + added_version()
    return load_dataset(cached("experiment", key, make, ".nc"))


def run_held_out(
    model: Model,
    data: xr.Dataset,
    seed: int = 0,
    descriptor: str | None = None,
    n_jobs: int = -1,
    n: int | None = None,
) -> xr.Dataset:
    """One structure for each held-out structure in the training range: behind every accuracy that is stated.

    The model card, README and the chapters ask in this way, with the seed and the sampling of the recipe, and so state
    the same numbers. The noise is not that of :func:`run_experiment` with the same seed. Parameters are those of it and
    of :func:`held_out_targets`.
    """
    whole_number("seed", seed, 0)
    workers(n_jobs)
    whole_number("n", n, 1, optional=True)
    descriptor = descriptor or model.name
    targets, _ = held_out_targets(data, descriptor, model, n, seed)
    return run_experiment(model, targets, 1, held_out_seed(seed), descriptor, n_jobs)


def held_out_seed(seed):
    """The seed of the noise of :func:`run_held_out`, for what is to be compared with it."""
    return seed_for(seed, "held out")


def judge(
    images: np.ndarray,
    descriptor: str,
    targets: np.ndarray,
    level: np.ndarray | None = None,
    n_jobs: int = -1,
    folder: Path | None = None,
) -> xr.Dataset:
    """Label, inflate and describe images that were drawn for targets.

    Parameters
    ----------
    images : (n, 28, 28) array_like
    descriptor : str
    targets : (k, N) float
    level : (n,) int, optional
        Number of the target that each image was drawn for; by default one image per target.
    n_jobs, folder
        See :func:`inflate_lib.simulate_dataset`.

    Returns
    -------
    xarray.Dataset
        As :func:`inflate_lib.simulate_dataset` gives it, with the variables ``level``, ``target`` (structure,
        component) and ``valid`` besides: the drawing is one structure, not a broken one of which the largest piece was
        taken, and it converged; of those that are not, none counts as ``buildable``. Images that give no structure
        keep their row.
    """
    data = simulate.simulate_dataset(images, n_jobs=n_jobs, folder=folder)
    whole = np.array([is_whole(image) for image in images])
    return as_experiment(data, descriptor, targets, level, data["converged"].values & whole)


def as_experiment(data, descriptor, targets, level=None, valid=None):
    """Simulated structures as an experiment: what each was meant for, and whether it counts."""
    level = np.arange(len(targets)) if level is None else np.asarray(level)
    valid = data["converged"].values if valid is None else valid
    return data.assign(
        level=("structure", level, {"long_name": "number of the target"}),
        target=(("structure", "component"), targets[level], {"long_name": f"target {descriptor}", "units": "1"}),
        valid=("structure", valid, {"long_name": "one structure that converges"}),
        buildable=data["buildable"] & valid,
    ).assign_attrs(descriptor=descriptor)


def check_targets(model, descriptor, targets, extrapolate=False):
    """Targets as an array (k, N), refused where they lie outside the range that the model was trained on.

    Raises
    ------
    ValueError
        With the range, for targets outside it. With `extrapolate` it is a warning instead.
    """
    components = get_descriptor(descriptor).length
    targets = numbers("targets", targets, f"finite numbers of shape (k, {components})")
    if targets.size == 0 or targets.size % components:
        raise ValueError(f"targets for {descriptor} must have shape (k, {components}), not {targets.shape}")
    targets = targets.reshape(-1, components)
    low, high = _target_range(model, descriptor)
    fits = _fits(low, high, targets)
    outside = ~fits.all(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        column = int(np.argmin(fits[row]))
        what = f"target {row} asks for {get_descriptor(descriptor).components[column]} = {targets[row, column]:.4g}"
        seen = f"{low[column]:.4g} to {high[column]:.4g}"
        many = f"{outside.sum()} of {len(targets)} targets for {descriptor} lie outside the training data"
        text = f"{many}: {what}, where structures from {seen} were seen"
        if not extrapolate:
            raise ValueError(f"{text}. Ask for something within that range, or say extrapolate=True.")
        warnings.warn(f"{text}. Expect poor structures.", stacklevel=3)
    return targets


def inside(model, descriptor, targets):
    """Which targets (k, N) lie within the range of the training data in every component, (k,) bool."""
    return _fits(*_target_range(model, descriptor), targets).all(axis=1)


def _target_range(model, descriptor):
    """Least and largest value of each component of a descriptor that a model was trained on, (N,) each."""
    if len(model.condition_min) == get_descriptor(descriptor).length:
        return model.condition_min, model.condition_max
    asked = columns(descriptor, PARTS)  # of a model for all descriptors
    return model.condition_min[asked], model.condition_max[asked]


def held_out_targets(
    data: xr.Dataset, descriptor: str, model: Model | None = None, n: int | None = None, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Targets that real structures reach which no model was trained on, so that each can be achieved.

    Parameters
    ----------
    data : xarray.Dataset
        Simulated structures, all of them.
    descriptor : str
    model : inflate_lib.models.Model, optional
        Leave structures out whose descriptor lies outside its training range.
    n : int, optional
        How many, drawn without repetition; all of them where it is None, or there are fewer.
    seed : int
        Of the draw.

    Returns
    -------
    targets : (n, N) float
    rows : (n,) int
        Which structures of `data` they belong to.
    """
    whole_number("seed", seed, 0)
    whole_number("n", n, 1, optional=True)
    usable = np.flatnonzero(data["converged"].values & held_out(data.sizes["structure"]))
    order = np.random.default_rng(seed).permutation(usable)
    matrix = descriptor_matrix(data, descriptor)
    rows = order if model is None else order[inside(model.trained, descriptor, matrix[order])]
    return matrix[rows[:n]], rows[:n]


def model_digest(model):
    """What a model is, to the last bit."""
    weights = [value.numpy() for _, value in sorted(model.net.state_dict().items())]
    return digest(*weights, model.condition_min, model.condition_max)


def _stored(model, told, seed):
    """Images drawn elsewhere (:mod:`inflate_lib.models.remote`), and which file holds them; None where there are none.

    Of this very model and noise, and for what it is told, whose last digits depend on the processor.
    """
    wanted = {"weights": model.trained.fingerprint, "seed": seed, "sampling": dict(model.sampling)}
    for path in sorted(paths.PRETRAINED.glob("*/drawings/*.safetensors")):
        tensors, record = storage.read(path, "drawing")
        for name in (name for name, about in record.items() if wanted.items() <= about.items()):
            asked = tensors[f"{name}.told"].numpy()
            if asked.shape == told.shape and np.allclose(asked, told, rtol=1e-6, atol=1e-9, equal_nan=True):
                return tensors[f"{name}.images"].numpy() / np.float32(255), path.name
    return None


def _draw(model, told, seed, folder):
    """Images piece by piece, with the number in each; a piece that a killed run has left in `folder` is not redone."""
    for start in range(0, len(told), PIECE):
        path = folder / f"images-{start:06d}.npy"
        if path.exists():
            images = np.load(path)
        else:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "[0-9]+ of [0-9]+ conditions lie outside")  # said once already
                images = generate(model.trained, told[start : start + PIECE], seed=seed, start=start, **model.sampling)
            with draft(path) as place:
                np.save(place, images)
        yield len(images), images


def _fits(low, high, targets):
    """Which components lie within the range of the training data; NaN does not."""
    slack = 1e-9 * np.maximum(1, np.abs(high))  # rounding
    return (targets >= low - slack) & (targets <= high + slack)
