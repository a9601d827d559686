"""Errors and their intervals; originality; best of n: against closed forms, SciPy and brute force."""

from itertools import combinations

import numpy as np
import pytest
import xarray as xr
from scipy import stats
from scipy.spatial.distance import directed_hausdorff
from sklearn.metrics import r2_score

from inflate_lib import paths
from inflate_lib.alternatives.best_of import _weighted_quantile, best_of, chances, selection
from inflate_lib.datasets.simulate import simulate_dataset
from inflate_lib.descriptors import OUTLINE_DISTANCE, POINT_DISTANCE
from inflate_lib.descriptors.distances import _hausdorff
from inflate_lib.descriptors.shape import mirror_axis, support_function
from inflate_lib.experiments.metrics import bootstrap, errors, misses, r_squared, scatter_between_samples
from inflate_lib.experiments.run import judge
from inflate_lib.experiments.tables import (
    _Failure,
    accuracy,
    failure_reasons,
    flaws,
    score,
    scores,
    side_by_side,
    with_interval,
)
from inflate_lib.experiments.variety import _mean_pairwise, diversity, nearest, novelty, pairwise
from inflate_lib.mechanics import Flaw
from inflate_lib.structures.augmentation import apply_variants, augment
from inflate_lib.structures.labels import PIXEL
from inflate_lib.structures.sources import load_sevens

RNG = np.random.default_rng(7)
IMAGES = load_sevens("digits").images


def experiment(target, achieved, valid=None, level=None, descriptor="height", images=None, flaw=None, reason=None):
    """An experiment without any simulation behind it."""
    n = len(target)
    target, achieved = np.reshape(target, (n, -1)), np.reshape(achieved, (n, -1))
    column, valid = np.zeros(n), np.ones(n, bool) if valid is None else np.asarray(valid)
    flaw = np.where(valid, "", "no_structure") if flaw is None else np.asarray(flaw)
    variables = {
        "image": (("structure", "row", "column"), IMAGES[:n] if images is None else images),
        "height": ("structure", column),
        "width": ("structure", column),
        "hull_area": ("structure", column),
        "medial_axis": (("structure", "point", "axis"), np.zeros((n, 30, 2))),
        "buildable": ("structure", valid & (flaw == "")),
        "flaw": ("structure", flaw.astype(object)),
        "reason": ("structure", np.array([""] * n if reason is None else reason, dtype=object)),
        "valid": ("structure", valid),
        "converged": ("structure", np.ones(n, bool)),
        "level": ("structure", np.arange(n) if level is None else np.asarray(level)),
        "target": (("structure", "component"), target),
    }
    data = xr.Dataset(variables)
    if descriptor == "axis":
        data["medial_axis"] = (("structure", "point", "axis"), achieved.reshape(n, 30, 2))
    else:
        names = {"height": ["height"], "width": ["width"], "box": ["height", "width"], "area": ["hull_area"]}
        for name, values in zip(names[descriptor], achieved.T, strict=True):
            data[name] = ("structure", values)
    return data


# --- errors --------------------------------------------------------------------------------------------------------


def test_errors_of_scalars_are_relative_and_of_axes_in_pixels():
    assert errors(experiment([1.0, 2.0], [1.1, 1.5]), "height") == pytest.approx([0.1, 0.25])
    assert errors(experiment([[1.0, 2.0]], [[1.1, 1.5]], descriptor="box"), "box") == pytest.approx([0.175])
    axis = RNG.random((1, 60))
    shifted = axis + np.tile([3 * PIXEL, 4 * PIXEL], 30)
    assert errors(experiment(axis, shifted, descriptor="axis"), "axis") == pytest.approx([5.0])
    assert misses("axis", shifted, axis) == pytest.approx([5.0])


def test_hausdorff_distance_is_that_of_scipy():
    axes, others = RNG.random((6, 60)), RNG.random((6, 60))
    expected = []
    for a, b in zip(axes.reshape(6, 30, 2), others.reshape(6, 30, 2), strict=True):
        expected.append(max(directed_hausdorff(a, b)[0], directed_hausdorff(b, a)[0]) / PIXEL)
    np.testing.assert_allclose(_hausdorff(axes, others), expected)
    np.testing.assert_allclose(_hausdorff(others, axes), expected)


