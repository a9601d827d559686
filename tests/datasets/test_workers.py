"""Simulations on a real Dask cluster of processes, with a worker killed in the middle."""

import os
import signal
import threading
import time
from collections import Counter
from functools import partial

import joblib
import numpy as np
import pytest
import xarray as xr
from killed_runs import run_and_kill

from inflate_lib import simulate_dataset
from inflate_lib._cache import digest
from inflate_lib.cli import app
from inflate_lib.datasets import _workers
from inflate_lib.datasets import simulate as datasets
from inflate_lib.datasets.simulate import _simulate as simulate
from inflate_lib.structures.sources import load_sevens

distributed = pytest.importorskip(
    "distributed", reason="Dask is not installed (pip install -e '.[dask]'): nothing of the cluster is checked"
)
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]  # Dask warns about slow machines

IMAGES = np.concatenate([load_sevens("digits").images[:89], np.zeros((1, 28, 28), np.uint8)])


@pytest.fixture(scope="module")
def dask():
    """Two workers, each a process under a nanny that replaces it when it dies."""
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0", "host": "127.0.0.1"}
    with distributed.LocalCluster(**options, silence_logs=50) as local:
        yield local.scheduler_address


def slowly(number):
    time.sleep(0.05)
    return 10 * number


def fails(number):
    raise FloatingPointError(f"number {number} overflowed")


def logged(log, images, *rest):
    """As `_simulate`, slowly, with a line in the log when it begins and when it ends."""
    piece = f"{os.getpid()} {digest(images)}\n"
    with open(log, "a") as file:
        file.write("begin " + piece)
    time.sleep(0.1)
    rows = simulate(images, *rest)
    with open(log, "a") as file:
        file.write("end " + piece)
    return rows


def test_a_killed_worker_loses_nothing_and_doubles_nothing(dask, tmp_path, monkeypatch):
    monkeypatch.setattr(datasets, "PIECE", 2)
    log, folder = tmp_path / "log", tmp_path / "pieces"
    log.touch()
    monkeypatch.setattr(datasets, "_simulate", partial(logged, log))  # what the workers do, to kill one in the middle
    with distributed.Client(dask, set_as_default=False) as client:
        pids = client.run(os.getpid)
    assert len(pids) == 2
    victim, stored_when_killed = str(next(iter(pids.values()))), []

    def open_pieces():
        """Pieces that the victim has begun and not ended."""
        lines = [line.split() for line in log.read_text().splitlines()]
        begun, ended = ({piece for what, pid, piece in lines if (what, pid) == (w, victim)} for w in ("begin", "end"))
        return begun - ended

    def kill_one():
        while len(list(folder.glob("[0-9]*.npz"))) < 4 or not open_pieces():
            time.sleep(0.002)
        os.kill(int(victim), signal.SIGKILL)
        stored_when_killed.append(len(list(folder.glob("[0-9]*.npz"))))

    stored, real = [], datasets._store
    monkeypatch.setattr(
        datasets, "_store", lambda path, rows: stored.append(path.name) or real(path, rows)
    )  # each once
    killer = threading.Thread(target=kill_one, daemon=True)
    killer.start()
    data = simulate_dataset(IMAGES, folder=folder, backend=dask, progress_text=False)
    killer.join(5)
    assert stored_when_killed and stored_when_killed[0] < 45, "the worker was not killed in the middle"
    assert len(stored) == len(set(stored)) == 45  # each piece once
    (cut,) = open_pieces()  # it died in the middle of a piece, which another process did
    ended = Counter(line.split()[2] for line in log.read_text().splitlines() if line.startswith("end"))
    assert ended[cut] == 1 and len(ended) == 45
    with distributed.Client(dask, set_as_default=False) as client:
        assert set(client.run(os.getpid).values()) != set(pids.values())
    monkeypatch.undo()
    xr.testing.assert_identical(data, simulate_dataset(IMAGES, n_jobs=1))  # the same numbers, in the same order
    assert data.reason[-1].item().startswith("image is blank")

    # what is there is not computed again, with no cluster at all
    monkeypatch.setattr(datasets, "PIECE", 2)
    again = simulate_dataset(IMAGES, folder=folder, backend="tcp://127.0.0.1:1", progress_text=False)
    xr.testing.assert_identical(again, data)


