"""Candidates: drawings are corrected for what they miss, training structures come in order, copies are found out."""

import numpy as np
import pytest

from inflate_lib import describe, inflate, label_image
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.datasets.simulate import simulate_dataset
from inflate_lib.diffusion import TrainedModel, TrainingConfig
from inflate_lib.inverse.candidates import Neighbours, _corrected, differences
from inflate_lib.inverse.constraints import Constraints
from inflate_lib.inverse.targets import Targets, deviations
from inflate_lib.structures.sources import load_sevens

DIGITS = load_sevens("digits").images


def test_a_biased_model_is_told_what_makes_it_hit():
    """It answers with g(y) = 0.6 y + 0.3; told y, moved by each miss, the answer converges to what is wanted."""
    config = TrainingConfig(channels=(4, 8), embedding=16, steps=1)
    model = TrainedModel(None, config, np.array([0.5]), np.array([2.0]))
    wanted = np.array([1.1])
    aim = wanted
    for _ in range(12):
        answer = 0.6 * aim + 0.3 + np.array([[-0.02], [0.0], [0.02]])
        aim = _corrected(aim, wanted, answer, model)
    assert 0.6 * aim + 0.3 == pytest.approx(wanted, abs=1e-4)
    assert _corrected(np.array([1.9]), wanted, np.array([[0.2]]), model) == 2.0  # never beyond what it has seen


def test_training_structures_come_in_the_order_of_their_largest_error():
    """Against every training structure and its mirror image, labelled, inflated and compared anew."""
    data = simulate_dataset(DIGITS[:60])
    rows = training_rows(data)
    lean = data.medial_axis.values[rows[3]] * [-1, 1]  # of a mirror image
    axis = Targets(axis=lean, width=float(data.width[rows[3]]))
    for targets, mirrors in ((Targets(height=0.9, area=0.7), (False,)), (axis, (False, True))):
        expected = {}
        for row in rows:
            for mirrored_one in mirrors:
                image = DIGITS[row][:, ::-1] if mirrored_one else DIGITS[row]
                misses = deviations(targets, describe(inflate(label_image(image))))
                expected[int(row), mirrored_one] = max(misses.values())
        source = Neighbours(data, targets, Constraints())
        (images, first), (_, later) = source.take(50, 0), source.take(1000, 50)
        order = [(one["training structure"], one["mirrored"]) for one in first + later]
        assert sorted(order) == sorted(expected) and not source.take(5, 0)[1]
        errors = [expected[key] for key in order]
        assert errors == pytest.approx(sorted(expected.values()), abs=1e-6)
        row, mirrored_one = order[0]
        image = DIGITS[row][:, ::-1] if mirrored_one else DIGITS[row]
        assert np.array_equal(label_image(images[0]), label_image(image))
    assert order[0] == (rows[3], True) and errors[0] < 1e-6


def test_the_same_structure_elsewhere_or_mirrored_does_not_differ():
    label, other = label_image(DIGITS[0]), label_image(DIGITS[1])
    shifted = [np.roll(label, shift, axis=1) for shift in (-2, 1, 2)]
    assert differences(label, [label, label[:, ::-1], *shifted]) == pytest.approx(0)
    assert 0 < differences(label, [other])[0] == differences(other, [label])[0] <= 1
