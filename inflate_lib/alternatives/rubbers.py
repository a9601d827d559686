"""Beyond the paper: structures of two rubbers, simulated, and a model that draws them (:mod:`.patterns`)."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

from inflate_lib import paths
from inflate_lib._cache import cached, digest
from inflate_lib._checks import whole_number
from inflate_lib.alternatives.patterns import FAMILIES, RATIO, pattern, stiffness_of
from inflate_lib.datasets.pairs import held_out
from inflate_lib.datasets.simulate import code_of_dataset, simulate_dataset
from inflate_lib.datasets.storage import load_dataset, save_dataset
from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.descriptors.registry import JOINT
from inflate_lib.diffusion import TrainedModel, generate
from inflate_lib.diffusion.randomness import seed_for
from inflate_lib.experiments.calibrate import questions
from inflate_lib.experiments.run import as_experiment
from inflate_lib.models import Model
from inflate_lib.models.calibration import Calibration
from inflate_lib.models.reach import load_reach
from inflate_lib.models.recipe import EDITION, Recipe
from inflate_lib.models.remote import train_and_test
from inflate_lib.models.train import training_set
from inflate_lib.structures import sources
from inflate_lib.structures.augmentation import apply_variants
from inflate_lib.structures.labels import FRAME, is_whole

FILE = "rubbers/joint.safetensors"  # in the folder of a profile's weights, the reach of two rubbers beside it


def simulate_rubbers(images: np.ndarray, maps: np.ndarray, ratio: float = RATIO, **how) -> xr.Dataset:
    """Inflate and describe structures of two rubbers.

    Parameters
    ----------
    images, maps : (n, 28, 28) array
        Grey images and the maps of their stiff rubber.
    ratio : float
    how
        ``n_jobs`` and the like, see :func:`inflate_lib.simulate_dataset`.

    Returns
    -------
    xarray.Dataset
        That of :func:`inflate_lib.simulate_dataset`, with the variable ``stiff``, the maps, and the attribute
        ``stiffness_ratio``. Stresses are in units of the soft rubber's.
    """
    if len(images) != len(maps):
        raise ValueError(f"maps: there are {len(maps)} of them for {len(images)} images")
    stiffness = np.array([_stiffness_or_soft(*pair, ratio) for pair in zip(images, maps, strict=True)])
    data = simulate_dataset(images, stiffness=stiffness, **how)
    data["stiff"] = ("structure", "row", "column"), np.asarray(maps), {"long_name": "map of the stiff rubber"}
    return data.assign_attrs(stiffness_ratio=float(ratio))


def _stiffness_or_soft(image, stiff, ratio):
    """The stiffness, or that of one rubber where the image holds no structure, which the data set will say."""
    try:
        return stiffness_of(image, stiff, ratio)
    except ValueError:
        return np.ones((FRAME, FRAME))


def simulated_rubbers(
    source: str = "auto",
    n_structures: int | None = None,
    seed: int = 0,
    ratio: float = RATIO,
    n_jobs: int | None = None,
) -> xr.Dataset:
    """The sevens, each with a pattern of two rubbers, simulated once and kept on disk.

    Parameters
    ----------
    source, n_structures, n_jobs
        See :func:`inflate_lib.simulated_sevens`.
    seed : int
        Of the patterns: their family is drawn as well.
    ratio : float
        Stiffness of the second rubber, in that of the first.

    Returns
    -------
    xarray.Dataset
        See :func:`simulate_rubbers`, with the variable ``family``.
    """
    whole_number("seed", seed, 0)
    sevens = sources.load_sevens(source, limit=n_structures)
    rng = np.random.default_rng([seed, 20])
    families = rng.choice(FAMILIES, len(sevens.images))
    maps = np.array([pattern(image, family, rng) for image, family in zip(sevens.images, families, strict=True)])

    def make(target, scratch):
        data = simulate_rubbers(sevens.images, maps, ratio, n_jobs=n_jobs, folder=scratch)
        data["family"] = "structure", families.astype(object), {"long_name": "family of patterns"}
        save_dataset(data.assign_attrs(source=sevens.source, source_description=sevens.description), target)

    key = {"images": digest(sevens.images, maps), "ratio": float(ratio), "code": code_of_dataset()}
    return load_dataset(cached("dataset", key, make, ".nc"))


def two_channels(images: np.ndarray, maps: np.ndarray, variants: np.ndarray | None = None) -> np.ndarray:
    """Structures of two rubbers as a model sees them: grey images and maps, flipped and shifted together.

    Parameters
    ----------
    images, maps : (n, 28, 28) array
    variants : (m, 4) int, optional
        From :func:`inflate_lib.structures.augmentation.augment`; None: as they are.

    Returns
    -------
    (m, 2, 28, 28) uint8
    """
    maps = np.uint8(255) * np.asarray(maps)
    if variants is not None:
        images, maps = apply_variants(images, variants), apply_variants(maps, variants, repeat_edge=True)
    return np.stack([images, maps], axis=1)


def train_rubbers(data: Sequence[xr.Dataset], recipe: Recipe, folder: Path, threads: int | None = None) -> TrainedModel:
    """Train the joint model of a recipe on structures of two rubbers.

    Parameters
    ----------
    data : sequence of xarray.Dataset
        From :func:`simulated_rubbers`, with different seeds: each has every seven once, so that the rule of
        :func:`inflate_lib.datasets.pairs.held_out` keeps the same sevens from all of them.
    recipe : Recipe
        Of the joint model of one rubber; `n_augmented` pairs are taken from each data set.
    folder : Path
        For checkpoints, from which a training that was stopped goes on.
    threads : int, optional
        CPU threads.
    """
    config = replace(recipe.config(JOINT), image_channels=2)
    sets = [training_set(JOINT, recipe, one) for one in data]
    about = sets[0].about | {"data": digest(*(one["stiff"].values for one in data)), "patterns": len(sets)}
    about |= {"stiffness_ratio": float(data[0].attrs["stiffness_ratio"]), "sampling": dict(recipe.sampling)}
    seen, unseen = [], []
    for one in sets:
        maps, out = one.data["stiff"].values, held_out(one.data.sizes["structure"])
        here = one.data["converged"].values
        seen.append((two_channels(one.originals[0], maps[here & ~out], one.variants), one.pairs[1]))
        unseen.append((two_channels(one.unseen[0], maps[here & out]), one.unseen[1]))
    pairs, kept = ([np.concatenate(part) for part in zip(*parts, strict=True)] for parts in (seen, unseen))
    return train_and_test(
        (pairs[0], pairs[1]), (kept[0], kept[1]), config, about, folder, "training two rubbers", threads, folder
    )


def load_rubber_model(profile: str = EDITION) -> Model:
    """The committed joint model of two rubbers, with what they reach: it draws images and maps, (m, 2, 28, 28).

    Raises
    ------
    FileNotFoundError
        There are no such weights of this profile.
    """
    file = paths.PRETRAINED / profile / FILE
    trained = TrainedModel.load(file)
    return Model(JOINT, trained, trained.metadata["sampling"], reach=load_reach(file.parent))


def rubber_experiment(
    model: Model, targets: np.ndarray, n_per_target: int, seed: int, descriptor: str, n_jobs: int | None = None
) -> xr.Dataset:
    """Draw structures of two rubbers for each target, inflate and describe them.

    Parameters
    ----------
    model : Model
        From :func:`load_rubber_model`.
    targets : (k, N) float
        Also beyond what the model was trained on.
    n_per_target, seed, descriptor
        See :func:`inflate_lib.experiments.run.run_experiment`, whose noise for the same seed is the same.
    n_jobs : int, optional
        Processes of the simulation.

    Returns
    -------
    xarray.Dataset
        As of :func:`inflate_lib.experiments.run.judge`, with the variable ``stiff``.
    """
    level = np.repeat(np.arange(len(targets)), n_per_target)
    told = model.told(descriptor, np.asarray(targets, dtype=float))[level]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "[0-9]+ of [0-9]+ conditions lie outside")
        drawn = generate(model.trained, told, seed=seed_for(seed, descriptor), **model.sampling)
    images, maps = drawn[:, 0], drawn[:, 1] > 0.5
    data = simulate_rubbers(images, maps, model.trained.metadata["stiffness_ratio"], n_jobs=n_jobs, progress_text="")
    valid = data["converged"].values & np.array([is_whole(image) for image in images])
    return as_experiment(data, descriptor, np.asarray(targets, dtype=float), level, valid)


def calibrated(model: Model, data: xr.Dataset, descriptor: str, n: int = 300, seed: int = 0) -> Model:
    """The same model, calibrated for one descriptor, as models of one rubber are; as it is where it does not listen."""
    asked = questions(data, descriptor, n, seed)
    answer = rubber_experiment(model.sampled(), asked, 1, seed_for(seed, "calibration"), descriptor)
    valid = answer["valid"].values
    try:
        fit = Calibration.fit(asked[valid], descriptor_matrix(answer, descriptor)[valid])
    except ValueError:
        return model
    return replace(model, calibrations={**model.calibrations, descriptor: fit})
