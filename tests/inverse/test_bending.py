"""Patterns of two rubbers that move the tip: the derivatives that lead to them, and what they reach."""

import numpy as np
import pytest
from mechanics_peers import hook

from inflate_lib import inflate, label_image
from inflate_lib.inverse.bending import _wanted, bend, tip, tip_moves
from inflate_lib.mechanics.buildable import find_flaw
from inflate_lib.structures.labels import WALL
from inflate_lib.structures.sources import load_sevens

LABELS = [label_image(image) for image in load_sevens("digits").images]
BUILDABLE = [label for label in LABELS[:12] if not find_flaw(inflate(label))][:4]


def test_the_tip_is_the_highest_tenth_and_moves_with_its_nodes():
    result = inflate(LABELS[0])
    there, height = tip(result.nodes), result.nodes[:, 1]
    assert there.any() and np.array_equal(there, height >= 0.9 * height.max())
    moved = result.deformed()[there, 0].mean() - result.nodes[there, 0].mean()
    assert tip_moves(result)[-1] == pytest.approx(moved, abs=1e-12)


def test_stiffer_pixels_move_the_tip_as_the_adjoint_says():
    """The direction in which `bend` goes first, from one rubber."""
    label, h = LABELS[0], 1e-4
    wanted = _wanted(inflate(label), 1)
    for e in np.argsort(-np.abs(wanted))[[0, 5, 40]]:
        moved = []
        for change in (h, -h):
            grid = np.ones(label.shape)
            grid[tuple(np.argwhere(label == WALL)[e])] += change
            moved.append(tip_moves(inflate(label, stiffness=grid))[-1])
        assert wanted[e] == pytest.approx((moved[0] - moved[1]) / (2 * h), rel=1e-3, abs=1e-8)


@pytest.mark.parametrize("number", range(len(BUILDABLE)))
def test_patterns_move_the_tip_to_both_sides_of_where_one_rubber_does(number):
    label = BUILDABLE[number]
    plain = tip_moves(inflate(label))[-1]
    left, right = bend(label, "left"), bend(label, "right")
    assert left.moved < plain - 0.01 and right.moved > plain + 0.01
    for found in (left, right):
        again = inflate(label, stiffness=np.where(found.stiff, 4.0, 1.0))
        assert not find_flaw(again) and not found.stiff[label != WALL].any()
        assert tip_moves(again)[-1] == pytest.approx(found.moved, abs=1e-9)


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
