"""Self-contact: hand-made shapes that cross, touch and keep apart; an independent count; time."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from mechanics_peers import random_label

from inflate_lib import inflate, label_image
from inflate_lib.mechanics.contact import crossing_edges, first_contact, self_contact
from inflate_lib.mechanics.mesh import boundary_edges
from inflate_lib.structures.sources import load_sevens

SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
DIGITS = load_sevens("digits").images


def shapes(*polygons):
    """Quadrilaterals that share no node, as a result with one load step."""
    nodes = np.concatenate(polygons)
    return moved(nodes, np.arange(len(nodes)).reshape(-1, 4), nodes)


def moved(nodes, cells, *positions):
    """A result with these deformed positions as its load steps."""
    displacement = np.array([p - nodes for p in positions])
    return SimpleNamespace(
        nodes=nodes, cells=cells, displacement=displacement, deformed=lambda step=-1: nodes + displacement[step]
    )


def beam(n, path):
    """A strip of n elements whose two sides follow `path`: parameter in [0, 1] → (point, normal)."""
    s = np.linspace(0, 1, n + 1)
    points, normals = path(s)
    nodes = np.concatenate([points - 0.05 * normals, points + 0.05 * normals])
    low = np.arange(n)
    return nodes, np.column_stack([low, low + 1, low + n + 2, low + n + 1])


def loop(turns, growth=0.3):
    """Path around a circle, `turns` times, while its radius grows from 1 to 1 + `growth`."""

    def path(s):
        angle = 2 * np.pi * turns * s
        normal = np.column_stack([np.cos(angle), np.sin(angle)])
        return normal * (1 + growth * s[:, None]), normal

    return path


def count_slowly(result, step=-1):
    """By solving for the crossing point of every pair of edges."""
    x, count = result.deformed(step), 0
    edges = boundary_edges(result.cells)
    for n, (i, j) in enumerate(edges):
        for k, m in edges[n + 1 :]:
            matrix = np.column_stack([x[j] - x[i], x[k] - x[m]])
            if {i, j} & {k, m} or abs(np.linalg.det(matrix)) < 1e-14:
                continue
            count += bool(np.all(np.abs(np.linalg.solve(matrix, x[k] - x[i]) - 0.5) < 0.5))
    return count


@pytest.mark.parametrize(
    ("other", "count"),
    [
        (SQUARE + [0.5, 0.5], 2),  # a corner inside
        (SQUARE * [0.2, 3] + [0.4, -1], 4),  # a cross
        (SQUARE + [1, 0], 0),  # side on side
        (SQUARE + [1, 0.5], 0),  # side on half a side
        (SQUARE + [1, 1], 0),  # corner on corner
        ((SQUARE - 0.5) @ [[1, 1], [-1, 1]] + [2, 0.5], 0),  # corner on side
        ((SQUARE - 0.5) @ [[1, 1], [-1, 1]] + [1.99, 0.5], 2),  # corner through side
        (SQUARE + [1.001, 0], 0),  # apart
        (SQUARE + [3, 3], 0),
    ],
)
def test_crossing_touching_and_apart(other, count):
    for turn in range(4):
        result = shapes(SQUARE, np.roll(other, turn, axis=0))
        assert self_contact(result) == count == len(crossing_edges(result))
        assert first_contact(result) == (0 if count else None)


def test_edges_that_share_a_node_do_not_count():
    # one element folded into its neighbour, whose edges it meets at the common nodes only
    nodes = np.array([[0.0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]])
    cells = np.array([[0, 1, 4, 3], [1, 2, 5, 4]])
    assert len(boundary_edges(cells)) == 6
    folded = nodes.copy()
    folded[2], folded[5] = [0.3, 0.2], [0.3, 0.8]
    assert self_contact(moved(nodes, cells, folded)) == 0


def test_strip_that_is_wound_up_crosses_itself_when_it_must():
    straight, cells = beam(60, lambda s: (np.column_stack([s, 0 * s]), np.column_stack([0 * s, 1 + 0 * s])))
    open_ring, spiral = beam(60, loop(0.9))[0], beam(60, loop(1.2))[0]
    overlap = beam(60, loop(1.2, growth=0.02))[0]  # its end lies within its beginning
    result = moved(straight, cells, straight, open_ring, spiral, overlap)
    assert [self_contact(result, step) for step in range(3)] == [0, 0, 0]
    assert self_contact(result) >= 2
    assert first_contact(result) == 3
    assert self_contact(result) == count_slowly(result)
    first, second = crossing_edges(result)[0]
    assert not set(first) & set(second)


def test_boundary_is_where_one_element_ends():
    for seed in range(5):
        label = random_label(seed)
        mesh = inflate(label, n_steps=1, pressure=0).mesh
        wall = np.pad(label == 0.5, 1)
        sides = sum(np.sum(wall & ~np.roll(wall, shift, axis)) for axis in (0, 1) for shift in (-1, 1))
        edges = boundary_edges(mesh.cells)
        assert len(edges) == sides
        assert {tuple(sorted(edge)) for edge in mesh.pressure_edges.tolist()} <= set(map(tuple, edges.tolist()))


def test_count_is_that_of_an_independent_method():
    found = []
    for seed in range(12):
        result = inflate(random_label(seed, size=12), n_steps=2, pressure=0.03)
        if result.converged:
            found.append(self_contact(result))
            assert found[-1] == count_slowly(result)
    assert len(found) > 6
    shaken = inflate(label_image(DIGITS[0]), n_steps=1)
    shaken.displacement[0] += np.random.default_rng(0).uniform(-0.05, 0.05, shaken.nodes.shape)
    assert self_contact(shaken) == count_slowly(shaken) > 10


def test_step_without_equilibrium_has_no_contact():
    result = inflate(label_image(DIGITS[0]), pressure=2.0)
    assert not result.converged
    assert self_contact(result) == 0


def test_it_takes_no_time():
    result = inflate(label_image(DIGITS[0]))
    self_contact(result)
    times = []
    for _ in range(20):
        started = time.perf_counter()
        self_contact(result)
        times.append(time.perf_counter() - started)
    assert min(times) < 1e-3