def test_hausdorff_distance_is_at_most_the_largest_distance_of_points():
    axes, others = RNG.random((20, 60)), RNG.random((20, 60))
    largest = 28 * POINT_DISTANCE.apart(axes, others).max(axis=1)
    assert (_hausdorff(axes, others) <= largest + 1e-9).all()
    np.testing.assert_allclose(_hausdorff(mirror_axis(axes), mirror_axis(others)), _hausdorff(axes, others))


def test_r_squared_is_that_of_scikit_learn_and_skips_what_is_not_there():
    target, achieved = RNG.random((40, 2)), RNG.random((40, 2))
    expected = r2_score(target, achieved, multioutput="variance_weighted")
    assert r_squared(target, achieved) == pytest.approx(expected)
    achieved[3] = np.nan
    known = np.arange(40) != 3
    expected = r2_score(target[known], achieved[known], multioutput="variance_weighted")
    assert r_squared(target, achieved) == pytest.approx(expected)
    assert r_squared(target, target) == 1
    assert np.isnan(r_squared(np.ones((5, 1)), RNG.random((5, 1))))
    assert np.isnan(r_squared(np.full((46, 1), 0.3335), RNG.random((46, 1))))  # of which the mean is another number


# --- intervals -----------------------------------------------------------------------------------------------------


def test_bootstrap_interval_of_a_mean_is_that_of_the_normal_distribution():
    values = RNG.normal(size=400)
    low, high = bootstrap(lambda rows: values[rows].mean(), 400, n_resamples=4000)
    half = 1.96 * values.std() / 20
    assert (low, high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.1 * half)


def test_bootstrap_interval_is_that_of_scipy():
    values = RNG.exponential(size=60)
    low, high = bootstrap(lambda rows: np.median(values[rows]), 60, n_resamples=3000)
    theirs = stats.bootstrap((values,), np.median, method="percentile", n_resamples=3000, rng=1).confidence_interval
    assert (low, high) == pytest.approx((theirs.low, theirs.high), abs=0.03)


def test_intervals_cover_the_truth_as_often_as_they_say():
    """Of 300 intervals of 80 % for the mean of 50 normal numbers, about 80 % hold it (± 4 standard deviations)."""
    covered = 0
    for trial in range(300):
        values = np.random.default_rng(trial).normal(size=50)
        low, high = bootstrap(lambda rows, v=values: v[rows].mean(), 50, seed=trial, n_resamples=150, level=0.8)
        covered += low <= 0 <= high
    assert abs(covered / 300 - 0.8) < 4 * np.sqrt(0.8 * 0.2 / 300)


def test_groups_keep_their_sizes():
    groups = np.repeat([0, 1, 2], [2, 5, 3])
    seen = []
    bootstrap(lambda rows: seen.append(np.bincount(groups[rows])) or 0.0, 10, groups, n_resamples=20)
    assert all(sizes.tolist() == [2, 5, 3] for sizes in seen)
    values = np.repeat([1.0, 5.0, 9.0], [2, 5, 3])  # no spread within a group, so none in the mean
    assert bootstrap(lambda rows: values[rows].mean(), 10, groups) == pytest.approx((values.mean(),) * 2)


def test_a_seed_gives_the_same_interval_and_another_one_a_different_one():
    values = RNG.normal(size=30)
    first, again, other = (bootstrap(lambda rows: values[rows].mean(), 30, seed=seed) for seed in (1, 1, 2))
    assert first == again != other


def test_an_interval_without_numbers_is_no_interval():
    low, high = bootstrap(lambda rows: np.array([np.nan, 1.0]), 5)
    assert np.isnan(low[0]) and np.isnan(high[0]) and (low[1], high[1]) == (1, 1)


# --- tables --------------------------------------------------------------------------------------------------------


