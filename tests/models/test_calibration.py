"""The linear answer of a model, measured and undone."""

import numpy as np
import pytest
from hypothesis import given, settings
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


def test_a_model_that_does_not_listen_is_refused():
    rng = np.random.default_rng(3)
    asked = rng.standard_normal((300, 1))
    with pytest.raises(ValueError, match="hardly follows its descriptor"):
        Calibration.fit(asked, rng.standard_normal((300, 1)))
    with pytest.raises(ValueError, match="hardly follows its descriptor"):
        Calibration.fit(asked, 0.4 * asked)  # to invert it would more than double what is asked for
    with pytest.raises(ValueError, match="needs more than 2 structures"):
        Calibration.fit(asked[:2], asked[:2])
