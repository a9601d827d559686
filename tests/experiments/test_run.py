"""Targets of an experiment: refused where no model has seen the like, and held out where it must not have."""

import numpy as np
import pytest
from invented import invented_data

from inflate_lib import paths
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.diffusion import TrainedModel, TrainingConfig, generate
from inflate_lib.experiments.run import check_targets, held_out_targets, run_experiment
from inflate_lib.models.weights import Model


@pytest.fixture(scope="module")
def data():
    return invented_data()


@pytest.fixture
def model():
    """An untrained network that believes it has seen heights from 1 to 1.5."""
    config = TrainingConfig(channels=(4, 8), embedding=16, steps=1)
    return TrainedModel(config.make_net(1), config, np.array([1.0]), np.array([1.5]))


def test_targets_outside_the_training_range_are_refused_with_the_range(model):
    with pytest.raises(ValueError, match=r"1 of 3 targets for height.*target 1 asks for h = 1\.9.*from 1 to 1\.5 were"):
        check_targets(model, "height", [1.2, 1.9, 1.5])
    with pytest.raises(ValueError, match="extrapolate=True"):
        run_experiment(Model("height", model), [0.5], 1)
    with pytest.raises(ValueError, match=r"finite numbers of shape \(k, 1\), not \[nan\]"):
        check_targets(model, "height", [np.nan])
    with pytest.raises(ValueError, match=r"must have shape \(k, 2\), not \(3,\)"):
        check_targets(model, "box", [1.0, 1.2, 1.4])
    assert check_targets(model, "height", [1.0, 1.5]).shape == (2, 1)


def test_and_generated_on_request_with_one_warning(model, tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "CACHE", tmp_path)
    model = Model("height", model, {"sampler": "ddim", "steps": 2})
    for _ in range(2):  # from the cache as well
        with pytest.warns(UserWarning, match="lie outside the training data") as caught:
            found = run_experiment(model, [1.9], 2, extrapolate=True)
        assert len(caught) == 1
    assert found.sizes["structure"] == 2 and not found["valid"].any()


def test_components_of_axes_are_named():
    config = TrainingConfig(channels=(4, 8), embedding=16, steps=1)
    low, high = np.zeros(60), np.ones(60)
    axis = np.full(60, 0.5)
    axis[7] = 2.0
    with pytest.raises(ValueError, match="asks for y of point 3 = 2"):
        check_targets(TrainedModel(config.make_net(60), config, low, high), "axis", axis)


def test_structures_drawn_in_pieces_are_those_drawn_at_once(model):
    at_once = generate(model, np.linspace(1, 1.5, 5), seed=4, sampler="ddim", steps=2)
    pieces = [
        generate(model, part, seed=4, sampler="ddim", steps=2, start=start)
        for start, part in ((0, np.linspace(1, 1.5, 5)[:2]), (2, np.linspace(1, 1.5, 5)[2:]))
    ]
    np.testing.assert_allclose(np.concatenate(pieces), at_once, atol=1e-6)


def test_held_out_targets_belong_to_structures_that_no_model_has_seen(data, model):
    targets, rows = held_out_targets(data, "height")
    assert set(rows) == {9, 19, 29, 39, 49, 59} and not set(rows) & set(training_rows(data))
    np.testing.assert_array_equal(targets, descriptor_matrix(data, "height")[rows])
    assert set(held_out_targets(data, "height", Model("height", model))[1]) == {
        9,
        19,
        29,
    }  # the others are taller than 1.5
    assert len(held_out_targets(data, "height", n=2)[1]) == 2
    assert 4 not in training_rows(data)  # did not converge
