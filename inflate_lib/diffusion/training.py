"""Training the conditional denoiser (sections 2.2 and 4.1), and its loss on given pairs."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from inflate_lib._checks import numbers, whole_number
from inflate_lib.diffusion import process, ranks, storage
from inflate_lib.diffusion.config import TrainingConfig
from inflate_lib.diffusion.loop import Loop
from inflate_lib.diffusion.model import TrainedModel
from inflate_lib.diffusion.randomness import random_generator
from inflate_lib.diffusion.schedule import at, cosine_schedule


def choose_device(name: str = "auto") -> torch.device:
    """The device called ``name``; "auto" is CUDA where there is one, else MPS (the paper's), else the CPU.

    Raises
    ------
    ValueError
        PyTorch has no such device here, with those that it has.
    """
    gpus = [f"cuda:{i}" for i in range(torch.cuda.device_count())] if torch.cuda.is_available() else []
    there = ["cuda"] * bool(gpus) + ["mps"] * torch.backends.mps.is_available() + ["cpu"]
    if name == "auto":
        return torch.device(there[0])
    if name not in (*there, *gpus):
        raise ValueError(f"device {name!r} cannot be used here, where PyTorch has {', '.join(there + gpus)}")
    return torch.device(name)


def train(
    images: np.ndarray,
    conditions: np.ndarray,
    config: TrainingConfig,
    folder: Path | None = None,
    progress: bool | str = True,
    threads: int | None = None,
    log: Path | None = None,
) -> TrainedModel:
    """Train a denoiser on pairs of structure and descriptor.

    Under ``torchrun``, after ``ranks.start()``, all processes call this with the same pairs and share each batch.

    Parameters
    ----------
    images : array, shape (n, h, w), or (n, c, h, w) where the configuration has c > 1 ``image_channels``
        uint8, or float in [0, 1].
    conditions : array, shape (n, N) or (n,)
        Descriptors in raw units.
    config : TrainingConfig
    folder : path, optional
        Where checkpoints go. If it holds one of this very run, training goes on from there.
    progress : bool or str
        Print a line every few seconds; a string is put before each line (to tell models trained side by side apart).
    threads : int, optional
        CPU threads for the duration of this call.
    log : path, optional
        Folder for ``history.csv`` and, where the package tensorboard is installed, TensorBoard events.

    Returns
    -------
    TrainedModel
        On the CPU, with the averaged weights where ``ema_decay`` is set. Its metadata tell the ``seconds`` spent, those
        of one step (median), and the ``device``.

    Raises
    ------
    ValueError
        Unusable images, conditions, or a checkpoint of another run.
    FloatingPointError
        The loss is no longer finite. The last checkpoint, written while it was, is kept.
    OSError
        A checkpoint cannot be written (full disk). The one before, if there is one, is kept.
    """
    whole_number("threads", threads, 1, optional=True)
    images, conditions = _checked(images, conditions, config)
    threads_before = torch.get_num_threads()
    torch.set_num_threads(threads or threads_before)
    try:
        run = Run(images, conditions, replace(config, strongest=0), folder)
        run.run(progress, log)
        return run.model()
    finally:
        torch.set_num_threads(threads_before)


def simple_loss(
    model: TrainedModel, images: np.ndarray, conditions: np.ndarray, seed: int = 0, timestep_draws: int = 1
) -> float:
    """L_simple (Eq. 12) of a model on pairs (n, h, w), (n, N), one random time step for each; the seed draws it.

    With ``timestep_draws`` as in :class:`.TrainingConfig` they are as noisy as in training; by default t is uniform.

    On pairs that the model was not trained on, a fair measure of how well it predicts; and, as it repeats itself, a
    check that stored weights still mean what they meant.
    """
    whole_number("seed", seed, 0)
    images, conditions = _checked(images, conditions, model.config)
    errors = []
    for first in range(0, len(images), 256):
        x0 = _to_network(torch.from_numpy(images[first : first + 256]))
        y = torch.from_numpy(model.scaled(conditions[first : first + 256])).float()
        generator = random_generator(seed, 4, first)
        t = torch.randint(model.config.T, (timestep_draws, len(x0)), generator=generator).amax(0)
        noise = torch.randn(x0.shape, generator=generator)
        errors.append(_squared_errors(model, x0, y, t, noise))
    return torch.cat(errors).mean().item()


def losses_in_time(
    model: TrainedModel, images: np.ndarray, conditions: np.ndarray | None, times: Sequence[int], seed: int = 0
) -> np.ndarray:
    """Mean squared error of a model's answer at some zero-based time steps.

    Parameters
    ----------
    images : array, shape (n, h, w)
    conditions : array, shape (n, N), or None
        None withholds the descriptor. The noise does not depend on them: what differs between two calls is theirs.
    times : sequence of int

    Returns
    -------
    array, shape (len(times),)
    """
    images, checked = _checked(images, np.zeros(len(images)) if conditions is None else conditions, model.config)
    y = None if conditions is None else torch.from_numpy(model.scaled(checked)).float()
    x0 = _to_network(torch.from_numpy(images))
    losses = []
    for time_step in times:
        noise = torch.randn(x0.shape, generator=random_generator(seed, 6, int(time_step)))
        t = torch.full((len(x0),), int(time_step))
        losses.append(_squared_errors(model, x0, y, t, noise).mean().item())
    return np.array(losses)


def _squared_errors(model: TrainedModel, x0: Tensor, y: Tensor | None, t: Tensor, noise: Tensor) -> Tensor:
    """Squared error of the answer, averaged over pixels, for each image: (n,)."""
    x = process.add_noise(model.schedule, x0, t, noise)
    with torch.inference_mode():
        prediction = model.net(x, t, y)
    target = process.training_target(model.schedule, x0, t, noise, model.config.objective)
    return process.squared_error(prediction, target)


class Run(Loop):
    """Training on the hybrid loss: random time steps, noise and withheld descriptors; an average of the weights."""

    parts = ("loss", "simple", "vlb")

    def __init__(self, images: np.ndarray, conditions: np.ndarray, config: TrainingConfig, folder: Path | None):
        n, device = len(images), choose_device(config.device)
        net = config.make_net(conditions.shape[1]).to(device)
        super().__init__(
            net,
            config.training_steps(n),
            config.batch_size,
            config.learning_rate,
            config.log_every,
            config.checkpoint_steps(n),
            folder,
            identity={"config": config.recipe(), "data": storage.fingerprint(images, conditions)},
        )
        self.config = config
        self.bfloat16 = config.precision == "bfloat16" or (config.precision == "auto" and device.type == "cuda")
        self.low, self.high = conditions.min(0), conditions.max(0)
        self.per_epoch, self.epoch, self.order = math.ceil(n / config.batch_size), None, None
        self.ema = [p.detach().clone() for p in self.parameters]
        # Not dynamic: the smaller batch at an epoch's end gets a graph of its own, and the others keep theirs.
        self.predict = torch.compile(net, dynamic=False) if config.compile else net
        self.schedule = cosine_schedule(config.T)
        self.weights = process.hybrid_weights(self.schedule, config.objective, config.vlb_weight, config.min_snr)
        self.vlb_weights = process.vlb_weights(self.schedule, config.objective) * config.T
        self.images = torch.from_numpy(images).to(device)
        scaled = TrainedModel(net, config, self.low, self.high).scaled(conditions)
        self.conditions = torch.from_numpy(scaled).float()

    def state(self) -> dict[str, Tensor]:
        names = (name for name, _ in self.net.named_parameters())
        return super().state() | {f"ema.{name}": average for name, average in zip(names, self.ema, strict=True)}

    def rows(self) -> Tensor:
        """Numbers of the pairs of this step; every epoch has an order of its own."""
        if self.epoch != self.step // self.per_epoch:
            self.epoch = self.step // self.per_epoch
            shuffle = random_generator(self.config.seed, 1, self.epoch)
            self.order = torch.randperm(len(self.images), generator=shuffle)
        first = self.step % self.per_epoch * self.batch_size
        return self.order[first : first + self.batch_size]

    def draw(self) -> tuple[Tensor, ...]:
        """Pairs of this step, their descriptors, time steps, which descriptors are withheld, and the noise.

        On the CPU and for the whole batch: the same numbers for every device and however many processes share it.
        """
        config, rows = self.config, self.rows()
        n = len(rows)
        generator = random_generator(config.seed, 2, self.step)
        # The descriptor decides most where the noise is strong: the largest of k draws has a density ∝ t^(k − 1).
        t = torch.randint(config.T, (config.timestep_draws, n), generator=generator).amax(0)
        dropped = torch.rand(n, generator=generator) < config.condition_dropout
        noise = torch.randn((n, config.image_channels, *self.images.shape[-2:]), generator=generator)
        y = self.conditions[rows]
        if config.parts:  # each part is withheld every second time, so that any combination can be asked for
            withheld = torch.rand((n, len(config.parts)), generator=generator) < 0.5
            withheld = withheld.repeat_interleave(torch.tensor(config.parts), dim=1)
            y = y.masked_fill(withheld, math.nan)
        return rows, y, t, dropped, noise

    def descend(self) -> Tensor:
        """The gradient of the hybrid loss (Eq. 11) on one batch, or on this process's share of it."""
        drawn = self.draw()
        n, mine = len(drawn[0]), slice(ranks.rank(), None, ranks.world())
        rows, y, t, dropped, noise = (part[mine] for part in drawn)
        if not len(rows):
            return torch.zeros(len(self.parts), device=self.device)
        losses = self.losses(self.there(rows), self.there(y), t, self.there(dropped), self.there(noise)) / n
        losses[0].backward()
        return losses.detach()

    def settle(self) -> None:
        """Let the averages follow the weights: quickly at first, when these are still far from any use."""
        torch._foreach_lerp_(self.ema, self.parameters, self.ema_step())

    def ema_step(self) -> float:
        """How far the averages move towards the weights at this step."""
        return 1 - min(self.config.ema_decay, (1 + self.step) / (10 + self.step))

    def there(self, tensor: Tensor) -> Tensor:
        """Send to the device; a GPU goes on computing meanwhile."""
        on_gpu = self.device.type == "cuda"
        return (tensor.pin_memory() if on_gpu else tensor).to(self.device, non_blocking=on_gpu)

    def losses(self, rows: Tensor, y: Tensor, t: Tensor, dropped: Tensor, noise: Tensor) -> Tensor:
        """Hybrid loss, its simple and its vlb part, summed over some rows of a batch."""
        x0 = _to_network(self.images[rows])
        x = process.add_noise(self.schedule, x0, t, noise)
        t = t.to(self.device)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
            prediction, target = self.answer(x, t, y, dropped, x0, noise)
        error = process.squared_error(prediction.float(), target.float())
        weighted = at(self.weights, t, error) * error, error, at(self.vlb_weights, t, error) * error
        return torch.stack([part.sum() for part in weighted])

    def answer(self, x: Tensor, t: Tensor, y: Tensor, dropped: Tensor, x0: Tensor, noise: Tensor):
        """What the network answers at x_t, and what it should."""
        target = process.training_target(self.schedule, x0, t, noise, self.config.objective)
        return self.predict(x, t, y, dropped), target

    def rate(self) -> float:
        rate = self.learning_rate * min(1, (self.step + 1) / max(1, self.config.warmup_steps))
        if self.config.learning_rate_decay == "cosine":
            rate *= 0.5 * (1 + math.cos(math.pi * self.step / self.total))
        return rate

    def model(self) -> TrainedModel:
        if self.config.ema_decay > 0:
            with torch.no_grad():
                torch._foreach_copy_(self.parameters, self.ema)
        net, size = self.net.cpu().eval(), tuple(self.images.shape[-2:])
        return TrainedModel(net, self.config, self.low, self.high, size, self.history, self.spent())


def _to_network(images: Tensor) -> Tensor:
    """Images (n, h, w) or (n, c, h, w), uint8 or float in [0, 1] → (n, c, h, w) float32 in [−1, 1]."""
    scale = 127.5 if images.dtype == torch.uint8 else 0.5
    return images.reshape(len(images), -1, *images.shape[-2:]).float() / scale - 1


def _checked(images, conditions, config: TrainingConfig) -> tuple[np.ndarray, np.ndarray]:
    try:
        images = np.ascontiguousarray(images)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"images must be an array of numbers ({error})") from None
    conditions = numbers("conditions", conditions, "an array of numbers", finite=False)
    if conditions.ndim == 1:
        conditions = conditions[:, None]
    cell = 2 ** (len(config.channels) - 1)
    channels = (config.image_channels,) if config.image_channels > 1 else ()
    fits = images.shape[1:-2] == channels and images.ndim == 3 + len(channels)
    if not fits or len(images) == 0 or images.shape[-2] % cell or images.shape[-1] % cell:
        shape = ", ".join(map(str, ("n", *channels, "h", "w")))
        raise ValueError(f"images must have shape ({shape}), h and w divisible by {cell}, not {images.shape}")
    if images.dtype != np.uint8:
        images = images.astype(np.float32)
        if not np.isfinite(images).all() or images.min() < 0 or images.max() > 1:
            raise ValueError("images must be uint8, or finite floats between 0 and 1")
    if conditions.ndim != 2 or len(conditions) != len(images) or conditions.shape[1] == 0:
        raise ValueError(f"conditions must have one row for each of {len(images)} images, not {conditions.shape}")
    if not np.isfinite(conditions).all():
        raise ValueError("conditions must be finite; leave out structures whose simulation failed")
    return images, conditions
