"""Expensive steps, computed once: safe under two processes and a killed run.

A result is one file, ``data/cache/<kind>/<hash of its key><suffix>``, with a ``.json`` sidecar that holds the key in
clear text and the digest of the bytes. The sidecar is written last and is what makes a result count, so a reader never
sees a half-written file, and a damaged one is made again.
"""

import ast
import dataclasses
import errno
import functools
import hashlib
import importlib.util
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from inflate_lib import paths
from inflate_lib._files import FULL, draft
from inflate_lib._progress import Aside

#: What each expensive step runs through: the step that it builds on, and packages of its own. Imports run in the same
#: order and never upwards (`make lint` checks it), so that no step can run through a package that its key leaves out.
STEPS = {
    "dataset": ("structures", "mechanics", "descriptors", "datasets"),
    "model": ("dataset", "diffusion", "models"),
    "experiment": ("model", "experiments"),
    "alternative": ("experiment", "alternatives"),
    "notebook": ("alternative", "plotting", "io", "inverse", "book.profiles", "book.page", "book.explorer"),
}
_SPEAKERS = {"print", "warn", "track", "Progress", "tell", "tell_time"}  # whose text is not a result
_NO_ROOM = FULL | {errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EEXIST}
_verified: set[tuple[str, int, int]] = set()  # files whose digest this process has checked already


class CacheError(RuntimeError):
    """The cache cannot be written (full disk, read-only folder) or a step did not write its result."""


def cached(kind: str, key: Mapping, make: Callable[[Path, Path], None], suffix: str) -> Path:
    """Return the file of an expensive step, making it first where it is not there yet.

    Parameters
    ----------
    kind
        What is stored, as a folder name: ``"dataset"``, ``"model"``.
    key
        Everything that the result depends on: parameters, :func:`digest` of inputs, :func:`step_version` of the code.
        Values are numbers, strings, booleans, None, and lists, mappings or dataclasses of those.
    make
        ``make(target, scratch)`` writes the file `target` (a temporary name, moved into place on success). `scratch`
        is a folder that survives a killed run, for finished parts and checkpoints; it goes away on success.
    suffix
        End of the file name, with its dot: ``".nc"``.

    Returns
    -------
    Path
        The finished file. When another process is making it, this call waits for that one.

    Raises
    ------
    CacheError
        The cache folder cannot be written, or `make` left no file. Errors of `make` itself pass through.
    """
    text, result = _named(kind, key, suffix)
    if _is_whole(result):
        return result
    folder, name = result.parent, result.stem
    with writing():
        folder.mkdir(parents=True, exist_ok=True)
        with _locked(folder / f".{name}.lock", f"{kind} {name}"):
            if not _is_whole(result):  # another process may have made it while we waited
                _make(result, text, make, scratch=folder / f".{name}.scratch")
    return result


def kept(kind: str, key: Mapping, suffix: str) -> Path | None:
    """The file that :func:`cached` would return at once; None where it would have to be made."""
    _, result = _named(kind, key, suffix)
    return result if _is_whole(result) else None


def _named(kind, key, suffix):
    """The key as text, and the file that it names."""
    text = json.dumps(_plain(key), sort_keys=True, allow_nan=False)
    return text, paths.CACHE / kind / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}{suffix}"


@contextmanager
def writing() -> Iterator[None]:
    """Whatever keeps the cache from being written, a full disk or a read-only folder, as a clear CacheError."""
    try:
        yield
    except OSError as error:
        if error.errno in _NO_ROOM and _concerns_cache(error):
            raise CacheError(
                f"cannot write the cache {paths.CACHE}: {error.strerror}. Make room or set INFLATE_CACHE to "
                "another folder; finished parts are kept and the next run goes on from them."
            ) from error
        raise


def digest(*things: Any) -> str:
    """Content hash of arrays (values, shape and dtype), bytes, text or files (Path): 32 hexadecimal digits."""
    total = hashlib.sha256()
    for thing in things:
        if isinstance(thing, Path):
            with thing.open("rb") as stream:
                part = hashlib.file_digest(stream, "sha256").digest()
        elif isinstance(thing, bytes | bytearray | memoryview):
            part = hashlib.sha256(thing).digest()
        elif isinstance(thing, str):
            part = hashlib.sha256(b"text" + thing.encode()).digest()
        else:
            array = np.ascontiguousarray(thing)
            if array.dtype.hasobject:
                raise ValueError(f"digest() takes arrays of numbers, bytes, text or a Path, not {type(thing).__name__}")
            head = f"{array.dtype.str}{array.shape}".encode()
            part = hashlib.sha256(head + array.tobytes()).digest()
        total.update(part)
    return total.hexdigest()[:32]


@functools.cache
def step_version(step: str) -> str:
    """:func:`code_version` of all that a step runs through, by its name in `STEPS`: a part of the step's key."""
    parts = (step_version(part) if part in STEPS else code_version(f"inflate_lib.{part}") for part in STEPS[step])
    return digest(*parts)[:16]


