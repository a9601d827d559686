"""Steering by a surrogate: what it sees is the label image, what it adds hits the target, and 0 is plain sampling."""

import json

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch
import torch.nn.functional as F
from torch import nn

from inflate_lib import paths
from inflate_lib.diffusion import TrainedModel, TrainingConfig, generate
from inflate_lib.models.surrogate import Judge, Network, Surrogate, centred, feet, soft_label
from inflate_lib.models.weights import Model
from inflate_lib.plotting.evaluation import plot_controls
from inflate_lib.structures.labels import FRAME, THRESHOLD, is_whole, joined, label_image
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


def test_a_correction_removes_most_of_a_small_error(trained, model):
    """Less where it would take pixels brighter than white or darker than black, but then it does no harm."""
    x0 = 2 * torch.from_numpy(DIGITS[:6] / 255).float()[:, None] - 1
    now = trained.net(soft_label((x0[:, 0] + 1) / 2))[:, HEIGHT]
    judge = Judge(trained, model.trained, "height")
    for sign in (-1, 1):
        wanted = now + sign * 0.02
        after = (x0 + judge(x0, torch.from_numpy(model.trained.scaled(wanted.numpy())).float())).clamp(-1, 1)
        missed = (trained.net(soft_label((after[:, 0] + 1) / 2))[:, HEIGHT] - wanted).abs()
        assert missed.median() < 0.002 and missed.max() <= 0.02


def test_what_is_finished_comes_nearer_behind_the_threshold(trained, model):
    """Grey pixels count as the label image counts them; no drawing gets worse, none falls apart."""
    blurred = torch.from_numpy(DIGITS[:12] / 255).float()
    x = 2 * F.avg_pool2d(F.pad(blurred, [1] * 4), 3, 1)[:, None] - 1
    labels = np.array([label_image(image) for image in ((x[:, 0] + 1) / 2).numpy()])
    now = 10 * labels.mean(axis=(1, 2))
    for sign in (-1, 1):
        wanted = now + sign * 0.05
        done = Judge(trained, model.trained, "height").finish(
            x, torch.from_numpy(model.trained.scaled(wanted[:, None])).float()
        )
        images = ((done[:, 0] + 1) / 2).numpy()
        after = 10 * np.array([label_image(image) for image in images]).mean(axis=(1, 2))
        assert (np.abs(after - wanted) <= 0.05 + 1e-6).all() and np.median(np.abs(after - wanted)) < 0.02
        assert all(is_whole(image) for image in images) and 0 <= images.min() <= images.max() <= 1


def test_nothing_is_finished_that_nobody_asked_for(trained, model):
    x = 2 * torch.from_numpy(DIGITS[:3] / 255).float()[:, None] - 1
    judge = Judge(trained, model.trained, "height")
    assert torch.equal(judge.finish(x, torch.full((3, 1), torch.nan)), x)


def test_pieces_a_pixel_or_two_apart_are_joined():
    image = np.zeros((FRAME, FRAME), np.float32)
    image[4:12, 10:14] = image[14:24, 10:14] = 0.9
    assert not is_whole(image) and is_whole(joined(image))
    assert (joined(image)[image > 0] == image[image > 0]).all()
    apart = image.copy()
    apart[14:16] = 0  # four dark rows: too far
    assert joined(apart) is apart and joined(joined(image)).sum() == joined(image).sum()
    both = joined(np.array([image, image[:, ::-1]])[0][:, ::-1])
    assert np.array_equal(both[:, ::-1], joined(image))


def test_feet_are_seen_wherever_they_stand():
    label = np.zeros((1, FRAME, FRAME), np.float32)
    label[0, 14:, 5:12] = 0.5
    moved = np.concatenate([np.roll(label, shift, axis=2) for shift in range(-5, 17)])
    seen = feet(torch.from_numpy(moved))
    assert seen.shape[1:] == (10, 20) and (seen == seen[0]).all() and seen[0].sum() == label[0, -10:].sum()


def drawn(model, told, seed, start=0):
    return generate(model.trained, told, seed, start=start, **model.sampling)


@pytest.mark.filterwarnings("ignore:.*outside the range")
@pytest.mark.parametrize("sampler", ["ddim", "dpm-solver++"])
def test_a_steered_drawing_comes_nearer(model, trained, sampler):
    """The same noise, steered to another brightness; each drawing depends on its own noise and target alone."""
    plain = model.sampled(sampler=sampler, steps=8, guidance=1.0)
    steered = plain.steered(trained)
    told = np.full((6, 1), 1.2)

    def brightness(images):
        with torch.no_grad():
            return trained.net(soft_label(torch.from_numpy(images), sharp=True))[:, 0].numpy()

    before = brightness(drawn(plain, told, 1))
    wanted = (before + 0.05)[:, None]
    images, again = drawn(steered, wanted, 1), drawn(steered, wanted[2:4], 1, start=2)
    assert images.shape == (6, FRAME, FRAME) and 0 <= images.min() <= images.max() <= 1
    assert np.median(np.abs(brightness(images) - wanted[:, 0])) < 0.5 * 0.05
    assert np.array_equal(again > THRESHOLD, images[2:4] > THRESHOLD)  # the same structures; many steep steps
    assert np.abs(again - images[2:4]).max() < 0.01  # magnify the rounding, which depends on the batch
    assert np.array_equal(drawn(plain.steered(trained, 0), told, 1), drawn(plain, told, 1))


def test_what_is_withheld_does_not_steer(trained):
    """Of a joint model; nor does a model without a judge."""
    torch.manual_seed(0)
    config = TrainingConfig(channels=(4, 8), embedding=16, steps=1, parts=(1, 1))
    joint = TrainedModel(config.make_net(2).eval(), config, np.array([1.0, 1.0]), np.array([1.5, 1.5]))
    judge = Judge(trained, joint, "height+width")
    x0 = 2 * torch.from_numpy(DIGITS[:3] / 255).float()[:, None] - 1
    nothing, height, both = (torch.tensor([values] * 3) for values in ([np.nan] * 2, [0.3, np.nan], [0.3, 0.3]))
    assert not judge(x0, nothing).any()
    assert torch.allclose(judge(x0, height), judge(x0, both), atol=1e-5)  # its two answers are equal
    with pytest.raises(ValueError, match="no judge"):
        generate(joint, [[1.2, 1.2]], steering=1.0)


def test_a_surrogate_is_kept_in_one_file(tmp_path):
    net = Network(3, (4, 6, 8))
    Surrogate(net, "height+width+area", np.arange(3.0), np.ones(3), 5.0).save(tmp_path / "surrogate.safetensors")
    found = Surrogate.load(tmp_path / "surrogate.safetensors")
    assert found.answers == "height+width+area" and (found.mean == np.arange(3.0)).all() and found.seconds == 5.0
    images = DIGITS[:4] / 255
    before = Surrogate(net.eval(), "height+width+area", np.arange(3.0), np.ones(3), 5.0).predict(images, "width")
    assert np.allclose(found.predict(images, "width"), before, atol=1e-2)
    (tmp_path / "other.safetensors").write_text("notes")
    with pytest.raises(ValueError, match=r"other\.safetensors"):
        Surrogate.load(tmp_path / "other.safetensors")
    with pytest.raises(OSError, match=r"other\.safetensors"):
        found.save(tmp_path / "other.safetensors")


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
