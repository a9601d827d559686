"""The forward process, its posterior and the losses: every formula of section 2 that needs no network.

Images are tensors (n, 1, h, w) in [−1, 1]; ``t`` is a zero-based index tensor (n,) (see ``schedule``).
Loss terms come one per image, as a **mean over pixels in nats**; divide by ``NATS_PER_BIT`` for the bits per pixel
that the diffusion literature quotes.

What the network predicts is its *objective*: ``"epsilon"``, the noise (the paper's), or ``"v"``, the velocity
v = √ᾱ ε − √(1 − ᾱ) x₀ of Salimans & Ho (2022).
"""

import math

import torch
from torch import Tensor

from inflate_lib._checks import choice
from inflate_lib.diffusion.schedule import Schedule, at

NATS_PER_BIT = math.log(2)
OBJECTIVES = ("epsilon", "v")


# --- forward process ---------------------------------------------------------------------------------------------


def add_noise(schedule: Schedule, x0: Tensor, t: Tensor, noise: Tensor) -> Tensor:
    """x_t = √ᾱ x₀ + √(1 − ᾱ) ε (Eqs. 3, 4): jump straight to step t of the forward process."""
    return at(schedule.alpha_bars.sqrt(), t, x0) * x0 + at((1 - schedule.alpha_bars).sqrt(), t, x0) * noise


def training_target(schedule: Schedule, x0: Tensor, t: Tensor, noise: Tensor, objective: str) -> Tensor:
    """What the network should answer at x_t: the noise, or the velocity."""
    choice("objective", objective, OBJECTIVES)
    if objective == "epsilon":
        return noise
    return at(schedule.alpha_bars.sqrt(), t, x0) * noise - at((1 - schedule.alpha_bars).sqrt(), t, x0) * x0


def predicted_x0(schedule: Schedule, x: Tensor, t: Tensor, prediction: Tensor, objective: str) -> Tensor:
    """The clean image that a prediction at x_t implies."""
    choice("objective", objective, OBJECTIVES)
    signal, spread = at(schedule.alpha_bars.sqrt(), t, x), at((1 - schedule.alpha_bars).sqrt(), t, x)
    if objective == "epsilon":
        return (x - spread * prediction) / signal
    return signal * x - spread * prediction


def predicted_noise(schedule: Schedule, x: Tensor, t: Tensor, prediction: Tensor, objective: str) -> Tensor:
    """The noise that a prediction at x_t implies."""
    choice("objective", objective, OBJECTIVES)
    if objective == "epsilon":
        return prediction
    return at((1 - schedule.alpha_bars).sqrt(), t, x) * x + at(schedule.alpha_bars.sqrt(), t, x) * prediction


# --- posterior and reverse step ------------------------------------------------------------------------------------


def posterior_mean(schedule: Schedule, x0: Tensor, x: Tensor, t: Tensor) -> Tensor:
    """μ̃ of Eq. 6, the mean of x_{t-1} given x_t and x_0; the variance is ``schedule.posterior_variances``."""
    before, now, beta = schedule.previous_alpha_bars, schedule.alpha_bars, schedule.betas
    on_x0 = before.sqrt() * beta / (1 - now)
    on_x = schedule.alphas.sqrt() * (1 - before) / (1 - now)
    return at(on_x0, t, x) * x0 + at(on_x, t, x) * x


def reverse_mean(schedule: Schedule, x: Tensor, t: Tensor, noise: Tensor) -> Tensor:
    """μ_θ of Eq. 10: the posterior mean with x₀ written in terms of x_t and the (predicted) noise."""
    per_noise = schedule.betas / (1 - schedule.alpha_bars).sqrt()
    return (x - at(per_noise, t, x) * noise) / at(schedule.alphas.sqrt(), t, x)


# --- losses --------------------------------------------------------------------------------------------------------


