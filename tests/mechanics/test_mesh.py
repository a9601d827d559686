"""Meshes: geometry that any label image must give, and labels that must be refused."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_peers import hook, random_label

from inflate_lib import build_mesh, label_image
from inflate_lib.mechanics.mesh import boundary_edges, boundary_loops
from inflate_lib.structures.labels import _EDGES
from inflate_lib.structures.sources import load_sevens

DIGITS = load_sevens("digits").images
labels = st.integers(0, 2**32 - 1).map(random_label) | st.sampled_from(list(DIGITS)).map(label_image)


def polygon_area(corners):
    x, y = np.moveaxis(corners, -1, 0)
    return 0.5 * (x * np.roll(y, -1, axis=-1) - y * np.roll(x, -1, axis=-1)).sum(axis=-1)


@settings(max_examples=60, deadline=None)
@given(labels, st.integers(1, 3))
def test_cells_are_the_wall_pixels(label, refine):
    mesh, size = build_mesh(label, refine), len(label)
    assert len(mesh.cells) == np.sum(label == 0.5) * refine**2
    assert np.allclose(polygon_area(mesh.nodes[mesh.cells]), (1 / size / refine) ** 2, rtol=1e-12)  # counter-clockwise
    x, y = mesh.nodes[mesh.cells].mean(axis=1).T * size
    assert np.all(label[(size - y).astype(int), x.astype(int)] == 0.5)
    assert len(np.unique(mesh.nodes, axis=0)) == len(mesh.nodes)
    assert np.array_equal(np.unique(mesh.cells), np.arange(len(mesh.nodes)))  # every node is used
    assert np.array_equal(mesh.clamped, mesh.nodes[:, 1] == 0)
    assert mesh.clamped.any()


@settings(max_examples=60, deadline=None)
@given(labels, st.integers(1, 3))
def test_pressure_edges_enclose_the_void(label, refine):
    mesh, size = build_mesh(label, refine), len(label)
    start, end = mesh.pressure_edges.T
    # as many edges leave a node as arrive: closed loops; counter-clockwise, they enclose the area of the void
    assert np.array_equal(np.sort(start), np.sort(end))
    (x0, y0), (x1, y1) = mesh.nodes[start].T, mesh.nodes[end].T
    assert np.isclose(0.5 * np.sum(x0 * y1 - x1 * y0), np.sum(label == 1) / size**2, rtol=1e-12)
    # the pixel on the left-hand side is void, the one on the right-hand side is wall
    middle, left = (mesh.nodes[start] + mesh.nodes[end]) / 2, np.column_stack([y0 - y1, x1 - x0]) / 2
    for side, expected in ((middle + left, 1), (middle - left, 0.5)):
        x, y = side.T * size
        assert np.all(label[(size - y).astype(int), x.astype(int)] == expected)
    borders = sum(np.sum((a == 1) != (b == 1)) for a, b in ((label[1:], label[:-1]), (label[:, 1:], label[:, :-1])))
    assert len(start) == borders * refine


@given(labels)
@settings(max_examples=30, deadline=None)
def test_mirrored_label_has_the_mirrored_mesh(label):
    mesh, mirrored = build_mesh(label), build_mesh(label[:, ::-1])
    flipped = np.sort(np.round((mesh.nodes * [-1, 1] + [1, 0]) * len(label)).view("f8,f8"), axis=0)
    assert np.array_equal(flipped, np.sort(np.round(mirrored.nodes * len(label)).view("f8,f8"), axis=0))


@given(labels, st.sampled_from(range(4)))
@settings(max_examples=30, deadline=None)
def test_turned_label_has_the_turned_mesh(label, turns):
    mesh, turned = build_mesh(label), build_mesh(np.rot90(label, -turns), clamped=_EDGES[turns])

    def described(mesh, turns):
        """Nodes, held nodes, and the two ends of each pressure edge, turned and in an order of their own."""
        nodes = np.round(len(label) * (mesh.nodes - 0.5) * 2).astype(int)
        for _ in range(turns):  # counter-clockwise, as np.rot90
            nodes = nodes[:, ::-1] * [-1, 1]
        ends = nodes[mesh.pressure_edges].reshape(-1, 4)
        return [sorted(rows.tolist()) for rows in (nodes, nodes[mesh.clamped], ends)]

    assert described(turned, turns) == described(mesh, 0)


def edited(*changes):
    label = hook()
    for where, value in changes:
        label[where] = value
    return label


@pytest.mark.parametrize(
    ("label", "message"),
    [
        (None, "must be an array of 0"),
        ("seven", "must be an array of 0"),
        ([[0, 0.5], [1]], "must be an array of 0"),
        (torch.tensor(hook(), requires_grad=True), "must be an array of 0"),
        (np.zeros((0, 0)), "square image"),
        (np.zeros((3, 4)), "square image"),
        (np.zeros((2, 3, 3)), "square image"),
        (np.full((4, 4), np.nan), "must be an array of 0"),
        (255 * hook(), "values must be 0"),
        (np.zeros((5, 5)), "no wall"),
        (np.where(hook() == 1, 0.5, hook()), "no void"),
        (np.roll(hook(), -2, axis=0)[:, ::-1] * (np.arange(12) < 10)[:, None], "nothing is clamped"),
        (edited((np.s_[-2:, 9:], 0.5)), "2 pieces"),
        (edited((np.s_[1, 0], 0.5)), "2 pieces"),  # a corner is a hinge, no connection
        (edited((np.s_[8:10, 1:3], 0)), "cavity is open"),
        (edited((np.s_[2:4, 4], 1)), "cavity is open"),
        (edited((np.s_[8:10, 1:3], 1), (np.s_[8:10, 0], 1)), "cavity is open"),  # to the frame
    ],
)
def test_labels_that_cannot_be_inflated(label, message):
    with pytest.raises(ValueError, match=message):
        build_mesh(label)


@pytest.mark.parametrize("refine", [0, -1, 1.5, "2", None, True])
def test_refine_must_be_a_whole_number(refine):
    with pytest.raises(ValueError, match="refine"):
        build_mesh(hook(), refine)


@pytest.mark.parametrize("turns", range(4))
def test_ground_may_close_the_cavity_at_the_clamped_edge_only(turns):
    label = hook()
    label[10:, 3:5] = 1  # down to the clamped edge, which has no pressure edges
    label[:2] = label[2]  # the wall reaches three edges of the image
    label[:, 0] = label[:, 1]
    label = np.rot90(label, -turns)
    mesh = build_mesh(label, clamped=_EDGES[turns])
    assert not mesh.clamped[mesh.pressure_edges].all(axis=1).any()
    assert mesh.clamped[mesh.pressure_edges].sum() == 2
    for other in (1, 2):
        with pytest.raises(ValueError, match="cavity is open"):
            build_mesh(label, clamped=_EDGES[(turns + other) % 4])


@pytest.mark.parametrize("edge", ["ceiling", None, 0, ["top"]])
def test_clamped_must_be_an_edge(edge):
    with pytest.raises(ValueError, match="clamped must be one of bottom, left, top, right"):
        build_mesh(hook(), clamped=edge)


def test_the_edge_that_no_wall_reaches_is_named():
    with pytest.raises(ValueError, match=r"nothing is clamped.*right edge"):
        build_mesh(hook(), clamped="right")


def test_loops_keep_to_one_hole_where_holes_touch_at_a_corner():
    label = np.full((8, 8), 0.5)
    label[1, 1] = label[2, 2] = label[3, 1] = 0.0  # pixels of outside within the wall, which share corners
    label[4:6, 2:4] = 1.0  # and one of them shares one with the cavity
    mesh = build_mesh(label)
    loops = boundary_loops(mesh.cells)
    edges = [pair for loop in loops for pair in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True)]
    assert len(edges) == len(set(edges)) == len(boundary_edges(mesh.cells)) == 32 + 3 * 4 + 8
    areas = sorted(round(64 * polygon_area(mesh.nodes[loop])) for loop in loops)
    assert areas == [-4, -1, -1, -1, 64]
    pressurised = {(end, start) for start, end in mesh.pressure_edges.tolist()}
    (cavity,) = [loop for loop in loops if (loop[0], loop[1]) in pressurised]
    assert len(cavity) == len(pressurised) == 8
