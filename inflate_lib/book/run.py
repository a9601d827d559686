"""Reproduce the notebooks under a profile, and build the book from them and from nothing else.

An executed notebook carries the fingerprint of everything that it depends on. It is *fresh* while that is unchanged and
the files that it published are still there; only notebooks that are not fresh run again.
"""

import functools
import json
import os
import platform
import re
import signal
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from enum import StrEnum
from itertools import groupby
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from filelock import FileLock, Timeout
from rich.console import Console
from rich.table import Table

from inflate_lib import paths
from inflate_lib._cache import digest, step_version
from inflate_lib._progress import Bars, Display, Lines, Schedule
from inflate_lib._provenance import package_versions
from inflate_lib.book._execution import Kernels, execute
from inflate_lib.book.profiles import Profile, check_profile, load_profile
from inflate_lib.models import RETRAIN
from inflate_lib.models.recipe import Recipe
from inflate_lib.structures.sources import CHOSEN, resolve_source

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
#: loky replaces a worker that has grown by 300 MB, as one that trains a second model may, and says so with a warning.
_RESTARTED = "ignore:A worker stopped while some jobs were given to the executor:UserWarning"
_DATA = {"mnist": "MNIST", "digits": "the embedded digits"}


class RunError(RuntimeError):
    """A run, or a book, that cannot be made as things are."""


class _Stale(StrEnum):
    """Why a notebook has to run."""

    ABSENT = "It has not been executed yet."
    FOREIGN = "What is in its place is not a notebook that this command made."
    PROFILE = "It was executed under the profile {}."
    CHANGED = "What it depends on has changed: {}."
    EDITED = "It was edited after it was executed."
    INCOMPLETE = "A file that it published is missing: {}."


@dataclass(frozen=True)
class _Job:
    """One notebook under one profile."""

    source: Path
    parameters: dict[str, Any]
    recipe: Recipe
    fingerprint: dict[str, Any]

    @property
    def name(self) -> str:
        return self.source.stem

    @property
    def executed(self) -> Path:
        return paths.EXECUTED / f"{self.name}.ipynb"

    def stale(self) -> str:
        """Why the notebook has to run; empty while its executed version is fresh."""
        try:
            notebook = json.loads(self.executed.read_text(encoding="utf-8"))
            stamp = notebook["metadata"]["inflate"]
            edited = stamp["cells"] != _content(notebook)
        except FileNotFoundError:
            return _Stale.ABSENT
        except (OSError, ValueError, KeyError, TypeError):
            return _Stale.FOREIGN
        before, now = stamp["fingerprint"], self.fingerprint
        if before.get("profile") != now["profile"]:
            return _Stale.PROFILE.format(before.get("profile"))
        if changed := [part for part in now if before.get(part) != now[part]]:
            return _Stale.CHANGED.format(", ".join(changed))
        if edited:
            return _Stale.EDITED
        gone = [file for file in stamp["published"] if not (paths.FIGURES / file).is_file()]
        return _Stale.INCOMPLETE.format((paths.FIGURES / gone[0]).relative_to(paths.ROOT)) if gone else ""


def executed_under(notebook: Path) -> dict[str, str] | None:
    """Profile and data source (None where it uses no data) of an executed notebook; None where it is not one."""
    try:
        stamp = json.loads(notebook.read_text(encoding="utf-8"))["metadata"]["inflate"]["fingerprint"]
        return {"profile": stamp["profile"], "source": stamp["data source"]}
    except (OSError, ValueError, KeyError, TypeError):
        return None


def plan(profile_name: str, only: Sequence[str] = ()) -> list[_Job]:
    """All jobs of a profile, in order, after every check that can be made before anything runs.

    Raises
    ------
    ProfileError
        The profile does not fit its layout or the notebooks.
    RunError
        `only` names no notebook, or more than one; or two notebooks have the same number.
    """
    notebooks = find_notebooks()
    profile = load_profile(profile_name)
    check_profile(profile, notebooks)
    chosen = [_match(name, notebooks) for name in only] if only else notebooks
    for number, same in groupby(chosen if not only else (), key=lambda notebook: notebook.stem[:2]):
        if len(twins := list(same)) > 1:
            raise RunError(f"notebooks: two have the number {number}, {_named(twins)}; take one out of the folder")
    shared = _shared_fingerprint()
    return [_job(profile, notebook, shared) for notebook in sorted(set(chosen))]


def find_notebooks() -> list[Path]:
    """The sources ``NN_name.md``, in order."""
    notebooks = sorted(paths.NOTEBOOKS.glob("[0-9][0-9]_*.md"))
    if not notebooks:
        raise RunError(f"no notebooks NN_name.md in {paths.NOTEBOOKS}; is INFLATE_HOME set to the checkout?")
    return notebooks


