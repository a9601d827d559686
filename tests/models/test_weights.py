"""A model is asked for structures: each depends on the seed, on its number and on its own target alone."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from inflate_lib import load_model, paths, simulated_sevens
from inflate_lib.descriptors import DESCRIPTORS, get_descriptor
from inflate_lib.descriptors.registry import JOINT, PARTS
from inflate_lib.diffusion import TrainedModel, TrainingConfig, generate
from inflate_lib.diffusion.randomness import seed_for
from inflate_lib.models.calibration import Calibration
from inflate_lib.models.reach import load_reach, reach_of, save_reach
from inflate_lib.models.weights import Model

FAST = {"sampler": "ddim", "steps": 2, "eta": 1.0, "guidance": 2.0}


def same(images, others):
    """Whether images are the same but for what a batch of another size rounds otherwise.

    An untrained network magnifies that: a pixel in a million differs by 0.01, the mean over an image by up to 1e-4;
    those of two drawings differ by 0.4.
    """
    return np.abs(images - others).mean(axis=(1, 2)).max() < 1e-3


@pytest.fixture(scope="module")
def reach():
    return reach_of(simulated_sevens("digits", 60))


@pytest.fixture(scope="module")
def ask(reach):
    """Untrained models of every descriptor, by name; each sees what it is told."""
    models = {}
    for name in (*DESCRIPTORS, JOINT):
        parts = tuple(get_descriptor(part).length for part in PARTS) if name == JOINT else ()
        config = TrainingConfig(channels=(4, 8), embedding=16, steps=1, parts=parts)
        n = get_descriptor(name).length
        low, high = np.full(n, -0.5), np.full(n, 2.0)
        net, random = config.make_net(len(low)).eval(), torch.Generator().manual_seed(0)
        for weights in net.parameters():  # an untrained network answers zero
            weights.data += 0.1 * torch.randn(weights.shape, generator=random)
        models[name] = Model(name, TrainedModel(net, config, low, high), FAST, {}, reach)
    return models


@given(seed=st.integers(0, 2**31), n=st.integers(1, 4), more=st.integers(1, 4), row=st.integers(0, 59))
@settings(max_examples=15, deadline=None)
def test_asking_for_more_gives_the_same_first_ones(ask, reach, seed, n, more, row):
    target = {"height": float(reach.height[row]), "area": float(reach.hull_area[row])}
    few, many = (ask[JOINT].draw(target, count, seed) for count in (n, n + more))
    assert few.shape == (n, 28, 28) and few.dtype == np.float32 and few.min() >= 0 and few.max() <= 1
    assert same(many[:n], few)


@given(seed=st.integers(0, 2**31), n=st.integers(1, 3), rows=st.lists(st.integers(0, 59), min_size=2, max_size=3))
@settings(max_examples=15, deadline=None)
def test_several_targets_are_as_each_alone(ask, reach, seed, n, rows):
    """Structure i of an array of targets is structure i of its own target alone."""
    axes = reach.medial_axis.values[rows]
    together = ask["axis"].draw({"axis": axes}, n, seed)
    assert together.shape == (len(rows) * n, 28, 28)
    for number, axis in enumerate(axes):
        alone = ask["axis"].draw({"axis": axis}, (number + 1) * n, seed)
        assert same(together[number * n : (number + 1) * n], alone[number * n :])


def test_seeds_and_targets_make_a_difference(ask, reach):
    heights = reach.height.values[:2]
    one = ask["height"].draw({"height": heights[0]}, 2, 0)
    assert np.abs(one - ask["height"].draw({"height": heights[0]}, 2, 1)).max() > 0.1
    assert np.abs(one - ask["height"].draw({"height": heights[1]}, 2, 0)).max() > 1e-6
    assert np.abs(one[0] - one[1]).max() > 0.1


def test_each_descriptor_has_noise_of_its_own(ask, reach):
    """One network, told the same as a height, a width and an area, draws three structures; every model shares them."""
    trained, value = ask["height"].trained, float(reach.height[0])
    models = {name: Model(name, trained, FAST) for name in ("height", "width", "area")}
    drawn = [model.draw({name: value}, 2, 0) for name, model in models.items()]
    for some, others in itertools.combinations(drawn, 2):
        assert min(np.abs(one - other).max() for one, other in itertools.product(some, others)) > 0.1
    told = ask[JOINT].told("height", np.full((2, 1), value))
    joint = generate(ask[JOINT].trained, told, seed_for(0, "height"), **FAST)
    np.testing.assert_array_equal(ask[JOINT].draw({"height": value}, 2, 0), joint)


def test_a_box_is_height_and_width(ask, reach):
    box = float(reach.height[0]), float(reach.width[0])
    for name in ("box", JOINT):
        by_name = ask[name].draw({"width": box[1], "height": box[0]}, 2)
        np.testing.assert_array_equal(ask[name].draw({"box": box}, 2), by_name)
        np.testing.assert_array_equal(ask[name].draw({"width": [box[1]] * 2, "height": box[0]}, 1)[0], by_name[0])


def test_a_calibrated_model_is_told_something_else(ask, reach):
    calibration = Calibration(np.array([0.9]), np.eye(1), np.array([0.02]), np.array([[1.25]]))
    plain = ask[JOINT]
    model = Model(JOINT, plain.trained, FAST, {"height": calibration}, reach)
    wanted = reach.height.values[:1]
    told = float(calibration.told(wanted[:, None])[0, 0])
    unchecked = Model(JOINT, plain.trained, FAST)
    np.testing.assert_array_equal(model.draw({"height": wanted}, 2), unchecked.draw({"height": told}, 2))
    both = {"height": wanted, "area": reach.hull_area.values[:1]}  # a combination without a calibration
    np.testing.assert_array_equal(model.draw(both, 2), plain.draw(both, 2))


@pytest.mark.parametrize(
    ("name", "targets", "message"),
    [
        ("height", {"height": 3.0}, r"height 3 is out of reach.*reach height 0\.\d+ to .*nearest reachable target"),
        ("height", {"height": [0.9, 3.0]}, "target 1: height 3 is out of reach"),
        (JOINT, {"height": 0.9, "width": 0.9, "area": 1.0}, "area 1 contradicts height 0.9 and width 0.9"),
        ("height", {"width": 1.0}, "the height model takes height, not 'width'"),
        (JOINT, {"hight": 1.0}, "takes height, width, area, stress, stretch, axis, outline, any of them, not 'hight'"),
        ("box", {"height": 0.9}, "width is not given"),
        ("box", {"box": (0.9, 0.9), "height": 0.9}, "height is asked for twice"),
        ("height", {"height": np.nan}, "height must be finite, not nan"),
        ("height", {"height": []}, r"a number or an array \(m,\), not one of shape \(0,\)"),
        ("height", {"height": "tall"}, "not 'tall'"),
        ("height", {"height": "1.05"}, "a number or an array .* not '1.05'"),
        ("height", {"height": True}, "a number or an array .* not True"),
        ("height", {"height": 0}, "height 0 is out of reach"),
        ("axis", {"axis": np.zeros((30, 2))}, "axis must begin at the origin, and its points must rise"),
        ("axis", {"axis": np.linspace([0.1, 0], [0.1, 1], 30)}, "axis must begin at the origin"),
        ("height", {}, "targets must be a mapping"),
        ("height", 0.9, "targets must be a mapping"),
        ("axis", {"axis": np.zeros((29, 2))}, r"an array \(30, 2\) or \(m, 30, 2\), not one of shape \(29, 2\)"),
        ("box", {"height": [0.9] * 2, "width": [0.9] * 3}, "as many of each descriptor, not 2 and 3"),
    ],
)
def test_what_cannot_be_drawn_is_refused(ask, name, targets, message):
    with pytest.raises(ValueError, match=message):
        ask[name].draw(targets)


@pytest.mark.parametrize("bad", [{"n": 0}, {"n": 1.5}, {"n": True}, {"seed": -1}, {"seed": "0"}])
def test_numbers_that_are_none_are_refused(ask, bad):
    with pytest.raises(ValueError, match=f"{next(iter(bad))} must be a whole number"):
        ask["height"].draw({"height": 0.9}, **bad)


def test_the_table_of_reach_comes_back(reach, tmp_path):
    save_reach(reach, tmp_path)
    back = load_reach(tmp_path)
    for name in ("height", "hull_area", "peak_stress", "medial_axis"):
        np.testing.assert_allclose(back[name], reach[name], rtol=1e-6)
    with pytest.raises(ValueError, match=r"reach\.npz cannot be read"):
        load_reach(tmp_path / "nowhere")
    whole = (tmp_path / "reach.npz").read_bytes()
    for damaged in (b"", b"text", whole[:-100], whole[: len(whole) // 2], whole[:300] + b"x" * 50 + whole[350:]):
        (tmp_path / "reach.npz").write_bytes(damaged)
        with pytest.raises(ValueError, match=r"reach\.npz cannot be read"):
            load_reach(tmp_path)


@pytest.mark.parametrize("name", [*DESCRIPTORS, JOINT])
def test_committed_weights_are_loaded_with_what_belongs_to_them(name):
    model = load_model(name)
    assert model.name == name and model.sampling["sampler"] == "ddim"
    combinations = {"height+area", "width+area", "height+width+area"}
    assert set(model.calibrations) == ({*DESCRIPTORS, *PARTS, *combinations} if name == JOINT else {name})
    assert model.reach.sizes["structure"] == 6265


def test_weights_that_are_not_there_are_named():
    with pytest.raises(ValueError, match=r"no model 'volume' of the profile 'laptop'; there are: area, axis, box"):
        load_model("volume")
    with pytest.raises(ValueError, match="no weights of the profile 'night'; there are: laptop"):
        load_model("height", "night")


def test_a_file_in_the_folder_is_no_profile(tmp_path, monkeypatch):
    (tmp_path / "README.md").touch()
    monkeypatch.setattr(paths, "PRETRAINED", tmp_path)
    with pytest.raises(ValueError, match="there are: none"):
        load_model("height")