def squared_error(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean over pixels of the squared difference, one number per image; its batch mean is L_simple (Eq. 12)."""
    return (prediction - target).square().flatten(1).mean(1)


def gaussian_kl(mean1: Tensor, variance1: Tensor, mean2: Tensor, variance2: Tensor) -> Tensor:
    """KL divergence in nats from N(mean2, variance2) to N(mean1, variance1), element by element (Eq. 15)."""
    return 0.5 * (torch.log(variance2 / variance1) + (variance1 + (mean1 - mean2).square()) / variance2 - 1)


def decoder_nll(x0: Tensor, mean: Tensor, variance: Tensor, levels: int = 256) -> Tensor:
    """−log p(x₀ | x₁) in nats, element by element: the Gaussian's mass in the bin of each grey level (Eq. 14, t = 0).

    The bins are 2 / (levels − 1) wide and centred on the grey levels in [−1, 1]; the two outermost reach to ±∞.
    """
    half, deviation = 1 / (levels - 1), variance.sqrt()
    a, b = (x0 - mean - half) / deviation, (x0 - mean + half) / deviation
    # Log-space differences of log-cdfs stay exact in the tails, where the difference of the cdfs would round to zero.
    flip = a > 0  # mirror bins on the right, so that both logs are of small numbers, not of numbers near one
    low, high = torch.where(flip, -b, a), torch.where(flip, -a, b)
    log_low, log_high = torch.special.log_ndtr(low), torch.special.log_ndtr(high)
    inner = log_high + torch.log1p(-torch.exp(log_low - log_high))
    log_mass = torch.where(x0 < -1 + half, torch.special.log_ndtr(b), inner)
    return -torch.where(x0 > 1 - half, torch.special.log_ndtr(-a), log_mass)


def prior_term(schedule: Schedule, x0: Tensor) -> Tensor:
    """KL(q(x_T | x₀) ‖ N(0, I)) per image (Eq. 14, t = T): no parameter in it, and nearly zero for a good schedule."""
    left = schedule.alpha_bars[-1].to(x0.dtype).to(x0.device)
    zero = torch.zeros_like(left)
    return gaussian_kl(left.sqrt() * x0, 1 - left, zero, zero + 1).flatten(1).mean(1)


def vlb_term(schedule: Schedule, x0: Tensor, x: Tensor, t: Tensor, noise: Tensor) -> Tensor:
    """L_{t} of Eq. 14 per image, for predicted noise (n, 1, h, w) and the paper's fixed variance σ² = β.

    A KL divergence between posterior and reverse step for t ≥ 1, the decoder's −log p(x₀ | x₁) for t = 0
    (zero-based).
    """
    mean, variance = reverse_mean(schedule, x, t, noise), at(schedule.betas, t, x)
    # β̃ is zero at the first step, where the decoder term is taken instead; any positive number avoids log 0 there.
    true_variance = at(schedule.posterior_variances.clamp(min=schedule.posterior_variances[1]), t, x)
    kl = gaussian_kl(posterior_mean(schedule, x0, x, t), true_variance, mean, variance)
    first = (t == 0).to(x.device).reshape(-1, *[1] * (x.ndim - 1))
    return torch.where(first, decoder_nll(x0, mean, variance), kl).flatten(1).mean(1)


def vlb_weights(schedule: Schedule, objective: str = "epsilon", cap_last: bool = True) -> Tensor:
    """c_t, shape (T,): with σ² = β, L_t = c_t · (mean squared error of the prediction) + a constant (nats).

    Both Gaussians' variances are fixed, so only their means count: c = β² / (2 σ² α (1 − ᾱ)) = β / (2 α (1 − ᾱ)) for
    the noise, times ᾱ for the velocity. The first entry belongs to the decoder with its bins shrunk to a density.

    ``cap_last``: the cosine schedule's last β sits at its cap of 0.999, which makes the last weight (499.5) many
    times all others together although that step holds no signal; it is lowered to the weight of the step before.
    """
    choice("objective", objective, OBJECTIVES)
    weights = schedule.betas / (2 * schedule.alphas * (1 - schedule.alpha_bars))
    if objective == "v":  # ε − ε_θ = √ᾱ (v − v_θ)
        weights = weights * schedule.alpha_bars
    if cap_last:
        weights = torch.cat([weights[:-1], torch.minimum(weights[-1:], weights[-2:-1])])
    return weights


def min_snr_weights(schedule: Schedule, objective: str, gamma: float) -> Tensor:
    """Weight (T,) of the squared error that counts errors of x₀ by min(SNR, γ) (Hang et al. 2023, section 3.4).

    In terms of x₀, the error of the noise weighs as SNR and that of the velocity as SNR + 1; dividing by these carries
    the weight over. Small γ spares the network the nearly clean images.
    """
    choice("objective", objective, OBJECTIVES)
    snr = schedule.signal_to_noise
    return snr.clamp(max=gamma) / (snr if objective == "epsilon" else snr + 1)


def hybrid_weights(
    schedule: Schedule, objective: str = "epsilon", vlb_weight: float = 0.001, min_snr: float = 0.0
) -> Tensor:
    """Weight (T,) of the squared error in L_hybrid = L_simple + λ L_vlb (Eq. 11) when t is drawn uniformly.

    L_vlb is a sum over the T steps and L_simple a mean, hence the factor T: 1 + λ T c_t. A positive ``min_snr`` is
    the γ of ``min_snr_weights``, which then take the place of the 1.
    """
    simple = min_snr_weights(schedule, objective, min_snr) if min_snr > 0 else 1
    return simple + vlb_weight * len(schedule) * vlb_weights(schedule, objective)
