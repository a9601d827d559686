"""What the experiments ask for: cluster centroids of the scalar descriptors (Table 1, Fig. 6) and three medial axes."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from inflate_lib import paths
from inflate_lib._checks import whole_number
from inflate_lib.descriptors import get_descriptor

LEVELS = ("low", "medium", "high")
TABULATED = ("height", "width", "box", "area")  # in the paper's Table 1
_NEIGHBOURS = 20  # a medial axis is ordinary if it has this many others close by
_ORDINARY = 0.9  # share of the axes that count as ordinary


@dataclass(frozen=True)
class Clusters:
    """Result of k-means: ``centroids`` (k, N), sorted by their first component, and the ``labels`` (n,) 0 … k − 1."""

    centroids: np.ndarray
    labels: np.ndarray


def find_clusters(matrix: np.ndarray, k: int = 3, seed: int = 0, n_starts: int = 10) -> Clusters:
    """k-means clusters of a descriptor, in its raw units (paper sec. 4.2, Fig. 6).

    Parameters
    ----------
    matrix : array (n, N)
        One row per structure, as `descriptor_matrix` gives it.
    k, seed, n_starts : int
        Number of clusters; seed and number of random starts, of which the best is kept.

    Raises
    ------
    ValueError
        Where there are fewer distinct rows than clusters, or values that are not finite.
    """
    from sklearn.cluster import KMeans
    from threadpoolctl import threadpool_limits

    for name, value, least in (("k", k, 1), ("seed", seed, 0), ("n_starts", n_starts, 1)):
        whole_number(name, value, least)
    matrix = _finite_matrix(matrix)
    n_distinct = len(np.unique(matrix, axis=0))
    if n_distinct < k:
        raise ValueError(f"matrix has {n_distinct} distinct rows; {k} clusters need at least as many")
    with threadpool_limits(1, "openmp"):  # several threads wait for one another longer than one computes
        fit = KMeans(k, n_init=n_starts, tol=0, max_iter=1000, random_state=seed).fit(matrix)
    order = np.argsort(fit.cluster_centers_[:, 0])
    return Clusters(fit.cluster_centers_[order], np.argsort(order)[fit.labels_])


def paper_targets():
    """The paper's Table 1, as a frame with the columns descriptor, level, component, paper (fifteen rows)."""
    table = pd.read_csv(paths.REFERENCE / "table1.csv").set_index(["descriptor", "cluster"])
    return pd.DataFrame(
        [
            (name, level, component, table.loc[(name, number), component])
            for name in TABULATED
            for number, level in enumerate(LEVELS, start=1)
            for component in get_descriptor(name).parts
        ],
        columns=["descriptor", "level", "component", "paper"],
    )


def compare_with_paper(centroids: Mapping) -> pd.DataFrame:
    """Table 1 side by side: columns descriptor, level, component, paper, here, deviation_percent (signed).

    ``centroids`` maps "height", "width", "box" and "area" to arrays (3, N), sorted from low to high.
    """
    table = paper_targets()
    table["here"] = np.concatenate([np.ravel(centroids[name]) for name in TABULATED])
    table["deviation_percent"] = 100 * (table.here / table.paper - 1)
    return table


def deviation_from_paper(centroids):
    """Mean and largest relative deviation of the twelve centroids' fifteen numbers from the paper's, in percent."""
    deviation = compare_with_paper(centroids).deviation_percent.abs()
    return float(deviation.mean()), float(deviation.max())


def choose_axes(axes: np.ndarray, n: int = 3) -> np.ndarray:
    """Pick real medial axes that are ordinary but as different from one another as they can be.

    The paper picks its three by hand; this is a rule instead, without chance. Two axes differ in *size* (their height,
    in standard deviations of the data) and in *shape* (their sideways course in units of their height, in standard
    deviations again), and the two count alike. An axis is *ordinary* if its distance to its 20th nearest neighbour is
    among the smallest 90 %, so that the data say something about its surroundings. The first pick is the ordinary axis
    farthest from the mean; every further one is the ordinary axis farthest from all picks so far.

    Parameters
    ----------
    axes : array (m, 60) or (m, 30, 2)
        Medial axes as `describe` gives them: the first point is the origin, heights rise evenly.
    n : int
        How many to pick.

    Returns
    -------
    int array (n,), row numbers in ``axes``, from the lowest axis to the highest.
    """
    from sklearn.neighbors import NearestNeighbors

    whole_number("n", n, 1)
    n_axes = len(axes)
    if not 1 <= n <= n_axes:
        raise ValueError(f"n is {n}; from {n_axes} medial axes, 1 to {n_axes} can be chosen")
    features = _size_and_shape(axes)
    neighbours = min(_NEIGHBOURS, n_axes - 1)
    remoteness = NearestNeighbors(n_neighbors=neighbours).fit(features).kneighbors()[0][:, -1] if neighbours else [0]
    n_ordinary = max(n, int(np.ceil(_ORDINARY * n_axes)))
    ordinary = np.sort(np.argsort(remoteness, kind="stable")[:n_ordinary])
    picks = [np.linalg.norm(features[ordinary], axis=1).argmax()]
    distance = np.full(n_ordinary, np.inf)
    while len(picks) < n:
        distance = np.minimum(distance, np.linalg.norm(features[ordinary] - features[ordinary[picks[-1]]], axis=1))
        picks.append(distance.argmax())
    chosen = ordinary[picks]
    return chosen[np.argsort(features[chosen, 0])]


def _size_and_shape(axes):
    """Medial axes as standardised features (m, 31): the height, and the 30 x-coordinates in units of that height.

    The height has variance 1 over the data, and so have the x-coordinates, all together.
    """
    axes = _finite_matrix(np.reshape(axes, (len(axes), -1))).reshape(len(axes), -1, 2)
    height = axes[:, -1, 1]
    if not np.all(height > 0):
        raise ValueError("medial axes must rise from the origin; at least one has no height")
    shape = axes[:, :, 0] / height[:, None]
    size = (height - height.mean()) / (height.std() or 1)
    return np.column_stack([size, (shape - shape.mean(axis=0)) / (np.sqrt(shape.var(axis=0).sum()) or 1)])


def _finite_matrix(matrix):
    matrix = np.asarray(matrix, float)
    if matrix.ndim != 2:
        raise ValueError(f"descriptors have shape {matrix.shape}; a matrix (structures, components) is needed")
    if not np.isfinite(matrix).all():
        raise ValueError("descriptors have values that are NaN or infinite; leave structures that did not converge out")
    return matrix
