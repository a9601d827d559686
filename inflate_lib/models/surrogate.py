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
from inflate_lib.structures.labels import FRAME, WALL, is_whole, joined, label_image

CHANNELS = (8, 16, 32)
_FOOT = (10, 20)  # rows and columns, of pixels, above the ground that a structure stands on
_FOOT_HIDDEN = 64
_KIND = "surrogate"
_SHARPNESS = 12.0  # of the border between dark and bright; at ∞ it is the threshold of the label image
_LARGEST = 0.5  # change of a pixel in one step, of the range from −1 to 1
_FINISHING, _LENGTHS = 40, (2.0, 1.0, 0.5, 0.25)  # steps that finish a drawing, at most, and their lengths
_LEAST_GAIN = 1e-3  # of the error, by such a step: rounding, which depends on the batch, decides nothing
_REPEATS = 2  # steps of each correction: the first leaves what is not linear, and, of several parts, some of each


class Network(nn.Module):
    """Two convolutions each on 28, 14 and 7 pixels a side, two more on the foot, and two dense layers.

    The foot is looked at twice since a thousandth of a side decides there where the medial axis begins: in the middle
    of the clamped edge, or at its end, if a node beside it sinks below the ground.
    """

    def __init__(self, outputs: int, channels=CHANNELS):
        super().__init__()
        self.channels = list(channels)
        layers, before = [], 1
        for number, width in enumerate(channels):
            stride = 1 if number == 0 else 2
            layers += [nn.Conv2d(before, width, 3, stride=stride, padding=1), nn.SiLU()]
            layers += [nn.Conv2d(width, width, 3, padding=1), nn.SiLU()]
            before = width
        self.whole = nn.Sequential(*layers, nn.Flatten())
        width, hidden = channels[0], 4 * channels[-1]
        self.foot = nn.Sequential(
            *(nn.Conv2d(1, width, 3, padding=1), nn.SiLU(), nn.Conv2d(width, width, 3, padding=1), nn.SiLU()),
            *(nn.Flatten(), nn.Linear(width * _FOOT[0] * _FOOT[1], _FOOT_HIDDEN), nn.SiLU()),
        )
        self.answer = nn.Sequential(
            nn.Linear(before * 49 + _FOOT_HIDDEN, hidden), nn.SiLU(), nn.Linear(hidden, outputs)
        )

    def forward(self, labels: Tensor) -> Tensor:
        seen = [self.whole(labels[:, None]), self.foot(feet(labels)[:, None])]
        return self.answer(torch.cat(seen, dim=1))


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

    def compare(self, x: Tensor, y: Tensor, sharp: bool = False) -> tuple[Tensor, Tensor]:
        """What the surrogate says of drawings (n, 1, 28, 28), and what was wanted: the same where nothing was."""
        answers, wanted = self.net(soft_label((x[:, 0] + 1) / 2, sharp))[:, self.at], y * self.slope + self.offset
        return answers, torch.where(wanted.isnan(), answers.detach(), wanted)

    def error(self, x: Tensor, y: Tensor, sharp: bool = False) -> Tensor:
        """Half the mean squared error of drawings, (n,), summed over the parts that were asked for."""
        answers, wanted = self.compare(x, y, sharp)
        return (answers - wanted).square() @ self.share / 2


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

    What is drawn in the end has grey pixels, and is a structure only behind the threshold of its label image, where a
    pixel more or less can move the medial axis by several pixels. So the drawing is finished (:meth:`finish`).
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

    def finish(self, x: Tensor, y: Tensor) -> Tensor:
        """Finished drawings (n, 1, 28, 28) in [−1, 1], corrected as the structures that they will be.

        Pieces that nearly touch are joined (:func:`.structures.labels.joined`). Then the same steps are made, but ŷ is
        that of the label image behind its threshold; only the gradient is that of the smooth one, as in the
        straight-through estimator (Bengio et al. 2013). Of steps of several lengths each drawing takes the one after
        which E is smallest, until none makes it smaller; what would fall into pieces stays as it was.
        """
        start = torch.stack([torch.from_numpy(joined(image)) for image in _bright(x)])
        start = 2 * start[:, None].to(x.dtype) - 1
        done, rows = start.clone(), torch.arange(len(x))
        for _ in range(_FINISHING):
            now, wanted = done[rows], y[rows]
            least = self._scale.error(now, wanted, sharp=True)
            step, better = self._step(now, wanted, sharp=True), torch.zeros(len(rows), dtype=torch.bool)
            for length in _LENGTHS:
                tried = (now + length * step).clamp(-1, 1)
                error = self._scale.error(tried, wanted, sharp=True)
                found = error < (1 - _LEAST_GAIN) * least
                done[rows[found]], least, better = tried[found], torch.minimum(error, least), better | found
            rows = rows[better]
            if not len(rows):
                break
        broken = [is_whole(a) and not is_whole(b) for a, b in zip(_bright(start), _bright(done), strict=True)]
        return torch.where(torch.tensor(broken)[:, None, None, None], start, done)

    def _step(self, x0, y, sharp=False):
        with torch.inference_mode(False), torch.enable_grad():
            x0 = x0.clone().requires_grad_()
            error = self._scale.error(x0, y.clone(), sharp)
            (gradient,) = torch.autograd.grad(error.sum(), x0)
        steepness = gradient.square().flatten(1).sum(dim=1).clamp(min=1e-12)
        step = -(2 * error.detach() / steepness)[:, None, None, None] * gradient
        largest = step.abs().flatten(1).amax(dim=1).clamp(min=_LARGEST)
        return step * (_LARGEST / largest)[:, None, None, None]


