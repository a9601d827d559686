"""The surrogate: what it is shown is where it stands, and it learns what can be seen."""

import numpy as np
import pytest
import torch
import xarray as xr
from invented import invented_data

from inflate_lib import describe, inflate, paths, simulated_sevens
from inflate_lib.alternatives import surrogate
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.descriptors.registry import PARTS
from inflate_lib.diffusion import TrainedModel, TrainingConfig
from inflate_lib.models import load_model
from inflate_lib.models import surrogate as models_surrogate

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
    trained = surrogate.train_surrogate(seen, steps=600, rows=np.arange(60))
    for name in ("height", "width", "area"):
        found, truth = trained.predict(seen["image"].values, name), descriptor_matrix(seen, name)
        assert ((found - truth) ** 2).mean() < 0.05 * truth.var(), name
    again = surrogate.train_surrogate(seen, steps=600, rows=np.arange(60))  # from the cache
    blank = np.concatenate([seen["image"].values[:2], np.zeros((1, 28, 28), np.uint8)])
    answers = again.predict(blank, "axis")
    np.testing.assert_allclose(answers[:2], trained.predict(blank[:2], "axis"))
    assert np.isnan(answers[2]).all() and np.isfinite(answers[:2]).all()


def test_structures_that_sag_beside_their_foot_are_shown_eight_times(data, monkeypatch):
    """As are their mirror images; unless no axis is asked for."""
    shown = []
    monkeypatch.setattr(surrogate, "train_once", lambda kind, net, loss, pairs, *rest: shown.append(pairs) or 0.0)
    axes = data["medial_axis"].values.copy()
    axes[:, 1:, 0] = RNG.uniform(-0.01, 0.01, axes[:, 1:, 0].shape)
    axes[[2, 5], 1:, 0] += np.array([0.1, -0.1])[:, None]
    seen = data.assign(medial_axis=(data["medial_axis"].dims, axes))
    for answers in ("height+axis", "height"):
        surrogate.train_surrogate(seen, answers=answers, rows=np.arange(10))
    assert shown == [2 * (8 + 2 * 8), 2 * 10]


def untrained(told):
    """A model of a descriptor, and a surrogate that answers with the same, whose scales differ."""
    one = get_descriptor(told)
    parts = [get_descriptor(part).length for part in one.parts] if one.any_part else []
    config = TrainingConfig(channels=(4, 8), embedding=16, steps=1, parts=parts)
    low, mean = RNG.random(one.length), RNG.random(one.length)
    model = TrainedModel(config.make_net(one.length), config, low, low + 1 + RNG.random(one.length))
    judge = models_surrogate.Surrogate(None, told, mean, 0.5 + RNG.random(one.length), 0.0)
    return model, judge


@pytest.mark.parametrize(("told", "parts"), [("height", 1), ("box", 1), ("joint", len(PARTS))])
def test_a_critic_finds_nothing_amiss_where_the_surrogate_expects_the_target(told, parts):
    model, judge = untrained(told)
    target = model.condition_min + RNG.random((3, len(model.condition_min)))
    answers = torch.from_numpy((target - judge.mean) / judge.scale).float()
    judge.net = Fixed(answers)
    y, x = torch.from_numpy(model.scaled(target)).float(), torch.zeros(3, 1, 28, 28)
    judged = models_surrogate.critic(judge, model, told)
    assert judged(x, y).abs().max() < 1e-10
    judge.net.answers = answers + 0.1
    assert torch.allclose(models_surrogate.critic(judge, model, told)(x, y), torch.tensor(0.01 * parts), rtol=1e-4)


def test_a_critic_passes_over_what_was_not_asked_for():
    model, judge = untrained("joint")
    judge.net = Fixed(torch.full((2, len(judge.mean)), 1e3))
    target = np.full((2, len(judge.mean)), np.nan)
    target[0, PARTS.index("area")] = 1e3 * judge.scale[2] + judge.mean[2]
    y = torch.from_numpy(model.scaled(target)).float()
    judge.net.answers.requires_grad_()
    found = models_surrogate.critic(judge, model, "joint")(torch.zeros(2, 1, 28, 28), y)
    assert found[0] < 1e-4 and found[1] == 0  # the area is met, and of the second nothing was wanted
    found.sum().backward()
    assert judge.net.answers.grad.isfinite().all()


class Fixed(torch.nn.Module):
    """It answers the same to everything."""

    def __init__(self, answers):
        super().__init__()
        self.answers = answers

    def forward(self, labels):
        return self.answers


def test_one_that_sees_blends_learns_from_them_as_well(data, tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "CACHE", tmp_path)
    blends = surrogate.blends_of(data, 12, seed=1)
    assert blends["converged"].mean() > 0.5 and blends.sizes["structure"] == 12
    plain, more = (surrogate.train_surrogate(data, steps=2, further=further) for further in (None, blends))
    image = data["image"].values[:1]
    assert plain.predict(image, "height") != more.predict(image, "height")
    assert np.array_equal(plain.mean, more.mean) and np.array_equal(plain.scale, more.scale)


def test_one_that_steers_learns_from_what_is_drawn(tmp_path, monkeypatch):
    """Each model draws its share for what training structures are, the joint one a seventh of it for each part."""
    monkeypatch.setattr(paths, "CACHE", tmp_path)
    data = simulated_sevens("digits", 30)
    models = [load_model(name).made_for("quick").sampled(steps=2) for name in ("height", "joint")]
    drawings = surrogate.drawings_of(models, data, 14, seed=1)
    assert drawings.sizes["structure"] == 7 + 7
    usable = drawings["converged"].values
    assert usable.sum() > 5
    again = describe(inflate(drawings["label"].values[usable][0]))
    assert drawings["height"].values[usable][0] == pytest.approx(again.height, rel=1e-12)
    blends = surrogate.blends_of(data, 4, seed=1)
    both = xr.concat([blends[list(drawings)], drawings], "structure")
    trained = surrogate.train_surrogate(data, steps=2, answers="joint", further=both)
    assert np.isfinite(trained.predict(data["image"].values[:1], "outline")).all()
