"""The training loop of every network here: Adam, checkpoints, a history of the loss, lines of progress.

A run that was interrupted goes on from its last checkpoint and ends as if nothing had happened, to the last bit.
"""

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.adam import adam

from inflate_lib._files import draft, naming
from inflate_lib._progress import Progress
from inflate_lib.diffusion import ranks, storage
from inflate_lib.diffusion.randomness import random_generator

_COLUMNS = ("step", "loss", "simple", "vlb", "seconds")  # of a log
_WARMUP = 50  # steps, of :func:`fit`
_PIECES = 20  # of a run of :func:`fit`, each with a checkpoint and an entry of the history


class Loop:
    """A training run: what a checkpoint stores, and what a step changes.

    A kind of training is a subclass, which says in :meth:`descend` what a step learns, in :meth:`rate` how quickly.
    Under ``torchrun`` the processes add up their gradients, and the first one alone reads and writes files.

    Parameters
    ----------
    net
        On its device already.
    total, batch_size
        Steps in all, and pairs in each.
    learning_rate
        The largest.
    log_every, checkpoint_every
        Steps that an entry of the history averages, and between two checkpoints.
    folder
        Where checkpoints go, if anywhere.
    identity
        What tells a checkpoint of this run from that of another.
    """

    parts: tuple[str, ...] = ("loss",)  # that a step returns; the history holds the averages of each
    checkpoint = "checkpoint.safetensors"  # in the folder

    def __init__(
        self,
        net: nn.Module,
        total: int,
        batch_size: int,
        learning_rate: float,
        log_every: int,
        checkpoint_every: int,
        folder: Path | None,
        identity: Mapping,
    ):
        self.net, self.total, self.batch_size, self.learning_rate = net, total, batch_size, learning_rate
        self.log_every, self.checkpoint_every = log_every, checkpoint_every
        self.path, self.identity = None if folder is None else Path(folder) / self.checkpoint, identity
        self.parameters = list(net.parameters())
        self.device = self.parameters[0].device
        self.fused = self.device.type == "cuda"
        for p in self.parameters:
            p.grad = torch.zeros_like(p)
        # The counts of steps are tensors that a GPU adds to itself.
        counts = [torch.zeros((), device=self.device if self.fused else "cpu") for _ in self.parameters]
        means, squares = ([torch.zeros_like(p) for p in self.parameters] for _ in range(2))
        self.adam = {"step": counts, "exp_avg": means, "exp_avg_sq": squares}
        self.step, self.history = 0, {name: [] for name in ("step", *self.parts)}
        self.seconds, self.per_step = 0.0, []  # spent in all; of one step, on average between entries of the history
        self.until = math.inf  # time.monotonic() at which the run stops, with a checkpoint to go on from
        self.sums, self.summed = torch.zeros(len(self.parts), device=self.device), 0  # since the last such entry

    def descend(self) -> Tensor:
        """Add the gradient of this step's loss to that of the parameters; return its parts, the loss first."""
        raise NotImplementedError

    def rate(self) -> float:
        """Learning rate of this step."""
        raise NotImplementedError

    def settle(self) -> None:
        """What else there is to do after a step of the optimiser."""

    def state(self) -> dict[str, Tensor]:
        """Every tensor that a step changes, by its name in the checkpoint."""
        tensors = {}
        for number, (name, p) in enumerate(self.net.named_parameters()):
            tensors[f"net.{name}"] = p.detach()
            tensors |= {f"adam.{name}.{key}": values[number] for key, values in self.adam.items()}
        return tensors

    def run(self, progress: bool | str, log: Path | None = None) -> None:
        """Train to the end, or as long as there is time, from the last checkpoint if there is one.

        `progress` is False for silence, or what to call the training in lines of progress; `log` is a folder for
        ``history.csv`` and TensorBoard events.
        """
        self.resume()
        first, report, rows = ranks.rank() == 0, None, None
        if first and progress is not False:
            report = Progress(progress if isinstance(progress, str) else "training", self.total, "steps", self.step)
        if first and log is not None:
            rows = _Log(Path(log), self.step)
        started = time.monotonic() - self.seconds
        done = self.step == self.total
        while not done:
            self.advance()
            done = self.step == self.total or time.monotonic() >= self.until
            checkpoint = done or self.step % self.checkpoint_every == 0
            if self.summed and (checkpoint or self.step % self.log_every == 0):
                steps = self.summed
                self.note()
                before, self.seconds = self.seconds, time.monotonic() - started
                self.per_step.append((self.seconds - before) / steps)
                if rows is not None:
                    rows.add(**{name: values[-1] for name, values in self.history.items()}, seconds=self.seconds)
            if report and (done or report.due()):
                loss = f"loss {self.history['loss'][-1]:.4f}" if self.history["loss"] else ""
                report.tell_time(self.step, loss, f"{report.rate(self.step) * self.batch_size:.0f} images/s")
            if checkpoint and self.path is not None and first:
                self.save()

    def advance(self) -> None:
        """One step."""
        self.forget()  # not to None: a process without a row in this batch has a gradient, too
        losses = self.descend()
        ranks.add_up([*(p.grad for p in self.parameters), losses])
        self.follow(self.rate())
        with torch.no_grad():
            self.sums += losses
            self.settle()
        self.step += 1
        self.summed += 1

    def forget(self) -> None:
        """Set the gradient to zero."""
        torch._foreach_zero_([p.grad for p in self.parameters])

    @torch.no_grad()
    def follow(self, rate: float | Tensor, capturable: bool = False) -> None:
        """Move the weights along the gradient, as Adam does.

        By the function: the class ``torch.optim.Adam`` loads PyTorch's compiler, more than a second in each process.
        """
        gradients, moments = [p.grad for p in self.parameters], (self.adam["exp_avg"], self.adam["exp_avg_sq"])
        adam(
            self.parameters, gradients, *moments, [], self.adam["step"], lr=rate, beta1=0.9, beta2=0.999, eps=1e-8,
            weight_decay=0.0, amsgrad=False, maximize=False, capturable=capturable,
            fused=self.fused, foreach=not self.fused,
        )  # fmt: skip

    def note(self) -> None:
        """Make an entry of the history; stop if the loss is lost."""
        averages = (self.sums / self.summed).tolist()
        if not math.isfinite(averages[0]):
            between = f"between steps {self.step - self.summed} and {self.step}"
            raise self.lost(f"the training loss became {averages[0]} {between}")
        for name, value in zip(self.history, (self.step, *averages), strict=True):
            self.history[name].append(value)
        self.sums.zero_()
        self.summed = 0

    def lost(self, what: str) -> FloatingPointError:
        kept = f" The last good state is in {self.path}." if self.path is not None and self.path.exists() else ""
        return FloatingPointError(f"{what}; try a smaller learning rate than {self.learning_rate}.{kept}")

    def save(self) -> None:
        tensors = self.state()
        if not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
            raise self.lost(f"the weights are no longer finite after step {self.step}")
        content = {**self.identity, "step": self.step, "history": self.history, "seconds": self.seconds}
        try:
            storage.write(self.path, "checkpoint", tensors, content)
        except OSError as error:
            kept = "the checkpoint before it is kept" if self.path.exists() else "there is no checkpoint yet"
            raise OSError(error.errno, f"{error.strerror} at step {self.step} ({kept})", str(self.path)) from error

    def resume(self) -> None:
        """Go on from the checkpoint; all processes take over what the first one read."""
        if self.path is not None and self.path.exists() and ranks.rank() == 0:
            self.restore()
        ranks.copy(list(self.state().values()), self.device)
        self.step, self.history = ranks.share((self.step, self.history))

    def restore(self) -> None:
        try:
            tensors, content = storage.read(self.path, "checkpoint")
        except ValueError as error:
            raise ValueError(f"{error}; delete the file to start over") from None
        if {name: content.get(name) for name in self.identity} != self.identity:
            raise ValueError(
                f"{self.path} belongs to a run with another configuration or other data; "
                "choose another folder, or delete the file to start over"
            )
        storage.fill(self.state(), tensors, self.path)
        self.step, self.history, self.seconds = (content[name] for name in ("step", "history", "seconds"))

    def spent(self) -> dict:
        """Seconds in all, the device, and the median of the seconds of a step."""
        step = {"seconds_per_step": float(np.median(self.per_step))} if self.per_step else {}
        return {"seconds": round(self.seconds, 1), "device": device_name(self.device), **step}


