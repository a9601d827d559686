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

from inflate_lib._cache import cached, digest, step_version
from inflate_lib.datasets.split import training_rows
from inflate_lib.descriptors import columns, descriptor_matrix, get_descriptor
from inflate_lib.diffusion import _storage
from inflate_lib.diffusion._loop import fit
from inflate_lib.diffusion._random import initialised
from inflate_lib.structures.labels import FRAME, label_image

if TYPE_CHECKING:
    import xarray as xr

CHANNELS, HIDDEN, BATCH = (8, 16, 32), 128, 64
#: Descriptors that it answers with, one after another.
ANSWERS = ("height", "width", "area", "axis")


class Network(nn.Module):
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
    """A trained network, with the mean and the scale (63,) of what it answers, and the seconds that training took."""

    net: Network
    mean: np.ndarray
    scale: np.ndarray
    seconds: float

    def predict(self, images, descriptor):
        """Descriptors, (n, N), of the structures in images (n, 28, 28); NaN where an image gives no structure."""
        labels, usable = _labels(images)
        return self.predict_labels(labels, descriptor, usable)

    def predict_labels(self, labels, descriptor, usable=None):
        """The same for label images (n, 28, 28)."""
        answers = np.full((len(labels), len(self.mean)), np.nan)
        usable = np.ones(len(labels), dtype=bool) if usable is None else usable
        with torch.inference_mode():
            for rows in np.array_split(np.flatnonzero(usable), max(1, len(labels) // 256)):
                if len(rows):
                    answers[rows] = self.net(torch.from_numpy(centred(labels[rows]))).numpy() * self.scale + self.mean
        return answers[:, columns(descriptor, ANSWERS)]


def train_surrogate(data: "xr.Dataset", steps: int = 1500, seed: int = 0, rows: np.ndarray | None = None) -> Surrogate:
    """Train the surrogate, or find it trained in the cache.

    Parameters
    ----------
    data : xarray.Dataset
        Simulated structures.
    steps : int
        Training steps of `BATCH` structures each.
    seed : int
        Of the first weights and the batches.
    rows : (m,) int, optional
        Structures to train on; by default those that the diffusion models are trained on.

    Returns
    -------
    Surrogate
    """
    rows = training_rows(data) if rows is None else rows
    labels, answers = data["label"].values[rows], _answer_matrix(data)[rows]
    parts = [columns(name, ANSWERS) for name in ANSWERS]
    mean = answers.mean(axis=0)
    scale = np.concatenate(
        [get_descriptor(n).error.scale(answers[:, of]) for n, of in zip(ANSWERS, parts, strict=True)]
    )
    net = initialised(lambda: Network(answers.shape[1]), seed)

    def make(target, scratch):
        x = torch.from_numpy(centred(np.concatenate([labels, labels[:, :, ::-1]])))
        y = np.concatenate([answers, mirrored(answers)])
        y = torch.from_numpy((y - mean) / scale).float()

        def loss(rows, generator):
            squares = (net(x[rows]) - y[rows]).square().mean(dim=0)
            return sum(squares[of].mean() for of in parts)  # an axis counts as much as each scalar

        history, seconds = fit(net, loss, len(x), steps, BATCH, 2e-3, seed, scratch, "training the surrogate")
        _storage.write(target, "surrogate", net.state_dict(), {"history": history, "seconds": seconds})

    key = {
        "data": digest(labels, answers),
        "steps": steps,
        "seed": seed,
        "code": step_version("alternative"),
    }
    path = cached("surrogate", key, make, ".safetensors")
    tensors, content = _storage.read(path, "surrogate")
    _storage.fill(net.state_dict(), tensors, path)
    return Surrogate(net.eval(), mean, scale, content["seconds"])


def _answer_matrix(data):
    """Everything that the surrogate answers: height, width, hull area and the medial axis, (n, 63)."""
    return np.column_stack([descriptor_matrix(data, name) for name in ANSWERS])


def mirrored(answers):
    """The answers for mirrored structures."""
    parts = [get_descriptor(name).mirrored(answers[:, columns(name, ANSWERS)]) for name in ANSWERS]
    return np.column_stack(parts)


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