def reading_minutes(notebook: Path) -> int:
    """Minutes that the text and the captions of a notebook take: 200 words each, and twenty seconds for an equation."""
    cells = jupytext.read(notebook).cells
    captions = [cell.metadata.get("mystnb", {}).get("figure", {}).get("caption", "") for cell in cells]
    text = "\n".join([cell.source for cell in cells if cell.cell_type == "markdown"] + captions)
    text, equations = re.subn(r"\$\$.*?\$\$|^```bash.*?^```", " ", text, flags=re.DOTALL | re.MULTILINE)
    words = len(re.findall(r"\w\S*", re.sub(r"\$[^$]*\$", "x", text)))  # a formula in a line counts as a word
    return round(words / 200 + equations / 3)


def reproduce(
    profile_name: str,
    only: Sequence[str] = (),
    jobs: int = 2,
    force: bool = False,
    console: Console | None = None,
    then: float = 0.0,
) -> None:
    """Execute every notebook of the profile that is not fresh, several side by side.

    The old version of a notebook that has to run is deleted first, so that a failed run leaves nothing stale behind.
    `then` is how many seconds the caller goes on for afterwards: a part of the time left that is shown.

    Raises
    ------
    RuntimeError
        As ``NotebookFailed``: the first notebook that failed, with its cell and error; running ones are ended.
    RunError
        The data source is another one than that of the notebooks executed before, and nobody asked for it.
    """
    console = console or Console()
    if jobs < 1:
        raise RunError(f"--jobs is {jobs}; at least one notebook has to run")
    with _only_run():
        work = plan(profile_name, only)
        _check_source(work)
        reasons = {job.name: "forced" if force else job.stale() for job in work}
        todo = [job for job in work if reasons[job.name]]
        names = {notebook.stem for notebook in find_notebooks()}
        for old in paths.EXECUTED.glob("*.ipynb"):
            renamed = old.stem not in names and executed_under(old) is not None  # not a notebook of somebody's own
            if renamed or any(old == job.executed for job in todo):
                old.unlink()
        for job in work:
            console.print(f"{job.name}: {reasons[job.name] or 'fresh'}", highlight=False)
        jobs = min(jobs, max(1, len(todo)))
        profile = load_profile(profile_name)
        budgets = profile.budgets(job.source for job in work)
        todo.sort(key=lambda job: -budgets.get(job.name, 0.0))  # the longest first: none runs alone at the end
        schedule = Schedule({job.name: budgets[job.name] for job in todo if budgets}, jobs, then)
        seconds = _run(todo, jobs, console, schedule, profile.first)
    _print_timings(console, profile_name, work, seconds, budgets)


def _job(profile: Profile, notebook: Path, shared: dict[str, Any]) -> _Job:
    parameters, recipe = profile.parameters(notebook), profile.recipe_of(notebook)
    fingerprint = {
        "profile": profile.name,
        "notebook": digest(notebook.read_bytes()),
        "parameters": digest(json.dumps(parameters, sort_keys=True)),
        "recipe": digest(json.dumps(asdict(recipe), sort_keys=True)),
        "data source": _resolved(recipe.source),
        **shared,
    }
    return _Job(notebook, parameters, recipe, fingerprint)


def _shared_fingerprint() -> dict[str, Any]:
    """What every notebook may depend on: the library without this runner, the reference numbers, weights, versions."""
    data = sorted(p for folder in (paths.REFERENCE, paths.PRETRAINED) for p in folder.rglob("*") if p.is_file())
    return {
        "library": step_version("notebook"),
        "data folder": digest(*(part for path in data for part in (path.name, path))),
        "weights": "trained anew" if RETRAIN in os.environ else "committed where they fit",
        "packages": package_versions(),
        "python": ".".join(platform.python_version_tuple()[:2]),
    }


@functools.cache
def _resolved(source: str) -> str:
    return resolve_source(source)


def _check_source(work: list[_Job]) -> None:
    """Other data would execute everything again: that has to be asked for."""
    if chosen := os.environ.get(CHOSEN):
        if named := {source for job in work if (source := job.fingerprint["data source"]) not in (None, chosen)}:
            raise RunError(f"--source {chosen}: this profile names its source itself, {', '.join(named)}")
        return
    for job in work:
        before, now = executed_under(job.executed), job.fingerprint["data source"]
        if not before or job.recipe.source != "auto" or before["profile"] != job.fingerprint["profile"]:
            continue
        if before["source"] not in (None, now):
            raise RunError(
                f"{job.name} was executed on {_DATA[before['source']]}, and the source 'auto' means {_DATA[now]} now: "
                f"every notebook would run again. Say --source {now} if that is meant, or --source {before['source']} "
                "to stay with what was executed."
            )


