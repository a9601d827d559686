"""Forward marginal, posterior, conversions and losses: algebra, brute force, autograd, and diffusers."""

import math

import numpy as np
import pytest
import torch
from diffusion_peers import SCHEDULE, diffusers_scheduler
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare
from torch.distributions import Normal, kl_divergence

from inflate_lib.diffusion import TrainingConfig, process, train
from inflate_lib.diffusion.process import NATS_PER_BIT

STEPS = [0, 1, 10, 100, 500, 900, 998, 999]


def batch(seed=0, dtype=torch.float64):
    """One random image, noise and time step for each of STEPS."""
    g = torch.Generator().manual_seed(seed)
    x0 = torch.rand(len(STEPS), 1, 6, 6, generator=g, dtype=dtype) * 2 - 1
    return x0, torch.randn(x0.shape, generator=g, dtype=dtype), torch.tensor(STEPS)


def test_marginal_is_the_chain_applied_step_by_step():
    mean, variance = 1.0, 0.0  # of x_t given x_0 = 1, pushed through each transition (Eq. 2)
    for t in range(len(SCHEDULE)):
        mean, variance = mean * SCHEDULE.alphas[t].sqrt(), variance * SCHEDULE.alphas[t] + SCHEDULE.betas[t]
        assert mean == pytest.approx(SCHEDULE.alpha_bars[t].sqrt().item(), rel=1e-10)
        assert variance == pytest.approx(1 - SCHEDULE.alpha_bars[t].item(), rel=1e-10)


def test_posterior_by_brute_force_on_a_grid():
    """Bayes in one dimension: q(x_{t-1} | x_t, x_0) ∝ q(x_t | x_{t-1}) q(x_{t-1} | x_0)."""
    grid = torch.linspace(-6, 6, 200_001, dtype=torch.float64)
    for t in (5, 100, 500, 900):
        x0, x = torch.tensor([[0.7], [-0.4]], dtype=torch.float64)
        before = SCHEDULE.alpha_bars[t - 1]
        log_p = Normal(SCHEDULE.alphas[t].sqrt() * grid, SCHEDULE.betas[t].sqrt()).log_prob(x)
        log_p += Normal(before.sqrt() * x0, (1 - before).sqrt()).log_prob(grid)
        p = torch.softmax(log_p, 0)
        mean = (p * grid).sum()
        variance = (p * (grid - mean) ** 2).sum()
        ours = process.posterior_mean(SCHEDULE, x0, x, torch.tensor([t]))
        assert mean.item() == pytest.approx(ours.item(), abs=1e-9)
        assert variance.item() == pytest.approx(SCHEDULE.posterior_variances[t].item(), rel=1e-6)


