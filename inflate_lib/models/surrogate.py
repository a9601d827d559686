"""A surrogate of the simulation: a small convolutional network that sees a structure and says how it will inflate.

The paper leaves this to future work (sec. 5). The network sees the label image, moved to the middle, so that it need
not learn that a shift changes nothing, and answers with all descriptors at once. It can be differentiated, so a model
can learn from it (:func:`critic`) and be steered by it while it draws (:class:`Judge`); it is trained by
:func:`inflate_lib.alternatives.surrogate.train_surrogate`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from inflate_lib.descriptors import get_descriptor
from inflate_lib.descriptors.registry import columns
from inflate_lib.diffusion import TrainedModel, storage
from inflate_lib.structures import labels
from inflate_lib.structures.labels import FRAME, label_image

CHANNELS, HIDDEN = (8, 16, 32), 128
_KIND = "surrogate"
_SHARPNESS = 12.0  # of the border between dark and bright; at ∞ it is the threshold of the label image
_LARGEST = 0.5  # change of a pixel in one step, of the range from −1 to 1
_REPEATS = 2  # steps of each correction: the first leaves what is not linear, and, of several parts, some of each


class Network(nn.Module):
    """Two convolutions each on 28, 14 and 7 pixels a side, and two dense layers."""

    def __init__(self, outputs: int, channels=CHANNELS, hidden: int = HIDDEN):
        super().__init__()
        self.channels = list(channels)
        layers, before = [], 1
        for number, width in enumerate(channels):
            stride = 1 if number == 0 else 2
            layers += [nn.Conv2d(before, width, 3, stride=stride, padding=1), nn.SiLU()]
            layers += [nn.Conv2d(width, width, 3, padding=1), nn.SiLU()]
            before = width
        self.layers = nn.Sequential(
            *layers, nn.Flatten(), nn.Linear(before * 49, hidden), nn.SiLU(), nn.Linear(hidden, outputs)
        )

    def forward(self, labels: Tensor) -> Tensor:
        return self.layers(labels[:, None])


@dataclass
class Surrogate:
    """A trained network, with the mean and the scale (N,) of what it answers, and the seconds that training took.

    `answers` are the descriptors that it answers with, as one: "height+width+area+axis".
    """

    net: Network
    answers: str
    mean: np.ndarray
    scale: np.ndarray
    seconds: float

    def columns(self, descriptor):
        """Where the components of a descriptor stand among its answers."""
        parts = get_descriptor(self.answers).parts
        if not set(get_descriptor(descriptor).parts) <= set(parts):
            raise ValueError(f"the surrogate answers with {', '.join(parts)}, not {descriptor}")
        return columns(descriptor, parts)

    def predict(self, images, descriptor):
        """Descriptors, (n, N), of the structures in images (n, 28, 28); NaN where an image gives no structure."""
        labels, usable = _labels(images)
        answers = np.full((len(labels), len(self.mean)), np.nan)
        with torch.inference_mode():
            for rows in np.array_split(np.flatnonzero(usable), max(1, len(labels) // 256)):
                if len(rows):
                    answers[rows] = self.net(torch.from_numpy(centred(labels[rows]))).numpy() * self.scale + self.mean
        return answers[:, self.columns(descriptor)]

    def save(self, path: Path) -> None:
        """Write one safetensors file, the weights in 16 bits. A file of the same name that is none is an OSError."""
        storage.check_files([path], _KIND)
        about = {"answers": self.answers, "channels": self.net.channels, "seconds": self.seconds}
        about |= {"mean": self.mean.tolist(), "scale": self.scale.tolist()}
        storage.write(path, _KIND, {name: value.half() for name, value in self.net.state_dict().items()}, about)

    @classmethod
    def load(cls, path: Path) -> "Surrogate":
        """Read a saved surrogate. A foreign, truncated or altered file is a ValueError that names it."""
        tensors, content = storage.read(path, _KIND)
        mean, scale = np.array(content["mean"]), np.array(content["scale"])
        net = Network(len(mean), tuple(content["channels"]))
        storage.fill(net.state_dict(), tensors, path)
        return cls(net.eval(), content["answers"], mean, scale, content["seconds"])


def robust(answers: Tensor, wanted: Tensor) -> Tensor:
    """Huber's loss: squares, but lines beyond 1, so that the few structures that snap do not decide the rest."""
    return 2 * F.huber_loss(answers, wanted, reduction="none")


