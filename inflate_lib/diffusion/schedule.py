"""The noise schedule: how much noise each of the T steps of the forward process adds (section 2.1 of the paper).

The paper counts steps t = 1 … T. Arrays start at zero, so **in this package ``t`` is a zero-based index**:
``schedule.betas[t]`` is the paper's β of step t + 1, and t = -1 would be the clean image (ᾱ = 1).
Everything is float64, because ᾱ ends at 2e-9 and single precision loses the last steps.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from inflate_lib._checks import number, whole_number


@dataclass(frozen=True, eq=False)
class Schedule:
    """Variances β of the forward process and every quantity that follows from them.

    Parameters
    ----------
    betas : Tensor, shape (T,)
        Variance of the noise that each step adds, each in (0, 1).
    """

    betas: Tensor

    def __post_init__(self):
        betas = torch.as_tensor(self.betas, dtype=torch.float64)
        if betas.ndim != 1 or len(betas) < 2 or not bool(((betas > 0) & (betas < 1)).all()):
            raise ValueError("betas must be a vector of at least two numbers, each strictly between 0 and 1")
        object.__setattr__(self, "betas", betas)

    def __len__(self) -> int:
        return len(self.betas)

    @cached_property
    def alphas(self) -> Tensor:
        """α = 1 − β."""
        return 1 - self.betas

    @cached_property
    def alpha_bars(self) -> Tensor:
        """ᾱ, the product of the α so far: the share of the clean image's variance that is left."""
        return torch.cumprod(self.alphas, 0)

    @cached_property
    def previous_alpha_bars(self) -> Tensor:
        """ᾱ one step earlier; 1 before the first step."""
        return torch.cat([torch.ones(1, dtype=torch.float64), self.alpha_bars[:-1]])

    @cached_property
    def posterior_variances(self) -> Tensor:
        """β̃ of Eq. 7, the variance of x_{t-1} given x_t and x_0; zero at the first step."""
        return self.betas * (1 - self.previous_alpha_bars) / (1 - self.alpha_bars)

    @cached_property
    def signal_to_noise(self) -> Tensor:
        """ᾱ / (1 − ᾱ), ratio of variances."""
        return self.alpha_bars / (1 - self.alpha_bars)


def cosine_schedule(T: int = 1000, s: float = 0.008, max_beta: float = 0.999) -> Schedule:
    """The schedule of Nichol & Dhariwal (2021), which the paper uses: ᾱ follows a squared cosine.

    ᾱ(u) = cos²(π/2 · (u + s)/(1 + s)) / cos²(π/2 · s/(1 + s)) at u = t/T, and β = 1 − ᾱ(t)/ᾱ(t − 1), at most
    ``max_beta``. The offset ``s`` keeps the first steps from being too small; the cap is met by the last step alone.
    """
    whole_number("T", T, 2)
    number("s", s, least=0)
    if not 0 < number("max_beta", max_beta) < 1:
        raise ValueError(f"max_beta must lie between 0 and 1, not {max_beta!r}")
    u = torch.arange(T + 1, dtype=torch.float64) / T
    alpha_bars = torch.cos((u + s) / (1 + s) * math.pi / 2) ** 2
    return Schedule((1 - alpha_bars[1:] / alpha_bars[:-1]).clamp(max=max_beta))


def linear_schedule(T: int = 1000, first: float = 1e-4, last: float = 0.02) -> Schedule:
    """The schedule of Ho et al. (2020), here for comparison: β grows linearly from ``first`` to ``last``.

    For another T than 1000 the ends scale by 1000/T, so that the chain ends equally noisy.
    """
    scale = 1000 / whole_number("T", T, 2)
    number("first", first, least=0, below=1)
    number("last", last, least=0, below=1)
    return Schedule(torch.linspace(first * scale, last * scale, T, dtype=torch.float64))


def at(values: Tensor, t: Tensor, like: Tensor) -> Tensor:
    """Pick ``values[t]`` and shape it (n, 1, …, 1), in the precision and on the device of ``like`` (n, …)."""
    picked = values[t.to(values.device)].to(like.dtype)  # before the move: not every device has double precision
    return picked.to(like.device).reshape(-1, *[1] * (like.ndim - 1))
