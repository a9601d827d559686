"""Properties of label images: what every structure must satisfy, whatever the image."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage

from inflate_lib import build_mesh
from inflate_lib.structures.labels import _EDGES, _EIGHT_NEIGHBOURS, MIN_PIXELS, is_open, label_image, stages
from inflate_lib.structures.sources import load_sevens, resolve_source

EMBEDDED = load_sevens("digits").images


@st.composite
def blobs(draw):
    """Grey images of random walks with a brush: connected strokes, with loops and specks, sometimes at the border."""
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    image = np.zeros((28, 28))
    spot = rng.integers(0, 28, 2)
    for _ in range(draw(st.integers(8, 90))):
        spot = np.clip(spot + rng.integers(-1, 2, 2), 0, 27)
        image[spot[0], spot[1]] = rng.uniform(0.4, 1)
    image[rng.integers(0, 28, 3), rng.integers(0, 28, 3)] = rng.uniform(0, 1, 3)
    return image


@st.composite
def structures(draw):
    """An image that holds a structure, with its label image."""
    image = draw(st.one_of(blobs(), st.sampled_from(list(EMBEDDED))))
    try:
        return image, label_image(image)
    except ValueError:
        assume(False)


@given(structures())
@settings(max_examples=100, deadline=None)
def test_wall_closes_the_void_and_stands_on_the_ground(structure):
    _, label = structure
    assert set(np.unique(label)) <= {0, 0.5, 1}
    void, outside = np.pad(label == 1, 1), np.pad(label, 1) == 0
    # two pixels of wall around the void: the outside begins at the third
    two_around = ndimage.binary_dilation(void, np.ones((5, 5)))
    assert not np.any(two_around[1:-1, 1:-1] & (label == 0))
    assert not np.any(ndimage.binary_dilation(void, _EIGHT_NEIGHBOURS) & outside)
    assert np.array_equal(two_around[1:-1, 1:-1], label > 0)
    assert ndimage.label(void, _EIGHT_NEIGHBOURS)[1] == 1
    assert label[-1].any() and np.all(label[-2:] != 1)


@given(structures())
@settings(max_examples=100, deadline=None)
def test_label_image_is_its_own_label_image(structure):
    _, label = structure
    assert np.array_equal(label_image(label), label)


@given(structures())
@settings(max_examples=100, deadline=None)
def test_mirror_image_has_the_mirrored_structure(structure):
    image, label = structure
    # the largest component is unique, unless two have the same size
    sizes = np.sort(np.bincount(ndimage.label(stages(image).grey > 0.5, _EIGHT_NEIGHBOURS)[0].ravel())[1:])
    assume(len(sizes) == 1 or sizes[-1] > sizes[-2])
    assert np.array_equal(label_image(image[:, ::-1]), label[:, ::-1])


@given(structures(), st.integers(-6, 6), st.integers(-6, 6))
@settings(max_examples=100, deadline=None)
def test_shifts_move_the_structure_sideways_only(structure, shift_x, shift_y):
    image, label = structure
    rows, columns = np.nonzero(image)
    assume(0 <= rows.min() + shift_y and rows.max() + shift_y < 28)
    assume(0 <= columns.min() + shift_x and columns.max() + shift_x < 28)
    shifted = label_image(np.roll(image, (shift_y, shift_x), axis=(0, 1)))
    columns, new_columns = np.flatnonzero(label.any(axis=0)), np.flatnonzero(shifted.any(axis=0))
    moved = new_columns[0] - columns[0]
    assert np.array_equal(np.roll(label, moved, axis=1), shifted)
    if shift_x == 0:
        assert moved == 0
    stayed_inside = 0 < columns[0] and columns[-1] < 27 and 0 < new_columns[0] and new_columns[-1] < 27
    if stayed_inside:  # the frame did not push it
        assert moved == shift_x


def test_holes_are_filled_and_specks_dropped():
    image = np.zeros((28, 28))
    image[5:15, 8:14] = 1
    image[8:10, 10:12] = 0  # a hole
    image[20, 20] = 1  # a speck
    panels = stages(image)
    assert panels.component.sum() == 56
    assert panels.filled.sum() == 60
    assert (label_image(image) == 1).sum() == 60
    assert [name for name, _ in panels.items()] == [
        "grey", "component", "filled", "expanded", "composite", "shifted", "domains",
    ]  # fmt: skip
    assert np.array_equal(panels.domains, label_image(image))


def test_known_structure():
    image = np.zeros((28, 28))
    image[3:10, 4:7] = 1
    expected = np.zeros((28, 28))
    expected[17:28, 2:9] = 0.5
    expected[19:26, 4:7] = 1
    assert np.array_equal(label_image(image), expected)


def test_structure_at_the_border_is_moved_inside_and_stays_closed():
    image = np.zeros((28, 28))
    image[10:28, 0:3] = 1
    label = label_image(image)
    assert np.flatnonzero(label.any(axis=0)).tolist() == list(range(7))  # two pixels to the right, no more
    assert (label == 1).sum() == image.sum()
    cut = label_image(image, pad=False)
    assert np.any(cut[-1] == 1) and np.any(cut[:, 0] == 1)  # without padding no wall is left at bottom and side
    assert is_open(cut) and not is_open(label) and build_mesh(label)
    inner = label_image(np.roll(image, 3, axis=1), pad=False)
    assert np.any(inner[-1] == 1) and not is_open(inner) and build_mesh(inner)  # the ground closes the cavity


@given(arrays(np.int8, (6, 6), elements=st.integers(0, 2)), st.sampled_from(_EDGES))
@settings(max_examples=150, deadline=None)
def test_a_cavity_is_open_where_it_leads_out(numbers, clamped):
    """By flooding what is no wall from outside, across the sides of pixels, and not from the ground."""
    label = numbers / 2
    sides = {edge: int(edge != clamped) for edge in ("top", "bottom", "left", "right")}
    around = np.pad(label, [(sides["top"], sides["bottom"]), (sides["left"], sides["right"])])
    rooms, _ = ndimage.label(around != 0.5)
    assert is_open(label, clamped) == bool(set(rooms[around == 1]) & set(rooms[around == 0]))
    assert is_open(label[:, ::-1], {"left": "right", "right": "left"}.get(clamped, clamped)) == is_open(label, clamped)


@given(structures(), st.sampled_from(range(4)))
@settings(max_examples=100, deadline=None)
def test_a_turned_image_has_the_turned_structure_at_the_turned_edge(structure, turns):
    """Number n of EDGES comes to the bottom by n quarter turns."""
    image, label = structure
    sizes = np.sort(np.bincount(ndimage.label(stages(image).grey > 0.5, _EIGHT_NEIGHBOURS)[0].ravel())[1:])
    assume(len(sizes) == 1 or sizes[-1] > sizes[-2])
    at_edge = label_image(np.rot90(image, -turns), clamped=_EDGES[turns])
    assert np.array_equal(np.rot90(at_edge, turns), label)
    assert np.array_equal(label_image(at_edge, clamped=_EDGES[turns]), at_edge)


def test_structure_at_each_edge():
    image = np.zeros((28, 28))
    image[3:10, 4:7] = 1
    for edge, rows, columns in (
        ("bottom", (17, 27), (2, 8)), ("top", (0, 10), (2, 8)), ("left", (1, 11), (0, 6)), ("right", (1, 11), (21, 27)),
    ):  # fmt: skip
        filled = np.argwhere(label_image(image, clamped=edge))
        assert (filled.min(axis=0).tolist(), filled.max(axis=0).tolist()) == (
            [rows[0], columns[0]],
            [rows[1], columns[1]],
        )


def test_uint8_bool_and_float_agree():
    label = label_image(EMBEDDED[0])
    assert np.array_equal(label_image(EMBEDDED[0] / 255), label)
    assert np.array_equal(label_image((EMBEDDED[0] / 255).astype(np.float32)), label)
    assert np.array_equal(label_image(EMBEDDED[0] > 127), label)


@pytest.mark.parametrize("thickness", [1, 3])
def test_thickness_of_the_wall(thickness):
    image = np.zeros((28, 28))
    image[10:16, 12:15] = 1
    label = label_image(image, wall=thickness)
    assert (label > 0).sum() == (6 + 2 * thickness) * (3 + 2 * thickness)


def square(side, value=1.0):
    image = np.zeros((28, 28))
    image[:side, :side] = value
    return image


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.zeros((28, 28)), "blank"),
        (np.full((28, 28), 127, np.uint8), "blank"),
        (square(3), f"9 pixels, fewer than {MIN_PIXELS}"),
        (square(25), "29 pixels wide and 29 high"),
        (np.ones((28, 28)), "32 pixels wide and 32 high"),
        (np.ones((8, 8)), r"shape \(8, 8\)"),
        (np.ones((2, 28, 28)), r"shape \(2, 28, 28\)"),
        (square(9, np.nan), "NaN"),
        (square(9, np.inf), "infinite"),
        (square(9, 255.0), "255.*0 to 255 as uint8"),
        (square(9, -0.1), "-0.1"),
        (square(9).astype(int), "int64"),
        (square(9).astype(complex), "complex"),
        (np.full((28, 28), "7"), "type"),
        (None, r"shape \(\)"),
        ([[1, 2], [3]], "image is not an array"),
        (torch.zeros(28, 28, requires_grad=True), "image is not an array.*detach"),
        (torch.zeros(28, 28, dtype=torch.bfloat16), "image is not an array"),
    ],
)
def test_unusable_images_are_refused_with_the_reason(image, reason):
    with pytest.raises(ValueError, match=reason):
        label_image(image)


@pytest.mark.parametrize(
    ("name", "value"),
    [("wall", w) for w in (0, -1, 1.5, "2", None, True, 10**6)]
    + [("threshold", t) for t in (-0.1, 1, np.nan, "x", None)]
    + [("clamped", edge) for edge in ("ceiling", "Bottom", "", None, 0)],
)
def test_arguments_out_of_range_are_named(name, value):
    with pytest.raises(ValueError, match=f"{name} must be .*not {value!r}"):
        label_image(square(9), **{name: value})


def test_largest_square_that_fits():
    assert np.array_equal(label_image(square(24))[2:-2, 2:-2], np.ones((24, 24)))


@pytest.fixture(scope="module")
def sevens():
    if resolve_source() != "mnist":
        pytest.skip("MNIST cannot be had: the facts about its sevens are not checked")
    return load_sevens("mnist").images


@pytest.mark.slow
@pytest.mark.mnist
def test_padding_keeps_the_wall_of_607_of_the_6265_sevens_and_five_closed(sevens):
    """A digit that touches the border has no wall there if it is dilated inside the frame; the ground is one, too."""
    labels = np.array([label_image(image) for image in sevens])
    assert labels.shape == (6265, 28, 28)
    digits = np.array([stages(image).filled for image in sevens])
    at_bottom = digits[:, -1].any(axis=1)
    at_side = digits[:, :, [0, -1]].any(axis=(1, 2))
    assert (at_bottom & ~at_side).sum() == 602
    assert np.flatnonzero(at_side).tolist() == [155, 1271, 1601, 4580, 5093]
    assert not digits[:, 0].any()

    assert not any(is_open(label) for label in labels)
    cut = np.array([label_image(image, pad=False) for image in sevens])
    at_border = (cut[:, [0, -1]] == 1).any(axis=(1, 2)) | (cut[:, :, [0, -1]] == 1).any(axis=(1, 2))
    assert np.array_equal(at_border, at_bottom | at_side)
    assert np.array_equal([is_open(label) for label in cut], at_side)
    for label in cut[at_border]:  # the mesh says the same
        with pytest.raises(ValueError) if is_open(label) else nullcontext():  # some are in pieces besides
            build_mesh(label)


@pytest.mark.mnist
def test_no_seven_is_near_the_limit_of_a_speck(sevens):
    smallest = min(stages(image).component.sum() for image in sevens)
    assert smallest > 1.5 * MIN_PIXELS
