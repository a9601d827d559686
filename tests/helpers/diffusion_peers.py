"""What the tests of the diffusion model share: diffusers' schedulers, and data whose perfect denoiser is known."""

import numpy as np
import pytest
import torch
from torch.distributions import Categorical, MixtureSameFamily, Normal

from inflate_lib.diffusion import cosine_schedule

SCHEDULE = cosine_schedule()


def diffusers_scheduler(name, **options):
    """A scheduler of diffusers with our β in double precision: its own are float32, which hides all but four digits.

    What is left to compare are the formulas. (`test_diffusion_schedule` compares the β.)
    """
    scheduler = getattr(pytest.importorskip("diffusers"), name)(beta_schedule="squaredcos_cap_v2", **options)
    scheduler.betas, scheduler.alphas, scheduler.alphas_cumprod = (
        SCHEDULE.betas,
        SCHEDULE.alphas,
        SCHEDULE.alpha_bars,
    )
    return scheduler


class Mixture:
    """Images of one pixel, distributed as a mixture of Gaussians, and what a perfect network answers for them."""

    def __init__(self, weights, means, deviations):
        self.weights, self.means, self.deviations = (
            torch.tensor(values, dtype=torch.float64) for values in (weights, means, deviations)
        )

    def noised(self, alpha_bar):
        """The distribution of x_t: each Gaussian shrunk and blurred."""
        spread = (alpha_bar * self.deviations**2 + 1 - alpha_bar).sqrt()
        return MixtureSameFamily(Categorical(self.weights), Normal(alpha_bar**0.5 * self.means, spread))

    def cdf(self, x):
        """Distribution function of the data, NumPy in and out."""
        return self.noised(1.0).cdf(torch.as_tensor(x)).numpy()

    def expected_x0(self, x, alpha_bar):
        """E[x₀ | x_t] for x of any shape: each Gaussian's own answer, weighted by how likely x comes from it."""
        parts = self.noised(alpha_bar).component_distribution
        x = x[..., None]
        share = torch.softmax(self.weights.log() + parts.log_prob(x), -1)
        gain = alpha_bar**0.5 * self.deviations**2 / parts.variance
        return (share * (self.means + gain * (x - parts.mean))).sum(-1)

    def answer(self, x, t, objective):
        """The perfect network's answer, with t (n,) all equal."""
        alpha_bar = SCHEDULE.alpha_bars[int(t[0])].item()
        signal, spread = alpha_bar**0.5, (1 - alpha_bar) ** 0.5
        x0 = self.expected_x0(x, alpha_bar)
        return (x - signal * x0) / spread if objective == "epsilon" else (signal * x - x0) / spread


def ddim_law(data, times, eta, n_points=1501):
    """Distribution function (a callable) in which DDIM with the perfect network ends, by quadrature.

    Song et al. (2021), Eq. 12: where η = 0, points of the initial distribution are carried along; else the density is
    pushed through each Gaussian transition on a grid. No random number takes part.
    """
    grid = torch.linspace(-6, 6, n_points, dtype=torch.float64)
    points, mass = grid, torch.softmax(Normal(0, 1).log_prob(grid), 0)
    for t, before in zip(times, [*times[1:], -1], strict=True):
        now = SCHEDULE.alpha_bars[t].item()
        left = SCHEDULE.alpha_bars[before].item() if before >= 0 else 1.0
        added = eta**2 * (1 - left) / (1 - now) * (1 - now / left)
        x0 = data.expected_x0(points, now)
        noise = (points - now**0.5 * x0) / (1 - now) ** 0.5
        points = left**0.5 * x0 + max(0.0, 1 - left - added) ** 0.5 * noise
        if added > 0:
            mass = Normal(points, added**0.5).log_prob(grid[:, None]).exp() @ mass
            points, mass = grid, mass / mass.sum()
    assert bool((points.diff() > 0).all())
    middle = (mass.cumsum(0) - mass / 2).numpy()
    return lambda x: np.interp(x, points.numpy(), middle)
