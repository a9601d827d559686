"""Blends of two structures lie between them; a family of digits and blends has each at any time."""

import numpy as np
import pytest

from inflate_lib import describe, inflate, label_image
from inflate_lib.alternatives.blends import Family, blend
from inflate_lib.structures.labels import main_component
from inflate_lib.structures.sources import load_sevens

IMAGES = load_sevens("digits", limit=24).images


def test_a_blend_of_an_image_with_itself_is_that_image_a_little_thicker_or_thinner():
    for image in IMAGES[:6]:
        changed = [((one > 127) != (image > 127)).sum() for one in blend(image[None], 8, seed=2)]
        assert np.median(changed) < 0.15 * (image > 127).sum()


def test_blends_are_grey_images_of_structures_that_inflate():
    blends = blend(IMAGES, 12, seed=0)
    assert blends.shape == (12, 28, 28) and blends.dtype == np.uint8
    heights = [describe(result).height for image in blends if (result := inflate(label_image(image))).converged]
    assert len(heights) >= 9 and np.ptp(heights) > 0.05


def test_the_same_seed_gives_the_same_blends_and_more_begin_with_fewer():
    assert np.array_equal(blend(IMAGES, 3, seed=5), blend(IMAGES, 6, seed=5)[:3])
    assert not np.array_equal(blend(IMAGES, 3, seed=5), blend(IMAGES, 3, seed=6))


def test_lengths_in_pixels_do_not_depend_on_the_type_of_the_image():
    assert np.array_equal(blend(IMAGES, 2), blend(IMAGES / 255, 2))


def test_a_number_of_blends_is_whole():
    with pytest.raises(ValueError, match="n must be a whole number"):
        blend(IMAGES, 0)


def test_a_family_begins_with_its_digits_and_any_member_can_be_had_alone():
    family, longer = Family(IMAGES, 6, seed=3), Family(IMAGES, 50, seed=3)
    assert len(family) == 30 and len(longer) == 74
    assert np.array_equal(np.stack([family[number] for number in range(24)]), IMAGES)
    last = longer[29]
    assert np.array_equal(last, list(family)[29]) and last.shape == (28, 28) and last.dtype == np.uint8
    assert not np.array_equal(last, Family(IMAGES, 6, seed=4)[29])
    with pytest.raises(ValueError, match="n must be a whole number"):
        Family(IMAGES, -1)


def test_members_are_whole_wherever_they_are_moved_and_as_often_mirrored_as_not():
    seven = IMAGES[:1]
    family = Family(np.concatenate([seven, seven]), 60)
    digits = [main_component(family[number] / 255) for number in range(2, 62)]
    first, last = np.transpose([np.flatnonzero(digit.any(axis=1))[[0, -1]] for digit in digits])
    assert first.min() >= 2 and last.max() <= 25  # with its wall of two pixels each is in the frame
    assert len(set(first)) >= 3
    upper = np.array([digit[top : top + 4].sum() > digit[bottom - 3 : bottom + 1].sum()
                      for digit, top, bottom in zip(digits, first, last, strict=True)])  # fmt: skip
    assert upper.all()  # none is upside down
    foot = [np.nonzero(digit[bottom])[0].mean() - np.nonzero(digit.any(axis=0))[0].mean()
            for digit, bottom in zip(digits, last, strict=True)]  # fmt: skip
    assert 15 < np.sum(np.array(foot) > 0) < 45  # a seven stands on its left
