"""A surrogate of the simulation: a small convolutional network that sees a structure and says how it will inflate.

The paper leaves this to future work (sec. 5). The network sees the label image, moved to the middle, so that it need
not learn that a shift changes nothing, and answers with all descriptors at once. It is trained on the structures that
the diffusion models are trained on, and their mirror images, and tested on those that are held out.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from inflate_lib._cache import digest
from inflate_lib._checks import whole_number
from inflate_lib.alternatives._training import train_once
from inflate_lib.datasets.split import training_rows
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.descriptors.registry import basic, columns, name_of
from inflate_lib.diffusion.randomness import initialised
from inflate_lib.structures.labels import FRAME, label_image

if TYPE_CHECKING:
    import xarray as xr

CHANNELS, HIDDEN, BATCH = (8, 16, 32), 128, 64


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
) -> Surrogate:
    """Train the surrogate, or find it trained in the cache.

    Parameters
    ----------
    data : xarray.Dataset
        Simulated structures.
    steps : int
        Training steps of 64 structures each.
    seed : int
        Of the first weights and the batches.
    rows : (m,) int, optional
        Structures to train on; by default those that the diffusion models are trained on.
    answers : str, optional
        Descriptor that it is to answer with, or several, "height+area"; by default all that the deformed nodes tell.

    Returns
    -------
    Surrogate
    """
    whole_number("steps", steps, 1)
    whole_number("seed", seed, 0)
    rows = training_rows(data) if rows is None else rows
    answers = answers or name_of(one.name for one in basic() if one.of_nodes and one.variable in data)
    told = get_descriptor(answers)
    labels, values = data["label"].values[rows], descriptor_matrix(data, answers)[rows]
    parts = [columns(part, told.parts) for part in told.parts]
    mean = values.mean(axis=0)
    scale = np.concatenate(
        [get_descriptor(part).error.scale(values[:, of]) for part, of in zip(told.parts, parts, strict=True)]
    )
    net = initialised(lambda: _Network(told.length), seed)
    x = torch.from_numpy(centred(np.concatenate([labels, labels[:, :, ::-1]])))
    y = torch.from_numpy((np.concatenate([values, told.mirrored(values)]) - mean) / scale).float()

    def loss(rows, generator):
        squares = (net(x[rows]) - y[rows]).square().mean(dim=0)
        return sum(squares[of].mean() for of in parts)  # an axis counts as much as each scalar

    options, key = {"steps": steps, "batch_size": BATCH, "seed": seed}, {"data": digest(labels, values)}
    seconds = train_once("surrogate", net, loss, len(x), options, key, "training the surrogate")
    return Surrogate(net, answers, mean, scale, seconds)


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
