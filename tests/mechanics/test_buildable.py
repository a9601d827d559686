"""What can be built: structures made by hand for each flaw, mirror images, and a count of what is covered twice."""

from dataclasses import replace

import numpy as np
import pytest
from mechanics_peers import random_label

from inflate_lib import inflate, label_image
from inflate_lib.mechanics import Flaw, Mesh, build_mesh, find_flaw, first_contact, self_contact
from inflate_lib.structures.labels import point_joints
from inflate_lib.structures.sources import load_sevens

LABELS = [label_image(image) for image in load_sevens("digits").images[:60]]
ARCH = np.zeros((28, 28))
ARCH[4:24, 6:9] = ARCH[4:24, 14:17] = ARCH[4:7, 6:17] = 1  # its legs bulge into one another
CHAIN = np.zeros((28, 28))
CHAIN[6:16, 12:15] = CHAIN[16:26, 15:18] = 1  # two rooms that share a corner


def beside(mesh, distance):
    """A mesh and a second one like it at a distance to the right, as one mesh."""
    n = len(mesh.nodes)
    return Mesh(
        np.concatenate([mesh.nodes, mesh.nodes + [distance, 0]]),
        np.concatenate([mesh.cells, mesh.cells + n]),
        np.concatenate([mesh.pressure_edges, mesh.pressure_edges + n]),
        np.tile(mesh.clamped, 2),
    )


def test_each_flaw_is_found():
    plain = next(label for label in LABELS if find_flaw(inflate(label)) is None)
    assert find_flaw(inflate(plain, pressure=2.0)) is Flaw.NO_EQUILIBRIUM
    assert find_flaw(inflate(beside(build_mesh(plain), 3.0))) is Flaw.IN_PIECES
    assert find_flaw(inflate(label_image(CHAIN))) is Flaw.POINT_JOINT
    assert find_flaw(inflate(label_image(ARCH))) is Flaw.CROSSING_WALLS


def test_walls_that_part_again_have_crossed():
    """Full pressure and none: what the last load step does not show counts, and so does what a single one shows."""
    label = label_image(ARCH)
    for history in ([1e-5, 0.01, 0.0], [0.01, 0.0]):
        result = inflate(label, pressure=history)
        assert result.converged and self_contact(result) == 0 and first_contact(result) == len(history) - 2
        assert find_flaw(result) is Flaw.CROSSING_WALLS
    assert find_flaw(inflate(label, pressure=[0.0])) is None  # at the load steps alone


def test_both_borders_of_the_wall_count():
    """A cavity that meets itself is found like an outer border that does."""
    result = inflate(LABELS[0])
    loop = np.unique(result.mesh.pressure_edges)
    for nodes in (loop, np.setdiff1d(np.arange(len(result.nodes)), loop)):
        shaken = replace(result, displacement=result.displacement.copy())
        shaken.displacement[3, nodes] += np.random.default_rng(0).uniform(-0.05, 0.05, (len(nodes), 2))
        assert find_flaw(shaken) is Flaw.CROSSING_WALLS


def test_a_mirrored_structure_has_the_same_flaw():
    labels = [*LABELS, label_image(ARCH), label_image(CHAIN), *(random_label(seed) for seed in range(10))]
    flaws = [find_flaw(inflate(label)) for label in labels]
    assert flaws == [find_flaw(inflate(label[:, ::-1])) for label in labels]
    assert {None, Flaw.POINT_JOINT, Flaw.CROSSING_WALLS} <= set(flaws)


@pytest.mark.parametrize("refine", [1, 2, 3])
def test_joints_are_those_of_the_pixels_on_every_mesh(refine):
    found = set()
    for label in [*LABELS[:30], label_image(CHAIN), *(random_label(seed) for seed in range(10))]:
        result = inflate(label, n_steps=1, pressure=0.0, refine=refine)
        found.add(joined := find_flaw(result) is Flaw.POINT_JOINT)
        assert joined == (point_joints(label) > 0)
    assert found == {True, False}


def covered(corners, points):
    """Number of quadrilaterals (m, 4, 2) that hold each point (k, 2)."""
    side = np.roll(corners, -1, axis=1) - corners
    away = points[:, None, None] - corners
    return np.sum(np.all(side[..., 0] * away[..., 1] > side[..., 1] * away[..., 0], axis=-1), axis=-1)


def test_what_can_be_built_covers_no_place_twice():
    """By counting elements over random points: no wall lies on a wall, not even wholly within one."""
    rng, buildable = np.random.default_rng(1), 0
    for label in [*LABELS[:9], label_image(ARCH)]:
        result, most = inflate(label), []
        for step in (3, 9):
            x = result.deformed(step)
            points = rng.uniform(x.min(axis=0), x.max(axis=0), (1000, 2))
            most.append(covered(x[result.cells], points).max())
        if find_flaw(result) is None:
            assert max(most) == 1
            buildable += 1
    assert buildable >= 5 and max(most) == 2  # the arch
