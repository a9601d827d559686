"""Training the conditional denoiser (sections 2.2 and 4.1): the loop, its checkpoints and its progress."""

import math
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from inflate_lib.diffusion import process, storage
from inflate_lib.diffusion.config import TrainingConfig
from inflate_lib.diffusion.model import TrainedModel
from inflate_lib.diffusion.schedule import at, cosine_schedule

CHECKPOINT = "checkpoint.safetensors"


def choose_device(name: str = "auto") -> torch.device:
    """The device called ``name``; "auto" is CUDA where there is one, else MPS (the paper's), else the CPU."""
    if name != "auto":
        try:
            return torch.empty(0, device=name).device
        except (RuntimeError, AssertionError, TypeError) as error:
            raise ValueError(f"device {name!r} cannot be used here: {error}") from None
    if torch.cuda.is_available():
        return torch.device("cuda")
    return torch.device("mps" if torch.backends.mps.is_available() else "cpu")


def random_generator(*key: int) -> torch.Generator:
    """A CPU generator that depends on the numbers of ``key`` alone.

    Each training step and each generated structure gets its own, so that results depend neither on where a run was
    interrupted nor on how structures are batched, and no generator's state has to be stored.
    """
    seed = np.random.SeedSequence(key).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(seed >> 1))


def train(
    images: np.ndarray,
    conditions: np.ndarray,
    config: TrainingConfig,
    folder: Path | None = None,
    progress: bool | str = True,
    threads: int | None = None,
) -> TrainedModel:
    """Train a denoiser on pairs of structure and descriptor.

    Parameters
    ----------
    images : array, shape (n, h, w)
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

    Returns
    -------
    TrainedModel
        On the CPU, with the averaged weights where ``ema_decay`` is set.

    Raises
    ------
    ValueError
        Unusable images, conditions, or a checkpoint of another run.
    FloatingPointError
        The loss is no longer finite. The last checkpoint, written while it was, is kept.
    """
    images, conditions = _checked(images, conditions, config)
    threads_before = torch.get_num_threads()
    torch.set_num_threads(threads or threads_before)
    try:
        run = _Run(images, conditions, config, folder)
        run.train(_Reporter(progress, run))
        return run.model()
    finally:
        torch.set_num_threads(threads_before)


class _Run:
    """The state of one training run: what a checkpoint stores, and what a step changes."""

    def __init__(self, images: np.ndarray, conditions: np.ndarray, config: TrainingConfig, folder: Path | None):
        self.config, self.path = config, Path(folder) / CHECKPOINT if folder is not None else None
        self.device = choose_device(config.device)
        self.low, self.high = conditions.min(0), conditions.max(0)
        self.per_epoch = math.ceil(len(images) / config.batch_size)
        self.total = config.training_steps(len(images))
        self.checkpoint_every = config.checkpoint_steps(len(images))
        self.net = config.make_net(conditions.shape[1]).to(self.device)
        self.ema = [p.detach().clone() for p in self.net.parameters()]
        self.optimiser = torch.optim.Adam(self.net.parameters(), lr=config.learning_rate)
        self.step, self.history = 0, {"step": [], "loss": [], "simple": [], "vlb": []}
        # Loss, simple and vlb part, summed since the last entry of the history.
        self.sums = torch.zeros(3, device=self.device)
        self.summed = 0

        self.schedule = cosine_schedule(config.T)
        self.weights = process.hybrid_weights(self.schedule, config.objective, config.vlb_weight, config.min_snr)
        self.vlb_weights = process.vlb_weights(self.schedule, config.objective) * config.T
        self.images = torch.from_numpy(images).to(self.device)
        scaled = TrainedModel(self.net, config, self.low, self.high).scaled(conditions)
        self.conditions = torch.from_numpy(scaled).to(self.device, torch.float32)
        # Tells this run's checkpoint from that of another data set or configuration.
        data = storage.fingerprint(images, conditions)
        self.identity = {"config": config.as_dict() | {"device": ""}, "data": data}
        if self.path is not None and self.path.exists():
            self.restore()

    def train(self, report) -> None:
        order, epoch = None, None
        while self.step < self.total:
            if epoch != self.step // self.per_epoch:
                epoch = self.step // self.per_epoch
                shuffle = random_generator(self.config.seed, 1, epoch)
                order = torch.randperm(len(self.images), generator=shuffle)
            first = self.step % self.per_epoch * self.config.batch_size
            self.advance(order[first : first + self.config.batch_size])
            done = self.step == self.total
            checkpoint = done or self.step % self.checkpoint_every == 0
            if checkpoint or self.step % self.config.log_every == 0:
                self.log()
            report(done)
            if checkpoint and self.path is not None:
                self.save()

    def advance(self, rows: Tensor) -> None:
        """One step of stochastic gradient descent on the hybrid loss (Eq. 11)."""
        config, n = self.config, len(rows)
        # On the CPU: the same numbers for every device.
        generator = random_generator(config.seed, 2, self.step)
        t = torch.randint(config.T, (n,), generator=generator)
        dropped = (torch.rand(n, generator=generator) < config.condition_dropout).to(self.device)
        rows = rows.to(self.device)
        x0 = to_network(self.images[rows])
        noise = torch.randn(x0.shape, generator=generator).to(self.device)

        x = process.add_noise(self.schedule, x0, t, noise)
        target = process.training_target(self.schedule, x0, t, noise, config.objective)
        prediction = self.net(x, t.to(self.device), self.conditions[rows], dropped)
        error = process.squared_error(prediction, target)
        loss = (at(self.weights, t, error) * error).mean()

        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate()
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        with torch.no_grad():
            self.sums += torch.stack([loss, error.mean(), (at(self.vlb_weights, t, error) * error).mean()])
            # The average follows quickly at first, when the weights are still far from any use.
            decay = min(config.ema_decay, (1 + self.step) / (10 + self.step))
            torch._foreach_lerp_(self.ema, list(self.net.parameters()), 1 - decay)
        self.step += 1
        self.summed += 1

    def learning_rate(self) -> float:
        rate = self.config.learning_rate * min(1, (self.step + 1) / max(1, self.config.warmup_steps))
        if self.config.learning_rate_decay == "cosine":
            rate *= 0.5 * (1 + math.cos(math.pi * self.step / self.total))
        return rate

    def log(self) -> None:
        """Close an interval of the history; stop if the loss is lost."""
        if self.summed == 0:
            return
        loss, simple, vlb = (self.sums / self.summed).tolist()
        if not math.isfinite(loss):
            raise self.lost(f"the training loss became {loss} between steps {self.step - self.summed} and {self.step}")
        for name, value in (("step", self.step), ("loss", loss), ("simple", simple), ("vlb", vlb)):
            self.history[name].append(value)
        self.sums.zero_()
        self.summed = 0

    def lost(self, what: str) -> FloatingPointError:
        kept = f" The last good state is in {self.path}." if self.path is not None and self.path.exists() else ""
        advice = f"try a smaller learning rate than {self.config.learning_rate}"
        return FloatingPointError(f"{what}; {advice}.{kept}")

    def save(self) -> None:
        tensors = {}
        for (name, p), average in zip(self.net.named_parameters(), self.ema, strict=True):
            tensors |= {f"net.{name}": p, f"ema.{name}": average}
            tensors |= {f"adam.{name}.{key}": value for key, value in self.optimiser.state[p].items()}
        if not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
            raise self.lost(f"the weights are no longer finite after step {self.step}")
        content = self.identity | {"step": self.step, "history": self.history}
        storage.write(self.path, "checkpoint", tensors, content)

    def restore(self) -> None:
        try:
            tensors, content = storage.read(self.path, "checkpoint")
        except ValueError as error:
            raise ValueError(f"{error}; delete the file to start over") from None
        if {name: content[name] for name in self.identity} != self.identity:
            raise ValueError(
                f"{self.path} belongs to a run with another configuration or other data; "
                "choose another folder, or delete the file to start over"
            )
        places = {}
        for (name, p), average in zip(self.net.named_parameters(), self.ema, strict=True):
            # Laid out in memory like Adam's own: element-wise arithmetic then repeats itself to the last bit.
            state = {"step": torch.zeros(()), "exp_avg": torch.zeros_like(p), "exp_avg_sq": torch.zeros_like(p)}
            self.optimiser.state[p] = state
            places |= {f"net.{name}": p.detach(), f"ema.{name}": average}
            places |= {f"adam.{name}.{key}": value for key, value in state.items()}
        storage.fill(places, tensors, self.path)
        self.step, self.history = content["step"], content["history"]

    def model(self) -> TrainedModel:
        if self.config.ema_decay > 0:
            with torch.no_grad():
                torch._foreach_copy_(list(self.net.parameters()), self.ema)
        net, size = self.net.cpu().eval(), tuple(self.images.shape[1:])
        return TrainedModel(net, self.config, self.low, self.high, size, self.history)