class _Log:
    """``history.csv``, and TensorBoard events where the package tensorboard is installed, in a folder.

    The rows are those of the run's history and the seconds spent until then. What a killed run logged after its last
    checkpoint, which ends at ``step``, is dropped: the run repeats it.
    """

    def __init__(self, folder: Path, step: int):
        self.path, heading = folder / "history.csv", ",".join(_COLUMNS) + "\n"
        before = self.path.read_text(errors="replace").splitlines(keepends=True) if self.path.exists() else []
        if before and before[0] != heading:
            raise FileExistsError(f"{self.path} is there already, and no log of a training: give another folder for it")
        whole = (line for line in before[1:] if line.endswith("\n") and line.count(",") == len(_COLUMNS) - 1)
        kept = [line for line in whole if int(line.split(",")[0]) <= step]
        with draft(self.path) as place:
            place.write_text(heading + "".join(kept))
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            print("no TensorBoard logs: the package tensorboard is not installed (pip install tensorboard)")
            self.events = None
        else:
            self.events = SummaryWriter(str(folder), purge_step=step + 1)

    def add(self, **row: float) -> None:
        """Append a row, by the names of ``_COLUMNS``."""
        with naming(self.path), self.path.open("a") as file:
            file.write(",".join(str(row[name]) for name in _COLUMNS) + "\n")
        if self.events is not None:
            for name in _COLUMNS[1:]:
                self.events.add_scalar(name, row[name], row["step"])
            self.events.flush()


