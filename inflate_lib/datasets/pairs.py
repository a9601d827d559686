"""What a model is trained on: augmented images with their descriptors, and where they come from (paper sec. 3.2).

One rule for every model, table and chapter says which structures are kept from training: :func:`held_out`.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr

from inflate_lib._cache import digest
from inflate_lib._checks import whole_number
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.structures import augmentation


def held_out(n: int) -> np.ndarray:
    """Which of n structures no model is trained on: every tenth, those with ``index % 10 == 9``.

    The rule looks at the position in the whole data set alone, before structures that did not converge are left out and
    before augmentation, so that no flip or shift of a held-out structure is ever seen in training.

    Returns
    -------
    (n,) bool
    """
    return np.arange(whole_number("n", n, 0)) % 10 == 9


def training_rows(data: xr.Dataset) -> np.ndarray:
    """Row numbers of the structures that models are trained on."""
    return np.flatnonzero(data["converged"].values & ~held_out(data.sizes["structure"]))


@dataclass(frozen=True)
class TrainingSet:
    """What the model of one descriptor is trained on; what is derived from it is computed once, when it is asked for.

    Attributes
    ----------
    data : xarray.Dataset
        Simulated structures, all of them; those that did not converge and those of
        :func:`inflate_lib.datasets.pairs.held_out` are not trained on.
    descriptor : str
    n_augmented : int
        Number of pairs; where flips and shifts do not give as many, all that they give.
    seed : int
        Of the draw among flips and shifts.
    """

    data: xr.Dataset
    descriptor: str
    n_augmented: int = augmentation.PAPER_SAMPLES
    seed: int = 0

    def __post_init__(self):
        get_descriptor(self.descriptor)  # refuses a name that is none
        whole_number("n_augmented", self.n_augmented, 1)
        whole_number("seed", self.seed, 0)

    @cached_property
    def originals(self) -> tuple[np.ndarray, np.ndarray]:
        """Images (n, 28, 28) and descriptors (n, N) of the structures that are trained on."""
        return self._part(training_rows(self.data))

    @cached_property
    def mirrored(self) -> np.ndarray:
        """Descriptors (n, N) of the mirror images of the originals."""
        return get_descriptor(self.descriptor).mirrored(self.originals[1])

    @cached_property
    def unseen(self) -> tuple[np.ndarray, np.ndarray]:
        """Images (k, 28, 28) and descriptors (k, N) of those that are held out."""
        kept = held_out(self.data.sizes["structure"]) & self.data["converged"].values
        return self._part(np.flatnonzero(kept))

    @cached_property
    def variants(self) -> np.ndarray:
        """Flips and shifts of the originals, (m, 4): see :func:`inflate_lib.structures.augmentation.augment`."""
        images = self.originals[0]
        n = min(self.n_augmented, len(augmentation.augment(images)))
        return augmentation.augment(images, n, seed=self.seed)

    @cached_property
    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """What is trained on: images (m, 28, 28) uint8 and descriptors (m, N)."""
        images, known = self.originals
        conditions = augmentation.augment_descriptors(known, self.mirrored, self.variants)
        return augmentation.apply_variants(images, self.variants), conditions

    @cached_property
    def about(self) -> dict:
        """What it is, exactly: two sets that agree in this are the same images, variants and split."""
        return {
            "descriptor": self.descriptor,
            "source": self.data.attrs.get("source", "unknown"),
            "structures": int(self.data["converged"].sum()),
            "data": digest(self.data["image"].values, self.data["converged"].values),
            "held_out": "index % 10 == 9",
            "n_augmented": self.n_augmented,
        }

    @cached_property
    def mean(self) -> list[float]:
        """Mean descriptor of all structures, (N,), by which simulations are told apart whose last digits may differ."""
        return np.nanmean(descriptor_matrix(self.data, self.descriptor), axis=0).tolist()

    def _part(self, rows):
        part = self.data.isel(structure=rows)
        return part["image"].values, descriptor_matrix(part, self.descriptor)