def test_scores_of_an_experiment_whose_errors_are_known():
    target = np.linspace(1, 2, 101)
    achieved = target * np.where(np.arange(101) % 2, 1.04, 0.99)
    valid = np.arange(101) != 100
    flaw = np.array(["", "point_joint", "crossing_walls", ""])
    data = experiment(target, target, flaw=flaw[np.arange(101) % 3])
    table = scores(experiment(target, achieved, valid, flaw=flaw[np.arange(101) % 4]), "height", data, n_resamples=200)
    assert score(table, "median error / target") == pytest.approx(2.5)
    assert score(table, "mean error / target") == pytest.approx(2.5)
    assert score(table, "within 2 %") == score(table, "within 5 %") - 50 == pytest.approx(50)
    assert score(table, "valid") == pytest.approx(100 * 100 / 101) and score(table, "buildable") == pytest.approx(
        100 * 50 / 101
    )
    assert score(table, "buildable, data set") == pytest.approx(100 * 34 / 101)
    assert score(table, "R²") == pytest.approx(r2_score(target[valid], achieved[valid]))
    absolute = np.abs(achieved - target)[valid]
    assert score(table, "mean error") == pytest.approx(absolute.mean())
    assert score(table, "mean error / standard deviation") == pytest.approx(absolute.mean() / target.std())
    measured = table[table["measure"] != "buildable, data set"]
    assert (measured["low"] <= measured["value"]).all() and (measured["value"] <= measured["high"]).all()


def test_scores_of_axes():
    target = (
        np.tile(np.column_stack([np.zeros(30), np.arange(30) / 30]).ravel(), (8, 1)) * np.linspace(1, 2, 8)[:, None]
    )
    achieved = target + np.tile([2 * PIXEL, 0.0], 30)
    table = scores(
        experiment(target, achieved, descriptor="axis"), "axis", experiment(target, target, descriptor="axis")
    )
    assert score(table, "mean point distance") == pytest.approx(2)
    assert score(table, "within 1 px") == 0
    expected = 100 * 2 * PIXEL * np.mean(1 / np.linspace(1, 2, 8))
    assert score(table, "mean point distance / height") == pytest.approx(expected)


def test_an_experiment_without_a_valid_structure_has_no_errors_and_no_valid_share():
    nothing = experiment([1.0, 2.0, 3.0], [np.nan] * 3, [False] * 3, level=[0, 0, 1])
    table = scores(nothing, "height", experiment([1.0, 2.0], [1.0, 2.0]), by_target=True, n_resamples=50)
    assert score(table, "valid") == score(table, "buildable") == 0
    assert table.set_index("measure").drop(["valid", "buildable", "buildable, data set"])["value"].isna().all()
    assert side_by_side({"height": table})["height"].tolist().count("–") == len(table) - 3
    assert accuracy(nothing, "height")[["valid", "buildable"]].eq(0).all(axis=None)


def test_numbers_with_intervals():
    assert with_interval(0.8312, 0.78, 0.874) == "0.831 [0.78, 0.874]"
    assert with_interval(-1.5, -2.0, -1.0) == "−1.5 [−2, −1]"
    assert with_interval(np.nan, 0, 1) == "–" and with_interval(2.0, np.nan, np.nan) == "2"


def test_reasons_are_counted_by_their_kind():
    """The reasons are those that the simulation itself gives."""
    dot, broad, two = (np.zeros((28, 28)) for _ in range(3))
    dot[5, 5] = broad[:, :] = 1
    two[4:20, 4:8] = two[4:20, 20:22] = 1
    images = [np.zeros((28, 28)), dot, broad, two, np.full((28, 28), np.nan), two]
    data = simulate_dataset(images, n_jobs=1, n_steps=1, progress_text=False)
    weak = simulate_dataset([two], n_jobs=1, progress_text=False, time_limit=1e-9)
    reason = [*data.reason.values, *weak.reason.values]
    n = len(reason)
    valid = [False] * (n - 2) + [True, False]
    found = failure_reasons([experiment([1.0] * n, [1.0] * n, valid, reason=reason)])
    assert found.to_dict() == dict.fromkeys(_Failure, 1)
    assert failure_reasons([]).empty


def test_flaws_of_valid_structures_are_counted_and_those_of_others_are_not():
    flaw = ["", "point_joint", "crossing_walls", "point_joint", "no_structure", "crossing_walls"]
    one = experiment([1.0] * 6, [1.0] * 6, [True] * 4 + [False] * 2, flaw=flaw)
    assert flaws([one, one]).to_dict() == {Flaw.POINT_JOINT: 4, Flaw.CROSSING_WALLS: 2}
    assert flaws([one.drop_vars("valid")]).to_dict() == {
        Flaw.POINT_JOINT: 2,
        Flaw.CROSSING_WALLS: 2,
        Flaw.NO_STRUCTURE: 1,
    }
    assert flaws([]).empty


