"""Data sets in parts: the same rows as in one piece, read as one, resumed, and never more than one part in memory."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import xarray as xr

from inflate_lib import paths, simulate_dataset
from inflate_lib.alternatives import Family, open_parts, parts, simulated_digits
from inflate_lib.cli import app
from inflate_lib.datasets import simulate
from inflate_lib.structures import load_digits

DIGITS = load_digits("all", "digits")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache, and parts of 16 structures."""
    monkeypatch.setattr(paths, "CACHE", tmp_path)
    monkeypatch.setattr(parts, "PART", 16)
    return tmp_path


def same(data, images):
    """Whether the parts hold, to the last bit, what the images give in one piece."""
    whole = simulate_dataset(images, n_jobs=1)
    return all(np.array_equal(data[name], whole[name], equal_nan=name not in ("reason", "flaw")) for name in whole)


def test_parts_are_the_digits_in_order_with_their_labels_and_each_seven_as_before(cache, monkeypatch):
    files = simulated_digits("all", "digits", 40, n_jobs=1)
    assert len(files) == 3 and {file.parent for file in files} == {files[0].parent}
    data = open_parts(files)
    assert data.sizes["structure"] == 40 and data.structure.values.tolist() == list(range(40))
    assert np.array_equal(data.digit, DIGITS.labels[:40]) and data.digit.dtype == np.int8
    assert same(data, DIGITS.images[:40])
    sevens = data.isel(structure=np.flatnonzero(data.digit.values == 7))
    assert sevens.sizes["structure"] >= 3 and same(sevens, load_digits([7], "digits").images[: len(sevens.digit)])
    assert data.attrs["source_description"] == "scikit-learn digits"
    # without this library: in any order, found by their names
    found = xr.open_mfdataset(str(files[0].parent / "*.nc"), engine="h5netcdf")
    xr.testing.assert_equal(found.load(), data.load())
    monkeypatch.setattr(parts, "simulate_dataset", lambda *a, **k: pytest.fail("computed again"))
    assert simulated_digits("all", "digits", 40, n_jobs=1) == files


def test_blends_follow_the_digits_and_what_is_none_keeps_its_row(cache, monkeypatch):
    blank = np.zeros((28, 28), np.uint8)
    member = Family.__getitem__
    monkeypatch.setattr(Family, "__getitem__", lambda self, row: blank if row == 9 else member(self, row))
    data = open_parts(simulated_digits([0, 3], "digits", 8, blends=10, seed=2, n_jobs=1))
    assert data.digit.values.tolist() == [*load_digits([0, 3], "digits", 8).labels, *[-1] * 10]
    assert same(data, np.stack(list(Family(load_digits([0, 3], "digits", 8).images, 10, seed=2))))
    assert "blank" in data.reason.values[9] and data.flaw.values[9] == "no_structure"  # wider than in other parts
    assert "10 blends of two, seed 2" in data.attrs["source_description"]


