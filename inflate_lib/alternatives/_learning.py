"""A plain training loop for the small networks beside the diffusion model: the surrogate and the baseline.

Adam with a warm-up and a cosine decay of the learning rate; checkpoints in safetensors files, from which a run that was
killed goes on to the same result.
"""

import math
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from inflate_lib._progress import Progress
from inflate_lib.diffusion import _storage
from inflate_lib.diffusion.training import random_generator

WARMUP = 50  # steps
CHECKPOINTS = 20  # in a run, as far as there is a folder


def fit(
    net: nn.Module,
    loss: Callable[[Tensor, torch.Generator], Tensor],
    n: int,
    steps: int,
    batch_size: int = 64,
    learning_rate: float = 2e-3,
    seed: int = 0,
    folder: Path | None = None,
    progress: str = "training",
) -> tuple[list[float], float]:
    """Train a network in place.

    Parameters
    ----------
    net
        Module whose parameters `loss` depends on.
    loss
        ``loss(rows, generator)`` → mean loss of the pairs with these numbers; draws random numbers from the generator.
    n
        Number of pairs.
    steps, batch_size, learning_rate, seed
        Of the optimisation; every step has a generator of its own.
    folder
        Where a checkpoint is kept.
    progress
        What to call the training in lines of progress.

    Returns
    -------
    history : list of float
        Loss, averaged over twentieths of the run.
    seconds : float
        Wall-clock seconds, those before an interruption included.

    Raises
    ------
    FloatingPointError
        The loss is no longer finite.
    """
    path = Path(folder) / "checkpoint.safetensors" if folder is not None else None
    optimiser = torch.optim.Adam(net.parameters(), lr=learning_rate)
    for p in net.parameters():  # what Adam itself would begin with
        averages = {name: torch.zeros_like(p) for name in ("exp_avg", "exp_avg_sq")}
        optimiser.state[p] = {"step": torch.zeros(())} | averages
    step, history, total, seconds = 0, [], 0.0, 0.0
    if path is not None and path.exists():
        tensors, content = _storage.read(path, "checkpoint")
        _storage.fill(_state(net, optimiser), tensors, path)
        step, history, seconds = (content[name] for name in ("step", "history", "seconds"))
    started, report = time.monotonic() - seconds, Progress(progress, steps, "steps", step)
    every = max(1, math.ceil(steps / CHECKPOINTS))
    while step < steps:
        rate = min(1.0, (step + 1) / WARMUP) * 0.5 * (1 + math.cos(math.pi * step / steps))
        optimiser.param_groups[0]["lr"] = learning_rate * rate
        generator = random_generator(seed, 5, step)
        rows = torch.randint(n, (min(batch_size, n),), generator=generator)
        value = loss(rows, generator)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        total += value.item()
        step += 1
        if step % every == 0 or step == steps:
            if not math.isfinite(total):
                raise FloatingPointError(f"{progress}: the loss became {total} before step {step}")
            history.append(total / (step - every * ((step - 1) // every)))
            total, seconds = 0.0, time.monotonic() - started
            if path is not None:
                content = {"step": step, "history": history, "seconds": seconds}
                _storage.write(path, "checkpoint", _state(net, optimiser), content)
        if report.due():
            report.tell_time(step, f"loss {value.item():.4g}")
    return history, seconds


def initialised(make: Callable[[], nn.Module], seed: int) -> nn.Module:
    """A network whose first weights follow from the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make()


def _state(net, optimiser):
    """Every tensor that a step changes, by its name in the checkpoint."""
    tensors = {}
    for name, p in net.named_parameters():
        tensors[f"net.{name}"] = p.detach()
        tensors |= {f"adam.{name}.{key}": value for key, value in optimiser.state[p].items()}
    return tensors
