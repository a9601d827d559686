"""Flips and shifts: which are allowed, what they do to images and descriptors, and that a simulation agrees."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from inflate_lib.descriptors import describe, get_descriptor
from inflate_lib.descriptors.shape import mirror_axis
from inflate_lib.structures.augmentation import (
    PAPER_SAMPLES,
    _allowed_variants,
    _structure_boxes,
    apply_variants,
    augment,
    augment_descriptors,
)
from inflate_lib.structures.labels import label_image
from inflate_lib.structures.sources import load_sevens, resolve_source

IMAGES = load_sevens("digits", limit=24).images


def slowly(image, flip, shift_x, shift_y):
    """The variant of one image by an independent route: flip, put on a large canvas, cut out."""
    canvas = np.pad(image[:, ::-1] if flip else image, 5)
    return canvas[5 - shift_y : 33 - shift_y, 5 - shift_x : 33 - shift_x]


variant_rows = st.lists(
    st.tuples(st.integers(0, 23), st.integers(0, 1), st.integers(-5, 5), st.integers(-5, 5)), min_size=1, max_size=8
)


@given(variant_rows)
@settings(max_examples=60, deadline=None)
def test_images_of_variants(rows):
    moved = apply_variants(IMAGES, np.array(rows))
    assert moved.dtype == np.uint8
    for (number, *how), image in zip(rows, moved, strict=True):
        assert np.array_equal(image, slowly(IMAGES[number], *how))


def test_directions_are_right_and_down():
    image = np.zeros((1, 28, 28))
    image[0, 10, 5] = 0.25
    moved = apply_variants(image, [(0, 0, 3, 0), (0, 0, 0, 2), (0, 1, 0, 0)])
    assert moved.dtype == float
    assert [tuple(np.argwhere(picture)[0]) for picture in moved] == [(10, 8), (12, 5), (10, 22)]


@given(st.tuples(st.integers(-2, 20), st.integers(5, 24), st.integers(-2, 20), st.integers(5, 24)), st.integers(0, 4))
@settings(max_examples=60, deadline=None)
def test_allowed_variants_are_all_that_keep_the_box_inside(box, max_shift):
    top, height, left, width = box
    bottom, right = top + height - 1, left + width - 1
    expected = {(0, 0, 0, 0)}
    for flip in (0, 1):
        first, last = (27 - right, 27 - left) if flip else (left, right)
        for shift_x in range(-max_shift, max_shift + 1):
            for shift_y in range(-max_shift, max_shift + 1):
                if first + shift_x >= 0 and last + shift_x <= 27 and top + shift_y >= 0 and bottom + shift_y <= 27:
                    expected.add((0, flip, shift_x, shift_y))
    variants = _allowed_variants(np.array([[top, bottom, left, right]]), max_shift)
    assert len(variants) == len(expected)
    assert set(map(tuple, variants)) == expected
    assert tuple(variants[0]) == (0, 0, 0, 0)


def test_box_is_that_of_digit_and_wall():
    image = np.zeros((28, 28))
    image[3:10, 4:7] = 1
    image[20, 20] = 1  # a speck does not count
    assert _structure_boxes([image]).tolist() == [[1, 11, 2, 8]]
    for label in map(label_image, IMAGES[:5]):
        rows, columns = np.nonzero(label)
        assert _structure_boxes([label]).tolist() == [[rows.min(), rows.max(), columns.min(), columns.max()]]


@pytest.mark.parametrize("seed", [0, 1])
def test_sample_is_originals_first_then_a_draw_without_repetition(seed):
    everything = augment(IMAGES)
    n_samples = len(everything) // 2
    variants = augment(IMAGES, n_samples, seed)
    assert variants.shape == (n_samples, 4)
    assert variants[:24].tolist() == [[number, 0, 0, 0] for number in range(24)]
    rows = set(map(tuple, variants))
    assert len(rows) == n_samples
    assert rows <= set(map(tuple, everything))
    assert np.array_equal(variants, augment(IMAGES, n_samples, seed))
    assert not np.array_equal(variants, augment(IMAGES, n_samples, seed + 1))


def test_draw_is_uniform():
    """Over many seeds every variant is drawn equally often, up to chance (chi-square, 5 sigma)."""
    everything = augment(IMAGES[:2])
    others = {tuple(row): 0 for row in everything[2:]}
    draws, size = 400, len(others) // 3
    for seed in range(draws):
        for row in augment(IMAGES[:2], 2 + size, seed)[2:]:
            others[tuple(row)] += 1
    probability = size / len(others)
    counts = np.array(list(others.values()))
    assert counts.sum() == draws * size
    statistic = ((counts - draws * probability) ** 2).sum() / (draws * probability * (1 - probability))
    freedom = len(others) - 1
    assert abs(statistic - freedom) < 5 * np.sqrt(2 * freedom)


def test_numbers_that_cannot_be_had_are_refused():
    most = len(augment(IMAGES))
    assert len(augment(IMAGES, most)) == most
    with pytest.raises(ValueError, match=rf"24.*to {most}"):
        augment(IMAGES, most + 1)
    with pytest.raises(ValueError, match="n_samples is 23"):
        augment(IMAGES, 23)
    with pytest.raises(ValueError, match=r"image number 1: .*blank"):
        augment(np.zeros((2, 28, 28)) + IMAGES[:1] / 255 * [[[1]], [[0]]])


@given(st.sampled_from([tuple(row) for row in augment(IMAGES).tolist()]))
@settings(max_examples=60, deadline=None)
def test_allowed_variants_are_the_same_structure(variant):
    """After labelling, an allowed variant differs from its original by its horizontal place and the flip alone."""
    number, flip, shift_x, _ = variant
    label, moved = label_image(IMAGES[number]), label_image(apply_variants(IMAGES, [variant])[0])
    assert np.array_equal(moved, apply_variants(label[None], [(0, flip, shift_x, 0)])[0])


def test_descriptors_follow_the_variants():
    variants = np.array([(0, 0, 0, 0), (1, 0, 0, 0), (1, 1, 2, 0), (0, 0, -1, 3)])
    area = np.array([[0.5], [0.7]])
    assert augment_descriptors(area, get_descriptor("area").mirrored(area), variants).ravel().tolist() == [
        0.5,
        0.7,
        0.7,
        0.5,
    ]
    axis = np.random.default_rng(0).normal(size=(2, 60))
    augmented = augment_descriptors(axis, get_descriptor("axis").mirrored(axis), variants)
    assert np.array_equal(augmented[[0, 1, 3]], axis[[0, 1, 0]])
    assert np.array_equal(augmented[2].reshape(30, 2), axis[1].reshape(30, 2) * [-1, 1])
    assert np.array_equal(mirror_axis(axis.reshape(2, 30, 2)).reshape(2, 60), mirror_axis(axis))


def test_simulation_of_variants_gives_the_same_descriptors():
    """The claim behind Fig. 4, checked by inflating augmented images anew."""
    from inflate_lib.mechanics.inflation import inflate

    variants = augment(IMAGES[:4], 64, seed=5)
    chosen = np.concatenate([variants[:4], variants[4::6]])
    assert chosen[:, 1].any() and chosen[:, 2].any() and chosen[:, 3].any()
    originals = [describe(inflate(label_image(image), n_steps=1)) for image in IMAGES[:4]]
    for variant, image in zip(chosen, apply_variants(IMAGES, chosen), strict=True):
        simulated, original = describe(inflate(label_image(image), n_steps=1)), originals[variant[0]]
        for name in ("height", "width", "box", "area", "axis"):
            vector = np.array([original.vector(name)])
            expected = augment_descriptors(vector, get_descriptor(name).mirrored(vector), [(0, *variant[1:])])[0]
            assert np.allclose(simulated.vector(name), expected, rtol=0, atol=1e-8), (name, variant)


def test_module_needs_numpy_alone():
    """It runs where training runs, and there may be nothing but numpy and torch."""
    code = "import sys, inflate_lib.structures.augmentation; print({'scipy', 'pandas', 'sklearn'} & set(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "set()"


@pytest.mark.mnist
def test_the_papers_71616_samples():
    if resolve_source() != "mnist":
        pytest.skip("MNIST cannot be had: the paper's number of samples is not checked")
    images = load_sevens("mnist").images
    variants = augment(images, PAPER_SAMPLES)
    assert variants.shape == (71_616, 4)
    assert np.array_equal(np.unique(variants[:, 0]), np.arange(6265))
    assert len(np.unique(variants, axis=0)) == 71_616
    drawn = variants[6265:]
    assert abs(drawn[:, 1].mean() - 0.5) < 0.01  # half of the drawn ones are flipped
    assert np.abs(drawn[:, 2:]).max() == 3
    assert abs(drawn[:, 2].mean()) < 0.05  # left and right are alike
