"""Cluster centroids and chosen medial axes."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from inflate_lib.descriptors import get_descriptor
from inflate_lib.experiments.targets import (
    LEVELS,
    TABULATED,
    _size_and_shape,
    choose_axes,
    compare_with_paper,
    deviation_from_paper,
    find_clusters,
    paper_targets,
)


def best_partition(values, k):
    """Exact k-means of a few scalars: in one dimension an optimal cluster is a run of sorted values."""
    values = np.sort(values)
    best = np.inf, None
    for cuts in itertools.combinations(range(1, len(values)), k - 1):
        runs = np.split(values, cuts)
        best = min(best, (sum(((run - run.mean()) ** 2).sum() for run in runs), [run.mean() for run in runs]))
    return best


@pytest.mark.parametrize("seed", range(4))
def test_scalar_clusters_are_the_optimal_ones(seed):
    values = 0.7 + np.random.default_rng(seed).gamma(6, 0.05, 50)  # one skewed peak, as heights have
    _, means = best_partition(values, 3)
    assert np.allclose(find_clusters(values[:, None], seed=seed).centroids[:, 0], means)


@given(arrays(float, (40, 2), elements=st.floats(0, 2, allow_subnormal=False), unique=True), st.integers(0, 5))
@settings(max_examples=25, deadline=None)
def test_clusters_are_means_of_their_nearest_members_and_sorted(matrix, seed):
    clusters = find_clusters(matrix, seed=seed)
    assert np.all(np.diff(clusters.centroids[:, 0]) >= 0)
    distances = np.linalg.norm(matrix[:, None] - clusters.centroids, axis=2)
    assert np.allclose(distances[np.arange(40), clusters.labels], distances.min(axis=1), atol=1e-6)
    for number, centroid in enumerate(clusters.centroids):
        assert np.allclose(matrix[clusters.labels == number].mean(axis=0), centroid, atol=1e-6)


def test_three_blobs_are_found_whatever_the_seed():
    centres = np.array([[0.9, 0.8], [1.0, 1.0], [1.2, 1.1]])
    blobs = np.concatenate([centre + 0.01 * np.random.default_rng(3).normal(size=(50, 2)) for centre in centres])
    for seed in range(5):
        clusters = find_clusters(blobs, seed=seed)
        assert np.allclose(clusters.centroids, centres, atol=0.01)
        assert np.array_equal(clusters.labels, np.repeat([0, 1, 2], 50))


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.ones((9, 1)), "1 distinct rows"),
        (np.full((9, 1), np.nan), "NaN"),
        (np.ones(9), "shape"),
    ],
)
def test_unusable_descriptors_are_refused(matrix, message):
    with pytest.raises(ValueError, match=message):
        find_clusters(matrix)


def reference_centroids():
    """Table 1 in the form of centroids, built from the file alone."""
    table = paper_targets().set_index(["descriptor", "component", "level"]).paper
    return {
        name: np.array([[table[name, part, level] for part in get_descriptor(name).parts] for level in LEVELS])
        for name in TABULATED
    }


def test_table_1_is_complete_and_rises_from_low_to_high():
    table = paper_targets()
    assert len(table) == 15 and len(table.groupby(["descriptor", "level"])) == 12  # numbers, and centroids
    for values in reference_centroids().values():
        assert np.all(np.diff(values, axis=0) > 0)
    height, width = reference_centroids()["box"].T
    assert height / width == pytest.approx([1.12, 1.07, 1.08], abs=0.006)  # the aspect ratios that Table 1 also prints


def test_deviation_is_relative_to_the_paper():
    centroids = reference_centroids()
    assert deviation_from_paper(centroids) == (0, 0)
    centroids["area"][2] *= 0.97
    centroids["box"][0, 1] *= 1.06
    mean, largest = deviation_from_paper(centroids)
    assert mean == pytest.approx(9 / 15)
    assert largest == pytest.approx(6)
    table = compare_with_paper(centroids)
    assert len(table) == 15
    assert table.deviation_percent.min() == pytest.approx(-3)


def leaning_axes():
    """Axes of 21 leanings times 11 heights, and one stray far outside."""
    rise = np.linspace(0, 1, 30)
    axes = [
        height * np.column_stack([lean * rise**2, rise])
        for lean in np.linspace(-0.4, 0.4, 21)
        for height in np.linspace(0.8, 1.2, 11)
    ]
    return np.array([*axes, np.column_stack([9 * rise, rise])])


def test_chosen_axes_are_real_distinct_and_ordinary():
    axes = leaning_axes()
    chosen = choose_axes(axes)
    assert len(set(chosen)) == 3
    assert len(axes) - 1 not in chosen  # the stray
    height = axes[chosen, -1, 1]
    lean = axes[chosen, -1, 0] / height
    assert np.all(np.diff(height) >= 0) and np.ptp(height) > 0.3
    assert np.ptp(lean) > 0.5
    features = _size_and_shape(axes)
    closest = min(np.linalg.norm(features[i] - features[j]) for i, j in itertools.combinations(chosen, 2))
    rng = np.random.default_rng(0)
    for _ in range(50):  # hardly any three axes taken at random are as far apart
        other = rng.choice(len(axes) - 1, 3, replace=False)
        assert closest >= min(np.linalg.norm(features[i] - features[j]) for i, j in itertools.combinations(other, 2))
    assert np.array_equal(choose_axes(axes.reshape(len(axes), 60)), chosen)


def test_chosen_axes_do_not_depend_on_the_order_of_the_structures():
    axes = np.random.default_rng(2).normal(size=(200, 30, 2)) * [0.02, 0]
    axes[:, :, 1] = np.linspace(0, 1, 30) * np.random.default_rng(3).normal(1, 0.1, (200, 1))
    order = np.random.default_rng(1).permutation(len(axes))
    assert np.array_equal(order[choose_axes(axes[order])], choose_axes(axes))


def test_size_and_shape_count_alike():
    features = _size_and_shape(leaning_axes())
    assert np.allclose(features.mean(axis=0), 0)
    assert features[:, 0].var() == pytest.approx(1)
    assert features[:, 1:].var(axis=0).sum() == pytest.approx(1)


def test_unusable_axes_are_refused():
    with pytest.raises(ValueError, match="1 to 2"):
        choose_axes(leaning_axes()[:2], n=3)
    with pytest.raises(ValueError, match="no height"):
        choose_axes(0 * leaning_axes())
    with pytest.raises(ValueError, match="NaN"):
        choose_axes(np.full((9, 60), np.nan))
    assert list(choose_axes(leaning_axes()[:1], n=1)) == [0]
