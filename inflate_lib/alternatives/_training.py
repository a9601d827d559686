"""What the networks beside the diffusion model have in common: they are trained once, and then found in the cache."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from inflate_lib._cache import cached, step_version
from inflate_lib.diffusion import storage
from inflate_lib.diffusion.loop import fit

_RATE = 2e-3  # the largest learning rate


def train_once(
    kind: str,
    net: nn.Module,
    loss: Callable[[Tensor, torch.Generator], Tensor],
    pairs: int,
    options: Mapping[str, int],
    key: Mapping,
    progress: str,
) -> float:
    """Train a network in place, by :func:`.diffusion.loop.fit`, or fill it with what was trained before.

    Parameters
    ----------
    kind
        Of the file, and what the cache calls it.
    net, loss, pairs
        As there.
    options
        Steps, batch_size and seed.
    key
        What else the trained network depends on.
    progress
        What to call the training.

    Returns
    -------
    float
        Seconds that the training took.
    """

    def make(target, scratch):
        history, seconds = fit(net, loss, pairs, **options, learning_rate=_RATE, folder=scratch, progress=progress)
        storage.write(target, kind, net.state_dict(), {"history": history, "seconds": seconds})

    path = cached(kind, {**key, **options, "code": step_version("alternative")}, make, ".safetensors")
    tensors, content = storage.read(path, kind)
    storage.fill(net.state_dict(), tensors, path)
    net.eval()
    return content["seconds"]
