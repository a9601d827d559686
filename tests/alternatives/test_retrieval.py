"""Retrieval is exact, and takes nothing that is held out; chance follows its seed."""

import numpy as np
import pytest
from invented import invented_data

from inflate_lib.alternatives.retrieval import random_structures, retrieved_structures
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.experiments.metrics import errors
from inflate_lib.experiments.run import held_out_targets


@pytest.fixture(scope="module")
def data():
    return invented_data()


@pytest.mark.parametrize("descriptor", ["height", "box", "area", "axis"])
def test_retrieval_finds_the_structure_itself(data, descriptor):
    rows = training_rows(data)[::7]
    found = retrieved_structures(data, descriptor, descriptor_matrix(data, descriptor)[rows])
    np.testing.assert_array_equal(found["image"].values, data["image"].values[rows])
    assert errors(found, descriptor).max() == 0


def test_retrieval_never_takes_a_held_out_structure(data):
    targets, _ = held_out_targets(data, "height")
    found = retrieved_structures(data, "height", targets)
    apart = np.abs(found["height"].values[:, None] - data["height"].values[training_rows(data)]).min(axis=1)
    assert (apart == 0).all() and errors(found, "height").min() > 0
    assert np.abs(found["height"].values - targets[:, 0]).max() == pytest.approx(1 / 60)


def test_random_structures_come_from_the_training_data_and_follow_the_seed(data):
    targets = np.full((40, 1), 1.3)
    first, again, other = (random_structures(data, "height", targets, seed)["height"].values for seed in (1, 1, 2))
    assert (first == again).all() and (first != other).any()
    assert set(first) <= set(data["height"].values[training_rows(data)])