def _bright(x):
    """Images in [0, 1], (n, 28, 28), of drawings (n, 1, 28, 28) in [−1, 1]."""
    return ((x[:, 0] + 1) / 2).numpy()


def soft_label(images: Tensor, sharp: bool = False) -> Tensor:
    """Label images (n, 28, 28) of images (n, 28, 28) in [0, 1], differentiable, in the middle of the bottom edge.

    :func:`inflate_lib.structures.labels.label_image` without what is about broken drawings (pieces, holes): the
    threshold is a sigmoid, the wall a maximum filter, and the move into the frame a choice of pixels. If `sharp`, the
    labels are those behind the threshold, and only their gradient is that of the sigmoid.
    """
    label = _with_wall(torch.sigmoid(_SHARPNESS * (images - labels.THRESHOLD)))
    if sharp:
        label = label + (_with_wall((images > labels.THRESHOLD).to(images.dtype)) - label).detach()
    solid = label.detach() > WALL / 2
    size, frame = label.shape[-1], torch.arange(labels.FRAME)
    columns, rows = solid.any(dim=1).int(), solid.any(dim=2).int()
    left, right = columns.argmax(dim=1), size - 1 - columns.flip(1).argmax(dim=1)
    bottom = size - 1 - rows.flip(1).argmax(dim=1)
    margin = (labels.FRAME - (right - left + 1)) // 2
    row = (bottom[:, None] - (labels.FRAME - 1) + frame) % size  # what wraps around is empty
    column = ((left - margin)[:, None] + frame) % size
    return label[torch.arange(len(label))[:, None, None], row[:, :, None], column[:, None, :]]


def _with_wall(digit):
    digit = F.pad(digit, [labels.THICKNESS] * 4)
    return (digit + F.max_pool2d(digit[:, None], 2 * labels.THICKNESS + 1, 1, labels.THICKNESS)[:, 0]) / 2


def feet(labels: Tensor) -> Tensor:
    """The lowest rows of label images (n, 28, 28), ten by twenty pixels about the middle of what is on the ground."""
    rows, columns = _FOOT
    grounded = (labels[:, -1].detach() > WALL / 2).int()
    last = labels.shape[-1] - 1 - grounded.flip(1).argmax(dim=1)
    middle = (grounded.argmax(dim=1) + last + 1) // 2
    wide = F.pad(labels[:, -rows:], (columns // 2, columns // 2))
    at = middle[:, None] + torch.arange(columns)
    return wide.gather(2, at[:, None].expand(-1, rows, -1))


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
