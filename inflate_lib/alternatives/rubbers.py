"""Beyond the paper: walls of two rubbers, the second of which is stiffer (its conclusion names the idea).

A structure is two images: the grey one, in which walls are encoded (:mod:`inflate_lib.structures.labels`), and beside
it a *map* of the stiff rubber, true where the wall is of it. What is asked of the map are the pixels of the
wall; a wall that grows beyond the frame takes the nearest of its edge. So image and map can be flipped and shifted
together, and stand for the flipped structure (:func:`two_channels`).
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr
from scipy import ndimage

from inflate_lib import paths
from inflate_lib._cache import cached, digest
from inflate_lib._checks import choice, positive_number, whole_number
from inflate_lib.datasets.pairs import held_out
from inflate_lib.datasets.simulate import code_of_dataset, simulate_dataset
from inflate_lib.datasets.storage import load_dataset, save_dataset
from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.descriptors.registry import JOINT
from inflate_lib.diffusion import TrainedModel, generate
from inflate_lib.diffusion.randomness import seed_for
from inflate_lib.experiments.calibrate import questions
from inflate_lib.experiments.run import as_experiment, is_whole
from inflate_lib.models import Model
from inflate_lib.models.calibration import Calibration
from inflate_lib.models.reach import load_reach
from inflate_lib.models.recipe import EDITION, Recipe
from inflate_lib.models.remote import train_and_test
from inflate_lib.models.train import training_set
from inflate_lib.structures import sources
from inflate_lib.structures.augmentation import apply_variants
from inflate_lib.structures.labels import FRAME, THICKNESS, WALL, as_grey, label_image, main_component, stages

FILE = "rubbers/joint.safetensors"  # in the folder of a profile's weights, the reach of two rubbers beside it
RATIO = 4.0  # stiffness of the second rubber, in that of the first
#: Grey levels of a picture of two rubbers.
LEVELS = {0: "outside", 64: "stiff wall", 127: "soft wall", 254: "void"}
_STIFF = 64
_CRUMB = 4  # pixels that a piece of one rubber must have
FAMILIES = ("side", "half", "bands", "patches")
_DIRECTIONS = {"right": (0, 1), "left": (0, -1), "top": (-1, 0), "bottom": (1, 0)}  # (row, column)


def pattern(image: np.ndarray, family: str, rng: np.random.Generator) -> np.ndarray:
    """A map of the stiff rubber for a grey image.

    Parameters
    ----------
    image : (28, 28) array
    family : {"side", "half", "bands", "patches"}
        The wall on the right, left, upper or lower side of the digit's line; all wall in one half of the frame,
        cut through the middle of the digit; stripes of equal width, 2 to 6 pixels, in any direction; or one to three
        discs, of 3 to 6 pixels in radius, around pixels of the digit.
    rng : numpy.random.Generator

    Returns
    -------
    (28, 28) bool
        Where the wall is stiff; False far from the wall.
    """
    digit = main_component(as_grey(image))
    spots = np.argwhere(digit)
    place = np.indices((FRAME, FRAME)).transpose(1, 2, 0)
    if choice("family", family, FAMILIES) == "side":
        # The wall lies on the side of the line to which its blurred image falls off.
        slope = np.stack(np.gradient(ndimage.gaussian_filter(np.pad(digit.astype(float), 4), 1.5)), -1)[4:-4, 4:-4]
        stiff = slope @ _direction(rng) < 0
    elif family == "half":
        stiff = (place - spots.mean(axis=0)) @ _direction(rng) > 0
    elif family == "bands":
        angle, width = rng.uniform(0, np.pi), rng.uniform(2, 6)
        stiff = (place @ [np.cos(angle), np.sin(angle)] / width + rng.uniform(0, 2)) % 2 < 1
    else:
        centres = spots[rng.integers(len(spots), size=rng.integers(1, 4))]
        radii = rng.uniform(3, 6, size=len(centres))
        stiff = (np.hypot(*(place[..., None, :] - centres).transpose(3, 0, 1, 2)) < radii).any(axis=-1)
    near = ndimage.maximum_filter(digit, size=2 * THICKNESS + 1)
    return stiff & near


def _direction(rng):
    return _DIRECTIONS[rng.choice(list(_DIRECTIONS))]


def stiffness_of(
    image: np.ndarray, stiff: np.ndarray, ratio: float = RATIO, wall: int = THICKNESS, clamped: str = "bottom"
) -> np.ndarray:
    """The stiffness of each pixel of ``label_image(image)``: what :func:`inflate_lib.inflate` is told of two rubbers.

    Parameters
    ----------
    image : (28, 28) array
        Grey image.
    stiff : (28, 28) array
        Map of the stiff rubber, bool; or a grey image, which is stiff where it is brighter than half.
    ratio : float
        Stiffness of that rubber; 1 is the paper's.
    wall, clamped
        As for :func:`inflate_lib.label_image`.

    Returns
    -------
    (28, 28) float
        1 or `ratio`; the map, moved to the ground as the label image is.
    """
    positive_number("ratio", ratio)
    done = stages(image, wall=wall, clamped=clamped)
    before, after = np.argwhere(done.composite)[0], np.argwhere(done.shifted)[0]
    moved = np.pad(as_grey(stiff) > 0.5, wall, mode="edge")  # on the canvas that the wall has grown on
    moved = np.roll(moved, after - before, axis=(0, 1))
    return np.where(moved[wall:-wall, wall:-wall], ratio, 1.0)


def castable(stiffness: np.ndarray, label: np.ndarray) -> np.ndarray:
    """The same stiffness, changed where a rubber could not be cast: crumbs, and parts that meet in a corner only.

    A *crumb* is a piece of fewer than four pixels; it becomes of the other rubber. Corners are filled up with the stiff
    one.

    Parameters
    ----------
    stiffness : (28, 28) float
        From :func:`stiffness_of`.
    label : (28, 28) float
        The label image.

    Returns
    -------
    (28, 28) float
    """
    wall = label == WALL
    stiff = wall & (stiffness > 1)
    stiff &= ~_crumbs(stiff)
    while True:  # stiff parts only grow
        corners, grown = _in_corners(stiff) | _in_corners(wall & ~stiff), _crumbs(wall & ~stiff)
        for row, column in np.ndindex(2, 2):
            grown[row : row + FRAME - 1, column : column + FRAME - 1] |= corners
        if not (grown & wall & ~stiff).any():
            return np.where(stiff, np.max(stiffness), 1.0)
        stiff |= grown & wall


def _crumbs(part):
    """(28, 28) bool: the pieces of a part, connected by sides, that are too small."""
    pieces, _ = ndimage.label(part)
    return part & (np.bincount(pieces.ravel()) < _CRUMB)[pieces]


def _in_corners(part):
    """(27, 27) bool: between which four pixels a part touches itself in the corner alone."""
    a, b, c, d = part[:-1, :-1], part[:-1, 1:], part[1:, :-1], part[1:, 1:]
    return (a & d & ~b & ~c) | (b & c & ~a & ~d)


def rubber_picture(image: np.ndarray, stiff: np.ndarray) -> np.ndarray:
    """A structure of two rubbers as one picture, (28, 28) uint8: grey levels 0, 64, 127, 254, which are ``LEVELS``."""
    return picture_of(label_image(image), stiffness_of(image, stiff, 2.0) > 1)


def picture_of(label: np.ndarray, stiff: np.ndarray | None = None) -> np.ndarray:
    """A label image as a picture, (28, 28) uint8; `stiff` (28, 28) bool is where its wall is of a stiff rubber."""
    picture = np.rint(254 * label).astype(np.uint8)
    return picture if stiff is None else np.where(stiff & (label == WALL), np.uint8(_STIFF), picture)


def is_picture(image: np.ndarray) -> bool:
    """Whether an image is a picture of two rubbers: of their grey levels alone, and with a stiff wall."""
    levels = set(np.unique(_as_levels(image)).tolist())
    return _STIFF in levels and levels <= {*LEVELS, 255}


def from_picture(picture: np.ndarray, wall: int = THICKNESS) -> tuple[np.ndarray, np.ndarray]:
    """Image and map of a structure of two rubbers, from a picture as of :func:`rubber_picture`.

    Raises
    ------
    ValueError
        Where a pixel has another grey level, or a stiff one is not where the wall around the void is.
    """
    levels = _as_levels(picture)
    if strange := sorted(set(np.unique(levels).tolist()) - {*LEVELS, 255}):
        meant = ", ".join(f"{level} ({name})" for level, name in LEVELS.items())
        raise ValueError(f"picture of two rubbers: its grey levels must be {meant}; it has {strange[0]} as well")
    stiff = levels == _STIFF
    image = np.where(stiff, 127, levels).astype(np.uint8)
    composite = stages(image, wall=wall).composite[wall:-wall, wall:-wall]
    if astray := int(np.sum(stiff & (composite != WALL))):
        raise ValueError(
            f"picture of two rubbers: {astray} pixels of level {_STIFF} are not in the wall, "
            f"which is {wall} pixels thick around the void"
        )
    return image, stiff


def _as_levels(picture):
    return np.rint(255 * as_grey(picture)).astype(np.uint8)


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
