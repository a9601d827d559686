"""What a model is trained on: augmented images with their descriptors, and where they come from (paper sec. 3.2)."""

import numpy as np

from inflate_lib._cache import digest
from inflate_lib.datasets.split import held_out
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.structures.augmentation import apply_variants, augment, augment_descriptors


def training_pairs(data, descriptor, n_augmented, seed=0):
    """Augmented images and descriptors to train on (paper sec. 3.2).

    Parameters
    ----------
    data : xarray.Dataset
        Simulated structures, all of them; those that did not converge and those of
        :func:`inflate_lib.datasets.split.held_out` are left out.
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
    matrix = descriptor_matrix(seen, descriptor)
    conditions = augment_descriptors(matrix, get_descriptor(descriptor).mirrored(matrix), variants)
    return apply_variants(images, variants), conditions


def _part(data, which):
    """The structures of a part that inflate."""
    return data.isel(structure=np.flatnonzero(data["converged"].values & which))


def _variants(images, n_augmented, seed):
    """As many flips and shifts as are wanted, or all."""
    return augment(images, min(n_augmented, len(augment(images))), seed=seed)


def _held_out(data):
    return held_out(data.sizes["structure"])


def _about(descriptor, data, n_augmented):
    """What a model was trained on, exactly."""
    get_descriptor(descriptor)
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
