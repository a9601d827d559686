"""The cache: once per key, whole or not at all, across processes and kills."""

import errno
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import inflate_lib
from inflate_lib import paths
from inflate_lib._cache import STEPS, CacheError, cached, code_version, digest


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "CACHE", tmp_path / "cache")
    return tmp_path / "cache"


def writer(text, calls=None):
    def make(target, scratch):
        if calls is not None:
            calls.append(text)
        target.write_text(text)

    return make


def never(target, scratch):
    raise AssertionError("the result was there and should not be made again")


def test_a_step_runs_once_and_its_sidecar_tells_the_key(cache):
    path = cached("kind", {"b": 2, "a": (1, 2)}, writer("result"), ".txt")
    assert path.read_text() == "result"
    assert path.parent == cache / "kind"
    assert path.suffix == ".txt"
    assert cached("kind", {"a": [1, 2], "b": np.int64(2)}, never, ".txt") == path
    assert json.loads(path.with_name(path.name + ".json").read_text())["key"] == {"a": [1, 2], "b": 2}


def test_another_key_or_kind_is_another_result():
    first = cached("kind", {"a": 1}, writer("one"), ".txt")
    assert cached("kind", {"a": 2}, writer("two"), ".txt").read_text() == "two"
    assert cached("other", {"a": 1}, writer("three"), ".txt").read_text() == "three"
    assert first.read_text() == "one"


def test_dataclasses_are_keys_and_arrays_are_not():
    @dataclass
    class Settings:
        rate: float

    cached("kind", {"s": Settings(0.1)}, writer("x"), ".txt")
    cached("kind", {"s": {"rate": 0.1}}, never, ".txt")
    with pytest.raises(ValueError, match=r"cannot hold ndarray; use .* digest"):
        cached("kind", {"a": np.zeros(3)}, never, ".txt")


@pytest.mark.parametrize("damage", ["result", "truncated", "sidecar", "no sidecar"])
def test_a_damaged_result_is_made_again(damage):
    path = cached("kind", {"a": 1}, writer("whole"), ".txt")
    note = path.with_name(path.name + ".json")
    if damage == "result":
        path.write_text("wrong")
    elif damage == "truncated":
        path.write_text("who")
    elif damage == "sidecar":
        note.write_text("{")
    else:
        note.unlink()
    assert cached("kind", {"a": 1}, writer("again"), ".txt").read_text() == "again"


def test_a_failed_step_leaves_no_result_but_its_finished_parts():
    def fails(target, scratch):
        (scratch / "part").write_text("kept")
        target.write_text("half")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        cached("kind", {"a": 1}, fails, ".txt")

    def resumes(target, scratch):
        assert not target.exists()
        target.write_text((scratch / "part").read_text())

    path = cached("kind", {"a": 1}, resumes, ".txt")
    assert path.read_text() == "kept"
    assert not list(path.parent.glob(".*.scratch"))


def test_a_step_that_writes_nothing_is_an_error():
    with pytest.raises(CacheError, match="wrote no file"):
        cached("kind", {"a": 1}, lambda target, scratch: None, ".txt")


def test_nothing_is_visible_while_the_step_runs(cache):
    def make(target, scratch):
        target.write_text("half")
        assert not list((cache / "kind").glob("[!.]*"))

    cached("kind", {"a": 1}, make, ".txt")


def test_a_cache_that_cannot_be_written_is_named(cache):
    cache.write_text("a file where the folder should be")
    with pytest.raises(CacheError, match="set INFLATE_CACHE"):
        cached("kind", {"a": 1}, writer("x"), ".txt")


@pytest.fixture
def small_files():
    """No file of this process may be larger than 8 kB: writing more fails, without the name of the file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_is_a_clear_error(small_files):
    with pytest.raises(CacheError, match=rf"{os.strerror(errno.EFBIG)}.*finished parts are kept"):
        cached("kind", {"a": 1}, writer("x" * 10_000), ".txt")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES])
def test_what_is_full_or_closed_elsewhere_is_not_blamed_on_the_cache(number):
    """A /dev/shm that is too small for the semaphores of processes says no more than that."""

    def fail(target, scratch):
        raise OSError(number, os.strerror(number))

    with pytest.raises((RuntimeError, OSError), match=os.strerror(number)) as raised:
        cached("kind", {"a": 1}, fail, ".txt")
    assert not isinstance(raised.value, CacheError)
    assert number != errno.ENOSPC or "/dev/shm" in str(raised.value)


def test_an_error_of_the_step_itself_passes_through(tmp_path):
    with pytest.raises(FileNotFoundError, match="absent"):
        cached("kind", {"a": 1}, lambda target, scratch: (tmp_path / "absent").read_text(), ".txt")


PROCESS = """
import os, sys, time
from pathlib import Path
from inflate_lib._cache import cached

log = Path(sys.argv[1])

def make(target, scratch):
    with log.open("a") as stream:
        stream.write("made\\n")
    part = scratch / "part"
    if sys.argv[2] == "hang" and not part.exists():
        part.write_text("first half, ")
        target.write_text("rubbish")
        time.sleep(60)
    time.sleep(0.5)
    target.write_text((part.read_text() if part.exists() else "") + "done")

