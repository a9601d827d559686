"""Patterns of two rubbers that move the tip: the derivative that leads to them, and what they reach."""

import numpy as np
import pytest
from mechanics_peers import hook

from inflate_lib import describe, inflate, label_image
from inflate_lib.inverse.bending import bend, tip, tip_gradient
from inflate_lib.mechanics.buildable import find_flaw
from inflate_lib.structures.labels import WALL
from inflate_lib.structures.sources import load_sevens

LABELS = [label_image(image) for image in load_sevens("digits").images]
BUILDABLE = [label for label in LABELS[:12] if not find_flaw(inflate(label))][:4]


def test_the_tip_is_the_end_of_the_medial_axis():
    for label in LABELS[:4]:
        result = inflate(label)
        assert tip(result.deformed()) == describe(result).medial_axis[-1, 0]


def test_its_gradient_is_its_derivative():
    result = inflate(LABELS[0])
    nodes = result.deformed()
    move = np.random.default_rng(0).normal(size=nodes.shape) * ~result.mesh.clamped[:, None]
    difference = (tip(nodes + 1e-7 * move) - tip(nodes - 1e-7 * move)) / 2e-7
    assert (tip_gradient(nodes) * move).sum() == pytest.approx(difference, rel=1e-4)


@pytest.mark.parametrize("number", range(len(BUILDABLE)))
def test_patterns_move_the_tip_to_both_sides_of_where_one_rubber_does(number):
    label = BUILDABLE[number]
    one = inflate(label)
    plain = tip(one.deformed()) - tip(one.nodes)
    left, right = bend(label, "left"), bend(label, "right")
    assert left.moved < plain - 0.01 and right.moved > plain + 0.01
    for found in (left, right):
        again = inflate(label, stiffness=np.where(found.stiff, 4.0, 1.0))
        assert not find_flaw(again) and not found.stiff[label != WALL].any()
        assert tip(again.deformed()) - tip(again.nodes) == pytest.approx(found.moved, abs=1e-9)


def test_a_mirrored_structure_bends_the_other_way():
    here, there = bend(LABELS[0], "left", tries=4), bend(LABELS[0][:, ::-1], "right", tries=4)
    assert there.moved == pytest.approx(-here.moved, abs=1e-6)
    assert np.array_equal(there.stiff[:, ::-1], here.stiff)


def test_without_a_try_it_is_of_one_rubber():
    assert not bend(hook(), "right", tries=0).stiff.any()


@pytest.mark.parametrize(
    ("wrong", "name"), [({"side": "up"}, "side"), ({"ratio": 0}, "ratio"), ({"tries": -1}, "tries")]
)
def test_wrong_arguments_are_named(wrong, name):
    with pytest.raises(ValueError, match=f"^{name}"):
        bend(LABELS[0], **{"side": "left"} | wrong)
