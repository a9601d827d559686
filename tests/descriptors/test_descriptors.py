"""Descriptors: exact shapes, invariances, and the medial axis against an independent way to cut a hull."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mechanics_peers import hook
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from inflate_lib import describe, inflate
from inflate_lib.descriptors import DESCRIPTORS, Descriptors, descriptor_matrix, get_descriptor
from inflate_lib.descriptors.shape import AXIS_POINTS, _hull_sides, outline_corners, support_function

numbers = st.floats(-5, 5).map(lambda x: round(x, 6))
clouds = st.lists(st.tuples(numbers, numbers), min_size=3, max_size=40).map(np.array)
lattices = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=3, max_size=30).map(
    lambda points: np.array(points, dtype=float)
)  # flat bottoms, flat tops and points in a row
points = clouds | lattices


def solid(nodes):
    """Skip what is nearly a line: its hull has no reliable chords."""
    spread = np.linalg.svd(nodes - nodes.mean(axis=0), compute_uv=False)
    assume(spread[1] > 1e-3)
    assume(np.ptp(nodes[:, 1]) > 1e-3)
    return nodes


def chord(nodes, height):
    """Left and right end of the hull's chord: the lowest and highest x of all segments between two points there."""
    below, above = nodes[nodes[:, 1] <= height], nodes[nodes[:, 1] >= height]
    a, b = below[:, None], above[None]
    rise = b[..., 1] - a[..., 1]
    share = np.divide(height - a[..., 1], rise, where=rise > 0, out=np.zeros((len(below), len(above))))
    x = np.concatenate([(a[..., 0] + share * (b[..., 0] - a[..., 0])).ravel(), nodes[nodes[:, 1] == height, 0]])
    return x.min(), x.max()


def same(one, other, tolerance=1e-9):
    return all(np.allclose(one.vector(name), other.vector(name), rtol=0, atol=tolerance) for name in DESCRIPTORS)


@given(points)
@settings(max_examples=150, deadline=None)
def test_axis_halves_the_chords(nodes):
    d = describe(solid(nodes))
    assert d.medial_axis.shape == (AXIS_POINTS, 2)
    assert np.array_equal(d.medial_axis[0], [0, 0])
    assert np.allclose(d.medial_axis[:, 1], np.arange(AXIS_POINTS) * d.height / AXIS_POINTS, rtol=0, atol=1e-12)
    bottom = nodes[:, 1].min()
    middles = [sum(chord(nodes, bottom + y)) / 2 for y in d.medial_axis[1:, 1]]
    foot = nodes[nodes[:, 1] == bottom, 0]
    assert np.allclose(d.medial_axis[1:, 0], np.array(middles) - (foot.min() + foot.max()) / 2, rtol=0, atol=1e-6)


@given(points)
@settings(max_examples=100, deadline=None)
def test_scalars_are_those_of_the_hull(nodes):
    d = describe(solid(nodes))
    assert (d.width, d.height) == tuple(np.ptp(nodes, axis=0))
    assert d.bounding_box == (d.height, d.width)
    x, y = nodes[ConvexHull(nodes).vertices].T
    assert np.isclose(d.hull_area, 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)), rtol=1e-9)
    assert 0 < d.hull_area <= d.width * d.height * (1 + 1e-12)
    more = np.concatenate([nodes, nodes.mean(axis=0)[None], nodes[::2]])  # inner points do not count
    assert same(d, describe(more), 1e-7)


@given(points)
@settings(max_examples=60, deadline=None)
def test_axis_lies_inside_the_hull(nodes):
    d = describe(solid(nodes))
    hull = ConvexHull(nodes)
    foot = nodes[nodes[:, 1] == nodes[:, 1].min(), 0]
    placed = d.medial_axis + [(foot.min() + foot.max()) / 2, nodes[:, 1].min()]
    assert np.all(placed @ hull.equations[:, :2].T + hull.equations[:, 2] < 1e-6)


