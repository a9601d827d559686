"""A conditional variational autoencoder as large as the diffusion model beside which it stands, and as long trained.

It answers the same targets and is judged by the same pipeline.
"""

from dataclasses import dataclass

import numpy as np
import torch
import xarray as xr
from torch import Tensor, nn

from inflate_lib._cache import digest
from inflate_lib._checks import whole_number, workers
from inflate_lib.alternatives.surrogate import train_once
from inflate_lib.datasets.pairs import TrainingSet
from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.diffusion import TrainedModel
from inflate_lib.diffusion.randomness import initialised, random_generator, seed_for
from inflate_lib.experiments.calibrate import questions
from inflate_lib.experiments.run import check_targets, judge_once, model_digest
from inflate_lib.models.calibration import Calibration

_LATENT = 4  # numbers that the autoencoder describes an image by, besides the descriptor
_FINER = (16, 32)  # channels on 28 and on 14 pixels a side
_KL_WEIGHT = 3.0  # β of Higgins et al. (2017): the more it weighs, the less of the descriptor is told by z instead
_TOLD = 16  # width of what it makes of the descriptor


class Autoencoder(nn.Module):
    """Conditional variational autoencoder (Sohn et al. 2015) of images (28, 28), told the descriptor at both ends.

    Parameters
    ----------
    n_conditions : int
        Length N of the descriptor.
    width : int
        Channels on the coarsest grid, 7 pixels a side, where numbers to be learned cost the least arithmetic.
    """

    def __init__(self, n_conditions: int, width: int):
        super().__init__()
        a, b, c = *_FINER, width
        self.deepest = c
        self.told = nn.Sequential(nn.Linear(n_conditions, 64), nn.SiLU(), nn.Linear(64, _TOLD), nn.SiLU())
        self.encoder = nn.Sequential(*_layer(1, a), *_layer(a, b, stride=2), *_layer(b, c, stride=2), nn.Flatten())
        self.posterior = nn.Linear(49 * c + _TOLD, 2 * _LATENT)
        self.unfold = nn.Linear(_LATENT + _TOLD, 49 * c)
        up = nn.Upsample(scale_factor=2)
        self.decoder = nn.Sequential(*_layer(c, b), up, *_layer(b, a), up, nn.Conv2d(a, 1, 3, padding=1))

    @property
    def n_parameters(self) -> int:
        """Number of trainable numbers."""
        return sum(p.numel() for p in self.parameters())

    def encode(self, images: Tensor, conditions: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance (n, LATENT) of q(z | x, y)."""
        told = self.told(conditions)
        return self.posterior(torch.cat([self.encoder(images[:, None]), told], dim=1)).chunk(2, dim=1)

    def decode(self, z: Tensor, conditions: Tensor) -> Tensor:
        """Mean image (n, 28, 28) in [0, 1] of p(x | z, y)."""
        h = self.unfold(torch.cat([z, self.told(conditions)], dim=1)).reshape(-1, self.deepest, 7, 7)
        return self.decoder(h)[:, 0].sigmoid()


def _kl_to_standard_normal(mean: Tensor, log_variance: Tensor) -> Tensor:
    """KL(N(mean, e^log_variance) ‖ N(0, 1)), summed over the last dimension, in nats."""
    return 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(dim=-1)


def _reconstruction_nll(images: Tensor, decoded: Tensor) -> Tensor:
    """−log p(x | z) per image, in nats, of pixels that are bright with the decoded probability.

    A grey pixel counts as bright in that share of the cases. A Gaussian whose variance fits the batch best (Rybkin et
    al. 2021) pays so well for sharp pixels that z comes to tell everything, height included, and the decoder no longer
    listens to the descriptor.
    """
    return nn.functional.binary_cross_entropy(decoded, images, reduction="none").flatten(1).sum(dim=1)


@dataclass
class _TrainedAutoencoder:
    """A trained autoencoder; ``condition_min`` and ``condition_max`` (N,) are the range of the training descriptors."""

    net: Autoencoder
    condition_min: np.ndarray
    condition_max: np.ndarray
    images_seen: int
    seconds: float

    def scaled(self, conditions):
        """Descriptors (n, N), min–max scaled as in training, float32."""
        extent = self.condition_max - self.condition_min
        return torch.from_numpy((conditions - self.condition_min) / np.where(extent > 0, extent, 1)).float()

    def generate(self, conditions, seed=0):
        """Images (n, 28, 28) for descriptors (n, N): decoded from z ~ N(0, 1). Image i depends on seed and i."""
        z = torch.stack([torch.randn(_LATENT, generator=random_generator(seed, 6, i)) for i in range(len(conditions))])
        with torch.inference_mode():
            return self.net.decode(z, self.scaled(np.asarray(conditions, dtype=float))).numpy()


def train_autoencoder(pairs: TrainingSet, like: TrainedModel) -> _TrainedAutoencoder:
    """Train the autoencoder that stands beside a diffusion model, or find it trained in the cache.

    It has as many parameters (the nearest width), sees as many images of the same pairs, in batches of the same
    size.

    Parameters
    ----------
    pairs : inflate_lib.datasets.pairs.TrainingSet
        Its seed is also that of the training.
    like : inflate_lib.diffusion.TrainedModel

    Returns
    -------
    TrainedAutoencoder
    """
    (images, conditions), seed = pairs.pairs, pairs.seed
    low, high = conditions.min(axis=0), conditions.max(axis=0)
    steps, batch_size = like.config.training_steps(len(images)), like.config.batch_size
    width = _nearest_width(conditions.shape[1], like.net.n_parameters)
    net = initialised(lambda: Autoencoder(conditions.shape[1], width), seed)
    trained = _TrainedAutoencoder(net, low, high, steps * batch_size, 0.0)
    x, y = torch.from_numpy(images).float() / 255, trained.scaled(conditions)

    def loss(rows, generator):
        mean, log_variance = net.encode(x[rows], y[rows])
        z = mean + (log_variance / 2).exp() * torch.randn(mean.shape, generator=generator)
        told = _KL_WEIGHT * _kl_to_standard_normal(mean, log_variance)
        return (_reconstruction_nll(x[rows], net.decode(z, y[rows])) + told).mean() / x[0].numel()

    options = {"steps": steps, "batch_size": batch_size, "seed": seed}
    key = {"pairs": digest(images, conditions), "width": width}
    what = f"training the autoencoder ({pairs.descriptor})"
    trained.seconds = train_once("autoencoder", net, loss, len(x), options, key, what)
    return trained


def _nearest_width(n_conditions, n_parameters):
    """Width whose autoencoder has the number of parameters nearest to a given one."""
    one, two = _count(n_conditions, 1), _count(n_conditions, 2)  # the number is linear in the width
    return max(1, 1 + round((n_parameters - one) / (two - one)))


def run_autoencoder(
    model: _TrainedAutoencoder,
    descriptor: str,
    targets: np.ndarray,
    seed: int = 0,
    n_jobs: int = -1,
    calibration: Calibration | None = None,
) -> xr.Dataset:
    """One structure that an autoencoder draws for each target (k, N), as :func:`.run_experiment` does."""
    whole_number("seed", seed, 0)
    workers(n_jobs)
    targets = check_targets(model, descriptor, targets)
    told = targets if calibration is None else calibration.told(targets)
    key = {"model": model_digest(model), "told": digest(told), "seed": seed}

    def draw(scratch):
        return model.generate(told, seed_for(seed, descriptor))

    return judge_once("alternative", draw, descriptor, targets, np.arange(len(targets)), key, n_jobs)


def calibrate_autoencoder(model, descriptor, data, seed=0, n=200, n_jobs=-1):
    """How an autoencoder answers (:mod:`inflate_lib.models.calibration`); None where n is 0 or it hardly listens."""
    if n == 0:
        return None
    targets = questions(data, descriptor, n, seed)
    answer = run_autoencoder(model, descriptor, targets, seed_for(seed, "calibration"), n_jobs)
    valid = answer["valid"].values
    try:
        return Calibration.fit(targets[valid], descriptor_matrix(answer, descriptor)[valid])
    except ValueError:
        return None


def _count(n_conditions, width):
    with torch.device("meta"):
        return Autoencoder(n_conditions, width).n_parameters


def _layer(inputs, outputs, stride=1):
    return nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1), nn.GroupNorm(1, outputs), nn.SiLU()
