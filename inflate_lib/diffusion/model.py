"""A trained denoiser with everything needed to use it, and the one file it is kept in."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from torch import Tensor

from inflate_lib.diffusion import storage
from inflate_lib.diffusion.config import TrainingConfig
from inflate_lib.diffusion.schedule import Schedule, cosine_schedule
from inflate_lib.diffusion.unet import UNet


class Judge(Protocol):
    """What steers a model while it draws, for scaled descriptors y (n, N); images are (n, 1, h, w) in [−1, 1]."""

    def __call__(self, x0: Tensor, y: Tensor) -> Tensor:
        """What to add to clean images."""

    def finish(self, x: Tensor, y: Tensor) -> Tensor:
        """Drawings that are done, corrected for the last time."""


@dataclass
class TrainedModel:
    """A network with everything needed to use it.

    ``condition_min`` and ``condition_max`` (N,) are the range of the training descriptors, in raw units; ``history``
    holds lists ``step``, ``loss``, ``simple``, ``vlb``; ``metadata`` is free for the caller (JSON).
    ``judge``, which is not stored, steers it.
    """

    net: UNet
    config: TrainingConfig
    condition_min: np.ndarray
    condition_max: np.ndarray
    image_size: tuple[int, int] = (28, 28)
    history: dict[str, list] = field(default_factory=dict)
    metadata: dict = field(default_factory=dict)
    judge: Judge | None = field(default=None, repr=False, compare=False)

    @property
    def schedule(self) -> Schedule:
        """The noise schedule it was trained on."""
        return cosine_schedule(self.config.T)

    @property
    def fingerprint(self) -> str:
        """What the weights are, to the last bit."""
        return storage.fingerprint(*(value.numpy() for value in self.net.state_dict().values()))

    def scaled(self, conditions: np.ndarray) -> np.ndarray:
        """Descriptors (n, N) min–max scaled as in training; a constant descriptor becomes zero."""
        extent = self.condition_max - self.condition_min
        return (conditions - self.condition_min) / np.where(extent > 0, extent, 1)

    def save(self, path: Path, half: bool = False) -> None:
        """Write one safetensors file; ``half`` stores the weights in 16 bits, at half the size.

        A file of the same name that is no model is an OSError and stays.
        """
        storage.check_files([path], "model")
        tensors = {name: value.half() if half else value for name, value in self.net.state_dict().items()}
        content = {
            "config": self.config.as_dict(),
            "condition_min": self.condition_min.tolist(),
            "condition_max": self.condition_max.tolist(),
            "image_size": list(self.image_size),
            "history": self.history,
            "metadata": self.metadata,
        }
        storage.write(path, "model", tensors, content)

    @classmethod
    def load(cls, path: Path) -> "TrainedModel":
        """Read a saved model, onto the CPU. A foreign, truncated or altered file is a ValueError that names it."""
        tensors, content = storage.read(path, "model")
        low, high = (np.array(content[name], dtype=np.float64) for name in ("condition_min", "condition_max"))
        try:
            config = TrainingConfig.from_dict(content["config"])
        except ValueError as error:
            raise ValueError(f"{path} was written by another version of this library: {error}") from error
        net = config.make_net(len(low))
        storage.fill(net.state_dict(), tensors, path)
        size = tuple(content["image_size"])
        return cls(net.eval(), config, low, high, size, content["history"], content["metadata"])
