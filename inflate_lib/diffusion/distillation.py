"""Guidance distilled into the network: one evaluation a step instead of two (Meng et al. 2023, section 3.1).

Classifier-free guidance asks the network twice, with the descriptor and without, and goes on with u + w (c − u). A
*student* that starts from the weights of that network, the *teacher*, and is told w besides can learn to give this
answer at once. It learns from the noisy images that the teacher learned from, each with a w of its own.
"""

import copy
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from inflate_lib.diffusion.config import TrainingConfig
from inflate_lib.diffusion.model import TrainedModel
from inflate_lib.diffusion.randomness import random_generator
from inflate_lib.diffusion.training import Run

_SLOWER = 0.5  # the student's learning rate, of the teacher's: it starts near its goal


class _Distillation(Run):
    """The loop of :func:`distil`: as in training, but the answer wanted is the guided teacher's."""

    checkpoint = "distillation.safetensors"

    def __init__(self, teacher: TrainedModel, images, conditions, config: TrainingConfig, folder: Path | None):
        super().__init__(images, conditions, config, folder)
        self.low, self.high = teacher.condition_min, teacher.condition_max
        self.conditions = torch.from_numpy(teacher.scaled(conditions)).float()
        self.teacher = copy.deepcopy(teacher.net).to(self.device).eval().requires_grad_(False)
        self.net.load_state_dict(self.teacher.state_dict(), strict=False)  # all but what takes w
        torch._foreach_copy_(self.ema, [p.detach() for p in self.parameters])
        self.weights = torch.ones_like(self.weights)  # the teacher's answers hold no noise: all times count alike

    def answer(self, x: Tensor, t: Tensor, y: Tensor, dropped: Tensor, x0: Tensor, noise: Tensor):
        generator = random_generator(self.config.seed, 7, self.step)
        w = torch.rand(self.batch_size, generator=generator)[: len(x)] * math.log(self.config.strongest)
        w = w.exp().to(self.device)
        with torch.no_grad():
            without = self.teacher(x, t, None)
            target = without + w[:, None, None, None] * (self.teacher(x, t, y) - without)
        return self.predict(x, t, y, None, w), target


def distil(
    teacher: TrainedModel,
    images: np.ndarray,
    conditions: np.ndarray,
    config: TrainingConfig,
    folder: Path | None = None,
    progress: bool | str = True,
) -> TrainedModel:
    """Teach a student to answer as its guided teacher does, at strengths from 1 to ``config.strongest``.

    Parameters
    ----------
    teacher : TrainedModel
    images, conditions
        As in :func:`inflate_lib.diffusion.train`.
    config : TrainingConfig
        The teacher's, but for ``strongest`` and ``distillation_steps``.
    folder, progress
        As there.

    Returns
    -------
    TrainedModel
        The student, which :func:`inflate_lib.diffusion.generate` asks once a step. Its history is the teacher's; its
        metadata hold, besides the teacher's, ``distillation``, the seconds spent and the loss at its end, and
        ``teacher``, the fingerprint of that one's weights.

    Raises
    ------
    ValueError
        ``config.strongest`` is not above 1, or the teacher is a student itself.
    """
    if config.strongest <= 1 or teacher.config.strongest:
        raise ValueError("a student needs a teacher that is none itself, and strongest > 1")
    budget = replace(config, steps=config.distillation_steps, epochs=None, checkpoint_every=None)
    budget = replace(budget, learning_rate=_SLOWER * config.learning_rate, learning_rate_decay="cosine")
    run = _Distillation(teacher, images, conditions, budget, folder)
    run.run(f"{progress}, distillation" if isinstance(progress, str) else progress)
    student = run.model()
    about = {"teacher": teacher.fingerprint, "distillation": {"loss": run.history["loss"][-1], **run.spent()}}
    return replace(student, config=config, history=teacher.history, metadata={**teacher.metadata, **about})