def test_reverse_mean_with_the_true_noise_is_the_posterior_mean():
    x0, noise, t = batch()
    x = process.add_noise(SCHEDULE, x0, t, noise)
    ours = process.reverse_mean(SCHEDULE, x, t, noise)
    torch.testing.assert_close(ours, process.posterior_mean(SCHEDULE, x0, x, t), rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("objective", process.OBJECTIVES)
@given(seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_the_target_leads_back_to_image_and_noise(objective, seed):
    x0, noise, t = batch(seed)
    x = process.add_noise(SCHEDULE, x0, t, noise)
    target = process.training_target(SCHEDULE, x0, t, noise, objective)
    torch.testing.assert_close(process.predicted_noise(SCHEDULE, x, t, target, objective), noise, rtol=0, atol=1e-9)
    # Dividing by √ᾱ magnifies rounding 20,000-fold at the last step.
    torch.testing.assert_close(process.predicted_x0(SCHEDULE, x, t, target, objective), x0, rtol=0, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_agrees_with_diffusers(dtype):
    theirs = diffusers_scheduler("DDPMScheduler")
    x0, noise, t = batch(dtype=dtype)
    close = {"rtol": 0, "atol": 5e-6 if dtype == torch.float32 else 1e-14}  # in float32 they round 1 − ᾱ
    x = process.add_noise(SCHEDULE, x0, t, noise)
    torch.testing.assert_close(theirs.add_noise(x0, noise, t), x, **close)
    velocity = process.training_target(SCHEDULE, x0, t, noise, "v")
    torch.testing.assert_close(theirs.get_velocity(x0, noise, t), velocity, **close)
    for kind, expected in (("fixed_small", SCHEDULE.posterior_variances), ("fixed_large", SCHEDULE.betas)):
        for step in STEPS[1:]:
            theirs_now = theirs._get_variance(step, variance_type=kind).item()
            assert theirs_now == pytest.approx(expected[step].item(), rel=1e-12)


@pytest.mark.parametrize(("objective", "name"), [("epsilon", "epsilon"), ("v", "v_prediction")])
def test_conversions_agree_with_diffusers(objective, name):
    answers = torch.randn(len(STEPS), 1, 6, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    x, _, _ = batch()
    ddim = diffusers_scheduler("DDIMScheduler", prediction_type=name, clip_sample=False)
    ddim.set_timesteps(1000)
    for step in STEPS:
        t, one, answer = torch.tensor([step]), x[:1], answers[:1]
        x0 = process.predicted_x0(SCHEDULE, one, t, answer, objective)
        torch.testing.assert_close(ddim.step(answer, step, one).pred_original_sample, x0, rtol=1e-12, atol=1e-12)
        noise = process.predicted_noise(SCHEDULE, one, t, answer, objective)
        left = SCHEDULE.alpha_bars[step]  # together the two must give x_t again
        torch.testing.assert_close(left.sqrt() * x0 + (1 - left).sqrt() * noise, one, rtol=0, atol=1e-12)


def test_kl_in_closed_form_and_by_monte_carlo():
    g = torch.Generator().manual_seed(0)
    m1, m2 = torch.randn(2, 5, generator=g, dtype=torch.float64)
    v1, v2 = torch.rand(2, 5, generator=g, dtype=torch.float64) + 0.2
    ours = process.gaussian_kl(m1, v1, m2, v2)
    p, q = Normal(m1, v1.sqrt()), Normal(m2, v2.sqrt())
    torch.testing.assert_close(ours, kl_divergence(p, q))
    draws = m1 + v1.sqrt() * torch.randn(200_000, 5, generator=g, dtype=torch.float64)
    samples = p.log_prob(draws) - q.log_prob(draws)
    error = samples.std(0) / math.sqrt(len(draws))
    assert bool(((samples.mean(0) - ours).abs() < 5 * error).all())
    assert bool((process.gaussian_kl(m1, v1, m1, v1).abs() < 1e-15).all())


@given(st.floats(-1.5, 1.5), st.floats(1e-4, 1.0))
@settings(deadline=None)
def test_decoder_sums_to_one_over_the_grey_levels(mean, deviation):
    levels = torch.linspace(-1, 1, 256, dtype=torch.float64)
    variance = torch.full_like(levels, deviation**2)
    nll = process.decoder_nll(levels, torch.full_like(levels, mean), variance)
    assert torch.exp(-nll).sum().item() == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("deviation", [SCHEDULE.betas[0].sqrt().item(), 0.05])
def test_decoder_is_the_mass_of_the_bin(deviation):
    levels = torch.linspace(-1, 1, 256, dtype=torch.float64)
    mean = torch.full_like(levels, 0.2468)
    mass = torch.exp(-process.decoder_nll(levels, mean, torch.full_like(levels, deviation**2)))
    edges = torch.cat([levels.new_tensor([-math.inf]), (levels[1:] + levels[:-1]) / 2, levels.new_tensor([math.inf])])
    torch.testing.assert_close(mass, Normal(mean[0], deviation).cdf(edges).diff(), rtol=0, atol=1e-14)
    assert mass.max() > 0.05  # and not all of it zero


def test_decoder_by_monte_carlo():
    """Round draws of the Gaussian to grey levels and count: a χ² test that a right formula fails once in a thousand."""
    g = torch.Generator().manual_seed(0)
    mean, deviation, n = 0.95, 0.04, 200_000  # at the bright end, so that the open bin matters
    draws = mean + deviation * torch.randn(n, generator=g, dtype=torch.float64)
    counts = torch.bincount(((draws + 1) * 127.5).round().clamp(0, 255).long(), minlength=256).numpy()
    levels = torch.linspace(-1, 1, 256, dtype=torch.float64)
    nll = process.decoder_nll(levels, torch.full_like(levels, mean), torch.full_like(levels, deviation**2))
    expected = n * torch.exp(-nll).numpy()
    often = expected > 10
    assert expected[-1] > 0.1 * n and often.sum() > 20

    def p_value(expected):
        together = [np.append(x[often], x[~often].sum()) for x in (counts, expected)]
        return chisquare(*together).pvalue

    assert p_value(expected) > 1e-3
    shifted = np.roll(expected, 1)  # a bin off by one would be noticed
    assert p_value(shifted) < 1e-9


def test_decoder_is_finite_with_a_gradient_far_out_in_the_tails():
    mean = torch.tensor([-1.0, -0.2, 0.9, 1.0], requires_grad=True)
    x0 = torch.tensor([1.0, 0.6, -0.5, -1.0])
    nll = process.decoder_nll(x0, mean, torch.full((4,), SCHEDULE.betas[0].item()))
    nll.sum().backward()
    assert bool(torch.isfinite(nll).all()) and bool((mean.grad.sign() == (mean - x0).sign()).all())


@pytest.mark.parametrize("objective", process.OBJECTIVES)
def test_gradient_of_the_vlb_is_that_of_the_reweighted_error(objective):
    x0, noise, t = batch()
    x0, noise, t = x0[1:], noise[1:], t[1:]  # the first term is the decoder's
    x = process.add_noise(SCHEDULE, x0, t, noise)
    prediction = torch.randn(x0.shape, generator=torch.Generator().manual_seed(5)).double().requires_grad_()
    as_noise = process.predicted_noise(SCHEDULE, x, t, prediction, objective)
    (direct,) = torch.autograd.grad(process.vlb_term(SCHEDULE, x0, x, t, as_noise).sum(), prediction)
    weights = process.vlb_weights(SCHEDULE, objective, cap_last=False)[t]
    target = process.training_target(SCHEDULE, x0, t, noise, objective)
    error = process.squared_error(prediction, target)
    (reweighted,) = torch.autograd.grad((weights * error).sum(), prediction)
    torch.testing.assert_close(direct, reweighted, rtol=1e-6, atol=1e-12)


def test_vlb_weights_golden_numbers():
    """Measured on improved-diffusion's own bound, in bits."""
    c = process.vlb_weights(SCHEDULE, cap_last=False) / NATS_PER_BIT
    theirs = [0.3807, 0.0899, 0.0135, 0.0045, 0.0149, 2.164, 720.6]
    np.testing.assert_allclose(c[STEPS[1:]], theirs, rtol=1.2e-2)  # as many digits as were printed
    capped = process.vlb_weights(SCHEDULE)
    assert capped[999] == capped[998]
    torch.testing.assert_close(capped[:999], c[:999] * NATS_PER_BIT)
    assert process.hybrid_weights(SCHEDULE, vlb_weight=0.001)[1].item() == pytest.approx(1.264, abs=1e-3)
    assert bool((process.hybrid_weights(SCHEDULE, vlb_weight=0) == 1).all())


def test_first_weight_is_the_decoder_with_its_bins_shrunk_to_a_density():
    """With many grey levels −log p(x₀ | x₁) becomes c₀ · error + constant."""
    mean = torch.tensor([0.0, 0.01, 0.02], dtype=torch.float64)
    variance = SCHEDULE.betas[:1]
    nll = process.decoder_nll(torch.zeros(3, dtype=torch.float64), mean, variance, levels=100_001)
    alpha, beta = SCHEDULE.alphas[0], SCHEDULE.betas[0]
    error = (mean * alpha.sqrt() * (1 - alpha).sqrt() / beta) ** 2  # noise error that moves the mean so far
    torch.testing.assert_close(nll - nll[0], process.vlb_weights(SCHEDULE)[0] * error, rtol=1e-4, atol=1e-7)


def test_variational_bound_of_the_exact_model_is_the_entropy():
    """Gaussian pixels and the exact denoiser: the bound exceeds the true −log p by little, and never falls below."""
    g = torch.Generator().manual_seed(0)
    mean, deviation = 0.1, 0.25
    x0 = (mean + deviation * torch.randn(400, 1, 4, 4, generator=g, dtype=torch.float64)).clamp(-1, 1)
    x0 = torch.round((x0 + 1) * 127.5) / 127.5 - 1

    def predict(x, t):
        left = SCHEDULE.alpha_bars[t[0]]
        return (x - left.sqrt() * mean) * (1 - left).sqrt() / (left * deviation**2 + 1 - left)

    terms = []  # of L_vlb (Eq. 13), the prior term last
    for step in range(len(SCHEDULE)):
        t = torch.full((len(x0),), step)
        x = process.add_noise(SCHEDULE, x0, t, torch.randn(x0.shape, generator=g, dtype=x0.dtype))
        terms.append(process.vlb_term(SCHEDULE, x0, x, t, predict(x, t)))
    terms = torch.stack([*terms, process.prior_term(SCHEDULE, x0)], dim=1)
    exact = process.decoder_nll(x0, torch.full_like(x0, mean), torch.full_like(x0, deviation**2)).mean()
    bound = terms.sum(1).mean()
    assert exact < bound < exact + 0.25
    assert terms[:, -1].max() < 1e-8  # nothing is left of the image at the end


@pytest.mark.parametrize("gamma", [1.0, 5.0])
def test_min_snr_weighs_errors_of_the_image_alike_whatever_is_predicted(gamma):
    """An error in x₀, seen as an error of the noise or of the velocity, costs min(SNR, γ) times its square."""
    x0, noise, t = batch()
    x = process.add_noise(SCHEDULE, x0, t, noise)
    g = torch.Generator().manual_seed(4)
    for objective in process.OBJECTIVES:
        target = process.training_target(SCHEDULE, x0, t, noise, objective)
        answer = target + torch.randn(x.shape, generator=g, dtype=torch.float64)
        of_image = process.squared_error(process.predicted_x0(SCHEDULE, x, t, answer, objective), x0)
        weighted = process.min_snr_weights(SCHEDULE, objective, gamma)[t] * process.squared_error(answer, target)
        torch.testing.assert_close(weighted, SCHEDULE.signal_to_noise.clamp(max=gamma)[t] * of_image, rtol=1e-9, atol=0)


def test_min_snr_in_the_hybrid_loss():
    vlb = process.hybrid_weights(SCHEDULE) - 1
    torch.testing.assert_close(
        process.hybrid_weights(SCHEDULE, min_snr=1e12), vlb + 1
    )  # ε: a high ceiling changes nothing
    weights = process.hybrid_weights(SCHEDULE, min_snr=5.0, vlb_weight=0)
    noisy = SCHEDULE.signal_to_noise < 5
    assert bool((weights[noisy] == 1).all()) and bool((weights[~noisy] < 1).all())
    assert 100 < int((~noisy).sum()) < 500  # it spares the nearly clean images, a good quarter of the chain
    velocity = process.hybrid_weights(SCHEDULE, "v", min_snr=5.0, vlb_weight=0)
    assert velocity.argmax() == noisy.int().argmax() or velocity.argmax() == noisy.int().argmax() - 1


def test_min_snr_enters_the_training():
    images, conditions = np.random.default_rng(0).random((8, 8, 8)), np.arange(8.0)
    options = {"channels": (4,), "embedding": 8, "hidden": 8, "steps": 4, "log_every": 4, "vlb_weight": 0.0}
    plain, weighted = (
        train(images, conditions, TrainingConfig(**options, min_snr=gamma), progress=False).history
        for gamma in (0.0, 1e-3)
    )
    assert plain["loss"] == plain["simple"]
    assert weighted["loss"][0] < 0.5 * weighted["simple"][0]


def test_unknown_objective():
    with pytest.raises(ValueError, match="'score'"):
        process.training_target(SCHEDULE, *batch()[:1], torch.tensor(STEPS), batch()[1], "score")
