"""Guidance distilled into the network: one evaluation a step instead of two (Meng et al. 2023, section 3.1).

Classifier-free guidance asks the network twice, with the descriptor and without, and goes on with u + w (c − u). A
*student* that starts from the weights of that network, the *teacher*, and is told w besides can learn to give this
answer at once. It learns from the noisy images that the teacher learned from, each with a w of its own.

A student draws in a few steps, which is cheap enough to *tune* it on what it draws: a critic, such as a surrogate of
the simulation, says how far a drawing is from its target, and the gradient is taken back through the last steps of the
sampler (Clark et al. 2024). The paper leaves such a descriptor loss to future work (sec. 5). A critic alone is content
with one good drawing for each target; the *energy score* (Gneiting and Raftery 2007) of two drawings and the real image
asks besides that drawings for one target differ as much as real structures do.
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
from inflate_lib.diffusion.training import Run, to_network

_SLOWER = 0.5  # the student's learning rate, of the teacher's: it starts near its goal
_SLOWEST = 0.2  # the same for tuning
_TUNED_FOR = 5, 8, 12  # steps of the sampler, one after another
_THROUGH = 2  # so many last steps the gradient goes back
_SMALL = 1e-6  # keeps the gradient of a distance finite where it vanishes


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
    """The loop of :func:`tune`: distillation goes on, and each step draws two images for each half of its targets."""

    checkpoint = "tuning.safetensors"

    def __init__(self, student, teacher, critic, weight, energy, images, conditions, config, folder):
        super().__init__(teacher, images, conditions, config, folder)
        self.net.load_state_dict(student.net.state_dict())
        torch._foreach_copy_(self.ema, [p.detach() for p in self.parameters])
        self.critic, self.weight, self.energy = critic, weight, energy

    def losses(self, rows: Tensor, y: Tensor, t: Tensor, dropped: Tensor, noise: Tensor) -> Tensor:
        """Those of the distillation, and to the first what the critic and the energy score say of drawings."""
        loss, *parts = super().losses(rows, y, t, dropped, noise)
        some = math.ceil(len(y) / 2)
        wanted = y[:some].repeat(2, 1)
        drawings = self.drawings(wanted)
        missed = self.critic(drawings, wanted).mean()
        score = energy_score(drawings[:some], drawings[some:], to_network(self.images[rows[:some]])).mean()
        return torch.stack([loss + len(y) * (self.weight * missed + self.energy * score), *parts])

    def drawings(self, y: Tensor) -> Tensor:
        """A drawing (n, 1, h, w) for each of the targets (n, N)."""
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

        *_, drawings = denoise(predict, self.schedule, noise, self.config.objective, "dpm-solver++", steps)
        return drawings


def energy_score(one: Tensor, other: Tensor, real: Tensor) -> Tensor:
    """How unlike the data drawings are, (n,): two for each target, beside the real image that has it, all (n, 1, h, w).

    (‖x − x₀‖ + ‖x′ − x₀‖ − ‖x − x′‖) / 2 with the root mean square over pixels as norm. Its mean is smallest where x
    and x′ are distributed as x₀ is (Gneiting and Raftery 2007, Eq. 22).
    """

    def distance(a, b):
        return ((a - b).square().mean(dim=(1, 2, 3)) + _SMALL).sqrt()

    return (distance(one, real) + distance(other, real) - distance(one, other)) / 2


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
    energy: float = 0.5,
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
    energy : float
        Weight of the :func:`energy_score`.
    folder, progress
        As there.

    Returns
    -------
    TrainedModel
        The student, tuned; its metadata hold ``tuning`` besides.
    """
    budget = replace(student.config, steps=steps, epochs=None, checkpoint_every=None)
    budget = replace(budget, learning_rate=_SLOWEST * teacher.config.learning_rate, learning_rate_decay="cosine")
    run = _Tuning(student, teacher, critic, weight, energy, images, conditions, budget, folder)
    run.run(f"{progress}, tuning" if isinstance(progress, str) else progress)
    how = {"steps": steps, "weight": weight, "energy": energy, "loss": run.history["loss"][-1], **run.spent()}
    metadata = student.metadata | {"tuning": how}
    return replace(run.model(), config=student.config, history=student.history, metadata=metadata)
