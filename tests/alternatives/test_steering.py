"""Steering by a surrogate: what it sees is the label image, what it adds hits the target, and 0 is plain sampling."""

import json

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch
from torch import nn

from inflate_lib import paths
from inflate_lib.alternatives.steering import _correction, steer
from inflate_lib.alternatives.surrogate import Surrogate, centred, soft_label
from inflate_lib.diffusion import TrainedModel, TrainingConfig, generate
from inflate_lib.models.weights import Model
from inflate_lib.plotting.evaluation import plot_controls
from inflate_lib.structures.labels import FRAME, label_image
from inflate_lib.structures.sources import load_sevens

DIGITS = load_sevens("digits").images
HEIGHT = slice(0, 1)


class Brightness(nn.Module):
    """A surrogate that expects the height to be the label image's mean, which is easy to check."""

    def forward(self, labels):
        return 10 * labels.mean(dim=(1, 2))[:, None] * torch.ones(63)


@pytest.fixture
def trained():
    return Surrogate(Brightness(), "height+width+area+axis", np.zeros(63), np.ones(63), 0.0)


@pytest.fixture(params=["epsilon", "v"])
def model(request):
    torch.manual_seed(0)
    config = TrainingConfig(channels=(4, 8), embedding=16, steps=1, objective=request.param)
    net = config.make_net(1).eval()
    for parameter in net.parameters():  # the last layer of an untrained network is zero
        parameter.data += 0.05 * torch.randn(parameter.shape)
    return Model("height", TrainedModel(net, config, np.array([1.0]), np.array([1.5])), {"sampler": "ddim"})


def test_soft_labels_of_sharp_drawings_are_their_label_images():
    compared = 0
    for image in DIGITS[::9]:
        sharp = label_image(image) == 1  # whole and without holes
        for moved in (sharp, np.roll(sharp, -2, axis=0)):
            hard = centred(label_image(moved)[None])
            soft = soft_label(torch.from_numpy(moved[None]).float()).numpy()
            assert np.abs(soft - hard).max() < 0.01
            compared += 1
    assert compared >= 20


def test_soft_labels_can_be_differentiated():
    """Where no two pixels are equally bright: of equals, a maximum takes any."""
    images = torch.rand(2, FRAME, FRAME, dtype=torch.float64, generator=torch.manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: soft_label(x).square().sum(dim=(1, 2)), images, fast_mode=True)


def test_a_correction_removes_most_of_a_small_error(trained):
    """Less where it would take pixels brighter than white or darker than black, but then it does no harm."""
    x0 = 2 * torch.from_numpy(DIGITS[:6] / 255).float()[:, None] - 1
    now = trained.net(soft_label((x0[:, 0] + 1) / 2))[:, HEIGHT]
    for sign in (-1, 1):
        wanted = now + sign * 0.02
        after = (x0 + _correction(x0, wanted, trained, HEIGHT)).clamp(-1, 1)
        missed = (trained.net(soft_label((after[:, 0] + 1) / 2))[:, HEIGHT] - wanted).abs()
        assert missed.median() < 0.002 and missed.max() <= 0.02


@pytest.mark.parametrize("sampler", ["ddim", "dpm-solver++"])
def test_no_strength_is_plain_sampling(model, trained, sampler):
    told = np.linspace(1.1, 1.4, 5)[:, None]
    model = model.sampled(sampler=sampler, steps=4, guidance=2.0)
    plain = generate(model.trained, told, 3, **model.sampling)
    assert np.array_equal(steer(model, told, told, trained, 0.0, 3), plain)


def test_steered_structures_come_nearer_to_what_the_surrogate_is_asked_for(model, trained):
    told, model = np.full((6, 1), 1.2), model.sampled(steps=6)

    def brightness(images):
        return trained.net(soft_label(torch.from_numpy(images)))[:, 0].numpy()

    plain = brightness(steer(model, told, told, trained, 0.0, 1))
    wanted = (plain + 0.05)[:, None]
    steered = steer(model, told, wanted, trained, 1.0, 1)
    assert steered.shape == (6, FRAME, FRAME) and 0 <= steered.min() <= steered.max() <= 1
    missed = np.abs(brightness(steered) - wanted[:, 0])
    assert np.median(missed) < 0.5 * 0.05
    again = steer(model, told[2:4], wanted[2:4], trained, 1.0, 1, start=2)
    assert np.allclose(again, steered[2:4], atol=1e-5)


def test_the_stored_comparison_is_whole_and_its_lines_differ_without_colour():
    table = pd.read_csv(paths.REFERENCE / "controls.csv")
    about = json.loads((paths.REFERENCE / "controls.json").read_text(encoding="utf-8"))
    assert about["targets"] == 200 and not table.duplicated(["control", "effort"]).any()
    assert (table["median low"] <= table["median"]).all() and (table["median"] <= table["median high"]).all()
    assert table["seconds"].gt(0).all() and table["valid"].between(90, 100).all()
    axes = plot_controls(table).axes
    for ax in axes:
        assert len({bars.lines[0].get_marker() for bars in ax.containers}) == len(ax.containers)
    assert sum(len(ax.containers) for ax in axes) == table["control"].nunique()
    plt.close("all")