def test_what_was_not_drawn_in_one_piece_is_not_buildable():
    """Its largest piece is, and counts as a structure of a data set."""
    broken = np.zeros((28, 28))
    broken[4:20, 4:8] = broken[4:20, 20:22] = 1
    judged = judge([broken, IMAGES[0]], "height", np.ones((2, 1)), n_jobs=1)
    assert judged["converged"].all() and not judged["flaw"].values[0]
    assert judged["valid"].values.tolist() == judged["buildable"].values.tolist() == [False, True]


# --- originality ---------------------------------------------------------------------------------------------------


def test_a_recited_structure_is_not_new_however_it_is_flipped_and_shifted():
    library = IMAGES[:30]
    variants = augment(library)[RNG.choice(2000, 40, replace=False)]
    distance, found = nearest(apply_variants(library, variants), library)
    assert (distance == 0).all()
    np.testing.assert_array_equal(apply_variants(library, found), apply_variants(library, variants))


def test_distance_to_the_nearest_is_the_smallest_of_all():
    images, library = IMAGES[30:33].astype(float) / 255, IMAGES[:5].astype(float) / 255
    distance, variant = nearest(images, library, max_shift=1)
    everything = np.array(
        [(k, flip, x, y) for k in range(5) for flip in (0, 1) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    )
    all_variants = apply_variants(library, everything)
    for image, d, v in zip(images, distance, variant, strict=True):
        brute = np.sqrt(((all_variants - image) ** 2).mean(axis=(1, 2)))
        assert d == pytest.approx(brute.min(), rel=1e-5)
        assert np.sqrt(((apply_variants(library, v[None])[0] - image) ** 2).mean()) == pytest.approx(d, rel=1e-5)


def test_no_images_have_no_neighbours():
    distance, variant = nearest(IMAGES[:0], IMAGES[:3])
    assert distance.shape == (0,) and variant.shape == (0, 4)


def test_pairwise_distances_forgive_flips_and_shifts():
    variants = np.array([[0, 0, 0, 0], [0, 1, 2, -1], [1, 0, 0, 0]])
    apart = pairwise(apply_variants(IMAGES[:2], variants))
    assert apart[0, 1] < 1e-6 and apart[0, 2] == pytest.approx(apart[1, 2], abs=0.02) and apart[0, 2] > 0.05
    np.testing.assert_array_equal(apart, apart.T)
    assert _mean_pairwise(apart) == pytest.approx(apart[np.triu_indices(3, 1)].mean())
    assert np.isnan(_mean_pairwise(apart, np.array([1, 1, 1])))


def test_diversity_of_the_same_structure_again_and_again_is_zero_and_that_of_the_data_is_not():
    values = np.linspace(0.8, 1.2, 12)
    data = experiment(values, values)
    same = experiment([1.0] * 6, [1.0] * 6, level=[0, 0, 0, 1, 1, 1], images=IMAGES[[0] * 6])
    table = diversity(same, "height", data, n_resamples=20)
    assert table["generated"].abs().max() < 1e-6 and (table["data"] > 0.05).all() and (table["n"] == 3).all()
    nearest_three = np.argsort(np.abs(values - 1.0), kind="stable")[:3]
    assert table["data"][0] == pytest.approx(_mean_pairwise(pairwise(IMAGES[nearest_three])))


def test_novelty_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "CACHE", tmp_path)
    data = experiment(np.ones(20), np.ones(20))
    first = novelty(IMAGES[18:22], data, np.arange(20))
    again = novelty(IMAGES[18:22], data, np.arange(20))
    assert (first[0] == again[0]).all() and (first[0][:2] == 0).all() and (first[0][2:] > 0).all()
    np.testing.assert_array_equal(first[1][:2], IMAGES[18:20])
    assert len(list(tmp_path.glob("novelty/*.npz"))) == 1


# --- best of n -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_chances_are_those_of_picking_all_subsets(n):
    best = [min(subset) for subset in combinations(range(6), n)]
    np.testing.assert_allclose(chances(6, n), np.bincount(best, minlength=6) / len(best))


def test_a_number_of_candidates_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="from 6 candidates, 1 to 6 can be picked"):
        chances(6, 7)


