"""Chance and retrieval: structures that exist, taken from those that the model was trained on.

Retrieval is as exact as the data are dense, but never new."""

import numpy as np
import xarray as xr
from sklearn.neighbors import NearestNeighbors

from inflate_lib._checks import whole_number
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.diffusion.randomness import seed_for
from inflate_lib.experiments.run import as_experiment


def random_structures(data: xr.Dataset, descriptor: str, targets: np.ndarray, seed: int = 0) -> xr.Dataset:
    """A real structure for each target, whatever the target, as an experiment (:func:`.as_experiment`)."""
    whole_number("seed", seed, 0)
    rows = np.random.default_rng(seed_for(seed, descriptor, "chance")).choice(training_rows(data), len(targets))
    return as_experiment(data.isel(structure=rows), descriptor, np.asarray(targets))


def retrieved_structures(data: xr.Dataset, descriptor: str, targets: np.ndarray) -> xr.Dataset:
    """The real structure whose descriptor is nearest to each target, as an experiment.

    Nearest in units of the standard deviation of each component; of axes, in plain distance.
    """
    rows, targets = training_rows(data), np.asarray(targets)
    matrix = descriptor_matrix(data, descriptor)[rows]
    scale = get_descriptor(descriptor).error.scale(matrix)
    found = NearestNeighbors(n_neighbors=1).fit(matrix / scale).kneighbors(targets / scale, return_distance=False)
    return as_experiment(data.isel(structure=rows[found[:, 0]]), descriptor, targets)
