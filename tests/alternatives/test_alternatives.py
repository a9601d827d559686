"""Baselines and surrogate: retrieval is exact, the autoencoder's bound is right, the surrogate learns."""

import numpy as np
import pytest
import torch
import xarray as xr
from torch.distributions import Bernoulli, Normal, kl_divergence

from inflate_lib import paths
from inflate_lib.alternatives import ablation, surrogate
from inflate_lib.alternatives.autoencoder import (
    Autoencoder,
    _kl_to_standard_normal,
    _nearest_width,
    _reconstruction_nll,
    _TrainedAutoencoder,
)
from inflate_lib.alternatives.retrieval import random_structures, retrieved_structures
from inflate_lib.datasets.split import training_rows
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.diffusion import TrainedModel, TrainingConfig, generate
from inflate_lib.diffusion.loop import fit
from inflate_lib.diffusion.randomness import initialised
from inflate_lib.experiments.metrics import errors
from inflate_lib.experiments.run import check_targets, held_out_targets, run_experiment
from inflate_lib.models.weights import Model
from inflate_lib.structures.labels import label_image
from inflate_lib.structures.sources import load_sevens

RNG = np.random.default_rng(3)


@pytest.fixture(scope="module")
def data():
    """Sixty embedded digits with invented descriptors that are simple functions of the number of the structure."""
    images = load_sevens("digits").images[:60]
    number = np.arange(60.0)
    axes = np.zeros((60, 30, 2))
    axes[:, :, 0] = np.linspace(0, 0.01, 30) * number[:, None]
    axes[:, :, 1] = np.linspace(0, 1, 30)
    return xr.Dataset(
        {
            "image": (("structure", "row", "column"), images),
            "label": (("structure", "row", "column"), np.array([label_image(image) for image in images], np.float32)),
            "converged": ("structure", number != 4),
            "height": ("structure", 1 + number / 60),
            "width": ("structure", 2 - number / 60),
            "hull_area": ("structure", 0.5 + number / 100),
            "medial_axis": (("structure", "point", "axis"), axes),
            "buildable": ("structure", np.ones(60, bool)),
            "flaw": ("structure", np.full(60, "", object)),
        },
        attrs={"source": "digits"},
    )


# --- targets -------------------------------------------------------------------------------------------------------


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


# --- structures that exist -----------------------------------------------------------------------------------------


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


# --- autoencoder ---------------------------------------------------------------------------------------------------


def test_kl_is_that_of_torch():
    mean, log_variance = torch.randn(7, 5), torch.randn(7, 5)
    theirs = kl_divergence(Normal(mean, (log_variance / 2).exp()), Normal(0.0, 1.0)).sum(dim=1)
    torch.testing.assert_close(_kl_to_standard_normal(mean, log_variance), theirs)
    assert _kl_to_standard_normal(torch.zeros(1, 5), torch.zeros(1, 5)).item() == 0


def test_reconstruction_is_the_likelihood_of_bright_and_dark_pixels():
    images, decoded = torch.rand(6, 28, 28), torch.rand(6, 28, 28)
    dark = -Bernoulli(decoded).log_prob(torch.zeros_like(images)).flatten(1).sum(dim=1)
    torch.testing.assert_close(_reconstruction_nll(torch.zeros_like(images), decoded), dark)
    bright = (images > 0.5).float()
    expected = -Bernoulli(decoded).log_prob(bright).flatten(1).sum(dim=1)
    torch.testing.assert_close(_reconstruction_nll(bright, decoded), expected)
    # A grey pixel is bright in its share of the cases, so that no other probability serves it better than its grey.
    for other in (decoded, 0.9 * images, 0.1 + 0.9 * images):
        assert (_reconstruction_nll(images, other) > _reconstruction_nll(images, images)).all()


@pytest.mark.parametrize(("n_conditions", "n_parameters"), [(1, 369_721), (60, 574_361)])
def test_the_autoencoder_is_as_large_as_the_model_beside_it(n_conditions, n_parameters):
    net = Autoencoder(n_conditions, _nearest_width(n_conditions, n_parameters))
    assert net.n_parameters == pytest.approx(n_parameters, rel=0.05)