@given(points, numbers, numbers, st.floats(0.1, 10))
@settings(max_examples=100, deadline=None)
def test_moved_scaled_and_mirrored_shapes(nodes, dx, dy, scale):
    d = describe(solid(nodes))
    # exact arithmetic keeps flat bottoms flat: moves by multiples of 2⁻²⁰
    move = np.round(np.array([dx, dy]) * 2**20) / 2**20
    moved = np.round(nodes * 2**20) / 2**20
    assume(np.linalg.svd(moved - moved.mean(axis=0), compute_uv=False)[1] > 1e-3)
    assert same(describe(moved), describe(moved + move), 1e-7)
    bigger = describe(scale * nodes)
    assert np.isclose(bigger.height, scale * d.height) and np.isclose(bigger.width, scale * d.width)
    assert np.isclose(bigger.hull_area, scale**2 * d.hull_area)
    assert np.allclose(bigger.medial_axis, scale * d.medial_axis, rtol=0, atol=1e-6)
    mirrored = describe(nodes * [-1, 1])
    assert np.isclose(mirrored.hull_area, d.hull_area) and mirrored.bounding_box == d.bounding_box
    assert np.allclose(mirrored.medial_axis, d.medial_axis * [-1, 1], rtol=0, atol=1e-7)


@given(points)
@settings(max_examples=60, deadline=None)
def test_sides_rise_and_share_the_hull(nodes):
    hull = nodes[ConvexHull(solid(nodes)).vertices]
    for start in range(len(hull)):  # whichever corner comes first
        left, right = _hull_sides(np.roll(hull, start, axis=0))
        for side in (left, right):
            assert np.all(np.diff(side[:, 1]) > 0)
            assert side[0, 1] == hull[:, 1].min() and side[-1, 1] == hull[:, 1].max()
        assert {*map(tuple, left), *map(tuple, right)} <= {*map(tuple, hull)}


def test_rectangle_and_triangles_exactly():
    y = np.arange(AXIS_POINTS) / AXIS_POINTS
    rectangle = describe([[1, 2], [4, 2], [4, 4], [1, 4]])
    assert (rectangle.height, rectangle.width, rectangle.hull_area) == (2, 3, 6)
    assert np.allclose(rectangle.medial_axis, np.column_stack([0 * y, 2 * y]), rtol=0, atol=1e-15)
    # flat bottom from 0 to 2, top at x = 4: the middle runs from 1 to 4
    triangle = describe([[0, 0], [2, 0], [4, 1]])
    assert np.isclose(triangle.hull_area, 1)
    assert np.allclose(triangle.medial_axis, np.column_stack([3 * y, y]), rtol=0, atol=1e-15)
    # standing on its tip, flat top from 0 to 2
    tip = describe([[4, 0], [2, 1], [0, 1]])
    assert np.allclose(tip.medial_axis, np.column_stack([-3 * y, y]), rtol=0, atol=1e-15)


def test_circle_approaches_its_numbers():
    angle = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    d = describe(np.column_stack([np.cos(angle), np.sin(angle)]))
    assert np.isclose(d.hull_area, np.pi, rtol=1e-5)
    assert np.abs(d.medial_axis[:, 0]).max() < 2e-3


def test_axis_of_an_inflated_structure_lies_inside_it():
    result = inflate(hook(), pressure=0.03)
    d, nodes = describe(result), result.deformed()
    foot = nodes[result.mesh.clamped, 0]
    placed = d.medial_axis + [(foot.min() + foot.max()) / 2, 0]
    for point in placed:  # a convex combination of the nodes: linear programming knows no hull
        weights = linprog(np.zeros(len(nodes)), A_eq=np.vstack([nodes.T, np.ones(len(nodes))]), b_eq=[*point, 1])
        assert weights.success
    assert same(d, describe(nodes))
    assert describe(result, step=0).height < d.height
    assert same(describe(result, step=9), d)


