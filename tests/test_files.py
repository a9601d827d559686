"""Files are there whole or not at all, whatever stops their writer, and nothing of a user's is in their way."""

import errno
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from inflate_lib import _files, paths
from inflate_lib._files import check_outputs, draft, hand_out, hand_out_folder, naming
from inflate_lib.book.card import write_card
from inflate_lib.diffusion import storage
from inflate_lib.diffusion.loop import _Log
from inflate_lib.models.reach import check_reach_file
from inflate_lib.models.train import pack


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setattr(paths, "CACHE", tmp_path_factory.mktemp("cache"))


KILLED = """
import os, signal, sys
from inflate_lib._files import draft

with draft(sys.argv[1]) as place:
    place.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def kill_a_writer(path):
    done = subprocess.run([sys.executable, "-c", KILLED, str(path)])
    assert done.returncode == -signal.SIGKILL


@pytest.mark.parametrize("durable", [False, True])
def test_a_file_takes_its_place_when_it_is_whole(tmp_path, durable):
    path = tmp_path / "new" / "file.txt"
    for text in ("first", "second"):
        with draft(path, durable) as place:
            assert place.name == "file.txt" and not place.exists()
            place.write_text(text)
            assert not path.exists() or path.read_text() == "first"
        assert path.read_text() == text
    assert os.listdir(path.parent) == ["file.txt"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("broken"), OSError(errno.ENOSPC, "No space left")])
def test_what_stops_the_writer_leaves_the_file_as_it_was(tmp_path, error):
    def fail():
        with draft(tmp_path / "file") as place:
            place.write_text("new")
            raise error

    (tmp_path / "file").write_text("old")
    with pytest.raises(type(error)):
        fail()
    assert (tmp_path / "file").read_text() == "old"
    assert os.listdir(tmp_path) == ["file"]


def test_a_killed_writer_leaves_the_file_as_it_was_and_the_next_one_tidies_up(tmp_path):
    path, other = tmp_path / "file [1]", tmp_path / "file [1].json"
    path.write_text("old")
    kill_a_writer(path)
    kill_a_writer(other)
    at_work = tmp_path / f".{path.name}.{os.getppid()}.x.partial"
    at_work.mkdir()
    assert path.read_text() == "old" and not other.exists() and len(os.listdir(tmp_path)) == 4
    for name in (path, other):
        with draft(name) as place:
            place.write_text("new")
    assert sorted(os.listdir(tmp_path)) == sorted([at_work.name, path.name, other.name])


def test_an_error_names_the_file(tmp_path):
    path = tmp_path / "file"
    with pytest.raises(OSError, match="No space left on device") as full, naming(path), open("/dev/full", "w") as file:
        file.write("text")
    assert full.value.filename == str(path)
    with (
        pytest.raises(OSError, match="No space left on device") as numpy,
        naming(path),
        open("/dev/full", "wb") as file,
    ):
        np.zeros(9999).tofile(file)
    assert numpy.value.filename == str(path)
    with pytest.raises(FileNotFoundError) as missing, draft(path) as place:
        place.read_text()
    assert missing.value.filename == str(path)
    with pytest.raises(FileNotFoundError) as another, draft(path):
        (tmp_path / "another").read_text()
    assert another.value.filename == str(tmp_path / "another")
    with pytest.raises(ConnectionRefusedError) as refused, draft(path):
        raise OSError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))
    assert refused.value.filename is None


def write(path, text="ours"):
    with hand_out(path) as place:
        place.write_text(text)


def test_only_what_is_as_it_was_written_is_replaced(tmp_path, monkeypatch):
    path = tmp_path / "new" / "file.txt"
    write(path)
    write(path, "again")
    assert path.read_text() == "again" and os.listdir(path.parent) == ["file.txt"]
    for text in ("a user changed it", "ours"):  # the second is what had been written before the last time
        path.write_text(text)
        with pytest.raises(FileExistsError, match=r"file\.txt is there already"):
            write(path)
        assert path.read_text() == text
    path.unlink()
    write(path)
    path.rename(tmp_path / "moved.txt")
    with pytest.raises(FileExistsError):
        write(tmp_path / "moved.txt")
    monkeypatch.setattr(paths, "CACHE", tmp_path / "moved.txt" / "no cache")
    write(path)  # without a cache, and so without a record
    with pytest.raises(FileExistsError):
        write(path)


def test_a_link_is_followed(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "link.txt").symlink_to(tmp_path / "disk" / "target")
    (tmp_path / "folder").symlink_to(tmp_path / "disk")
    for text in ("first", "second"):
        write(tmp_path / "link.txt", text)
        assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "disk" / "target").read_text() == text
        write(tmp_path / "folder" / "file", text)
    assert sorted(os.listdir(tmp_path / "disk")) == ["file", "target"]
    assert sorted(os.listdir(tmp_path)) == ["disk", "folder", "link.txt"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("broken"), OSError(errno.ENOSPC, "No space left")])
def test_a_set_of_files_is_there_whole_or_not_at_all(tmp_path, error):
    def hand(fail):
        with hand_out_folder(tmp_path / "new" / "set") as place:
            (place / "a").write_text(f"a {fail}")
            (place / "deep").mkdir()
            (place / "deep" / "b").write_text("b")
            if fail:
                raise error

    with pytest.raises(type(error)):
        hand(fail=True)
    assert os.listdir(tmp_path) == []
    hand(fail=False)
    (tmp_path / "new" / "set" / "mine").write_text("mine")
    with pytest.raises(type(error)):
        hand(fail=True)
    assert sorted(os.listdir(tmp_path / "new" / "set")) == ["a", "deep", "mine"]
    assert (tmp_path / "new" / "set" / "a").read_text() == "a False"
    (tmp_path / "new" / "set" / "deep" / "b").write_text("mine")
    with pytest.raises(FileExistsError, match=r"deep/b is there already"):
        hand(fail=False)
    assert sorted(os.listdir(tmp_path / "new" / "set")) == ["a", "deep", "mine"]


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in.png").write_text("input")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link.png").symlink_to("in.png")
    (tmp_path / "hard.png").hardlink_to("in.png")
    (tmp_path / "here").symlink_to(".")
    (tmp_path / "loop.png").symlink_to("loop.png")
    os.mkfifo("fifo.png")
    return tmp_path


@pytest.mark.parametrize(
    ("outputs", "message"),
    [
        (["in.png"], "input in.png"),
        (["./in.png"], "input in.png"),
        (["folder/../in.png"], "input in.png"),
        (["{here}/in.png"], "input in.png"),
        (["here/in.png"], "input in.png"),
        (["link.png"], "input in.png"),
        (["hard.png"], "input in.png"),
        (["IN.png"], "input in.png"),
        (["In.PNG"], "input in.png"),
        (["a.png", "./a.png"], "two files"),
        (["a.png", "A.png"], "two files"),
        (["folder/a.png", "here/folder/a.png"], "two files"),
        (["caf\u00e9.png", "cafe\u0301.png"], "two files"),
        (["folder"], "is a folder"),
        (["fifo.png"], "is there already"),
        (["/dev/null"], "is there already"),
        (["loop.png"], "is there already"),
        (["new/a.png", "new"], "a file and a folder"),
        (["in.png/a.png"], "in.png is no folder"),
        (["a" * 300], "too long"),
        (["/proc/a.png"], "cannot be written"),
    ],
)
def test_outputs_that_cannot_be_are_refused_before_the_work(place, outputs, message):
    before = sorted(os.listdir(place))
    with pytest.raises(OSError, match=message):
        check_outputs([one.format(here=place) for one in outputs], ["in.png"])
    assert sorted(os.listdir(place)) == before and (place / "in.png").read_text() == "input"


def test_outputs_that_can_be_are_not(place):
    check_outputs(["a.png", "new/deep/a.png", "folder/b.png", "x" * 250], ["in.png", "missing.png"])
    assert "new" not in os.listdir(place)
    write("x" * 250)
    assert (place / ("x" * 250)).read_text() == "ours"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_named(place):
    (place / "folder").chmod(0o555)
    with pytest.raises(OSError, match=r"folder/a\.png cannot be written: Permission denied"):
        check_outputs(["folder/a.png"])


def test_one_run_at_a_time_has_a_folder(place):
    with _files.locked(place), pytest.raises(BlockingIOError, match="another run"), _files.locked(place):
        pass
    with _files.locked(place):
        pass


def test_files_of_a_kind_replace_their_kind_alone(tmp_path):
    """Weights, logs, tables and cards are known by what they hold: they may come from another machine."""
    for name in ("model.safetensors", "pack.safetensors", "history.csv", "reach.npz", "README.md"):
        (tmp_path / name).write_text("step,mine\n1,2\n")
    before = {path.name: path.read_text() for path in tmp_path.iterdir()}
    for write_it in (
        lambda: storage.check_files([tmp_path / "model.safetensors"], "model"),
        lambda: pack(tmp_path / "pack.safetensors", ["height"], None, None),
        lambda: _Log(tmp_path, 0),
        lambda: check_reach_file(tmp_path),
        lambda: write_card(tmp_path, None, None),
    ):
        with pytest.raises(FileExistsError, match="is there already"):
            write_it()
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == before
    storage.check_files(paths.PRETRAINED.glob("laptop/*.safetensors"), "model")
    check_reach_file(paths.PRETRAINED / "laptop")