print(cached("kind", {"a": 1}, make, ".txt").read_text())
"""


def start(log, mode, cache):
    environment = {**os.environ, "INFLATE_CACHE": str(cache)}
    command = [sys.executable, "-c", PROCESS, str(log), mode]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def test_two_processes_make_it_once(tmp_path, cache):
    log = tmp_path / "log"
    both = [start(log, "quick", cache) for _ in range(2)]
    answers = [process.communicate(timeout=60)[0] for process in both]
    assert [answer.splitlines()[-1] for answer in answers] == ["done", "done"]
    assert log.read_text() == "made\n"


def test_a_killed_process_is_resumed_by_the_next(tmp_path, cache):
    log = tmp_path / "log"
    first = start(log, "hang", cache)
    deadline = time.monotonic() + 60
    while not list(cache.glob("kind/.*.partial")) and time.monotonic() < deadline:
        time.sleep(0.05)
    first.send_signal(signal.SIGKILL)
    first.communicate()
    assert not list((cache / "kind").glob("[!.]*"))
    second = start(log, "hang", cache)
    assert second.communicate(timeout=60)[0].strip() == "first half, done"
    assert log.read_text() == "made\nmade\n"


def test_digest_sees_values_shape_and_type(tmp_path):
    array = np.arange(6.0)
    same = digest(array.copy())
    assert digest(array) == same
    others = [digest(array.reshape(2, 3)), digest(array.astype("f4")), digest(array[::-1]), digest(array, array)]
    assert len({same, *others}) == 5
    assert digest(array.reshape(2, 3).T) == digest(np.ascontiguousarray(array.reshape(2, 3).T))
    (tmp_path / "file").write_bytes(b"bytes")
    assert digest(tmp_path / "file") == digest(b"bytes")
    with pytest.raises(ValueError, match="arrays of numbers"):
        digest(np.array([None]))


def test_code_version_sees_code_and_not_comments(tmp_path):
    def version(text):
        path = tmp_path / "module.py"
        path.write_text(text)
        return code_version(path)

    plain = version("def f(x):\n    return x + 1\n")
    assert version('def f(x):\n    """Add one."""\n\n    return x + 1  # indeed\n') == plain
    assert version("def f(x):\n    return x + 2\n") != plain
    assert code_version("inflate_lib._cache") == code_version(sys.modules["inflate_lib._cache"])
    with pytest.raises(ValueError, match="no source"):
        code_version("inflate_lib.absent")


def test_code_version_does_not_hear_what_is_said(tmp_path):
    def version(text, name="module.py"):
        path = tmp_path / name
        path.write_text(text)
        return code_version(path)

    says = "def f(x):\n    print(f'x is {x}')\n    warnings.warn('large')\n    raise RuntimeError('no')\n"
    plain = version(says)
    for word, other in (("x is", "here is"), ("large", "too large"), ("no'", "not this'")):
        assert version(says.replace(word, other)) == plain
    assert version(says.replace("RuntimeError", "ValueError")) != plain
    assert version("def f(x):\n    print('1', file=x)\n") != version("def f(x):\n    print('2', file=x)\n")
    recorded = version(says, "descriptors.py")  # a data set keeps the words of its errors
    assert version(says.replace("no'", "not this'"), "descriptors.py") != recorded


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """The library in a folder of its own, to change it there, and the versions of its steps before a change."""
    folder = tmp_path_factory.mktemp("copy")
    shutil.copytree(
        Path(inflate_lib.__file__).parent, folder / "inflate_lib", ignore=shutil.ignore_patterns("*pycache*")
    )
    return folder, versions(folder)


def versions(folder):
    """The version of each step, of the library in a folder."""
    code = "from inflate_lib._cache import STEPS, step_version; print(*map(step_version, STEPS))"
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    said = subprocess.check_output([sys.executable, "-c", code], env=environment, cwd=folder, text=True)
    return dict(zip(STEPS, said.split(), strict=True))


@pytest.mark.parametrize(
    ("module", "before", "after", "first"),
    [
        ("mechanics/material.py", "0.1644", "0.1645", "dataset"),
        ("datasets/pairs.py", "% 10 == 9\n", "% 10 == 8\n", "dataset"),
        ("diffusion/schedule.py", "0.008", "0.009", "model"),
        ("models/train.py", "steps // 10", "steps // 20", "model"),
        ("experiments/run.py", "1e-9 * np.maximum", "1e-8 * np.maximum", "experiment"),
        ("alternatives/autoencoder.py", "LATENT = 4", "LATENT = 5", "alternative"),
        ("plotting/style.py", "17.0", "18.0", "notebook"),
        ("book/page.py", "dpi: int = 200", "dpi: int = 100", "notebook"),
        ("diffusion/loop.py", "no TensorBoard logs", "TensorBoard keeps no logs", None),
        ("mechanics/inflation.py", '"""', '"""In other words: ', None),
        ("book/pdf.py", "1800", "3600", None),
        ("cli/design.py", "max=1000", "max=2000", None),
    ],
)
def test_a_change_makes_stale_what_runs_through_it_and_no_more(copy, module, before, after, first):
    folder, unchanged = copy
    steps, path = list(STEPS), folder / "inflate_lib" / module
    text = path.read_text(encoding="utf-8")
    assert before in text
    path.write_text(text.replace(before, after, 1), encoding="utf-8")
    try:
        stale = [step for step, version in versions(folder).items() if version != unchanged[step]]
    finally:
        path.write_text(text, encoding="utf-8")
    assert stale == (steps[steps.index(first) :] if first else [])
