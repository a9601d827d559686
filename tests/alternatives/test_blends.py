"""Blends of two structures lie between them."""

import numpy as np
import pytest

from inflate_lib import describe, inflate, label_image
from inflate_lib.alternatives.blends import blend
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
