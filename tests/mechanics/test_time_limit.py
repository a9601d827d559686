"""Every structure ends in bounded time: the solver counts its factorisations and gives up with a reason."""

import numpy as np
import pytest
from scipy import ndimage

from inflate_lib import build_mesh, inflate, label_image, simulate_dataset
from inflate_lib.datasets.simulate import TIME_LIMIT
from inflate_lib.mechanics import inflation
from inflate_lib.structures.sources import load_sevens

LIMIT = inflation._FACTORISATIONS[0]
SEVEN = label_image(load_sevens("digits").images[0])


def random_wall(rng):
    """A random blob with random holes, down to walls of one pixel and hinges at corners; or None where it has none."""
    blob = ndimage.gaussian_filter(rng.random((25, 24)), rng.choice([0.7, 1, 1.5, 2, 3])) > 0.5
    parts = ndimage.label(blob)[0]
    body = ndimage.binary_fill_holes(parts == 1 + np.argmax(np.bincount(parts.ravel())[1:]))
    label = np.zeros((28, 28))
    label[3:, 2:26] = 0.5 * body
    inside = ndimage.binary_erosion(label > 0, np.ones((3, 3)))
    label[inside & (rng.random(label.shape) < rng.uniform(0.3, 1))] = 1
    label = np.roll(label, 27 - np.flatnonzero(label.any(axis=1)).max(), axis=0)
    try:
        return build_mesh(label)
    except ValueError:
        return None


def nominal_seconds(result):
    """Seconds of the nominal core that an inflation took."""
    system = inflation.build_system(result.mesh, result.element, result.lame)
    return result.factorisations * inflation.nominal_seconds(system)


def limited(*arguments, **options):
    """An inflation under the limit of a data set's structures, and that it kept to it and says how it ended."""
    result = inflate(*arguments, **options, time_limit=TIME_LIMIT[0])
    assert nominal_seconds(result) <= TIME_LIMIT[0]
    assert result.factorisations <= LIMIT
    assert result.converged == (result.reason == "") == bool(np.isfinite(result.displacement).all())
    return result


def test_random_walls_end_in_time():
    rng = np.random.default_rng(0)
    meshes = [mesh for mesh in (random_wall(rng) for _ in range(600)) if mesh is not None]
    assert len(meshes) > 30
    outcomes = [limited(mesh, pressure=p).converged for mesh in meshes[:60] for p in (0.01, 0.05, 1.0)]
    assert 10 < sum(outcomes) < len(outcomes) - 10  # both kinds, or this tests nothing


def sieve():
    label = np.full((28, 28), 0.5)
    label[1:-1:2, 1:-1:2] = 1
    return label


def solid():
    """The most expensive mesh of 28 × 28 pixels."""
    label = np.full((28, 28), 0.5)
    label[10:12, 10:12] = 1
    return label


def on_one_pixel():
    """A large room on a stalk of a single pixel's width: next to a mechanism."""
    label = np.zeros((28, 28))
    label[:14] = 0.5
    label[1:13, 1:27] = 1
    label[14:, 14] = 0.5
    return label


@pytest.mark.parametrize("shape", [sieve, solid, on_one_pixel])
@pytest.mark.parametrize("pressure", [-0.01, 0.001, 0.05, 5.0])
def test_extreme_structures_end_in_time(shape, pressure):
    limited(shape(), pressure=pressure)


def test_who_runs_out_of_effort_says_so(monkeypatch):
    label, free = SEVEN, inflate(SEVEN)
    monkeypatch.setattr(inflation, "_FACTORISATIONS", (20, 2))
    short = inflate(label)
    assert short.factorisations == 20 and not short.converged
    assert "within 20 factorisations" in short.reason and "load step" in short.reason
    reached = np.isfinite(short.displacement).all(axis=(1, 2)).sum()
    assert 0 < reached < 10 and f"load step {reached + 1} of 10" in short.reason
    assert np.array_equal(short.displacement[:reached], free.displacement[:reached])
    monkeypatch.setattr(inflation, "_FACTORISATIONS", (20, 8))  # eight per load step are more than enough
    assert np.array_equal(inflate(label).displacement, free.displacement)


def test_time_limit_is_a_number_of_factorisations_that_depends_on_the_mesh():
    free = inflate(SEVEN)
    needed = nominal_seconds(free)
    same = inflate(SEVEN, time_limit=1.001 * needed)
    assert same.converged and np.array_equal(same.displacement, free.displacement)
    short = inflate(SEVEN, time_limit=0.5 * needed)
    assert not short.converged
    assert short.factorisations in (free.factorisations // 2, (free.factorisations - 1) // 2)
    assert f"within {short.factorisations} factorisations, the time limit of {0.5 * needed:g} s" in short.reason
    costly = inflate(solid(), pressure=5.0, time_limit=0.5 * needed)
    assert costly.factorisations < short.factorisations / 10
    again = inflate(SEVEN, time_limit=0.5 * needed)
    assert again.reason == short.reason and np.array_equal(again.displacement, short.displacement, equal_nan=True)
    assert inflate(SEVEN, time_limit=1e-9).factorisations == 0


def test_limit_of_a_data_set_grows_with_the_load_steps_and_can_be_chosen(monkeypatch):
    given, real = [], inflation.inflate
    monkeypatch.setattr(
        inflation,
        "inflate",
        lambda *a, time_limit, **k: given.append(time_limit) or real(*a, time_limit=time_limit, **k),
    )
    image = load_sevens("digits").images[:1]
    for options in ({}, {"n_steps": 1}, {"n_steps": 40}, {"time_limit": 1e-6}):
        data = simulate_dataset(image, **options)
    assert given == [1, 1, 4, 1e-6]
    assert "the time limit of 1e-06 s" in data.reason.item() and data.label.any()


@pytest.mark.parametrize("seconds", [0, -1, np.nan, np.inf, True, "long", [1]])
def test_time_limits_that_are_none_are_refused(seconds):
    with pytest.raises(ValueError, match="time_limit must be a positive number"):
        inflate(SEVEN, time_limit=seconds)
