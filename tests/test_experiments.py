"""Experiments: what models are trained on, and which weights are used."""

import numpy as np
import pytest
import xarray as xr

from inflate_lib.augmentation import apply_variants, augment
from inflate_lib.datasets import held_out
from inflate_lib.experiments import training_pairs
from inflate_lib.sources import load_sevens


@pytest.fixture(scope="module")
def data():
    """Forty embedded digits with invented descriptors, each of which tells which structure it belongs to."""
    images = load_sevens("digits").images[:40]
    number = np.arange(40.0)
    converged = number != 3
    axes = np.repeat(number, 60).reshape(40, 30, 2)
    return xr.Dataset(
        {
            "image": (("structure", "row", "column"), images),
            "converged": ("structure", converged),
            "height": ("structure", number),
            "width": ("structure", number / 2),
            "hull_area": ("structure", number / 3),
            "medial_axis": (("structure", "point", "axis"), axes),
        },
        attrs={"source": "digits"},
    )


def test_every_tenth_structure_is_held_out():
    assert np.flatnonzero(held_out(40)).tolist() == [9, 19, 29, 39]
    assert held_out(6265).sum() == 626 and not held_out(9).any()


@pytest.mark.parametrize("n_augmented", [36, 100, 10**6])
def test_no_variant_of_a_held_out_structure_is_trained_on(data, n_augmented):
    images, conditions = training_pairs(data, "height", n_augmented)
    seen = set(conditions[:, 0].astype(int))
    assert seen == set(range(40)) - {3, 9, 19, 29, 39}  # 3 did not converge
    assert len(images) == len(conditions) <= n_augmented
    hidden = data["image"].values[held_out(40)]
    variants = {image.tobytes() for image in apply_variants(hidden, augment(hidden))}
    assert not variants & {image.tobytes() for image in images}


def test_the_split_follows_the_position_in_the_whole_data_set(data):
    """A structure that fails must not move the others into or out of the held-out part."""
    failed = data.assign(converged=("structure", np.arange(40) >= 5))
    kept = set(training_pairs(failed, "height", 100)[1][:, 0].astype(int))
    assert kept == set(range(5, 40)) - {9, 19, 29, 39}
