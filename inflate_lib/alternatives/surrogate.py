"""A surrogate of the simulation: a small convolutional network that sees a structure and says how it will inflate.

The paper leaves this to future work (sec. 5). The network sees the label image, moved to the middle, so that it need
not learn that a shift changes nothing, and answers with all descriptors at once. It is trained on the structures that
the diffusion models are trained on, and their mirror images, and tested on those that are held out; one that others
learn from (:func:`critic`) sees blends of these structures as well.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from inflate_lib._cache import cached, code_version, digest, step_version
from inflate_lib._checks import whole_number
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.datasets.simulate import simulate_dataset
from inflate_lib.datasets.storage import load_dataset, save_dataset
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.descriptors.registry import basic, columns, name_of
from inflate_lib.diffusion import TrainedModel, storage
from inflate_lib.diffusion.loop import fit
from inflate_lib.diffusion.randomness import initialised
from inflate_lib.structures import labels
from inflate_lib.structures.blends import blend
from inflate_lib.structures.labels import FRAME, label_image

if TYPE_CHECKING:
    import xarray as xr

CHANNELS, HIDDEN, BATCH = (8, 16, 32), 128, 64
_RATE = 2e-3  # the largest learning rate
_SHARPNESS = 12.0  # of the border between dark and bright; at ∞ it is the threshold of the label image


class _Network(nn.Module):
    """Two convolutions each on 28, 14 and 7 pixels a side, and two dense layers."""

    def __init__(self, outputs: int, channels=CHANNELS, hidden: int = HIDDEN):
        super().__init__()
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

    net: _Network
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


def train_surrogate(
    data: "xr.Dataset",
    steps: int = 1500,
    seed: int = 0,
    rows: np.ndarray | None = None,
    answers: str | None = None,
    further: "xr.Dataset | None" = None,
    channels: tuple[int, ...] = CHANNELS,
    batch_size: int = BATCH,
) -> Surrogate:
    """Train the surrogate, or find it trained in the cache.

    Parameters
    ----------
    data : xarray.Dataset
        Simulated structures.
    steps : int
        Training steps of ``batch_size`` structures each.
    seed : int
        Of the first weights and the batches.
    rows : (m,) int, optional
        Structures to train on; by default those that the diffusion models are trained on.
    answers : str, optional
        Descriptor that it is to answer with, or several, "height+area"; by default all that the deformed nodes tell.
    further : xarray.Dataset, optional
        More simulated structures to learn from, all of them; see :func:`blends_of`.
    channels, batch_size
        Width of the network at each scale, and structures in a step.

    Returns
    -------
    Surrogate
    """
    whole_number("steps", steps, 1)
    whole_number("seed", seed, 0)
    whole_number("batch_size", batch_size, 1)
    rows = training_rows(data) if rows is None else rows
    answers = answers or name_of(one.name for one in basic() if one.of_nodes and one.variable in data)
    told = get_descriptor(answers)
    seen, values = data["label"].values[rows], descriptor_matrix(data, answers)[rows]
    parts = [columns(part, told.parts) for part in told.parts]
    mean = values.mean(axis=0)
    scale = np.concatenate(
        [get_descriptor(part).error.scale(values[:, of]) for part, of in zip(told.parts, parts, strict=True)]
    )
    if further is not None:
        usable = further["converged"].values
        seen = np.concatenate([seen, further["label"].values[usable]])
        values = np.concatenate([values, descriptor_matrix(further, answers)[usable]])
    net = initialised(lambda: _Network(told.length, channels), seed)
    x = torch.from_numpy(centred(np.concatenate([seen, seen[:, :, ::-1]])))
    y = torch.from_numpy((np.concatenate([values, told.mirrored(values)]) - mean) / scale).float()

    def loss(rows, generator):
        errors = robust(net(x[rows]), y[rows]).mean(dim=0)
        return sum(errors[of].mean() for of in parts)  # a curve counts as much as each scalar

    options, key = {"steps": steps, "batch_size": batch_size, "seed": seed}, {"data": digest(seen, values)}
    key |= {"channels": channels}
    seconds = train_once("surrogate", net, loss, len(x), options, key, "training the surrogate")
    return Surrogate(net, answers, mean, scale, seconds)


def robust(answers: Tensor, wanted: Tensor) -> Tensor:
    """Huber's loss: squares, but lines beyond 1, so that the few structures that snap do not decide the rest."""
    return 2 * F.huber_loss(answers, wanted, reduction="none")


def blends_of(data: "xr.Dataset", n: int, seed: int = 0) -> "xr.Dataset":
    """Blends (:func:`.structures.blend`) of the structures that models are trained on, simulated; from the cache."""
    images = data["image"].values[training_rows(data)]

    def make(target, scratch):
        save_dataset(simulate_dataset(blend(images, n, seed), folder=scratch), target)

    key = {
        "blends of": digest(images),
        "n": n,
        "seed": seed,
        "code": step_version("dataset") + code_version("inflate_lib.structures.blends"),
    }
    return load_dataset(cached("blends", key, make, ".nc"))


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
    at, net = surrogate.columns(descriptor), surrogate.net.eval().requires_grad_(False)
    extent, low = model.condition_max - model.condition_min, model.condition_min
    slope, offset = extent / surrogate.scale[at], (low - surrogate.mean[at]) / surrogate.scale[at]
    slope, offset = (torch.from_numpy(values).float() for values in (slope, offset))
    sizes = torch.tensor(model.config.parts or [len(at)])
    share = (1 / sizes).repeat_interleave(sizes)  # of each number in its part

    def loss(x: Tensor, y: Tensor) -> Tensor:
        answers, wanted = net(soft_label((x[:, 0] + 1) / 2))[:, at], y * slope + offset
        wanted = torch.where(wanted.isnan(), answers.detach(), wanted)  # no error where nothing is wanted
        return robust(answers, wanted) @ share

    return loss


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


def train_once(
    kind: str,
    net: nn.Module,
    loss: Callable[[Tensor, torch.Generator], Tensor],
    pairs: int,
    options: Mapping[str, int],
    key: Mapping,
    progress: str,
) -> float:
    """Train a network in place, by :func:`.diffusion.loop.fit`, or fill it with what was trained before.

    Parameters
    ----------
    kind
        Of the file, and what the cache calls it.
    net, loss, pairs
        As there.
    options
        Steps, batch_size and seed.
    key
        What else the trained network depends on.
    progress
        What to call the training.

    Returns
    -------
    float
        Seconds that the training took.
    """

    def make(target, scratch):
        history, seconds = fit(net, loss, pairs, **options, learning_rate=_RATE, folder=scratch, progress=progress)
        storage.write(target, kind, net.state_dict(), {"history": history, "seconds": seconds})

    path = cached(kind, {**key, **options, "code": step_version("alternative")}, make, ".safetensors")
    tensors, content = storage.read(path, kind)
    storage.fill(net.state_dict(), tensors, path)
    net.eval()
    return content["seconds"]


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
