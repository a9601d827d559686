"""Training on a GPU without waiting for Python: a step is recorded once, in a CUDA graph, and replayed.

A step of a small network is some hundred kernels of a few microseconds each. To start them one by one takes longer than
to compute them; a graph starts all of them in one call. Several models replay theirs side by side, each on a stream of
its own, so that small kernels fill a large GPU.

What a step draws comes from the generators of the plain loop, on the CPU, into tensors that stay in place. So the loss
is that of the plain loop, step by step, and a run goes on exactly where it was stopped.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from inflate_lib.diffusion.config import TrainingConfig
from inflate_lib.diffusion.model import TrainedModel
from inflate_lib.diffusion.schedule import Schedule
from inflate_lib.diffusion.training import Run

_TRIALS = 3  # steps before the recorded one, in which cuDNN chooses its algorithms
_WARMUP = 500  # steps after a start from weights alone, whose moments Adam has yet to find


class CapturedRun(Run):
    """A training run whose steps are replayed. Where there is no CUDA, the same calls compute them one by one.

    Parameters
    ----------
    images, conditions, config, folder
        As in :func:`inflate_lib.diffusion.train`; they are not checked.
    start : TrainedModel, optional
        Weights of this very training, stopped somewhere, to go on from where `folder` has no checkpoint. Adam begins
        anew, with a warm-up.

    Raises
    ------
    ValueError
        `start` is of another training.
    """

    def __init__(
        self,
        images: np.ndarray,
        conditions: np.ndarray,
        config: TrainingConfig,
        folder: Path | None = None,
        start: TrainedModel | None = None,
    ):
        super().__init__(images, conditions, replace(config, strongest=0), folder)
        self.replay, self.inputs, self.started = None, [], 0
        self.identity = self.identity | {"start": None}
        self.now = torch.zeros(2, device=self.device)  # learning rate, and how far the averages move
        self.stream = None
        if self.device.type == "cuda":  # a replayed step can read nothing from the CPU
            self.stream = torch.cuda.Stream(self.device)
            self.schedule = Schedule(self.schedule.betas.to(self.device))
            self.weights, self.vlb_weights = self.weights.to(self.device), self.vlb_weights.to(self.device)
        if start is not None:
            self.start(start)

    def start(self, model: TrainedModel) -> None:
        """Go on from weights alone."""
        fits = np.array_equal(model.condition_min, self.low) and np.array_equal(model.condition_max, self.high)
        if model.config.recipe() != self.config.recipe() or not fits or not model.history.get("step"):
            raise ValueError("the weights to start from are of another training: another recipe or other data")
        for places in (self.parameters, self.ema):
            with torch.no_grad():
                torch._foreach_copy_(places, [p.to(self.device) for p in model.net.parameters()])
        self.history, self.seconds = model.history, model.metadata["seconds"]
        self.step = self.started = self.history["step"][-1]
        self.identity = self.identity | {"start": model.fingerprint}

    def rate(self) -> float:
        since = self.step - self.started
        return super().rate() * (min(1, (since + 1) / _WARMUP) if self.started else 1)

    def compute(self) -> None:
        """All of a step that the device does alone: forward, backward, Adam, and the averages of weights and loss."""
        self.forget()
        losses = self.losses(*self.inputs) / self.batch_size
        losses[0].backward()
        recorded = self.stream is not None
        self.follow(self.now[0] if recorded else self.rate(), capturable=recorded)
        with torch.no_grad():
            self.sums += losses
            torch._foreach_lerp_(self.ema, self.parameters, [self.now[1]] * len(self.ema))

    def capture(self) -> None:
        """Record a step. Where that fails, a line says why, and steps stay those of the plain loop."""
        self.inputs = [
            torch.zeros(self.batch_size, *part.shape[1:], dtype=part.dtype, device=self.device) for part in self.draw()
        ]
        if self.stream is None:
            self.replay = self.compute
            return
        kept = {name: tensor.clone() for name, tensor in self.state().items()}
        graph = torch.cuda.CUDAGraph()
        self.stream.wait_stream(torch.cuda.current_stream())
        try:
            with torch.cuda.stream(self.stream):
                for _ in range(_TRIALS):
                    self.compute()
            with torch.cuda.graph(graph, stream=self.stream):
                self.compute()
            self.replay = graph.replay
        except RuntimeError as error:  # a slower run is better than none
            print(f"no CUDA graph, but plain steps: {error}", flush=True)
        torch.cuda.synchronize()
        with torch.no_grad():  # as if there had been no trials
            for name, tensor in self.state().items():
                tensor.copy_(kept[name])
            self.sums.zero_()

    def advance(self) -> None:
        if self.replay is None or len(self.rows()) < self.batch_size:  # a smaller batch ends an epoch
            super().advance()
            return
        for place, part in zip(self.inputs, self.draw(), strict=True):
            place.copy_(self.there(part))
        self.now.copy_(self.there(torch.tensor([self.rate(), self.ema_step()])))
        self.replay()
        self.step += 1
        self.summed += 1

    def run(self, progress: bool | str, log: Path | None = None) -> None:
        with torch.cuda.stream(self.stream):
            super().run(progress, log)