def _match(name: str, notebooks: list[Path]) -> Path:
    """The notebook that ``inflation``, ``05_inflation``, ``04`` or ``4`` means."""
    split = {notebook: notebook.stem.partition("_") for notebook in notebooks}
    found = [n for n, (number, _, title) in split.items() if name in (n.stem, title) or name.zfill(2) == number]
    if not found:
        raise RunError(f"--only {name}: there is no such notebook; there are: {', '.join(n.stem for n in notebooks)}")
    if len(found) > 1:
        raise RunError(f"--only {name}: there are {_named(found)}; say which, by its whole name")
    return found[0]


def _named(notebooks: Sequence[Path]) -> str:
    """Their names, as those of files that may have spaces in them."""
    return " and ".join(repr(notebook.stem) for notebook in notebooks)


def _run(
    todo: list[_Job], jobs: int, console: Console, schedule: Schedule, first: str | None = None
) -> dict[str, float]:
    """Execute the jobs, the one of that name alone before the others; seconds by name.

    The first failure, Ctrl-C or a kill ends all that still run.
    """
    threads = str(max(1, (os.cpu_count() or 1) // jobs))
    environment = {name: os.environ.get(name, threads) for name in _THREADS}
    environment |= {"INFLATE_HOME": str(paths.ROOT), "INFLATE_CACHE": str(paths.CACHE), "PYTHONHASHSEED": "0"}
    environment["PYTHONWARNINGS"] = ",".join(filter(None, [os.environ.get("PYTHONWARNINGS"), _RESTARTED]))
    display = Bars(console, schedule) if console.is_terminal else Lines(console, schedule)
    seconds = {}
    many = len(todo) > 2 * jobs
    with _kill_is_ctrl_c(), display, Kernels(environment, many) as kernels, ThreadPoolExecutor(jobs) as pool:
        try:
            for group in ([job for job in todo if job.name == first], [job for job in todo if job.name != first]):
                for future in as_completed([pool.submit(_timed, job, kernels, display) for job in group]):
                    name, time_taken = future.result()
                    seconds[name] = time_taken
                    display.finished(name, time_taken)
        except BaseException as error:
            kernels.stop()
            pool.shutdown(cancel_futures=True)
            if isinstance(error, KeyboardInterrupt):
                raise RunError("stopped; run the same command again to go on") from None
            raise
    return seconds


def _timed(job: _Job, kernels: Kernels, display: Display) -> tuple[str, float]:
    start = time.monotonic()
    execute(job.source, job.executed, job.parameters, kernels, display, finish=functools.partial(_stamp, job))
    return job.name, time.monotonic() - start


def _stamp(job: _Job, notebook: nbformat.NotebookNode, manifest: Path) -> None:
    """Write into the executed notebook what it was made from; remove figures that an older version published."""
    published = sorted(set(manifest.read_text(encoding="utf-8").split("\n")) - {""})
    cells = _content(json.loads(nbformat.writes(notebook)))
    notebook.metadata["inflate"] = {"fingerprint": job.fingerprint, "published": published, "cells": cells}
    folder = paths.FIGURES / job.fingerprint["profile"]
    for note in folder.glob("*.json"):
        origin = json.loads(note.read_text(encoding="utf-8"))
        if origin.get("notebook") == job.name and f"{folder.name}/{note.name}" not in published:
            for file in [*origin.get("files", []), note.name]:
                (folder / file).unlink(missing_ok=True)


def _content(notebook: dict[str, Any]) -> str:
    """What would show that somebody edited an executed notebook: the digest of its cells, as they are in the file."""
    return digest(json.dumps(notebook["cells"], sort_keys=True))


@contextmanager
def _only_run():
    """Two runs at once would delete each other's notebooks."""
    paths.EXECUTED.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(paths.EXECUTED / ".lock", timeout=0):
            yield
    except Timeout as error:
        raise RunError("another `inflate reproduce` is at work in this checkout; wait for it") from error


@contextmanager
def _kill_is_ctrl_c():
    """A plain `kill` ends the kernels in the same orderly way as Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _print_timings(
    console: Console, profile: str, work: list[_Job], seconds: dict[str, float], budgets: dict[str, float]
) -> None:
    table = Table(title=f"Profile {profile}")
    table.add_column("notebook")
    table.add_column("minutes to read", justify="right")
    table.add_column("seconds to run", justify="right")
    table.add_column("budget", justify="right")
    for job in work:
        took, budget = seconds.get(job.name), budgets.get(job.name)
        ran = "fresh" if took is None else f"{took:.1f}" + " (over budget)" * (took > (budget or took))
        table.add_row(job.name, str(reading_minutes(job.source)), ran, f"{budget:.0f}" if budget else "")
    console.print(table)
