"""Files that are there whole or not at all, and that take the place of nothing but the program's own.

What is written stands beside its place first and is moved into it in one operation (:func:`draft`). What a user names
is handed out by :func:`hand_out`, which replaces a file only where a record says that the program wrote it as it is;
:func:`check_outputs` says before the work what would be refused after it.
"""

import errno
import glob
import hashlib
import os
import shutil
import tempfile
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from inflate_lib import paths

fcntl: Any
try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}  # what a full disk says, without the name of the file
_PARTIAL = ".partial"  # ends the name of a folder in which something is being written
_at_work: set[Path] = set()  # those of this process


@contextmanager
def draft(path: str | os.PathLike, durable: bool = False) -> Iterator[Path]:
    """A place to write a file that takes its own place once it is whole.

    The place has the name of `path` and lies in a hidden folder beside it. Where the writing fails, nothing changes;
    what a killed process left there is swept by the next one that writes the same file.

    Parameters
    ----------
    path
        The file to make or to replace; folders above it are made.
    durable
        Wait until the file is on the disk, so that it survives a loss of power; for a checkpoint.

    Raises
    ------
    OSError
        With the name of `path`, also where the disk is full.
    """
    final = Path(path).absolute()
    final.parent.mkdir(parents=True, exist_ok=True)
    with _partial(final.parent, f".{final.name[:40]}", path) as beside:  # with all of a long name it would be too long
        place = beside / final.name
        yield place
        if durable:
            _flush(place)
        os.replace(place, final)


def written_before(path: str | os.PathLike) -> bool:
    """Whether a file is, byte for byte, what the program last wrote there: so says a record in the cache."""
    try:
        return _record(path).read_text(encoding="ascii") == file_digest(path)
    except (OSError, ValueError):
        return False


def read_by(read: Callable[[Path], Any]) -> Callable[[Path], bool]:
    """The same for files of the program's own kind, which no record needs to tell: whether its reader takes them."""

    def ours(path: Path) -> bool:
        try:
            read(path)
        except (OSError, ValueError):
            return False
        return True

    return ours


@contextmanager
def hand_out(path: str | os.PathLike, ours: Callable[[Path], bool] = written_before) -> Iterator[Path]:
    """A place to write a file that a user named; it takes its own place once it is whole.

    Parameters
    ----------
    path
        Folders above it are made; a link is followed.
    ours
        Says of a file that is there already whether the program wrote it, so that it may be replaced.

    Raises
    ------
    OSError
        As :func:`check_outputs`, and with the name of `path`, also where the disk is full.
    """
    check_outputs([path], ours=ours)
    path, final = Path(path), Path(os.path.realpath(path))
    with hand_out_folder(final.parent, ours) as folder, naming(path):
        yield folder / path.name
        os.replace(folder / path.name, folder / final.name)


@contextmanager
def hand_out_folder(folder: str | os.PathLike, ours: Callable[[Path], bool] = written_before) -> Iterator[Path]:
    """A folder to write files in, which take their places in `folder`, under the same names, once all are whole.

    What else is in `folder` stays as it is. Parameters and errors are those of :func:`hand_out`.
    """
    folder = Path(os.path.realpath(folder))
    inner = not _at_work.isdisjoint((folder, *folder.parents))  # the outer one checks and records
    with made(folder), _partial(folder, "inflate", folder) as place:
        yield place
        names = [file.relative_to(place) for file in sorted(place.rglob("*")) if not file.is_dir()]
        if not inner:
            check_outputs([folder / name for name in names], ours=ours)
        for name in names:
            final = Path(os.path.realpath(folder / name))
            final.parent.mkdir(parents=True, exist_ok=True)
            os.replace(place / name, final)
            if not inner:
                _keep_record(final)


