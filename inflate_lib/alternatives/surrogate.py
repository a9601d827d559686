"""Training the surrogate of the simulation (:mod:`inflate_lib.models.surrogate`).

It learns from the structures that the diffusion models are trained on, and their mirror images, and is tested on those
that are held out; one that models learn from or are steered by sees blends of these structures as well. Structures that
sag beside their foot are rare, but a sixth of what it is shown: their medial axes begin elsewhere, which it would
otherwise never answer.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
import xarray as xr
from torch import Tensor, nn

from inflate_lib._cache import cached, code_version, digest, step_version
from inflate_lib._checks import whole_number
from inflate_lib.alternatives.blends import blend
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.datasets.simulate import simulate_dataset
from inflate_lib.datasets.storage import load_dataset, save_dataset
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.descriptors.registry import JOINT, basic, columns, name_of
from inflate_lib.diffusion import storage
from inflate_lib.diffusion.loop import fit
from inflate_lib.diffusion.randomness import initialised
from inflate_lib.experiments.run import run_experiment
from inflate_lib.models.surrogate import CHANNELS, Network, Surrogate, centred, robust
from inflate_lib.models.weights import Model
from inflate_lib.structures.labels import FRAME

BATCH = 64
_RATE = 2e-3  # the largest learning rate
_SHIFTED = 2 / FRAME  # sideways step of a medial axis after its first point, in sides; without sagging it is rare
_REPEATED = 8  # times that a structure with such an axis is shown for once that another is


def train_surrogate(
    data: xr.Dataset,
    steps: int = 1500,
    seed: int = 0,
    rows: np.ndarray | None = None,
    answers: str | None = None,
    further: xr.Dataset | None = None,
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
    net = initialised(lambda: Network(told.length, channels), seed)
    x = torch.from_numpy(centred(np.concatenate([seen, seen[:, :, ::-1]])))
    y = torch.from_numpy((np.concatenate([values, told.mirrored(values)]) - mean) / scale).float()
    shown = torch.from_numpy(np.tile(_shown(values, told), 2))
    shown = torch.arange(len(x)).repeat_interleave(shown)

    def loss(rows, generator):
        errors = robust(net(x[shown[rows]]), y[shown[rows]]).mean(dim=0)
        return sum(errors[of].mean() for of in parts)  # a curve counts as much as each scalar

    options, key = {"steps": steps, "batch_size": batch_size, "seed": seed}, {"data": digest(seen, values)}
    key |= {"channels": channels}
    seconds = train_once("surrogate", net, loss, len(shown), options, key, "training the surrogate")
    return Surrogate(net, answers, mean, scale, seconds)


def _shown(values, told):
    """How often each structure is shown, (n,): more often if it sags, and its medial axis begins beside the foot."""
    if "axis" not in told.parts:
        return np.ones(len(values), int)
    sideways = values[:, columns("axis", told.parts)[2]]  # of the second point; the first is the origin
    return np.where(np.abs(sideways) > _SHIFTED, _REPEATED, 1)


def blends_of(data: xr.Dataset, n: int, seed: int = 0) -> xr.Dataset:
    """Blends (``alternatives.blend``) of the structures that models are trained on, simulated; from the cache."""
    images = data["image"].values[training_rows(data)]

    def make(target, scratch):
        save_dataset(simulate_dataset(blend(images, n, seed), folder=scratch), target)

    key = {
        "blends of": digest(images),
        "n": n,
        "seed": seed,
        "code": step_version("dataset") + code_version("inflate_lib.alternatives.blends"),
    }
    return load_dataset(cached("blends", key, make, ".nc"))


def drawings_of(models: Sequence[Model], data: xr.Dataset, n: int, seed: int = 0) -> xr.Dataset:
    """What models draw for descriptors of the structures that they are trained on, simulated; from the cache.

    About `n` in all. Each model draws as many; one that takes any combination, as many for each part alone.
    """
    rng, rows, found = np.random.default_rng(seed), training_rows(data), []
    for model in models:
        asked = get_descriptor(model.name)
        for part in asked.parts if asked.any_part else (model.name,):
            share = n // len(models) // (len(asked.parts) if asked.any_part else 1)
            targets = descriptor_matrix(data, part)[rng.choice(rows, share)]
            found.append(run_experiment(model, targets, 1, seed, part))
    wanted = ["label", "converged", *(get_descriptor(name).variable for name in get_descriptor(JOINT).parts)]
    return xr.concat([one[wanted] for one in found], "structure")


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