def code_version(*modules: ModuleType | str | Path) -> str:
    """Hash of the code of modules (or their names, or source files), without what only speaks.

    A package counts with all it contains. Comments, docstrings and layout do not count, nor does the text that is
    printed, warned of or raised: a change of the code makes a result again, a better sentence does not. The errors of
    what a data set runs through are the exception: it keeps their text, as the reason why a structure has no result.
    """
    total = hashlib.sha256()
    for module in modules:
        for source in _sources(module):
            kept = not {source.parent.name, source.stem}.isdisjoint(STEPS["dataset"])
            total.update(_bare_code(source.read_text(encoding="utf-8"), errors=kept).encode())
    return total.hexdigest()[:16]


def _make(result: Path, key_text: str, make: Callable[[Path, Path], None], scratch: Path) -> None:
    """Write `result` and its sidecar; the caller holds the lock."""
    scratch.mkdir(exist_ok=True)
    note = _sidecar(result)
    with draft(result) as target:
        with redirect_stdout(Aside(sys.stdout)), _elsewhere():
            make(target, scratch)
        if not target.is_file():
            raise CacheError(f"the step that makes {result} wrote no file")
        sidecar = {"key": json.loads(key_text), "bytes": target.stat().st_size, "digest": digest(target)}
        note.unlink(missing_ok=True)  # from here to the last line the result does not count
    with draft(note) as target:
        target.write_text(json.dumps(sidecar, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    shutil.rmtree(scratch, ignore_errors=True)


def _is_whole(result: Path) -> bool:
    """Whether the result is there with the bytes that its sidecar promises."""
    try:
        state = result.stat()
        seen = (str(result), state.st_mtime_ns, state.st_size)
        promised = json.loads(_sidecar(result).read_text(encoding="utf-8"))
        if promised["bytes"] != state.st_size:
            return False
        if seen not in _verified:
            if promised["digest"] != digest(result):
                return False
            _verified.add(seen)
    except (OSError, ValueError, KeyError, TypeError):  # missing or unreadable: make it again
        return False
    return True


def _sidecar(result: Path) -> Path:
    return result.with_name(result.name + ".json")


@contextmanager
def _locked(path: Path, what: str) -> Iterator[None]:
    """Hold a lock that the operating system frees when its holder dies; say so when another process holds it."""
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        print(f"another process is computing {what}; waiting for it", file=Aside(sys.stdout), flush=True)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def _concerns_cache(error: OSError) -> bool:
    if error.filename is None:
        return not _has_room()
    return Path(os.fsdecode(error.filename)).resolve().is_relative_to(paths.CACHE.resolve())


@contextmanager
def _elsewhere() -> Iterator[None]:
    """A full disk that is not the cache's, such as a small ``/dev/shm``, is not to be taken for the cache's."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno in FULL and _has_room():
            raise RuntimeError(tell_full(error)) from error
        raise


def tell_full(error: OSError) -> str:
    """The sentence for a full disk whose error names no file: which folders have how much room."""
    folders = dict.fromkeys((str(paths.CACHE), tempfile.gettempdir(), "/dev/shm", os.getcwd()))
    room = [f"{folder} {shutil.disk_usage(folder).free / 1e6:,.1f} MB" for folder in folders if os.path.isdir(folder)]
    return (
        f"{error.strerror}, and no file was named. There is room for: {'; '.join(room)}. Processes that work side by "
        "side need some in /dev/shm."
    )


def _has_room() -> bool:
    """Whether a file of a megabyte can be written into the cache."""
    try:
        with tempfile.TemporaryFile(dir=paths.CACHE) as probe:
            probe.write(bytes(10**6))
    except OSError:
        return False
    return True


def _plain(value: Any) -> Any:
    """The value in JSON's own types, so that equal keys give equal text."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Mapping):
        return {str(name): _plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    raise ValueError(
        f"a cache key cannot hold {type(value).__name__}; use numbers, text, lists, or digest() of arrays and files"
    )


def _sources(module: ModuleType | str | Path) -> list[Path]:
    """The source files of a module, or of everything in a package, found without importing it."""
    if isinstance(module, Path):
        return [module]
    spec = module.__spec__ if isinstance(module, ModuleType) else importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise ValueError(f"no source found for module {module!r}")
    origin = Path(spec.origin)
    return sorted(origin.parent.rglob("*.py")) if origin.name == "__init__.py" else [origin]


def _bare_code(source: str, errors: bool) -> str:
    """The code without docstrings and messages; with the text of `errors`, or without."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            if ast.get_docstring(node, clean=False) is not None:
                node.body = node.body[1:] or [ast.Pass()]
        elif isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and not errors:
            node.exc.args = []
        elif isinstance(node, ast.Call) and _speaks(node):
            node.args = [argument for argument in node.args if not isinstance(argument, ast.Constant | ast.JoinedStr)]
    return ast.unparse(tree)


def _speaks(call: ast.Call) -> bool:
    """Whether a call only tells somebody something; what is printed to a file may be a result."""
    to_file = any(keyword.arg == "file" for keyword in call.keywords)
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    return name in _SPEAKERS and not to_file
