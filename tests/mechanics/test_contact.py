"""Self-contact: hand-made shapes that cross, touch and keep apart; an independent count; walls that cannot cross."""

import time
from functools import partial
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from mechanics_peers import places, random_label
from scipy import sparse

from inflate_lib import describe, inflate, label_image, paths
from inflate_lib.descriptors import get_descriptor
from inflate_lib.inverse.adjoint import sensitivities
from inflate_lib.mechanics import _barrier, contact
from inflate_lib.mechanics.contact import (
    contact_forces,
    coupled_system,
    crossing_edges,
    first_contact,
    self_contact,
    walls_of,
)
from inflate_lib.mechanics.inflation import assemble, build_system, equilibrium, solve
from inflate_lib.mechanics.mesh import Mesh, boundary_edges
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


# --- walls that cannot cross ------------------------------------------------------------------------------------------

GAP = 0.1


def barrier_at(x, gap=GAP):
    """Potential of node 0 before the edge from node 1 to node 2, and its derivatives (3, 2) and (6, 6)."""
    gradient, hessian = np.empty(6), np.empty((6, 6))
    potential = _barrier.barrier(x, 0, 1, 2, gap, 1.0, gradient, hessian)
    return potential, gradient.reshape(3, 2), hessian


def arch():
    """A hand-made cavity whose outer walls meet."""
    image = np.zeros((28, 28))
    image[4:24, 6:9] = image[4:24, 14:17] = image[4:7, 6:17] = 1
    return label_image(image)


def slit():
    """A tall, narrow cavity, which suction closes."""
    image = np.zeros((28, 28))
    image[4:26, 13:15] = 1
    return label_image(image)


def blocks(n_lower, n_upper, apart=0.1):
    """Two square blocks above one another, held at their far ends and along their sides, with pressure between them."""

    def block(n, bottom):
        x, y = np.meshgrid(np.linspace(0, 1, n + 1), bottom + np.linspace(0, 1, n + 1))
        corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
        return np.column_stack([x.ravel(), y.ravel()]), corner[:, None] + [0, 1, n + 2, n + 1]

    (lower, cells), (upper, more) = block(n_lower, 0.0), block(n_upper, 1.0 + apart)
    nodes, first = np.concatenate([lower, upper]), len(lower)
    face = first - n_lower - 1 + np.arange(n_lower + 1), first + np.arange(n_upper + 1)[::-1]
    edges = np.concatenate([np.column_stack([line[:-1], line[1:]]) for line in face])
    held = np.column_stack([np.ones(len(nodes), dtype=bool), np.isin(nodes[:, 1], [0.0, 2.0 + apart])])
    return Mesh(nodes, np.concatenate([cells, first + more]), edges, held)


@pytest.fixture(scope="module")
def pressed():
    result = inflate(arch(), contact=True)
    assert result.converged and first_contact(inflate(arch())) is not None
    return result


def as_matrix(system, blocks):
    """The blocks of a lower triangle as a symmetric sparse matrix."""
    rows, columns = places(system.pattern)
    rows, columns = (2 * rows[:, None] + [0, 0, 1, 1]).ravel(), (2 * columns[:, None] + [0, 1, 0, 1]).ravel()
    lower = sparse.csc_array((blocks.ravel(), (rows, columns)))
    return sparse.csc_array(sparse.tril(lower) + sparse.tril(lower, -1).T)


