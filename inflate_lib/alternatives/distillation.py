"""Guidance distilled into the network: one evaluation a step instead of two (Meng et al. 2023, section 3.1).

Classifier-free guidance asks the network twice, with the descriptor and without, and goes on with u + w (c − u). A
*student* that starts from the weights of that network, the *teacher*, and is told w besides can learn to give this
answer at once. It learns from the noisy images that the teacher learned from, each with a w of its own.

A student draws in a few steps, which is cheap enough to *tune* it on what it draws: a critic, such as a surrogate of
the simulation, says how far a drawing is from its target, and the gradient is taken back through the last steps of the
sampler (Clark et al. 2024). The paper leaves such a descriptor loss to future work (sec. 5).
"""

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from inflate_lib.diffusion.config import TrainingConfig
from inflate_lib.diffusion.model import TrainedModel
from inflate_lib.diffusion.randomness import random_generator
from inflate_lib.diffusion.sampling import denoise
from inflate_lib.diffusion.training import Run

_SLOWER = 0.5  # the student's learning rate, of the teacher's: it starts near its goal
_SLOWEST = 0.2  # the same for tuning
_TUNED_FOR = 5, 8, 12  # steps of the sampler, one after another
_THROUGH = 2  # so many last steps the gradient goes back


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


class _Tuning(_Distillation):
    """The loop of :func:`tune`: distillation goes on, and each step draws a batch and asks the critic about it."""

    checkpoint = "tuning.safetensors"

    def __init__(self, student, teacher, critic, weight, images, conditions, config, folder):
        super().__init__(teacher, images, conditions, config, folder)
        self.net.load_state_dict(student.net.state_dict())
        torch._foreach_copy_(self.ema, [p.detach() for p in self.parameters])
        self.critic, self.weight = critic, weight

    def losses(self, rows: Tensor, y: Tensor, t: Tensor, dropped: Tensor, noise: Tensor) -> Tensor:
        """Those of the distillation, and to the first what the critic says of a drawing for each target."""
        loss, *parts = super().losses(rows, y, t, dropped, noise)
        return torch.stack([loss + self.weight * self.missed(y).sum(), *parts])

    def missed(self, y: Tensor) -> Tensor:
        """What the critic says, (n,), of one drawing for each of the targets (n, N)."""
        n, steps, size = len(y), _TUNED_FOR[self.step % len(_TUNED_FOR)], self.images.shape[1:]
        generator = random_generator(self.config.seed, 8, self.step)
        w = (torch.rand(n, generator=generator) * math.log(self.config.strongest)).exp().to(self.device)
        noise = (torch.randn((n, 1, *size), generator=generator).to(self.device) for _ in range(steps + 1))
        number = 0

        def predict(x, t):
            nonlocal number
            number += 1
            with torch.set_grad_enabled(number > steps - _THROUGH):
                return self.predict(x, t.to(self.device), y, None, w)

        *_, drawing = denoise(predict, self.schedule, noise, self.config.objective, "dpm-solver++", steps)
        return self.critic(drawing, y)


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


def tune(
    student: TrainedModel,
    teacher: TrainedModel,
    critic: Callable[[Tensor, Tensor], Tensor],
    images: np.ndarray,
    conditions: np.ndarray,
    steps: int,
    weight: float = 0.05,
    folder: Path | None = None,
    progress: bool | str = True,
) -> TrainedModel:
    """Go on with a distillation, and draw besides what a critic approves of.

    Parameters
    ----------
    student, teacher : TrainedModel
        As :func:`distil` leaves and takes them.
    critic : callable
        ``critic(x, y)`` of drawings (n, 1, h, w) in [−1, 1] and the scaled conditions (n, N) that they were drawn for
        → (n,): how far each is from its target. It can be differentiated with respect to x.
    images, conditions
        As in :func:`inflate_lib.diffusion.train`.
    steps : int
        Training steps.
    weight : float
        Of what the critic says, beside the loss of the distillation.
    folder, progress
        As there.

    Returns
    -------
    TrainedModel
        The student, tuned; its metadata hold ``tuning`` besides.
    """
    budget = replace(student.config, steps=steps, epochs=None, checkpoint_every=None)
    budget = replace(budget, learning_rate=_SLOWEST * teacher.config.learning_rate, learning_rate_decay="cosine")
    run = _Tuning(student, teacher, critic, weight, images, conditions, budget, folder)
    run.run(f"{progress}, tuning" if isinstance(progress, str) else progress)
    about = {"tuning": {"steps": steps, "weight": weight, "loss": run.history["loss"][-1], **run.spent()}}
    return replace(run.model(), config=student.config, history=student.history, metadata=student.metadata | about)