def device_name(device: torch.device) -> str:
    """Which GPU it is; else "cpu" or "mps"."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


class _Fit(Loop):
    """The loop of :func:`fit`."""

    def __init__(self, net: nn.Module, loss: Callable, n: int, steps: int, batch_size: int, seed: int, **options):
        every = max(1, math.ceil(steps / _PIECES))
        options |= {"log_every": every, "checkpoint_every": every}
        identity = {"steps": steps, "batch_size": batch_size, "seed": seed}
        super().__init__(net, steps, min(batch_size, n), identity=identity, **options)
        self.loss, self.n, self.seed = loss, n, seed

    def descend(self) -> Tensor:
        generator = random_generator(self.seed, 5, self.step)
        rows = torch.randint(self.n, (self.batch_size,), generator=generator)
        value = self.loss(rows, generator)
        value.backward()
        return value.detach()[None]

    def rate(self) -> float:
        decay = 0.5 * (1 + math.cos(math.pi * self.step / self.total))
        return self.learning_rate * (min(1.0, (self.step + 1) / _WARMUP) * decay)


def fit(
    net: nn.Module,
    loss: Callable[[Tensor, torch.Generator], Tensor],
    n: int,
    steps: int,
    batch_size: int = 64,
    learning_rate: float = 2e-3,
    seed: int = 0,
    folder: Path | None = None,
    progress: bool | str = False,
) -> tuple[list[float], float]:
    """Train one of the small networks beside the diffusion model, in place; a warm-up, then a cosine decay.

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
        What to call the training in lines of progress; False for silence.

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
    run = _Fit(net, loss, n, steps, batch_size, seed, learning_rate=learning_rate, folder=folder)
    run.run(progress)
    return run.history["loss"], run.seconds