def test_barrier_is_a_potential():
    """Force and stiffness against difference quotients: before the edge, before its ends, on both sides, and turned."""
    rng, h = np.random.default_rng(0), 1e-6
    for along in rng.uniform(-0.08, 1.08, 60):
        angle = rng.uniform(0, 2 * np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        x = np.array([[along, rng.choice([-1, 1]) * rng.uniform(0.01, 0.09)], [0, 0], [1, 0]]) @ turn.T
        potential, force, stiffness = barrier_at(x)
        assert potential >= 0
        for unknown in range(6):
            move = np.zeros(6)
            move[unknown] = h
            plus, minus = barrier_at(x + move.reshape(3, 2)), barrier_at(x - move.reshape(3, 2))
            assert force.ravel()[unknown] == pytest.approx((plus[0] - minus[0]) / (2 * h), rel=1e-5, abs=1e-7)
            slope = (plus[1] - minus[1]).ravel() / (2 * h)
            assert np.allclose(stiffness[unknown], slope, rtol=1e-5, atol=1e-5 * np.abs(stiffness).max())


def test_barrier_begins_at_the_gap_without_a_kink_and_has_no_end():
    def before_the_middle(d):
        return barrier_at(np.array([[0.5, d], [0, 0], [1, 0]]))

    potential, force, stiffness = before_the_middle(GAP * (1 - 1e-6))
    assert 0 <= potential < 1e-12 and np.abs(force).max() < 1e-5 and np.abs(stiffness).max() < 1e-3
    assert not any(np.any(part) for part in before_the_middle(GAP))
    assert before_the_middle(1e-300)[0] > 600 * GAP
    assert not before_the_middle(0.0)[0] < np.inf  # so that no equilibrium is found there, but no error raised


def test_a_straight_wall_is_one_wall_however_it_is_divided():
    d = 0.03
    whole, force, _ = barrier_at(np.array([[0.5, d], [-9, 0], [9, 0]]))
    for place in (0.2, 0.5, 0.58, 0.6, 0.61):
        corners = [-1, 0.2, 0.58, 0.6, 1.0, 2.0]
        parts = [barrier_at(np.array([[place, d], [a, 0], [b, 0]])) for a, b in pairwise(corners)]
        assert sum(part[0] for part in parts) == pytest.approx(whole, rel=1e-12)
        assert np.allclose(sum(part[1][0] for part in parts), force[0], rtol=1e-12, atol=1e-14)


def test_where_nothing_comes_near_nothing_changes():
    compared = 0
    for image in DIGITS[:40]:
        label = label_image(image)
        free, guarded = inflate(label), inflate(label, contact=True)
        if not contact_forces(guarded).any() and first_contact(free) is None:
            compared += np.array_equal(free.displacement, guarded.displacement)
            assert np.abs(free.displacement - guarded.displacement).max() < 1e-10
    assert compared > 10


@pytest.mark.mnist
def test_walls_do_not_cross_at_any_load_step():
    """Sevens whose walls cross without contact, some from the first load steps on."""
    sevens = load_sevens("mnist").images
    for number in (4, 8, 15, 16, 225):
        label = label_image(sevens[number])
        free, guarded = inflate(label), inflate(label, contact=True)
        assert first_contact(free) is not None
        assert guarded.converged and first_contact(guarded) is None
        before = max(first_contact(free) - 2, 0)
        assert np.array_equal(guarded.displacement[:before], free.displacement[:before])
        shape, mirrored = describe(guarded), describe(inflate(label[:, ::-1], contact=True))
        assert (mirrored.width, mirrored.hull_area) == pytest.approx((shape.width, shape.hull_area), rel=1e-7)


def test_tangent_and_residual_belong_together(pressed):
    """At positions in contact, along random moves of all free nodes."""
    build, x = partial(build_system, pressed.mesh, pressed.element, pressed.lame), pressed.deformed()
    walls = walls_of(pressed.mesh, pressed.gap, pressed.lame[1])
    system, _ = coupled_system(build, walls, x)
    matrix, h = as_matrix(system, assemble(system, x, 0.01, walls).tangent), 1e-7
    for seed in range(3):
        move = np.zeros_like(x)
        move[system.order] = np.random.default_rng(seed).normal(size=(len(system.order), 2))
        plus, minus = (assemble(system, x + e * move, 0.01, walls).residual for e in (h, -h))
        expected = matrix @ move[system.order].ravel()
        assert np.abs((plus - minus) / (2 * h) - expected).max() < 1e-5 * np.abs(expected).max()


def test_contact_forces_balance(pressed):
    """Walls push one another with forces whose sum and moment are zero; with the rest every free node is at rest."""
    for step in range(len(pressed.load_steps)):
        forces, x = contact_forces(pressed, step), pressed.deformed(step)
        assert np.abs(forces.sum(axis=0)).max() < 1e-14
        assert abs(np.sum(x[:, 0] * forces[:, 1] - x[:, 1] * forces[:, 0])) < 1e-14
        assert np.abs(equilibrium(pressed, step)[1].residual).max() < 1e-10
    assert np.abs(forces).max() > 1e-5


@pytest.mark.parametrize(("n_lower", "n_upper"), [(4, 4), (5, 3)])
def test_blocks_that_are_pulled_together_press_as_they_must(n_lower, n_upper):
    """Suction stretches both by half of what separates them: a state of uniaxial strain, of which all is known.

    Each stretched by ℓ, they bear P = μ (ℓ − 1/ℓ) + λ ln ℓ / ℓ; what the suction has besides presses on the contact.
    """
    mesh, (lam, mu), suction, errors = blocks(n_lower, n_upper), (1.0, 1.0), 0.3, []
    stretch = 1.05
    pressure = suction - mu * (stretch - 1 / stretch) - lam * np.log(stretch) / stretch
    for gap in (0.02, 0.01, 0.005):
        result = inflate(mesh, pressure=-suction, lame=(lam, mu), contact=gap)
        assert result.converged and first_contact(result) is None
        upper = mesh.nodes[:, 1] > 1.05
        errors.append(abs(contact_forces(result)[upper, 1].sum() / pressure - 1))
        face = mesh.nodes[:, 1] == 1.0
        assert np.abs(result.displacement[-1][face, 1] - 0.05).max() < gap
    assert errors[-1] < (lam + 2 * mu) * gap / 2 / pressure  # they are stretched by less than a gap too little
    assert all(1.5 < a / b < 2.5 for a, b in pairwise(errors))  # the gap's own thickness


def test_a_thin_ring_closes_on_itself_at_the_pressure_of_the_elastica():
    """Under a pressure p from outside its opposite sides meet at p = 5.247 D/R³ (Flaherty, Keller, Rubinow 1972)."""
    thickness, around, through, (lam, mu) = 0.02, 720, 6, (16.44, 0.1644)
    angle = 2 * np.pi * np.arange(around) / around
    radius = 1 + 0.002 * np.cos(2 * angle)[:, None] + thickness * np.linspace(-0.5, 0.5, through + 1)
    number = np.arange(radius.size).reshape(radius.shape)
    after = np.roll(number, -1, axis=0)
    cells = np.stack([number[:, :-1], number[:, 1:], after[:, 1:], after[:, :-1]], -1).reshape(-1, 4)
    nodes = np.stack([radius * np.cos(angle)[:, None], radius * np.sin(angle)[:, None]], -1).reshape(-1, 2)
    middle, held = number[:, through // 2], np.zeros((radius.size, 2), dtype=bool)
    held[number[:: around // 2], 1] = held[number[around // 4 :: around // 2], 0] = True  # lines of symmetry
    mesh = Mesh(nodes, cells, np.column_stack([middle, np.roll(middle, -1)]), held)
    stiffness = 4 * mu * (lam + mu) / (lam + 2 * mu) * thickness**3 / 12  # D, in plane strain
    loads = np.array([1.5, 2.5, *np.linspace(2.8, 3.6, 9), 4.3, 5.0, 5.5, 6.0])
    result = inflate(mesh, pressure=-loads * stiffness, lame=(lam, mu), contact=0.1 * thickness)
    assert (
        result.converged and first_contact(result) is None and first_contact(inflate(mesh, pressure=-loads * stiffness))
    )
    before, first, second = (np.abs(contact_forces(result, step)[:, 1]).sum() for step in (-3, -2, -1))
    assert before == 0 < first
    touch = loads[-2] - first * (loads[-1] - loads[-2]) / (second - first)
    assert touch == pytest.approx(5.247, rel=0.02)


def test_contact_against_another_solver():
    """GetFEM has contact by an augmented Lagrangian: as the gap shrinks, the arch goes to its result."""
    table = pd.read_csv(paths.REFERENCE / "contact_getfem.csv")
    table = table[table.structure == "arch"].sort_values("gap (pixels)")
    apart = []
    for row in table.itertuples():
        shape = describe(inflate(arch(), contact=row[2] / 28))
        apart.append(abs(shape.width / row.width - 1))
    assert apart[0] < 2e-5 and np.all(np.diff(apart) > 0)


def test_newton_keeps_its_quadratic_rate_in_contact():
    """From nodes that are off by up to a third of the gap: each error is at most four times the square of the last."""
    result = inflate(blocks(5, 3), pressure=-0.3, lame=(1.0, 1.0), contact=0.02)
    truth, walls = result.deformed(), walls_of(result.mesh, result.gap, 1.0)
    system, _ = coupled_system(lambda pairs: build_system(result.mesh, "mean-dilatation", (1, 1), pairs), walls, truth)
    shift = 0.3 * result.gap * np.random.default_rng(0).uniform(-1, 1, (len(system.order), 2))
    shift[: len(system.pinned)][system.pinned] = 0
    x, errors = truth.copy(), []
    x[system.order] += shift
    for _ in range(6):
        errors.append(np.abs(x - truth).max() / result.gap)
        state, load = assemble(system, x, result.pressures[-1], walls), np.zeros_like(x)
        load[system.order] = -state.residual.reshape(-1, 2)
        x += solve(system, state, load)
    assert errors[0] > 0.2 and errors[-1] < 1e-11
    assert all(b < 4 * a**2 + 1e-11 for a, b in pairwise(errors))


def test_a_cavity_can_be_sucked_shut():
    """Opposite nodes meet head on, which no equilibrium is stable in: the walls find a side, and go on."""
    result = inflate(slit(), pressure=-0.01, contact=True)
    assert result.converged and first_contact(inflate(slit(), pressure=-0.01)) is not None
    assert first_contact(result) is None and contact_forces(result).any()


def test_the_answer_has_a_limit_without_a_gap():
    """Height, width and area change in proportion to the gap."""
    sizes = [
        [(shape := describe(inflate(arch(), contact=share / 28))).height, shape.width, shape.hull_area]
        for share in (0.1, 0.05, 0.025, 0.0125)
    ]
    changes = np.abs(np.diff(sizes, axis=0)).max(axis=1)
    assert changes[0] < 0.005
    assert np.all(changes[1:] < 0.75 * changes[:-1])


def test_derivatives_count_the_contact_in(pressed, monkeypatch):
    """All elements stiffened together, but not the barrier: λ, μ grow and κ, which is in units of μ, shrinks."""
    h, stiffness, ends = 1e-4, contact.STIFFNESS, []
    lam, mu = pressed.lame
    for e in (h, -h):
        monkeypatch.setattr(contact, "STIFFNESS", stiffness / (1 + e))
        ends.append(describe(inflate(pressed.mesh, lame=(lam * (1 + e), mu * (1 + e)), contact=True)).height)
    monkeypatch.setattr(contact, "STIFFNESS", stiffness)
    derivative = sensitivities(pressed, get_descriptor("height").gradient).sum()
    assert derivative == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=1e-3)


@pytest.mark.parametrize("bad", ["yes", -0.1, 0.0, np.nan, np.inf, None, [0.1]])
def test_contact_is_true_false_or_a_gap(bad):
    with pytest.raises(ValueError, match="contact must be a positive number of lengths of the unit square, or a bool"):
        inflate(arch(), contact=bad)


def test_contact_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="nearer than the gap"):
        inflate(arch(), contact=0.5)
    with pytest.raises(ValueError, match="element must be one of mean-dilatation, q1, not"):
        inflate(arch(), element="stabilised", contact=True)
    assert inflate(arch(), contact=False).gap == 0