def check_outputs(
    outputs: Iterable[str | os.PathLike],
    inputs: Iterable[str | os.PathLike] = (),
    ours: Callable[[Path], bool] = written_before,
) -> None:
    """Refuse, before the work, outputs that would destroy something or could not be written.

    Parameters
    ----------
    outputs, inputs
        Files that will be written, and those that are read.
    ours
        See :func:`hand_out`.

    Raises
    ------
    OSError
        Where an output is an input, by any name or link; where two outputs have one name; where a folder, a device, or
        a file that the program did not write is there already; and where its folder cannot be written. Names that
        differ by capitals alone count as one, as they do on some disks.
    """
    sources: dict[Any, Any] = {}
    for given in inputs:
        sources |= dict.fromkeys((_folded(os.path.realpath(given)), _identity(given)), given)
    sources.pop(None, None)  # an input that is not there has no identity
    places, folders = set(), {}
    for path in outputs:
        final = Path(os.path.realpath(path))
        key = _folded(final)
        if source := sources.get(key) or sources.get(_identity(final)):
            raise FileExistsError(f"{path} would take the place of the input {source}: give it another name")
        if key in places:
            raise FileExistsError(f"two files would have the name {path}: give them, or the inputs, other names")
        if final.is_dir():
            raise IsADirectoryError(f"{path} is a folder: give the name of a file")
        if os.path.lexists(final) and not (final.is_file() and ours(final)):
            raise FileExistsError(f"{path} is there already, not as inflate wrote it: give another name, or move it")
        places.add(key)
        folders.setdefault(final.parent, path)
    existing = {}
    for folder, path in folders.items():
        above = (folder, *folder.parents)
        if not places.isdisjoint(map(_folded, above)):
            raise NotADirectoryError(f"{folder} would be a file and a folder: give other names")
        existing.setdefault(next(one for one in above if os.path.lexists(one)), path)
    for folder, path in existing.items():
        if not folder.is_dir():
            raise NotADirectoryError(f"{path} cannot be written: {folder} is no folder")
        try:
            tempfile.TemporaryFile(dir=folder).close()
        except OSError as error:
            raise OSError(f"{path} cannot be written: {error.strerror or error}") from None


@contextmanager
def made(folder: Path) -> Iterator[None]:
    """Make a folder and those above it; what of them is empty in the end is removed again."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for path in missing:
            with suppress(OSError):
                path.rmdir()


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep a folder for this run, until it ends or dies; a BlockingIOError where another one has it."""
    if fcntl is None:
        yield
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BlockingIOError(f"another run is writing into {folder}: wait, or give another folder") from None
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(number)


def sweep(folder: Path, name: str = "inflate") -> None:
    """Remove what was left half-written in a folder by processes that are no more."""
    for left in folder.glob(f"{glob.escape(name)}.*{_PARTIAL}"):
        if not _runs(left.name[len(name) + 1 :].split(".")[0]):
            shutil.rmtree(left, ignore_errors=True)


def file_digest(path: str | os.PathLike) -> str:
    """SHA-256 of a file, as ``sha256sum`` prints it."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@contextmanager
def naming(path: str | os.PathLike) -> Iterator[None]:
    """Give the name of the file to the error of a full disk, which leaves it out."""
    try:
        yield
    except OSError as error:
        if error.filename is None and (error.errno in FULL or "requested and" in str(error)):  # NumPy has no errno
            code = error.errno or errno.ENOSPC
            raise OSError(code, error.strerror or os.strerror(code), str(path)) from error
        raise


@contextmanager
def _partial(folder: Path, name: str, path: str | os.PathLike) -> Iterator[Path]:
    """A place in `folder` that is gone in the end; an error names `path`, or what in `folder` it would have become."""
    sweep(folder, name)
    with naming(path):
        partial = Path(tempfile.mkdtemp(prefix=f"{name}.{os.getpid()}.", suffix=_PARTIAL, dir=folder))
    at_work = Path(os.path.realpath(partial))
    _at_work.add(at_work)
    try:
        with naming(path):
            yield partial
    except OSError as error:
        if not str(error.filename).startswith(str(partial)):
            raise
        final = folder / os.path.relpath(error.filename, partial)
        raise OSError(error.errno, error.strerror, str(path if final == Path(path).absolute() else final)) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        _at_work.discard(at_work)


def _record(path: str | os.PathLike) -> Path:
    """Where the digest of what the program wrote to a file is kept."""
    name = os.fsencode(os.path.realpath(path))
    return paths.CACHE / "written" / hashlib.sha256(name).hexdigest()


def _keep_record(path: Path) -> None:
    """Without a record, as in a cache that cannot be written, the file is never replaced."""
    with suppress(OSError):
        _record(path).parent.mkdir(parents=True, exist_ok=True)
        _record(path).write_text(file_digest(path), encoding="ascii")


def _folded(path: str | os.PathLike) -> str:
    """A path in which capitals do not count, nor how an accent is encoded."""
    return unicodedata.normalize("NFC", os.fspath(path)).casefold()


def _identity(path: str | os.PathLike) -> tuple[int, int] | None:
    """What all names of one file have in common; None where there is no file."""
    try:
        state = os.stat(path)
    except OSError:
        return None
    return state.st_dev, state.st_ino


def _flush(path: Path) -> None:
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def _runs(number: str) -> bool:
    """Whether a process of this number is alive."""
    try:
        os.kill(int(number), 0)
    except PermissionError:
        return True
    except (OSError, ValueError, OverflowError):
        return False
    return True