def test_never_more_than_one_part_is_in_memory(cache, monkeypatch):
    """The images of a part are asked for when the parts before it are on the disk."""
    there, member = [], Family.__getitem__

    def counted(self, row):
        there.append(len(list(cache.glob("digits/*/*.nc"))))
        return member(self, row)

    monkeypatch.setattr(Family, "__getitem__", counted)
    simulated_digits("all", "digits", 40, n_jobs=1)
    assert there == [row // 16 for row in range(40)]


def test_a_damaged_part_alone_is_made_again(cache, monkeypatch):
    files = simulated_digits("all", "digits", 40, n_jobs=1)
    before = [file.stat().st_mtime_ns for file in files]
    files[1].write_bytes(files[1].read_bytes()[:-9])
    assert simulated_digits("all", "digits", 40, n_jobs=1) == files
    assert [file.stat().st_mtime_ns == time for file, time in zip(files, before, strict=True)] == [True, False, True]


RUN = """
import sys
from pathlib import Path
from inflate_lib import paths
from inflate_lib.alternatives import parts
from inflate_lib.datasets import simulate
paths.CACHE, parts.PART, simulate.ALONE = Path(sys.argv[1]), 16, 0
parts.simulated_digits("all", "digits", 40, n_jobs=2, backend=sys.argv[2] if len(sys.argv) > 2 else None)
"""


def done(cache):
    """How many of the 40 structures are on the disk: in whole parts, and in pieces of a part that is not whole yet."""
    parts = {note.name.removesuffix(".nc.json") for note in cache.glob("digits/*/*.nc.json")}
    pieces = [file for file in cache.glob("digits/*/.*.scratch/*.npz") if file.parent.stem[1:] not in parts]
    return 16 * len(parts), len(pieces)  # so small a part goes in pieces of one


def killed(cache, *backend):
    """A run in a process of its own, killed when a part and a piece of another are there; returns how many are left."""
    process = subprocess.Popen([sys.executable, "-c", RUN, str(cache), *backend], start_new_session=True)
    limit = time.monotonic() + 120
    while not all(done(cache)):
        assert process.poll() is None and time.monotonic() < limit
        time.sleep(0.001)
    os.kill(process.pid, signal.SIGKILL)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return 40 - sum(done(cache))


def resumes(cache, monkeypatch, backend=None):
    """Go on where a run was killed; returns the data set and how many structures were simulated anew."""
    new, store = [], simulate._store

    def counted(path, rows):
        new.append(len(rows["reason"]))
        store(path, rows)

    monkeypatch.setattr(simulate, "_store", counted)
    return open_parts(simulated_digits("all", "digits", 40, n_jobs=1, backend=backend)), sum(new)


@pytest.mark.slow
def test_a_killed_run_goes_on_from_its_parts_and_pieces(cache, monkeypatch):
    left = killed(cache)
    data, new = resumes(cache, monkeypatch)
    assert new == left < 24  # neither the first part nor the pieces of the next one
    assert same(data, DIGITS.images[:40])


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # Dask warns about slow machines
def test_under_dask_the_parts_are_the_same_and_a_killed_run_goes_on(cache, monkeypatch):
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0", "host": "127.0.0.1"}
    with distributed.LocalCluster(**options, silence_logs=50) as local:
        left = killed(cache, local.scheduler_address)
        data, new = resumes(cache, monkeypatch, local.scheduler_address)
    assert new == left < 24
    assert same(data, DIGITS.images[:40])


@pytest.mark.parametrize("digits", [["all"], ["0", "3", "7"], ["037"], ["0,3,7"]])
def test_the_command_keeps_parts_and_says_where(cache, digits, monkeypatch, capsys):
    options = ["--digits", *digits, "--source", "digits", "--structures", "5", "--blends", "2", "--jobs", "1"]
    monkeypatch.setattr("sys.argv", ["inflate", "dataset", *options])
    with pytest.raises(SystemExit) as end:
        app.run()
    told = capsys.readouterr().out
    assert not end.value.code and "xarray.open_mfdataset" in told
    (folder,) = cache.glob("digits/*")
    assert f"{folder}/*.nc" in told
    wanted = "all" if digits == ["all"] else [0, 3, 7]
    data = xr.open_mfdataset(str(folder / "*.nc"), engine="h5netcdf")
    assert data.digit.values.tolist() == [*load_digits(wanted, "digits", 5).labels, -1, -1]


def test_what_is_no_digit_is_told(monkeypatch):
    monkeypatch.setattr("sys.argv", ["inflate", "dataset", "--digits", "0", "three"])
    with pytest.raises(SystemExit, match="--digits takes all, or digits such as 0 3 7, not 0 three"):
        app.run()


@pytest.mark.parametrize("digits", [[], ["--digits", "3"]])
@pytest.mark.parametrize(("wrong", "told"), [(["--jobs", "0"], "n_jobs"), (["--backend", "lokky"], "unknown backend")])
def test_who_works_is_checked_though_nothing_is_left_to_do(cache, monkeypatch, digits, wrong, told):
    given = ["inflate", "dataset", "--source", "digits", "--structures", "2", *digits]
    monkeypatch.setattr("sys.argv", given)
    with pytest.raises(SystemExit) as end:
        app.run()
    assert not end.value.code
    monkeypatch.setattr("sys.argv", [*given, *wrong])
    with pytest.raises(SystemExit, match=told):
        app.run()


def test_a_blend_takes_two_digits(cache, monkeypatch):
    options = ["--source", "digits", "--structures", "1", "--blends", "3"]
    monkeypatch.setattr("sys.argv", ["inflate", "dataset", *options])
    with pytest.raises(SystemExit, match="two digits, and there is 1: ask for more structures"):
        app.run()


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "dask.array", None)
    with pytest.raises(RuntimeError, match=r"inflate-lib\[dask\]"):
        open_parts([])
