"""Does a model draw many different structures, and new ones? Distances of images under flips and shifts.

A flip or a shift makes no new structure (``augmentation``), so two images are as far apart as they are where one has
been flipped and moved to lie on the other as well as it can. The distance is the root mean square difference of their
pixels, on the scale from 0 (black) to 1 (white).
"""

import numpy as np
import pandas as pd
import xarray as xr

from inflate_lib import _progress
from inflate_lib._cache import cached, digest, step_version
from inflate_lib._checks import whole_number
from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.experiments.metrics import bootstrap
from inflate_lib.structures.augmentation import MAX_SHIFT, apply_variants


def nearest(images, library, max_shift=MAX_SHIFT, progress_text=""):
    """The image of a library that is nearest to each of some images, flipped and shifted as training images are.

    Parameters
    ----------
    images : (n, 28, 28) array_like
        uint8, or float in [0, 1].
    library : (m, 28, 28) array_like
    max_shift : int
        Largest shift in pixels, in each direction.
    progress_text : str
        What to call this in lines of progress.

    Returns
    -------
    distance : (n,) float
    variant : (n, 4) int
        Row for :func:`inflate_lib.structures.augmentation.apply_variants`: which image, its flip and its shift.
    """
    images, library = _flat(images), np.asarray(library)
    best, variant = np.full(len(images), np.inf), np.zeros((len(images), 4), dtype=int)
    moves = _moves(max_shift)
    if progress_text:
        moves = _progress.track(((1, move) for move in moves), len(moves), f"{progress_text}: flips and shifts")
    for move in moves:
        squares = _squared_distances(images, _flat(_moved(library, move)))
        number = squares.argmin(axis=1)
        squares = squares[np.arange(len(images)), number]
        better = squares < best
        best[better] = squares[better]
        variant[better] = np.column_stack([number, np.broadcast_to(move, (len(number), 3))])[better]
    apart = images - _flat(apply_variants(library, variant))  # again, without the rounding of _squared_distances
    return np.sqrt((apart**2).mean(axis=1)), variant


def novelty(images: np.ndarray, data: xr.Dataset, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each image from the nearest of the structures with numbers `rows` in a data set; kept in the cache.

    Parameters
    ----------
    images : (n, 28, 28) array_like
    data : xarray.Dataset
    rows : (m,) int
        Those that models were trained on, as a rule.

    Returns
    -------
    distance : (n,) float
    neighbour : (n, 28, 28)
        The nearest structure's image, flipped and shifted as it fits best.
    """
    library = data["image"].values[rows]

    def make(target, scratch):
        distance, variant = nearest(images, library, progress_text="nearest training structures")
        with open(target, "wb") as file:
            np.savez(file, distance=distance, variant=variant)

    key = {"images": digest(np.asarray(images), library), "code": step_version("experiment")}
    with np.load(cached("novelty", key, make, ".npz")) as found:
        return found["distance"], apply_variants(library, found["variant"])


def pairwise(images, max_shift=MAX_SHIFT):
    """Distances of all pairs of images, (n, n), with zeros on the diagonal."""
    flat = _flat(images).astype(np.float64)
    least = np.full((len(images), len(images)), np.inf)
    for move in _moves(max_shift):
        moved = _flat(_moved(np.asarray(images), move)).astype(np.float64)
        np.minimum(least, _squared_distances(flat, moved), out=least)
    least = np.minimum(least, least.T)  # what a shift pushes over the border makes one way longer than the other
    np.fill_diagonal(least, 0.0)
    return np.sqrt(least / flat.shape[1])


def _mean_pairwise(distances, rows=None):
    """Mean distance of pairs of different images, from :func:`pairwise`; `rows` may repeat some, for a bootstrap."""
    rows = np.arange(len(distances)) if rows is None else rows
    different = rows[:, None] != rows[None, :]
    return distances[np.ix_(rows, rows)][different].mean() if different.any() else np.nan


def diversity(
    experiment: xr.Dataset, descriptor: str, data: xr.Dataset, seed: int = 0, n_resamples: int = 1000
) -> pd.DataFrame:
    """How different the structures of each target are, beside as many real ones that come closest to the target.

    A model that always draws the same structure has no diversity; one that draws as variously as structures of this
    descriptor are has that of the data.

    Parameters
    ----------
    experiment : xarray.Dataset
        From :func:`inflate_lib.experiments.run.run_experiment`, several structures per target.
    descriptor : str
    data : xarray.Dataset
        Simulated structures.
    seed, n_resamples : int
        Of the bootstrap.

    Returns
    -------
    pandas.DataFrame
        A row per target: target, n (valid structures), generated, data (mean pairwise distances), each with low and
        high, and ratio.
    """
    whole_number("seed", seed, 0)
    whole_number("n_resamples", n_resamples, 1)
    real = np.flatnonzero(data["converged"].values)
    matrix = descriptor_matrix(data, descriptor)[real]
    scale, rows = get_descriptor(descriptor).error.scale(matrix), []
    for level in np.unique(experiment["level"].values):
        mine = (experiment["level"].values == level) & experiment["valid"].values
        target = experiment["target"].values[experiment["level"].values == level][0]
        order = np.argsort(np.linalg.norm((matrix - target) / scale, axis=1), kind="stable")
        found = {"generated": experiment["image"].values[mine], "data": data["image"].values[real[order[: mine.sum()]]]}
        row: dict[str, float] = {"target": int(level) + 1, "n": int(mine.sum())}
        for name, images in found.items():
            apart, low, high = pairwise(images), np.nan, np.nan
            if len(images):
                low, high = bootstrap(lambda r, d=apart: _mean_pairwise(d, r), len(images), None, seed, n_resamples)
            row |= {name: _mean_pairwise(apart), f"{name} low": float(low), f"{name} high": float(high)}
        rows.append(row | {"ratio": row["generated"] / row["data"]})
    return pd.DataFrame(rows)


def _moves(max_shift):
    shifts = range(-max_shift, max_shift + 1)
    return [(flip, x, y) for flip in (0, 1) for x in shifts for y in shifts]


def _moved(images, move):
    return apply_variants(images, np.column_stack([np.arange(len(images)), np.tile(move, (len(images), 1))]))


def _flat(images):
    """Images as rows of float32 in [0, 1]."""
    images = np.asarray(images)
    scale = 255 if images.dtype == np.uint8 else 1
    return images.reshape(len(images), np.prod(images.shape[1:])).astype(np.float32) / np.float32(scale)


def _squared_distances(a, b):
    squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)[None, :] - 2 * a @ b.T
    return np.maximum(squares, 0.0)
