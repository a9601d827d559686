"""The surrogate: what it is shown is where it stands, and it learns what can be seen."""

import numpy as np
import pytest
from invented import invented_data

from inflate_lib import paths
from inflate_lib.alternatives import surrogate
from inflate_lib.descriptors import descriptor_matrix, get_descriptor

RNG = np.random.default_rng(3)


@pytest.fixture(scope="module")
def data():
    return invented_data()


def test_structures_are_moved_to_the_middle_wherever_they_stand():
    label = np.zeros((28, 28), np.float32)
    label[20:28, 3:11] = 0.5
    moved = np.array([np.roll(label, shift, axis=1) for shift in range(-3, 17)])
    centred = surrogate.centred(moved)
    assert (centred == centred[0]).all() and centred[0, 20:28, 10:18].all() and centred[0].sum() == label.sum()
    assert (surrogate.centred(label[None, :, ::-1]) == centred[:1, :, ::-1]).all()


def test_mirrored_answers_are_mirrored_twice_the_same():
    answers = RNG.random((4, 63))
    told = get_descriptor("height+width+area+axis")
    flipped = told.mirrored(answers)
    np.testing.assert_array_equal(flipped[:, :3], answers[:, :3])
    np.testing.assert_array_equal(flipped[:, 3::2], -answers[:, 3::2])
    np.testing.assert_array_equal(told.mirrored(flipped), answers)


@pytest.mark.slow
def test_the_surrogate_learns_what_can_be_seen_in_the_label(data, tmp_path, monkeypatch):
    """Answers that are sums over pixels and differ from one structure to the next: a network can learn them."""
    monkeypatch.setattr(paths, "CACHE", tmp_path)
    solid = (data["label"].values > 0).mean(axis=(1, 2))
    void = (data["label"].values == 1).mean(axis=(1, 2))
    seen = data.assign(height=("structure", void), hull_area=("structure", solid), width=("structure", solid + void))
    trained = surrogate.train_surrogate(seen, steps=800, rows=np.arange(60))
    for name in ("height", "width", "area"):
        found, truth = trained.predict(seen["image"].values, name), descriptor_matrix(seen, name)
        assert ((found - truth) ** 2).mean() < 0.05 * truth.var(), name
    again = surrogate.train_surrogate(seen, steps=800, rows=np.arange(60))  # from the cache
    blank = np.concatenate([seen["image"].values[:2], np.zeros((1, 28, 28), np.uint8)])
    answers = again.predict(blank, "axis")
    np.testing.assert_allclose(answers[:2], trained.predict(blank[:2], "axis"))
    assert np.isnan(answers[2]).all() and np.isfinite(answers[:2]).all()