def test_more_candidates_never_hurt_when_they_are_simulated():
    error = RNG.exponential(size=(15, 12))
    error[RNG.random(error.shape) < 0.2] = np.inf
    for q in (0.25, 0.5, 0.9):
        found = [_weighted_quantile(*best_of(error, error, n), q) for n in range(1, 13)]
        assert (np.diff(found) <= 0).all() if np.isfinite(found).all() else found == sorted(found, reverse=True)
    failing = [(w * np.isinf(e)).sum() for e, w in (best_of(error, error, n) for n in range(1, 13))]
    assert (np.diff(failing) <= 1e-12).all()


def test_a_ranking_that_knows_nothing_is_as_good_as_the_first_candidate():
    error, ranking = RNG.exponential(size=(4000, 8)), RNG.random((4000, 8))
    ordered, weights = best_of(error, ranking, 4)
    assert (ordered * weights).sum() / 4000 == pytest.approx(1.0, abs=0.05)
    perfect, weights = best_of(error, error, 4)
    assert (perfect * weights).sum() / 4000 == pytest.approx(0.25, abs=0.02)  # the least of n exponential numbers: 1/n


def test_weighted_quantiles():
    assert _weighted_quantile([3.0, 1.0, 2.0], [1, 1, 1], 0.5) == 2
    assert _weighted_quantile([1.0, 2.0, 3.0], [8, 1, 1], 0.5) == 1
    assert _weighted_quantile([1.0, 2.0, np.inf], [1, 1, 2], 0.9) == np.inf


class Guess:
    """A surrogate that knows the height exactly."""

    def __init__(self, heights):
        self.heights = heights

    def predict(self, images, descriptor):
        assert descriptor == "height"
        return self.heights


def test_a_surrogate_that_knows_everything_ranks_as_the_simulation_does():
    target, heights = np.repeat([1.0, 1.2], 10), RNG.uniform(0.9, 1.3, 20)
    candidates = experiment(target, heights, level=np.repeat([0, 1], 10))
    table = selection(candidates, "height", Guess(heights[:, None]), ns=(1, 4, 10), n_resamples=20,
                      seconds={"generate": 0.1, "simulate": 0.01, "surrogate": 0.001})  # fmt: skip
    simulated, guessed = (table[table["by"] == by].reset_index(drop=True) for by in ("simulation", "surrogate"))
    assert simulated["median"].tolist() == guessed["median"].tolist()
    assert (np.diff(simulated["median"]) <= 0).all()
    assert simulated["seconds"].tolist() == pytest.approx([0.11, 0.44, 1.1])
    assert guessed["seconds"].tolist() == pytest.approx([0.101, 0.404, 1.01])


def test_scatter_between_samples_is_that_of_the_normal_law():
    """Means of n normal numbers: two samples differ by 2 σ/√(πn) on average, which halves of one sample must tell."""
    rng, n, deviation = np.random.default_rng(0), 100, 3.0
    found = []
    for trial in range(400):
        values = rng.normal(1.0, deviation, n)
        found.append(scatter_between_samples(lambda rows, values=values: values[rows].mean(), n, trial))
    exact = 2 * deviation / np.sqrt(np.pi * n)
    error = np.std(found) / np.sqrt(len(found))
    assert abs(np.mean(found) - exact) < 4 * error < 0.1 * exact  # halves divided by 2 would be 29 % too small
    two = np.abs(np.diff(rng.normal(1.0, deviation, (2, 4000, n)).mean(axis=2), axis=0))  # and so do two samples
    assert abs(two.mean() - exact) < 4 * two.std() / np.sqrt(4000)


def test_distances_of_outlines_are_those_of_their_supporting_lines():
    """Of two upright rectangles on the ground, all lines but the lowest move by what the corner moves along them."""
    narrow, wide = (
        support_function(np.array([[-w, 0], [w, 0], [w, h], [-w, h]])) for w, h in ((0.25, 1.0), (0.5, 1.0))
    )
    angle = 2 * np.pi * np.arange(32) / 32
    assert np.allclose(OUTLINE_DISTANCE.apart(narrow, wide), 0.25 * np.abs(np.cos(angle)))
    assert OUTLINE_DISTANCE.of(narrow, wide) == pytest.approx(28 * 0.25 * np.abs(np.cos(angle)).mean())
    assert OUTLINE_DISTANCE.share(narrow, wide) == pytest.approx(0.25 * np.abs(np.cos(angle)).mean())
    units = OUTLINE_DISTANCE.in_units(narrow[None], wide[None], np.array([narrow, wide]), "side")
    assert units["Hausdorff distance"][1] == pytest.approx(7) and "outline distance / height" in units
