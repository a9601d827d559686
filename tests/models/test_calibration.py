"""The answer of a model, measured and undone."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from inflate_lib.models.calibration import Calibration


def answers(targets, matrix, offset, scatter, rng):
    return targets @ matrix.T + offset + scatter * rng.standard_normal(targets.shape)


@given(slope=st.floats(0.6, 3), offset=st.floats(-1, 1), mean=st.floats(-2, 2), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_undoes_an_exact_linear_answer(slope, offset, mean, seed):
    """What it tells a model without scatter, whatever its slope and offset, is answered with the target."""
    rng = np.random.default_rng(seed)
    asked = mean + rng.standard_normal((40, 1))
    calibration = Calibration.fit(asked, slope * asked + offset)
    wanted = mean + rng.standard_normal((10, 1))
    np.testing.assert_allclose(slope * calibration.told(wanted) + offset, wanted, atol=1e-9)


def test_undoes_the_coupling_of_two_components():
    rng = np.random.default_rng(0)
    matrix, offset = np.array([[0.8, 0.2], [-0.1, 1.4]]), np.array([0.3, -0.2])
    asked = rng.standard_normal((60, 2)) @ [[0.1, 0.0], [0.05, 0.2]] + [1.0, 0.9]
    calibration = Calibration.fit(asked, asked @ matrix.T + offset)
    wanted = asked[:7] + 0.01
    np.testing.assert_allclose(calibration.told(wanted) @ matrix.T + offset, wanted, atol=1e-9)


def test_an_axis_is_calibrated_along_its_principal_directions_only():
    """Sixty components that move in three directions: the answer there is undone; across them nothing is changed."""
    rng = np.random.default_rng(1)
    basis = np.linalg.qr(rng.standard_normal((60, 3)))[0].T
    asked = rng.standard_normal((200, 3)) * [3, 2, 1] @ basis
    calibration = Calibration.fit(asked, 0.7 * asked)
    assert calibration.directions.shape == (3, 60)
    np.testing.assert_allclose(0.7 * calibration.told(asked), asked, atol=1e-9)
    across = rng.standard_normal(60)
    across -= basis.T @ (basis @ across)
    np.testing.assert_allclose(calibration.told((across + asked[0])[None]) - calibration.told(asked[:1]), [across])


def test_scatter_averages_out_of_the_fit():
    """With n answers that scatter by s about the line, its slope is known to s / (std √n): five times that is safe."""
    rng = np.random.default_rng(2)
    asked = rng.standard_normal((400, 1))
    calibration = Calibration.fit(asked, answers(asked, np.array([[0.8]]), 0.1, 0.5, rng))
    assert abs(calibration.slope[0, 0] - 0.8) < 5 * 0.5 / np.sqrt(400)


def bent(x):
    """An answer that exaggerates in the outer quarters of the data, but not in the middle half."""
    return x + 0.4 * np.sign(x) * np.maximum(np.abs(x) - 0.67, 0)


def test_an_answer_that_bends_is_undone_better_than_by_a_line():
    """From what a few hundred targets gave: the ends, too, come out near what was asked for."""
    rng = np.random.default_rng(4)
    asked, ends = rng.standard_normal((300, 1)), np.array([[-1.8], [1.8]])
    got = bent(asked) + 0.05 * rng.standard_normal((300, 1))
    slope, offset = np.polyfit(asked[:, 0], got[:, 0], 1)
    by_line, by_fit = (bent(told) - ends for told in ((ends - offset) / slope, Calibration.fit(asked, got).told(ends)))
    assert np.abs(by_fit).max() < np.abs(by_line).max() / 2


def test_answers_about_a_line_mostly_leave_it_straight():
    """A bend that is scatter alone predicts nothing; now and then it does by luck."""
    straight = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        asked = rng.standard_normal((300, 1))
        fit = Calibration.fit(asked, 1.2 * asked + 0.5 * rng.standard_normal((300, 1)))
        straight += np.allclose(np.diff(fit.bends[0, 1]), np.diff(fit.bends[0, 0]))
    assert straight >= 10


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(40, 120), k=st.integers(1, 2))
@example(seed=606, n=97, k=2)
@settings(max_examples=20, deadline=None)
def test_every_target_has_one_answer_also_far_outside(seed, n, k):
    """g is undone by its inverse everywhere, rises, and goes on straight beyond the data."""
    rng = np.random.default_rng(seed)
    asked = rng.standard_normal((n, k))
    calibration = Calibration.fit(asked, bent(asked) + 0.1 * rng.standard_normal((n, k)))
    along = calibration.directions.sum(axis=0)  # moves every coordinate alike, so that each leaves its bend behind
    far = calibration.mean + np.linspace(-20, 20, 201)[:, None] * along
    np.testing.assert_allclose(calibration.answer(calibration.told(far)), far, atol=1e-8)
    np.testing.assert_allclose(calibration.told(calibration.answer(far)), far, atol=1e-8)
    step = np.diff(calibration.told(far), axis=0)
    assert k == 2 or (step * along > 0).all()
    for end in (step[:10], step[-10:]):
        np.testing.assert_allclose(end, end[:1].repeat(10, 0), atol=1e-9)


def test_broken_drawings_do_not_pull_the_line():
    """One drawing in twenty misses by a third, all of them among the tall ones: the line stays where it was."""
    rng = np.random.default_rng(5)
    asked = 1 + 0.1 * rng.standard_normal((300, 1))
    got = 1.2 * asked - 0.2 + 0.02 * rng.standard_normal((300, 1))
    tall, broken = np.array([[1.2]]), got.copy()
    broken[rng.choice(np.argsort(asked[:, 0])[-100:], 15, replace=False)] -= 0.35
    least_squares = np.polyval(np.polyfit(asked[:, 0], broken[:, 0], 1), tall)
    truth, found = (Calibration.fit(asked, one).answer(tall) for one in (got, broken))
    assert abs(found - truth) < 0.25 * abs(least_squares - truth)


def test_few_answers_and_old_headers_leave_it_straight():
    rng = np.random.default_rng(6)
    asked = rng.standard_normal((39, 1))
    few = Calibration.fit(asked, bent(asked))
    steps = np.diff(few.told(np.linspace(-3, 3, 7)[:, None]), axis=0)
    np.testing.assert_allclose(steps, steps[:1].repeat(6, 0), rtol=1e-9)
    old = {name: value for name, value in few.as_dict().items() if name != "bends"} | {"n": 39, "seed": 1}
    np.testing.assert_array_equal(Calibration.from_dict(old).told(asked), few.told(asked))


def test_a_model_that_does_not_listen_is_refused():
    rng = np.random.default_rng(3)
    asked = rng.standard_normal((300, 1))
    with pytest.raises(ValueError, match="hardly follows its descriptor"):
        Calibration.fit(asked, rng.standard_normal((300, 1)))
    with pytest.raises(ValueError, match="hardly follows its descriptor"):
        Calibration.fit(asked, 0.4 * asked)  # to invert it would more than double what is asked for
    with pytest.raises(ValueError, match="needs more than 2 structures"):
        Calibration.fit(asked[:2], asked[:2])