def test_vectors_have_the_declared_lengths():
    d = describe([[0, 0], [2, 0], [4, 1]])
    for name in DESCRIPTORS:
        assert len(d.vector(name)) == get_descriptor(name).length
    assert d.vector("box").tolist() == [d.height, d.width]
    assert d.vector("axis").tolist() == d.medial_axis.ravel().tolist()
    with pytest.raises(ValueError, match=r"'weight'.*height"):
        d.vector("weight")


@pytest.mark.parametrize(
    "nodes",
    [None, [], 3, "seven", np.zeros((4, 3)), np.zeros((0, 2)), [[0, 0]], [[0, 0], [1, 1]], [[0, 0], [1, 1], [2, 2]],
     np.ones((5, 2)), [[0, 0], [1, 0], [0, np.nan]], [[0, 0], [1, 0], [0, np.inf]]],
)  # fmt: skip
def test_shapes_without_descriptors(nodes):
    with pytest.raises(ValueError, match="nodes"):
        describe(nodes)


def test_only_equilibria_are_described():
    result = inflate(hook(), pressure=2.0)
    with pytest.raises(ValueError, match=r"no equilibrium.*load step"):
        describe(result)
    for step in (10, -11, 1.5, "last", None):
        with pytest.raises(ValueError, match="step must be a whole number from -10 to 9"):
            describe(result, step)


def test_matrix_takes_rows_and_columns_in_order():
    import xarray as xr

    rng = np.random.default_rng(0)
    rows = [Descriptors(*rng.random(3), rng.random((AXIS_POINTS, 2)), rng.random(32)) for _ in range(3)]
    data = xr.Dataset(
        {name: ("structure", [getattr(row, name) for row in rows]) for name in ("height", "width", "hull_area")}
        | {"medial_axis": (("structure", "point", "axis"), [row.medial_axis for row in rows])}
    )
    for name in DESCRIPTORS:
        matrix = descriptor_matrix(data, name)
        assert matrix.shape == (3, get_descriptor(name).length)
        assert np.array_equal(matrix, [row.vector(name) for row in rows])
    with pytest.raises(ValueError, match="unknown descriptor"):
        descriptor_matrix(data, "volume")


def test_support_functions_of_a_rectangle_and_of_a_disc():
    angle = 2 * np.pi * np.arange(32) / 32
    rectangle = np.array([[3.0, 1.0], [5.0, 1.0], [5.0, 1.5], [3.0, 1.5]])  # 2 wide, 0.5 high
    expected = np.abs(np.cos(angle)) + 0.5 * np.maximum(np.sin(angle), 0)
    assert np.allclose(support_function(rectangle), expected, atol=1e-14)
    circle = np.arange(3200) * 2 * np.pi / 3200
    disc = np.column_stack([7 + 0.4 * np.cos(circle), 0.4 + 0.4 * np.sin(circle)])
    assert np.allclose(support_function(disc), 0.4 + 0.4 * np.sin(angle), atol=1e-14)


@given(points)
@settings(max_examples=60, deadline=None)
def test_an_outline_tells_height_and_width_and_encloses_the_hull(nodes):
    shape, outline = describe(solid(nodes)), get_descriptor("outline")
    (height, same_height), (width, same_width) = (bound(shape.outline) for bound in outline.bounds.values())
    assert height == same_height == pytest.approx(shape.height)
    assert width == same_width == pytest.approx(shape.width)
    corners = outline_corners(shape.outline)
    assert ConvexHull(corners).volume >= shape.hull_area * (1 - 1e-9)
    mirrored = describe(np.asarray(nodes) * [-1, 1])
    assert np.allclose(outline.mirrored(shape.outline[None])[0], mirrored.outline, atol=1e-9)
    # A target may be the corners of the outline, or its support function.
    for value in (corners, shape.outline):
        assert np.allclose(outline.target(value), shape.outline, atol=1e-9 + 1e-6 * shape.height)