def test_what_the_autoencoder_draws_depends_on_seed_number_and_target_alone():
    net = initialised(lambda: Autoencoder(1, 4), seed=0)
    model = _TrainedAutoencoder(net, np.array([0.0]), np.array([2.0]), 0, 0.0)
    images = model.generate(np.array([[0.5], [1.0], [1.5]]), seed=1)
    assert images.shape == (3, 28, 28) and 0 <= images.min() and images.max() <= 1
    np.testing.assert_allclose(model.generate(np.array([[0.5], [1.0]]), seed=1), images[:2], atol=1e-6)
    assert not np.allclose(model.generate(np.array([[0.5]]), seed=2), images[:1], atol=1e-6)


# --- surrogate -----------------------------------------------------------------------------------------------------


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


def test_a_network_learns_a_linear_map():
    """The training loop, on a problem with a known answer."""
    weights = torch.randn(6, 2)
    x = torch.randn(500, 6)
    y = x @ weights
    net = initialised(lambda: torch.nn.Linear(6, 2), seed=0)
    history, _ = fit(net, lambda rows, _: (net(x[rows]) - y[rows]).square().mean(), 500, 600, 64, 0.05)
    torch.testing.assert_close(net.weight.T, weights, atol=1e-2, rtol=0)
    assert history[-1] < 1e-4 * history[0] and len(history) == 20


def test_training_that_was_interrupted_ends_as_if_it_had_not_been(tmp_path):
    x = torch.randn(50, 3)

    def trained(folder, stop=None):
        net = initialised(lambda: torch.nn.Linear(3, 1), seed=0)
        calls = []

        def loss(rows, generator):
            calls.append(1)
            if len(calls) == stop:
                raise KeyboardInterrupt
            return (net(x[rows]) + torch.randn(1, generator=generator)).square().mean()

        history, _ = fit(net, loss, 50, 40, 8, 0.05, seed=5, folder=folder)
        return net.weight.detach().clone(), history, len(calls)

    whole = trained(None)
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path, stop=24)
    weights, history, calls = trained(tmp_path)
    assert calls == 40 - 22  # the last checkpoint was after 22 steps
    assert torch.equal(weights, whole[0]) and history == whole[1]


def test_a_loss_that_is_lost_is_an_error():
    net = torch.nn.Linear(1, 1)
    with pytest.raises(FloatingPointError, match="the training loss became nan between steps 0 and 1"):
        fit(net, lambda rows, _: net.weight.sum() * torch.nan, 5, 20)


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


# --- ablations -----------------------------------------------------------------------------------------------------


def test_variants_of_sampling_change_one_thing():
    base = {"sampler": "ddim", "steps": 50, "eta": 1.0, "guidance": 1.0}
    variants = ablation._sampling_variants(base)
    assert {options["guidance"] for (group, _), options in variants.items() if group == "guidance"} == {0, 1, 2, 3, 5}
    assert {options["guidance"] for (group, _), options in variants.items() if group == "sampler"} == {1}
    assert variants["sampler", "DDIM, 50 steps"] == base
    assert [o["steps"] for (_, name), o in variants.items() if name.startswith("DPM")] == [10, 20, 50]
    assert variants["sampler", "ancestral, all steps"]["sampler"] == "ancestral"


def test_variants_of_training_change_one_thing_and_are_recipes():
    base = {"steps": 10, "objective": "v", "ema_decay": 0.99, "vlb_weight": 0.001}
    variants = ablation.training_variants(base)
    changed = {name: {k for k in options if options[k] != base.get(k)} for (_, name), (options, _) in variants.items()}
    assert changed["of this profile"] == set() and changed["without EMA"] == {"ema_decay"}
    assert changed["ε-prediction"] == {"objective"} and changed["without the VLB term"] == {"vlb_weight"}
    assert all(options == base for (group, _), (options, n) in variants.items() if group == "data" and n)
    for options, _ in variants.values():
        TrainingConfig.from_dict(options)
    assert ("recipe", "v-prediction") in ablation.training_variants({**base, "objective": "epsilon"})


def test_seeds_are_put_together():
    import pandas as pd

    runs = pd.DataFrame({"group": ["a"] * 3, "variant": ["x", "x", "y"], "seed": [0, 1, 0]})
    runs = runs.assign(**{"R²": [0.5, 0.7, 0.1], "median error": [4.0, 2.0, 9.0], "valid": [90.0, 94.0, 50.0]})
    table = ablation.over_seeds(runs).set_index("variant")
    assert table.loc["x", ["seeds", "R²", "R² low", "R² high"]].tolist() == pytest.approx([2, 0.6, 0.5, 0.7])
    assert table.loc["y", "seeds"] == 1 and table.loc["x", "median error"] == 3
