"""One model for all ten digits: a joint model that may be told the digit as well, trained on all of MNIST.

The digit is one more part of the condition, ten numbers of which one is 1, and is withheld as often as the others are.
"""

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from inflate_lib import paths
from inflate_lib._checks import whole_number
from inflate_lib.datasets.pairs import TrainingSet, held_out
from inflate_lib.descriptors.registry import JOINT
from inflate_lib.diffusion import TrainedModel
from inflate_lib.models import reach
from inflate_lib.models.calibration import Calibration
from inflate_lib.models.recipe import EDITION, Recipe
from inflate_lib.models.remote import train_and_test
from inflate_lib.models.weights import Model

if TYPE_CHECKING:
    import xarray as xr

KINDS = 10
FILE = "digits/joint.safetensors"  # in the folder of a profile's weights, the reach of the digits beside it


def held_out_digits(digit: np.ndarray) -> np.ndarray:
    """Which structures are kept from training, (n,) bool: every tenth of each digit (n,).

    The sevens among them are those of :func:`inflate_lib.datasets.pairs.held_out`, which no other model has seen.
    """
    kept = np.zeros(len(digit), dtype=bool)
    for one in np.unique(digit):
        rows = np.flatnonzero(digit == one)
        kept[rows] = held_out(len(rows))
    return kept


class DigitSet(TrainingSet):
    """Pairs as sevens make them, the digit as one more part of the condition; `data` has a variable ``digit``."""

    @cached_property
    def _kept(self):
        return held_out_digits(self.data["digit"].values)

    @cached_property
    def originals(self) -> tuple[np.ndarray, np.ndarray]:
        return self._part(np.flatnonzero(self.data["converged"].values & ~self._kept))

    @cached_property
    def mirrored(self) -> np.ndarray:
        return np.column_stack([super().mirrored, self.originals[1][:, -KINDS:]])

    @cached_property
    def unseen(self) -> tuple[np.ndarray, np.ndarray]:
        return self._part(np.flatnonzero(self.data["converged"].values & self._kept))

    @cached_property
    def about(self) -> dict:
        return super().about | {"held_out": "every tenth of each digit"}

    def _part(self, rows):
        images, known = super()._part(rows)
        return images, np.column_stack([known, np.eye(KINDS)[self.data["digit"].values[rows]]])


def train_digits(data: "xr.Dataset", recipe: Recipe, folder: Path, threads: int | None = None) -> TrainedModel:
    """Train the joint model of a recipe on digits of all kinds, as many pairs as there are structures.

    Parameters
    ----------
    data : xarray.Dataset
        Simulated digits, from :func:`inflate_lib.alternatives.simulated_digits`.
    recipe : Recipe
    folder : Path
        For checkpoints, from which a training that was stopped goes on.
    threads : int, optional
        CPU threads.

    Returns
    -------
    TrainedModel
        See :func:`told_digit` for how to ask it.
    """
    pairs = DigitSet(data, JOINT, data.sizes["structure"], recipe.seed)
    config = recipe.config(JOINT)
    config = replace(config, parts=(*config.parts, KINDS))
    about = pairs.about | {"mean": pairs.mean, "sampling": dict(recipe.sampling)}
    return train_and_test(pairs.pairs, pairs.unseen, config, about, folder, "training all digits", threads, folder)


def told_digit(trained: TrainedModel, digit: int | None = None) -> TrainedModel:
    """The model of all digits as a joint model that is told the same digit always, or none.

    The first layer of the descriptor network is linear in what the network is told, so that to tell it a digit adds
    a constant to that layer's bias: the two models answer the same.
    """
    whole_number("digit", digit, 0, KINDS - 1, optional=True)
    config = replace(trained.config, parts=trained.config.parts[:-1])
    n = sum(config.parts)
    state = trained.net.state_dict()
    weight = state["descriptor.0.weight"]  # columns: descriptors, digits, and for each part whether it is known
    state["descriptor.0.weight"] = torch.cat([weight[:, :n], weight[:, n + KINDS : -1]], dim=1)
    if digit is not None:
        state["descriptor.0.bias"] = state["descriptor.0.bias"] + weight[:, n + digit] + weight[:, -1]
    net = config.make_net(n)
    net.load_state_dict(state)
    low, high = trained.condition_min[:n], trained.condition_max[:n]
    return replace(trained, net=net.eval(), config=config, condition_min=low, condition_max=high)


def load_digits_model(digit: int | None = None, profile: str = EDITION) -> Model:
    """The committed model of all digits, told one of them or none, with what they reach.

    Raises
    ------
    FileNotFoundError
        There are no such weights of this profile.
    """
    file = paths.PRETRAINED / profile / FILE
    trained = TrainedModel.load(file)
    table, fits = reach.load_reach(file.parent), {}
    if digit is None:  # as it was calibrated
        fits = {name: Calibration.from_dict(one) for name, one in trained.metadata["calibration"].items()}
    return Model(JOINT, told_digit(trained, digit), trained.metadata["sampling"], fits, table)
