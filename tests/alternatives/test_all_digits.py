"""All digits in a small table: what it keeps of a data set, what counts as met, and that the stored one is true."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from inflate_lib import inflate, label_image, paths, simulate_dataset
from inflate_lib.alternatives.all_digits import (
    compact,
    nearest_digits,
    nearest_miss,
    reachable_area,
    save_compact,
    sizes_of,
    stored_digits,
)
from inflate_lib.mechanics.inflation import PRESSURE
from inflate_lib.structures import load_digits, resolve_source


@pytest.fixture(scope="module")
def data():
    found = load_digits("all", "digits", 11)
    images = np.concatenate([found.images, np.zeros((1, 28, 28), np.uint8)])
    return simulate_dataset(images, n_jobs=1, n_steps=1).assign(digit=("structure", np.append(found.labels, -1)))


def test_lean_and_bow_are_those_of_the_axis(data):
    table = compact(data)
    for row in range(11):
        axis = data.medial_axis.values[row]
        line = np.linspace(0, 1, 20_001)[:, None] * axis[-1]
        bow = np.linalg.norm(axis[:, None] - line, axis=-1).min(axis=1).max()  # from the nearest of many points
        assert table.bow[row] == pytest.approx(bow, abs=1e-4) and table.lean[row] == axis[-1, 0]
    assert np.isnan(table.bow[11]) and "blank" in table.reason.values[11]


def test_the_table_comes_back_to_four_digits(data, tmp_path):
    table = compact(data)
    save_compact(table, tmp_path / "table.nc")
    back = xr.load_dataset(tmp_path / "table.nc", engine="h5netcdf")
    assert set(back.data_vars) == set(table.data_vars)
    for name, values in table.items():
        if values.dtype.kind == "f":
            assert np.allclose(back[name], values, rtol=0, atol=1.01e-4, equal_nan=True)
        else:
            assert np.array_equal(back[name], values)
    assert sizes_of(back).shape == (11, 2)


@pytest.mark.mnist
def test_the_nearest_digits_are_those_of_the_table_and_inflate_to_it():
    if resolve_source() != "mnist":
        pytest.skip("MNIST cannot be had")
    wanted = {"height": np.array([1.6]), "width": np.array([1.5])}
    found, table = nearest_digits(wanted, 4, n_jobs=1), stored_digits()
    assert np.allclose(found.height, table.height[found.structure.values], atol=2e-4)
    sizes = np.column_stack([table.height, table.width])
    misses = np.abs(sizes / [1.6, 1.5] - 1).max(axis=1)
    assert np.array_equal(misses[found.structure.values], np.sort(misses)[:4])
    leaning = {"axis": np.linspace([0, 0], [0.2, 1.45], 30).ravel()}  # it ends an increment below the top
    assert nearest_digits(leaning, 1, n_jobs=1).height.item() == pytest.approx(1.5, abs=1e-2)


def test_a_target_is_met_where_both_sizes_are():
    sizes = np.array([[1.0, 1.0], [2.0, 1.0]])
    targets = np.array([[1.0, 1.0], [1.02, 0.99], [1 / 1.05, 1.0], [2.0, 1.1], [1.5, 1.0]])
    assert nearest_miss(sizes, targets) == pytest.approx([0, 0.02, 0.05, 0.1, 1 / 3])


def test_the_region_of_one_structure_is_a_box_and_far_ones_add():
    box = (1.02 - 1 / 1.02) ** 2
    assert reachable_area(np.array([[1.0, 1.0]]), step=1e-3) == pytest.approx(box, rel=0.1)
    assert reachable_area(np.array([[1.0, 1.0], [2.0, 2.0]]), step=1e-3) == pytest.approx(5 * box, rel=0.1)
    assert reachable_area(np.array([[1.0, 1.0], [1.0, 1.0]]), step=1e-3) == pytest.approx(box, rel=0.1)


def test_the_stored_table_is_small_and_of_all_training_digits():
    assert (paths.REFERENCE / "all_digits.nc").stat().st_size < 2e6
    table = stored_digits()
    counts = [5923, 6742, 5958, 6131, 5842, 5421, 5918, 6265, 5851, 5949]  # of the published file of labels
    assert np.bincount(table.digit).tolist() == counts
    assert np.array_equal(table.buildable, table.flaw == "")
    assert np.array_equal(table.height.isnull(), table.reason != "")
    counted = pd.read_csv(paths.REFERENCE / "all_digits.csv").set_index("digits")
    assert counted.structures[:10].tolist() == counts and counted.structures["all"] == 60_000
    sevens = table.where(table.digit == 7, drop=True)
    assert counted.height["sevens"] == pytest.approx(float(sevens.height.median()), abs=2e-4)
    assert counted["buildable %"]["sevens"] == pytest.approx(100 * float((sevens.flaw == "").mean()), abs=1e-3)
    assert reachable_area(sizes_of(sevens)) == pytest.approx(counted.reach["sevens"], rel=0.01)


@pytest.mark.mnist
def test_the_stored_table_is_what_a_simulation_gives():
    if resolve_source() != "mnist":
        pytest.skip("MNIST cannot be had: the stored table is not checked")
    rows = np.sort(np.random.default_rng(0).choice(60_000, 24, replace=False))
    found, stored = load_digits("all", "mnist"), stored_digits().isel(structure=rows)
    data = simulate_dataset(found.images[rows], n_jobs=1)
    table = compact(data.assign(digit=("structure", found.labels[rows])))
    for name in ("height", "width", "hull_area", "peak_stretch", "lean", "bow"):
        assert np.allclose(table[name], stored[name], rtol=0, atol=1.1e-4, equal_nan=True), name
    assert np.array_equal(table.flaw, stored.flaw) and np.array_equal(table.digit, stored.digit)


@pytest.mark.mnist
def test_a_path_that_snaps_loses_its_stability_where_load_steps_end_and_regains_it_where_one_leads():
    if resolve_source() != "mnist":
        pytest.skip("MNIST cannot be had: the stored paths are not checked")
    followed = pd.read_csv(paths.REFERENCE / "snapping.csv")
    path = followed[followed.structure == 1102]
    label = label_image(load_digits("all", "mnist", 1103).images[1102])
    limit = path.pressure[: path.index[~path.stable][0]].max()
    assert inflate(label, 4, pressure=0.98 * limit).converged
    assert not inflate(label).converged and inflate(label, 1).converged
    end = np.interp(PRESSURE, path.pressure[-5:], path.height[-5:])
    assert path.stable.iloc[-1] and inflate(label, 1).deformed()[:, 1].max() == pytest.approx(end, abs=1e-3)


def test_the_stored_paths_are_those_of_all_structures_without_an_equilibrium():
    table, followed = stored_digits(), pd.read_csv(paths.REFERENCE / "snapping.csv")
    assert set(followed.structure) == set(np.flatnonzero(table.flaw == "no_equilibrium"))
    for _, path in followed.groupby("structure"):
        assert path.pressure.diff().abs().max() < 0.2 * PRESSURE and path.height.diff().abs().max() < 0.1
