"""Random numbers that depend on a seed alone, not on what was drawn before."""

from collections.abc import Callable

import numpy as np
import torch
from torch import nn


def random_generator(*key: int) -> torch.Generator:
    """A CPU generator that depends on the numbers of ``key`` alone.

    Each training step and each generated structure gets its own, so that results depend neither on where a run was
    interrupted nor on how structures are batched, and no generator's state has to be stored.
    """
    seed = np.random.SeedSequence(key).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(seed >> 1))


def seed_for(seed: int, *names: str) -> int:
    """A seed of its own for what the names stand for, a descriptor or a purpose: what has another shares no noise."""
    key = seed, *"/".join(names).encode()
    return int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0] >> 1)


def initialised(make: Callable[[], nn.Module], seed: int) -> nn.Module:
    """A network whose first weights follow from the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make()
