"""Demands of a maker: each against its definition, spelled out slowly."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage

from inflate_lib import inflate, label_image
from inflate_lib.inverse.constraints import Constraints, _is_symmetric, _wide_enough, from_millimetres, mirrored, pixels
from inflate_lib.inverse.refine import Rejection, _free_place, attempt
from inflate_lib.mechanics.mesh import boundary_loops
from inflate_lib.structures.labels import FRAME, OUTSIDE, PIXEL, VOID, WALL
from inflate_lib.structures.sources import load_sevens

DIGITS = load_sevens("digits").images


@pytest.fixture(scope="module")
def seven():
    label = label_image(DIGITS[0])
    return label, inflate(label)


def slowly_wide_enough(void, width):
    """Every place of the square one by one."""
    places = np.zeros_like(void)
    covered = np.zeros_like(void)
    for row in range(len(void) - width + 1):
        for column in range(len(void) - width + 1):
            square = (slice(row, row + width), slice(column, column + width))
            if void[square].all():
                places[row, column] = True
                covered[square] = True
    deep = [
        (r, c)
        for r, c in np.argwhere(void & ~covered)
        if not covered[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2].any()
    ]
    return ndimage.label(places)[1] == 1 and not deep


@settings(deadline=None, max_examples=150)
@given(arrays(bool, (9, 9)), st.integers(1, 4), st.booleans())
def test_the_width_of_a_cavity_is_that_of_a_square_that_passes(void, width, smooth):
    if smooth:
        void = ndimage.binary_dilation(ndimage.binary_erosion(void, np.ones((2, 2))), np.ones((4, 3)))
    assert _wide_enough(void, width) == slowly_wide_enough(void, width)


def test_strips_are_as_wide_as_they_are():
    for width in range(1, 6):
        strip = np.zeros((20, 20), bool)
        strip[3 : 3 + width, 2:18] = True
        strip[3:18, 2 : 2 + width] = True
        assert _wide_enough(strip, width) and not _wide_enough(strip, width + 1)
    neck = np.zeros((20, 20), bool)
    neck[2:8, 2:8] = neck[2:8, 10:16] = neck[4, 8:10] = True  # two rooms and a door of one pixel
    assert _wide_enough(neck, 1) and not _wide_enough(neck, 2)


def test_lengths_count_in_whole_pixels():
    assert [pixels(n * PIXEL) for n in range(29)] == list(range(29))
    assert pixels(2.01 * PIXEL) == 3 and pixels(0) == 0
    assert Constraints(min_void=2 * PIXEL).min_void == from_millimetres(280, min_void=20).min_void


def test_material_is_the_area_of_the_wall(seven):
    label, result = seven
    x, y = np.moveaxis(result.nodes[result.cells], -1, 0)
    area = 0.5 * np.abs((x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(1)).sum()  # of the mesh, by the shoelace
    assert Constraints(max_material=area * (1 + 1e-12)).broken_by(label) == ""
    assert Constraints(max_material=area * (1 - 1e-6)).broken_by(label) == "max_material"
    assert from_millimetres(50, max_material=2500 * area * 1.001).broken_by(label) == ""


def test_mirror_images_are_symmetric_structures():
    made = 0
    for image in DIGITS[:20]:
        assert not _is_symmetric(label_image(image))
        for picture in mirrored(image / 255):
            try:
                label = label_image(picture)
            except ValueError:
                continue
            made += 1
            assert _is_symmetric(label) and Constraints(symmetric=True).broken_by(label) == ""
            assert Constraints(symmetric=True).broken_by(label_image(image)) == "symmetric"
    assert made >= 40
    assert mirrored(np.zeros((28, 28))) == []


def test_a_region_is_touched_by_the_pixels_that_reach_into_it(seven):
    label, _ = seven
    rows, columns = np.nonzero(label != OUTSIDE)
    left, right, top = columns.min() * PIXEL, (columns.max() + 1) * PIXEL, (FRAME - rows.min()) * PIXEL
    for region in ((right, 0, 2, 1), (-1, 0, left, 1), (-1, top, 2, 3)):
        assert Constraints(keep_out=region).broken_by(label) == ""
    for region in ((right - 1e-3, 0, 2, 1), (-1, 0, left + 1e-3, 1), (-1, top - 1e-3, 2, 3)):
        assert Constraints(keep_out=region).broken_by(label) == "keep_out"
    inside = np.argwhere(label == VOID)[5]
    x, y = (inside[1] + 0.5) * PIXEL, (FRAME - inside[0] - 0.5) * PIXEL
    assert Constraints(keep_out=(x - 0.001, y - 0.001, x + 0.001, y + 0.001)).broken_by(label) == "keep_out"


def test_an_inflated_structure_keeps_out_too(seven):
    label, result = seven
    reached = result.deformed()[:, 1].max()
    at_rest = result.nodes[:, 1].max()
    assert reached > at_rest + 0.03
    above = Constraints(keep_out=(-1, reached + 1e-6, 2, 3))
    between = Constraints(keep_out=(-1, (reached + at_rest) / 2, 2, 3))
    assert above.broken_by(label) == above.broken_when_inflated(result) == between.broken_by(label) == ""
    assert between.broken_when_inflated(result) == "keep_out"
    for middle in result.deformed()[result.cells].mean(axis=1)[::20]:  # a pin inside the wall, smaller than an element
        x, y = middle
        assert Constraints(keep_out=(x - 1e-4, y - 1e-4, x + 1e-4, y + 1e-4)).broken_when_inflated(result) == "keep_out"


def test_the_borders_of_a_wall_are_closed_and_complete(seven):
    label, result = seven
    loops = boundary_loops(result.cells)
    areas = []
    for loop in loops:
        x, y = result.nodes[loop].T
        areas.append(0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / PIXEL**2)
        steps = np.abs(np.diff(result.nodes[np.append(loop, loop[0])], axis=0)).sum(axis=1)
        assert np.allclose(steps, PIXEL)  # from each node to a neighbour, the last to the first as well
    assert sum(areas) == pytest.approx((label == WALL).sum())  # holes run clockwise
    assert min(areas) == pytest.approx(-(label == VOID).sum())


def test_a_structure_steps_aside_for_a_region(seven):
    label, result = seven
    columns = np.flatnonzero(np.any(label != OUTSIDE, axis=0))
    left = result.deformed()[:, 0].min()
    region = Constraints(keep_out=(-1, 0, left + 1.5 * PIXEL, 2))
    shift = _free_place(label, result, region)
    assert shift == min(2, FRAME - 1 - columns[-1]) == 2
    reason, moved, inflated = attempt(DIGITS[0] / 255, region)
    assert reason is None and np.array_equal(moved, np.roll(label, shift, axis=1))
    assert np.allclose(inflated.displacement, result.displacement, atol=1e-9)
    assert inflated.deformed()[:, 0].min() > left + 1.5 * PIXEL
    nowhere = Constraints(keep_out=(-1, 0.5, 2, 0.6))
    assert _free_place(label, result, nowhere) is None
    assert attempt(DIGITS[0] / 255, nowhere)[0] is Rejection.KEEP_OUT


def test_the_smallest_structures_are_the_limit_of_what_can_be_demanded():
    """A cavity of twelve pixels, and a narrow one beside a wide obstacle; a square one that fills the frame."""
    block, line = np.zeros((2, FRAME, FRAME))
    block[23:26, 12:16] = line[14:26, 25] = 1
    least, beside = Constraints(max_material=44 * PIXEL**2), Constraints(keep_out=(0, 0, 23 * PIXEL, 1))
    for possible, image in ((least, block), (beside, line)):
        possible.check()
        assert possible.broken_by(label_image(image)) == ""
    square = np.zeros((FRAME, FRAME))
    square[2:26, 2:26] = 1
    largest = Constraints(min_void=24 * PIXEL)
    largest.check()
    assert largest.broken_by(label_image(square)) == ""
    for demand, message in (
        ({"max_material": 43.9 * PIXEL**2}, "max_material .* the least wall"),
        ({"max_material": 50 * PIXEL**2, "min_void": 5 * PIXEL}, "max_material .* the least wall"),
        ({"keep_out": (0, 0, 23.1 * PIXEL, 1)}, "no room"),
        ({"keep_out": (0, 4.9 * PIXEL, 1, 1)}, "no room"),
        ({"keep_out": (-5, -5, 5, 5)}, "no room"),
        ({"min_void": 24.1 * PIXEL}, "does not fit into the frame"),
    ):
        with pytest.raises(ValueError, match=message):
            Constraints(**demand).check()


@pytest.mark.parametrize(
    ("demand", "message"),
    [
        ({"min_void": -1}, "min_void"),
        ({"min_void": 2}, "more than the frame"),
        ({"min_void": "wide"}, "min_void"),
        ({"max_material": 0}, "max_material"),
        ({"max_material": float("nan")}, "max_material"),
        ({"symmetric": "yes"}, "symmetric"),
        ({"keep_out": (0, 0, 1)}, "four numbers"),
        ({"keep_out": (0, 0, 1, float("nan"))}, "four numbers"),
        ({"keep_out": (1, 0, 0, 1)}, "left < right"),
    ],
)
def test_demands_that_make_no_sense_are_refused(demand, message):
    with pytest.raises(ValueError, match=message):
        Constraints(**demand)
    with pytest.raises(ValueError, match="size"):
        from_millimetres(0)
