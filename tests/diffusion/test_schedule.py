"""The noise schedule against published numbers, against diffusers, and as a schedule should behave."""

import numpy as np
import pytest
import torch
from diffusion_peers import diffusers_scheduler
from hypothesis import given
from hypothesis import strategies as st

from inflate_lib.diffusion import Schedule, cosine_schedule, linear_schedule
from inflate_lib.diffusion.schedule import at


def test_cosine_golden_numbers():
    s = cosine_schedule()
    assert len(s) == 1000 and s.betas.dtype == torch.float64
    assert s.betas[0].item() == pytest.approx(4.128422482196914e-05, rel=1e-12)
    assert s.betas[1].item() == pytest.approx(4.614175273665033e-05, rel=1e-12)
    assert s.betas[998].item() == pytest.approx(0.7499993929, abs=1e-10)
    assert s.betas[999].item() == 0.999
    assert int((s.betas == 0.999).sum()) == 1  # only the last one meets the cap
    assert s.alpha_bars[998].item() == pytest.approx(2.42877e-06, rel=1e-5)
    assert s.alpha_bars[999].item() == pytest.approx(2.42877e-09, rel=1e-5)


def test_agrees_with_diffusers_in_its_single_precision():
    diffusers = pytest.importorskip("diffusers")
    theirs = diffusers.DDPMScheduler(beta_schedule="squaredcos_cap_v2")
    ours = cosine_schedule()
    np.testing.assert_allclose(theirs.betas, ours.betas, atol=1e-7)
    np.testing.assert_allclose(theirs.alphas_cumprod, ours.alpha_bars, rtol=5e-5)
    theirs = diffusers.DDPMScheduler(beta_schedule="linear", beta_start=1e-4, beta_end=0.02)
    np.testing.assert_allclose(theirs.alphas_cumprod, linear_schedule().alpha_bars, rtol=5e-5)


def test_signal_to_noise_agrees_with_diffusers():
    theirs = pytest.importorskip("diffusers.training_utils").compute_snr(
        diffusers_scheduler("DDPMScheduler"), torch.arange(1000)
    )
    torch.testing.assert_close(theirs.double(), cosine_schedule().signal_to_noise, rtol=1e-5, atol=0)


@given(st.integers(2, 2000), st.sampled_from([cosine_schedule, linear_schedule]))
def test_any_length_gives_a_chain_from_signal_to_noise(T, make):
    if make is linear_schedule and T < 25:
        T += 25  # its first and last β scale with 1000 / T and must stay below one
    s = make(T)
    assert len(s) == T
    assert bool((s.alpha_bars.diff() < 0).all())
    assert bool((s.signal_to_noise > 0).all())
    assert s.previous_alpha_bars[0] == 1 and s.posterior_variances[0] == 0
    assert bool((s.posterior_variances <= s.betas).all())


def test_the_cosine_keeps_more_signal_in_the_middle():
    assert cosine_schedule().alpha_bars[499] > 5 * linear_schedule().alpha_bars[499]


@pytest.mark.parametrize("betas", [[0.5], [0.5, 1.0], [0.0, 0.1], [[0.1, 0.2]], [0.1, float("nan")]])
def test_impossible_betas_are_refused(betas):
    with pytest.raises(ValueError, match="betas"):
        Schedule(torch.tensor(betas))


def test_impossible_settings_are_refused():
    with pytest.raises(ValueError, match="max_beta"):
        cosine_schedule(1000, max_beta=1.5)
    with pytest.raises(ValueError, match="T must be a whole number of at least 2, not 1"):
        cosine_schedule(1)


def test_at_picks_by_row_in_the_precision_of_the_images():
    picked = at(torch.arange(5, dtype=torch.float64), torch.tensor([4, 0]), torch.zeros(2, 1, 3, 3))
    assert picked.shape == (2, 1, 1, 1) and picked.dtype == torch.float32
    assert picked.flatten().tolist() == [4, 0]
