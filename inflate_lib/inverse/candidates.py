"""Where the candidates of a search come from: drawings of a model, or the training structures nearest to the targets.

Whatever they come from, the search (:mod:`inflate_lib.inverse.search`) labels, inflates, refines and judges them, and
chooses among them, in one and the same way: so the two can be compared, and can work together.
"""

import numpy as np
import xarray as xr

from inflate_lib.datasets.pairs import training_rows
from inflate_lib.descriptors import Descriptors, descriptor_matrix, get_descriptor
from inflate_lib.diffusion import generate
from inflate_lib.inverse.constraints import Constraints
from inflate_lib.inverse.targets import Targets
from inflate_lib.models.surrogate import centred
from inflate_lib.models.weights import Model
from inflate_lib.structures.labels import FRAME, OUTSIDE, VOID, WALL

STARTS = ("both", "model", "training")


class Drawings:
    """Candidates that a model draws, told the targets and, from batch to batch, corrected for what it misses.

    Parameters
    ----------
    model : Model
    targets : Targets
    seed : int
        With the number of its first candidate it makes the seed of each batch.
    """

    name = "model"

    def __init__(self, model: Model, targets: Targets, seed: int):
        self.model, self.seed = model, seed
        self.wanted = targets.vector(model.name)
        self.aim = np.clip(self.wanted, model.trained.condition_min, model.trained.condition_max)

    def take(self, size: int, first: int) -> tuple[np.ndarray, list[dict]]:
        """Images (size, 28, 28) of the candidates from number `first` on, and for each how to draw it again."""
        seed = int(np.random.SeedSequence([self.seed, first]).generate_state(1)[0])
        batch = {"seed": seed, "first": first, "size": size, "conditions": self.aim.tolist()}
        images = generate(self.model.trained, np.tile(self.aim, (size, 1)), seed=seed, **self.model.sampling)
        return images, [batch | {"row": row} for row in range(size)]

    def learn(self, achieved: list[Descriptors]) -> None:
        """Correct what the model is told by what the last batch achieved."""
        if achieved:
            vectors = [shape.vector(self.model.name) for shape in achieved]
            self.aim = _corrected(self.aim, self.wanted, vectors, self.model.trained)


class Neighbours:
    """Training structures as candidates, the nearest to the targets first.

    How near one is, is the largest of its relative errors, by which designs are judged. A mirror image is a candidate
    of its own where mirroring makes a difference: to an axis, or to a region that has to be kept free. A shift makes
    none, for every structure is moved to where it fits.

    Parameters
    ----------
    data : xarray.Dataset
        Simulated structures; those that are held out from training stay out here as well.
    targets : Targets
    constraints : Constraints
    """

    name = "training"

    def __init__(self, data: xr.Dataset, targets: Targets, constraints: Constraints):
        rows = training_rows(data)
        self.cavities = data["label"].values[rows] == VOID
        errors = []
        for mirrored in (False, True):
            vectors = {name: descriptor_matrix(data, name)[rows] for name in targets.asked}
            if mirrored:
                vectors = {name: get_descriptor(name).mirrored(values) for name, values in vectors.items()}
            shares = [get_descriptor(name).error.share(vectors[name], targets.vector(name)) for name in vectors]
            errors.append(np.max(shares, axis=0))
        same = np.array_equal(*errors) and constraints.keep_out is None
        errors = errors[0] if same or constraints.symmetric else np.concatenate(errors)
        self.numbers, self.order, self.taken = data["structure"].values[rows], np.argsort(errors, kind="stable"), 0

    def take(self, size: int, first: int) -> tuple[np.ndarray, list[dict]]:
        """Cavities (k, 28, 28) of the next candidates, k ≤ `size`, and for each which structure it is."""
        chosen = self.order[self.taken : self.taken + size]
        self.taken += len(chosen)
        number, mirrored = chosen % len(self.numbers), chosen >= len(self.numbers)
        images = np.where(mirrored[:, None, None], self.cavities[number, :, ::-1], self.cavities[number])
        origins = [
            {"training structure": int(self.numbers[i]), "mirrored": bool(flip)}
            for i, flip in zip(number, mirrored, strict=True)
        ]
        return images.astype(float), origins

    def learn(self, achieved: list[Descriptors]) -> None:
        """Nothing: what they inflate to is known."""


def _corrected(aim, wanted, achieved, model):
    """Conditions for the next batch: moved against the median miss of this one, so that the middle of the next hits.

    Kept within the range that the model was trained on.
    """
    miss = np.median(achieved, axis=0) - wanted
    return np.clip(aim - miss, model.condition_min, model.condition_max)


def differences(labels, others):
    """How much label images (m, 28, 28) differ from others (n, 28, 28), (m, n): 0 the same, 1 nothing in common.

    The share of the pixels of both, middle laid on middle, that are not the same; of a structure and its mirror image
    the one that is nearer counts.
    """
    labels, others = (np.reshape(part, (-1, FRAME, FRAME)) for part in (labels, others))
    b, shares = _rows(others), []
    for a in (_rows(labels), _rows(labels[:, :, ::-1])):
        alike = sum(np.float32(a == value) @ np.float32(b == value).T for value in (WALL, VOID))
        both = np.float32(a != OUTSIDE) @ np.float32(b != OUTSIDE).T
        either = np.sum(a != OUTSIDE, axis=1)[:, None] + np.sum(b != OUTSIDE, axis=1) - both
        shares.append(1 - alike / either)
    return np.minimum(*shares)


def _rows(labels):
    return centred(labels).reshape(len(labels), FRAME**2)
