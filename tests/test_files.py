"""Files and folders are there whole or not at all, whatever stops their writer."""

import errno
import os
import signal
import subprocess
import sys

import pytest

from inflate_lib._files import draft, naming

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


def test_a_folder_takes_the_place_of_the_one_before(tmp_path):
    path = tmp_path / "folder"
    for name in ("first", "second"):
        with draft(path) as place:
            place.mkdir()
            (place / name).touch()
        assert os.listdir(path) == [name]
    assert os.listdir(tmp_path) == ["folder"]


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
    with pytest.raises(FileNotFoundError) as missing, draft(path) as place:
        place.read_text()
    assert missing.value.filename == str(path)
    with pytest.raises(FileNotFoundError) as another, draft(path):
        (tmp_path / "another").read_text()
    assert another.value.filename == str(tmp_path / "another")
    with pytest.raises(ConnectionRefusedError) as refused, draft(path):
        raise OSError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))
    assert refused.value.filename is None
