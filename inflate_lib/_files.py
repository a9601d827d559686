"""Files that are there whole or not at all: written beside their place, then moved into it in one operation."""

import errno
import glob
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}  # what a full disk says, without the name of the file


@contextmanager
def draft(path: str | os.PathLike, durable: bool = False) -> Iterator[Path]:
    """A place to write a file, or a folder, that takes its own place once it is whole.

    The place has the name of `path` and lies in a hidden folder beside it. Where the writing fails, nothing changes;
    what a killed process left there is swept by the next one that writes the same file.

    Parameters
    ----------
    path
        The file or folder to make or to replace; folders above it are made.
    durable
        Wait until the file is on the disk, so that it survives a loss of power; for a checkpoint.

    Raises
    ------
    OSError
        With the name of `path`, also where the disk is full.
    """
    final = Path(path).absolute()
    final.parent.mkdir(parents=True, exist_ok=True)
    _sweep(final)
    with naming(path):
        beside = tempfile.mkdtemp(prefix=f".{final.name}.{os.getpid()}.", suffix=".partial", dir=final.parent)
    place = Path(beside) / final.name
    try:
        with naming(path):
            yield place
            if durable:
                _flush(place)
            _move(place, final)
    except OSError as error:
        if str(error.filename).startswith(beside):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        shutil.rmtree(beside, ignore_errors=True)


@contextmanager
def naming(path: str | os.PathLike) -> Iterator[None]:
    """Give the name of the file to the error of a full disk, which leaves it out."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno in FULL:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def _flush(path: Path) -> None:
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def _move(place: Path, final: Path) -> None:
    """Put what was written in its place. A folder cannot be replaced in one operation: the old one steps aside."""
    before = place.with_name(f"{final.name}.before")
    if final.is_dir():
        os.replace(final, before)
    try:
        os.replace(place, final)
    except OSError:
        if before.exists():
            os.replace(before, final)
        raise


def _sweep(final: Path) -> None:
    """Remove what was left beside a file by processes that are no more."""
    for left in final.parent.glob(f".{glob.escape(final.name)}.*.partial"):
        if not _runs(left.name[len(final.name) + 2 :].split(".")[0]):
            shutil.rmtree(left, ignore_errors=True)


def _runs(number: str) -> bool:
    """Whether a process of this number is alive."""
    try:
        os.kill(int(number), 0)
    except PermissionError:
        return True
    except (OSError, ValueError, OverflowError):
        return False
    return True