class _Reporter:
    """Prints one plain line every few seconds: step, loss, images per second, time left."""

    def __init__(self, progress: bool | str, run: _Run, seconds: float = 5):
        self.on, self.label = progress is not False, progress if isinstance(progress, str) else "training"
        self.run, self.seconds = run, seconds
        self.started = self.printed = time.monotonic()
        self.first = run.step

    def __call__(self, done: bool) -> None:
        now = time.monotonic()
        if not self.on or (now - self.printed < self.seconds and not done):
            return
        self.printed = now
        rate = (self.run.step - self.first) / max(now - self.started, 1e-9)
        left = (self.run.total - self.run.step) / rate
        losses = self.run.history["loss"]
        loss = f"{losses[-1]:.4f}" if losses else "–"
        state = f"{now - self.started:.0f} s" if done else f"{left // 60:.0f} min {left % 60:02.0f} s left"
        print(
            f"{self.label}: step {self.run.step}/{self.run.total}  loss {loss}  "
            f"{rate * self.run.config.batch_size:.0f} images/s  {state}",
            flush=True,
        )


def to_network(images: Tensor) -> Tensor:
    """Images (n, h, w), uint8 or float in [0, 1] → (n, 1, h, w) float32 in [−1, 1]."""
    scale = 127.5 if images.dtype == torch.uint8 else 0.5
    return images[:, None].float() / scale - 1


def _checked(images, conditions, config: TrainingConfig) -> tuple[np.ndarray, np.ndarray]:
    try:
        images, conditions = np.ascontiguousarray(images), np.asarray(conditions, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"images and conditions must be arrays of numbers ({error})") from None
    if conditions.ndim == 1:
        conditions = conditions[:, None]
    cell = 2 ** (len(config.channels) - 1)
    if images.ndim != 3 or len(images) == 0 or images.shape[1] % cell or images.shape[2] % cell:
        raise ValueError(f"images must have shape (n, h, w), h and w divisible by {cell}, not {images.shape}")
    if images.dtype != np.uint8:
        images = images.astype(np.float32)
        if not np.isfinite(images).all() or images.min() < 0 or images.max() > 1:
            raise ValueError("images must be uint8, or finite floats between 0 and 1")
    if conditions.ndim != 2 or len(conditions) != len(images) or conditions.shape[1] == 0:
        raise ValueError(f"conditions must have one row for each of {len(images)} images, not {conditions.shape}")
    if not np.isfinite(conditions).all():
        raise ValueError("conditions must be finite; leave out structures whose simulation failed")
    return images, conditions