def test_a_run_killed_at_any_moment_goes_on_from_its_pieces(dask, tmp_path):
    images = IMAGES[:80]
    data, redone, stored = run_and_kill(tmp_path, images, dask, kills=3)
    xr.testing.assert_identical(data, simulate_dataset(images, n_jobs=1))
    assert 0 < stored[0] < stored[-1] < 40
    assert redone <= 3 * (_workers.IN_FLIGHT * 2 + 1), stored  # those in flight, and the one that was being stored


def test_a_cluster_that_joblib_made_active_is_used_in_the_same_way(dask, monkeypatch):
    with pytest.raises(ValueError, match=r"needs a distributed.Client in this process"):
        simulate_dataset(IMAGES[:2], backend="dask")
    addresses, real = [], _workers.run_on_cluster
    monkeypatch.setattr(
        _workers, "run_on_cluster", lambda address, *rest: addresses.append(address) or real(address, *rest)
    )
    with distributed.Client(dask):
        named = simulate_dataset(IMAGES[:4], n_steps=1, backend="dask")
        with joblib.parallel_config("dask"):
            active = simulate_dataset(IMAGES[:4], n_steps=1)
    assert addresses == [dask, dask]
    xr.testing.assert_identical(named, simulate_dataset(IMAGES[:4], n_steps=1))
    xr.testing.assert_identical(named, active)


def test_tasks_are_taken_as_they_are_needed(dask):
    taken = []

    def tasks():
        for number in range(40):
            taken.append(number)
            yield (number,)

    results = _workers.run_on_cluster(dask, slowly, tasks())
    first = next(results)
    assert len(taken) < 40
    assert sorted([first, *results]) == [(number, 10 * number) for number in range(40)]


def test_an_error_of_a_task_is_told(dask):
    with pytest.raises(RuntimeError, match="number 3 overflowed"):
        list(_workers.run_on_cluster(dask, fails, [(3,)]))


def test_a_worker_with_other_code_is_refused(dask, monkeypatch):
    monkeypatch.setattr(_workers, "step_version", lambda step: "other")  # the workers are processes with our code
    with pytest.raises(RuntimeError, match="another version of inflate_lib"):
        list(_workers.run_on_cluster(dask, slowly, [(1,)]))


def test_no_scheduler_and_no_workers_are_told(monkeypatch):
    monkeypatch.setattr(_workers, "PATIENCE", 1)
    with pytest.raises(RuntimeError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1"):
        list(_workers.run_on_cluster("tcp://127.0.0.1:1", slowly, [(1,)]))
    with pytest.raises(RuntimeError, match=r"nonsense:.* is no address of a Dask scheduler"):
        list(_workers.run_on_cluster("nonsense://x", slowly, [(1,)]))
    options = {"n_workers": 0, "dashboard_address": "127.0.0.1:0", "host": "127.0.0.1", "silence_logs": 50}
    with distributed.LocalCluster(**options) as empty, pytest.raises(RuntimeError, match="has no workers"):
        list(_workers.run_on_cluster(empty.scheduler_address, slowly, [(1,)]))


def test_the_command_takes_an_address(dask, tmp_path, monkeypatch, capsys):
    from inflate_lib import paths

    monkeypatch.setattr(paths, "CACHE", tmp_path)
    monkeypatch.setattr("sys.argv", ["inflate", "dataset", "--source", "digits", "--structures", "3", "--dask", dask])
    with pytest.raises(SystemExit) as end:
        app.run()
    assert not end.value.code and "structure: 3" in capsys.readouterr().out