class _Scale:
    """From a model's scaled conditions (n, N), NaN where a part is withheld, to the surrogate's scale."""

    def __init__(self, surrogate: Surrogate, model: TrainedModel, descriptor: str):
        self.net, self.at = surrogate.net.eval().requires_grad_(False), surrogate.columns(descriptor)
        extent, low = model.condition_max - model.condition_min, model.condition_min
        slope, offset = extent / surrogate.scale[self.at], (low - surrogate.mean[self.at]) / surrogate.scale[self.at]
        self.slope, self.offset = (torch.from_numpy(values).float() for values in (slope, offset))
        sizes = torch.tensor(model.config.parts or [len(low)])
        self.share = (1 / sizes).repeat_interleave(sizes)  # of each number in its part

    def compare(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """What the surrogate says of drawings (n, 1, 28, 28), and what was wanted: the same where nothing was."""
        answers, wanted = self.net(soft_label((x[:, 0] + 1) / 2))[:, self.at], y * self.slope + self.offset
        return answers, torch.where(wanted.isnan(), answers.detach(), wanted)


def critic(surrogate: Surrogate, model: TrainedModel, descriptor: str) -> Callable[[Tensor, Tensor], Tensor]:
    """How far drawings are from their targets, for a model to learn from: the *descriptor loss* of the paper's sec. 5.

    Parameters
    ----------
    surrogate : Surrogate
        Answers with all parts of the descriptor.
    model : TrainedModel
        For the scale of its conditions.
    descriptor : str
        That the model was trained for.

    Returns
    -------
    callable
        ``loss(x, y)`` of drawings (n, 1, 28, 28) in [−1, 1] and the scaled conditions (n, N) that they were drawn for,
        NaN where a part was withheld → (n,): the sum over the parts that were asked for, in standard deviations
        squared, so that each weighs as much as in a model of its own. It can be differentiated with respect to x.
    """
    scale = _Scale(surrogate, model, descriptor)

    def loss(x: Tensor, y: Tensor) -> Tensor:
        return robust(*scale.compare(x, y)) @ scale.share

    return loss


class Judge:
    """Steers a model by a surrogate while it draws (:func:`inflate_lib.diffusion.generate`).

    Classifier guidance (Dhariwal & Nichol 2021) adds the gradient of a second network to each step; diffusion posterior
    sampling (Chung et al. 2023) takes that gradient at the estimate of the clean image, x̂₀, where a network that was
    trained on clean images can be asked. Here the surrogate predicts the descriptor ŷ of the structure that x̂₀ is
    becoming, and x̂₀ is moved against the gradient g of its mean squared error E (halved, summed over the parts),

        x̂₀ ← x̂₀ − 2 E / ‖g‖² · g.

    This is Polyak's step: with one descriptor, and as long as ŷ is linear, it removes the error at once; it is made
    twice. The gradient is not taken through the diffusion model, which would triple the cost.
    """

    def __init__(self, surrogate: Surrogate, model: TrainedModel, descriptor: str):
        self._scale = _Scale(surrogate, model, descriptor)
        self.fingerprint = storage.fingerprint(*(value.numpy() for value in surrogate.net.state_dict().values()))

    def __call__(self, x0: Tensor, y: Tensor) -> Tensor:
        """What to add to clean images (n, 1, 28, 28) in [−1, 1] that were drawn for the scaled conditions y (n, N)."""
        moved = x0
        for _ in range(_REPEATS):
            moved = moved + self._step(moved, y)
        return moved - x0

    def _step(self, x0, y):
        with torch.inference_mode(False), torch.enable_grad():
            x0 = x0.clone().requires_grad_()
            answers, wanted = self._scale.compare(x0, y.clone())
            error = (answers - wanted).square() @ self._scale.share / 2
            (gradient,) = torch.autograd.grad(error.sum(), x0)
        steepness = gradient.square().flatten(1).sum(dim=1).clamp(min=1e-12)
        step = -(2 * error.detach() / steepness)[:, None, None, None] * gradient
        largest = step.abs().flatten(1).amax(dim=1).clamp(min=_LARGEST)
        return step * (_LARGEST / largest)[:, None, None, None]


def soft_label(images: Tensor) -> Tensor:
    """Label images (n, 28, 28) of images (n, 28, 28) in [0, 1], differentiable, in the middle of the bottom edge.

    :func:`inflate_lib.structures.labels.label_image` without what is about broken drawings (pieces, holes): the
    threshold is a sigmoid, the wall a maximum filter, and the move into the frame a choice of pixels.
    """
    digit = F.pad(torch.sigmoid(_SHARPNESS * (images - labels.THRESHOLD)), [labels.THICKNESS] * 4)
    label = (digit + F.max_pool2d(digit[:, None], 2 * labels.THICKNESS + 1, 1, labels.THICKNESS)[:, 0]) / 2
    solid = label.detach() > labels.WALL / 2
    size, frame = label.shape[-1], torch.arange(labels.FRAME)
    columns, rows = solid.any(dim=1).int(), solid.any(dim=2).int()
    left, right = columns.argmax(dim=1), size - 1 - columns.flip(1).argmax(dim=1)
    bottom = size - 1 - rows.flip(1).argmax(dim=1)
    margin = (labels.FRAME - (right - left + 1)) // 2
    row = (bottom[:, None] - (labels.FRAME - 1) + frame) % size  # what wraps around is empty
    column = ((left - margin)[:, None] + frame) % size
    return label[torch.arange(len(label))[:, None, None], row[:, :, None], column[:, None, :]]


def centred(labels):
    """Label images moved sideways to the middle of the frame, (n, 28, 28) float32."""
    labels = np.ascontiguousarray(labels, dtype=np.float32)
    columns = labels.any(axis=1)
    first = columns.argmax(axis=1)
    last = columns.shape[1] - 1 - columns[:, ::-1].argmax(axis=1)
    shift = (columns.shape[1] - 1 - last - first) // 2
    source = (np.arange(columns.shape[1]) - shift[:, None]) % columns.shape[1]
    return np.take_along_axis(labels, source[:, None, :], axis=2)


def _labels(images):
    """Label images, and which images give one."""
    found, usable = np.zeros((len(images), FRAME, FRAME), np.float32), np.ones(len(images), bool)
    for number, image in enumerate(images):
        try:
            found[number] = label_image(image)
        except ValueError:
            usable[number] = False
    return found, usable
