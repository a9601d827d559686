"""Walls of two rubbers: patterns, what flips and shifts do to them, pictures, the data set, the models."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from inflate_lib import describe, inflate, label_image, paths, simulate_dataset
from inflate_lib.alternatives import rubbers
from inflate_lib.alternatives.patterns import (
    FAMILIES,
    LEVELS,
    RATIO,
    castable,
    from_picture,
    pattern,
    rubber_picture,
    stiffness_of,
)
from inflate_lib.alternatives.rubbers import (
    load_rubber_model,
    rubber_experiment,
    simulate_rubbers,
    simulated_rubbers,
    train_rubbers,
    two_channels,
)
from inflate_lib.datasets.pairs import held_out
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.descriptors.registry import JOINT
from inflate_lib.models import Model
from inflate_lib.models.recipe import load_recipe
from inflate_lib.structures.augmentation import augment, augment_descriptors
from inflate_lib.structures.labels import VOID, WALL, point_joints, stages
from inflate_lib.structures.sources import load_sevens

IMAGES = load_sevens("digits").images[:24]


def patterns(family=None, images=IMAGES, seed=0):
    rng = np.random.default_rng(seed)
    return np.array([pattern(image, family or rng.choice(FAMILIES), rng) for image in images])


def share_stiff(image, stiff):
    return (stiffness_of(image, stiff) > 1)[label_image(image) == WALL].mean()


@pytest.mark.parametrize("family", FAMILIES)
def test_a_pattern_follows_from_its_seed_and_leaves_both_rubbers_in_most_walls(family):
    maps = patterns(family)
    assert np.array_equal(maps, patterns(family)) and not np.array_equal(maps, patterns(family, seed=1))
    shares = np.array([share_stiff(*pair) for pair in zip(IMAGES, maps, strict=True)])
    assert ((shares > 0.02) & (shares < 0.98)).mean() > 0.9


def test_a_side_is_the_wall_that_lies_on_that_side_of_the_line():
    line = np.zeros((28, 28), np.uint8)
    line[6:22, 13:15] = 255
    found = set()
    for seed in range(12):
        stiff = pattern(line, "side", np.random.default_rng(seed))
        found.add((stiff[10:18, 11:13].mean(), stiff[10:18, 15:17].mean()))  # the wall on the left, and on the right
    assert {(0.0, 1.0), (1.0, 0.0)} <= found and (1.0, 1.0) not in found


def test_no_family_of_this_name():
    with pytest.raises(ValueError, match=r"family.*stripes"):
        pattern(IMAGES[0], "stripes", np.random.default_rng(0))


def test_the_map_goes_to_the_ground_with_the_structure():
    """The stiff pixels of the wall are those of a map that is laid over the same image before it is moved."""
    for image, stiff in zip(IMAGES, patterns(), strict=True):
        done = stages(image)
        canvas = np.pad(stiff, 2, mode="edge")
        stiffness, wall = stiffness_of(image, stiff, 3.0), done.domains == WALL
        assert set(np.unique(stiffness)) <= {1.0, 3.0}
        assert (stiffness[wall] == 3).sum() == (canvas & (done.composite == WALL)).sum()
        assert np.all(stiffness_of(image, stiff, 1.0) == 1)


def test_flipped_and_shifted_pairs_inflate_to_what_they_are_said_to():
    """The promise of the augmentation: nothing is simulated again, and all is as if it had been."""
    maps, variants = patterns(), augment(IMAGES, 60, seed=2)
    chosen = variants[len(IMAGES) :: 3]
    pairs = two_channels(IMAGES, maps, chosen)
    assert pairs.shape == (len(chosen), 2, 28, 28) and pairs.dtype == np.uint8
    assert {flip for _, flip, *_ in chosen.tolist()} == {0, 1} and np.abs(chosen[:, 2:]).max() > 0
    again = simulate_rubbers(pairs[:, 0], pairs[:, 1] > 127, n_jobs=1, progress_text="")
    first = simulate_rubbers(IMAGES, maps, n_jobs=1, progress_text="")
    known = descriptor_matrix(first, JOINT)
    expected = augment_descriptors(known, get_descriptor(JOINT).mirrored(known), chosen)
    assert np.allclose(descriptor_matrix(again, JOINT), expected, atol=1e-7)


def test_a_stiff_rubber_of_ratio_one_is_the_data_set_of_the_paper():
    plain, ones = simulate_dataset(IMAGES[:6], n_jobs=1), simulate_rubbers(IMAGES[:6], patterns()[:6], 1.0, n_jobs=1)
    for name in ("height", "width", "hull_area", "medial_axis", "peak_stress"):
        assert np.array_equal(plain[name], ones[name])


def test_every_row_is_its_own_pair_inflated():
    maps = patterns()
    images = np.concatenate([IMAGES[:3], np.zeros((1, 28, 28), np.uint8)])
    data = simulate_rubbers(images, maps[:4], n_jobs=1)
    for row in range(3):
        result = inflate(label_image(images[row]), stiffness=stiffness_of(images[row], maps[row]))
        assert data.height.values[row] == describe(result).height
    assert "blank" in data.reason.values[3] and not data.converged[3]
    assert data.attrs["stiffness_ratio"] == RATIO and np.array_equal(data.stiff, maps[:4])
    with pytest.raises(ValueError, match="maps: there are 3 of them for 4 images"):
        simulate_rubbers(images, maps[:3])


def test_data_sets_of_two_seeds_hold_the_same_sevens_with_other_patterns():
    one, other = (simulated_rubbers("digits", 12, seed=seed, n_jobs=1) for seed in (0, 1))
    assert np.array_equal(one.image, other.image) and not np.array_equal(one.stiff, other.stiff)
    assert set(one.family.values) <= set(FAMILIES)
    assert np.array_equal(one.stiff, simulated_rubbers("digits", 12, seed=0, n_jobs=1).stiff)


def test_a_picture_says_what_a_pair_says():
    for image, stiff in zip(IMAGES, patterns(), strict=True):
        picture = rubber_picture(image, stiff)
        assert set(np.unique(picture).tolist()) <= set(LEVELS)
        back, read = from_picture(picture)
        label = label_image(image)
        assert np.array_equal(label_image(back), label)
        wall = label == WALL
        assert np.array_equal(stiffness_of(back, read)[wall], stiffness_of(image, stiff)[wall])


def test_each_rubber_can_be_cast():
    for image, stiff in zip(IMAGES, np.random.default_rng(0).random((24, 28, 28)) < 0.4, strict=True):
        label, stiffness = label_image(image), stiffness_of(image, stiff)
        wall, cast = label == WALL, castable(stiffness, label)
        assert set(np.unique(cast)) <= {1.0, RATIO} and np.array_equal(castable(cast, label), cast)
        for part in (wall & (cast == 1), wall & (cast == RATIO)):
            pieces, n = ndimage.label(part)
            assert n == 0 or np.bincount(pieces.ravel())[1:].min() >= 4
            if not point_joints(label):
                assert n == ndimage.label(part, np.ones((3, 3)))[1]  # none hang together in corners alone
    whole = np.where(np.arange(28) < 14, RATIO, 1.0)[None].repeat(28, axis=0)
    label = label_image(IMAGES[0])
    assert np.array_equal(castable(whole, label)[label == WALL], whole[label == WALL])


def test_other_pictures_are_refused():
    picture = rubber_picture(IMAGES[0], patterns()[0])
    grey = picture.copy()
    grey[0, 0] = 100
    with pytest.raises(ValueError, match=r"64 \(stiff wall\).*it has 100"):
        from_picture(grey)
    grey = picture.copy()
    grey[label_image(IMAGES[0]) == VOID] = 64
    with pytest.raises(ValueError, match=r"blank|not in the wall"):
        from_picture(grey)
    grey = picture.copy()
    grey[0, 27] = 64
    with pytest.raises(ValueError, match="1 pixels of level 64 are not in the wall"):
        from_picture(grey)


@pytest.mark.slow
def test_a_network_of_two_channels_learns_from_sevens_that_are_not_held_out(tmp_path):
    tiny = {"channels": [4, 8], "embedding": 16, "steps": 4, "batch_size": 16, "checkpoint_every": 4}
    recipe = load_recipe("laptop")
    recipe = replace(recipe, training={**recipe.training, **tiny}, n_augmented=40)
    data = [simulated_rubbers("digits", 30, seed=seed, n_jobs=1) for seed in (0, 1)]
    trained = train_rubbers(data, recipe, tmp_path)
    assert trained.metadata["pairs"] == 80 and trained.metadata["patterns"] == 2 and held_out(30).sum() == 3
    assert trained.config.image_channels == 2 and trained.metadata["held_out_loss"] > 0
    trained.save(tmp_path / "two.safetensors", half=True)


def test_an_experiment_keeps_each_pair_with_its_target(monkeypatch):
    maps = patterns()
    drawn = two_channels(IMAGES[:4], maps[:4]) / np.float32(255)
    drawn[3] = 0
    monkeypatch.setattr(rubbers, "generate", lambda trained, told, seed: drawn)
    trained = SimpleNamespace(metadata={"stiffness_ratio": RATIO}, config=SimpleNamespace(parts=()))
    found = rubber_experiment(Model(JOINT, trained), [[0.9], [1.0]], 2, 0, "height", n_jobs=1)
    assert found.target.values.ravel().tolist() == [0.9, 0.9, 1.0, 1.0] and found.valid.values.tolist()[3] is False
    result = inflate(label_image(IMAGES[2]), stiffness=stiffness_of(IMAGES[2], maps[2]))
    assert found.height.values[2] == describe(result).height and np.array_equal(found.stiff[2], maps[2])


@pytest.mark.slow
@pytest.mark.skipif(not (paths.PRETRAINED / "laptop" / "rubbers").exists(), reason="no weights")
def test_the_stored_model_draws_pairs_of_the_height_it_is_asked_for():
    model = load_rubber_model()
    assert model.trained.metadata["stiffness_ratio"] == RATIO
    heights = []
    for wanted in (0.8, 1.15):
        drawn = model.draw({"height": wanted}, 6, seed=1)
        assert drawn.shape == (6, 2, 28, 28)
        data = simulate_rubbers(drawn[:, 0], drawn[:, 1] > 0.5, n_jobs=1)
        heights.append(float(data.height.median()))
    assert heights[0] == pytest.approx(0.8, rel=0.08) and heights[1] == pytest.approx(1.15, rel=0.08)


def test_a_profile_without_such_a_model_is_told():
    with pytest.raises(FileNotFoundError, match="ci"):
        load_rubber_model("ci")
