"""One training run in several processes, on several GPUs or machines, under ``torchrun``.

Each process, a *rank*, takes its share of every batch, and the gradients are added up. With a single process everything
here does nothing.
"""

import os
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, distributed


def start(device: str = "auto") -> None:
    """Join the processes that ``torchrun`` started, if it did: NCCL where each has a GPU, else Gloo."""
    if int(os.environ.get("WORLD_SIZE", 1)) == 1 or distributed.is_initialized():
        return
    on_gpu = torch.cuda.is_available() and (device == "auto" or device.startswith("cuda"))
    if on_gpu:
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    distributed.init_process_group("nccl" if on_gpu else "gloo")


def finish() -> None:
    """Leave them."""
    if distributed.is_initialized():
        distributed.destroy_process_group()


def world() -> int:
    """Number of processes."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def rank() -> int:
    """Which of them this is; number 0 alone reads and writes files."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def share(value: Any = None) -> Any:
    """What rank 0 passed; every rank must call this."""
    values = [value]
    if world() > 1:
        distributed.broadcast_object_list(values)
    return values[0]


def copy(tensors: Sequence[Tensor], device: torch.device) -> None:
    """Overwrite the tensors of every rank with those of rank 0; ``device`` is where the processes exchange."""
    if world() > 1:
        for tensor in tensors:
            exchanged = tensor.to(device, copy=True)
            distributed.broadcast(exchanged, 0)
            tensor.copy_(exchanged)


def add_up(tensors: Sequence[Tensor]) -> None:
    """Replace each tensor by its sum over the ranks, in one exchange."""
    if world() > 1:
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        distributed.all_reduce(flat)
        for tensor, part in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(part.view_as(tensor))
