"""Build the book from executed notebooks, and from nothing else."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import yaml
from rich.console import Console

from inflate_lib import paths
from inflate_lib._cache import digest
from inflate_lib._provenance import code_state
from inflate_lib.book._execution import strip_colour
from inflate_lib.book.run import RunError, find_notebooks, plan

SECONDS = 60.0  # what the pages take, roughly
_COMPLAINT = re.compile(r"\b(WARNING|ERROR|CRITICAL|SEVERE)\b")  # as Sphinx marks them


def build_book(profile_name: str, console: Console | None = None) -> Path:
    """Build ``book/_build/html`` with warnings as errors, after a check that every page is fresh under this profile.

    Where nothing has changed since the last time, that book is left as it is.
    """
    console = console or Console()
    check_book(profile_name)
    if warned := [line for job in plan(profile_name) for line in _warnings_in(job.executed)]:
        console.print("On stderr, left out of the book:", *warned, sep="\n", markup=False, highlight=False)
    build = paths.BOOK / "_build"
    whole, made_of = build / "complete", _made_of(profile_name)  # without it an earlier build broke off
    page = build / "html" / "index.html"
    before = whole.read_text() if whole.is_file() else None
    if before != made_of or not page.is_file():
        if before is None:  # Sphinx would keep the pages
            for folder in ("html", ".doctrees", ".jupyter_cache"):
                shutil.rmtree(build / folder, ignore_errors=True)
        whole.unlink(missing_ok=True)
        page = run_jupyter_book("html")
        whole.write_text(made_of)
    console.print(f"The book: {page}", highlight=False, soft_wrap=True)
    return page


def _made_of(profile_name: str) -> str:
    """The digest of all that pages are made of: files of the repository, executed notebooks, the profile's figures."""
    folders = paths.BOOK, paths.ROOT / "inflate_lib", paths.DATA, paths.FIGURES / profile_name
    folders += (paths.ROOT / "lab" / "built",)
    skipped = paths.BOOK / "_build", paths.CACHE
    files = [*paths.ROOT.glob("*.md"), *(path for folder in folders for path in folder.rglob("*.*"))]
    files = [path for path in sorted(files) if path.is_file() and "__pycache__" not in path.parts]
    files = [path for path in files if not any(map(path.is_relative_to, skipped))]
    return digest(json.dumps(code_state()), *(part for path in files for part in (str(path), path)))


def run_jupyter_book(builder: str) -> Path:
    """Run one of Jupyter Book's builders, warnings as errors; its first page, ``book/_build/<builder>/index.html``."""
    command = [sys.executable, "-c", "import sys; from jupyter_book.cli.main import main; sys.exit(main())"]
    options = ["--builder", builder, "-n", "-W", "--keep-going"]
    terminal = getattr(sys.stdout, "encoding", None) or "utf-8"
    environment = {**os.environ, "PYTHONIOENCODING": f"{terminal}:replace"}  # Sphinx must not die of a character
    complaints = []
    with subprocess.Popen(
        [*command, "build", str(paths.BOOK), *options],
        stderr=subprocess.PIPE, encoding=terminal, errors="replace", env=environment,
    ) as build:  # fmt: skip
        for line in build.stderr or ():
            print(line, end="", file=sys.stderr, flush=True)
            complaints += [strip_colour(line.strip())] if _COMPLAINT.search(line) else []
    page = paths.BOOK / "_build" / builder / "index.html"
    if build.returncode or not page.is_file():
        why = "Jupyter Book reported warnings or errors; each has to go before the book is built:"
        raise RunError("\n".join([why, *complaints]))
    return page


def check_book(profile_name: str) -> None:
    """Refuse a book with a missing, stale or other-profile page, or whose contents are not the notebooks there are."""
    problems = [f"{job.name}: {why}" for job in plan(profile_name) if (why := job.stale())]
    listed = set(_toc_notebooks())
    there = {notebook.stem for notebook in find_notebooks()}
    problems += [f"{name}: in book/_toc.yml, but there is no such notebook" for name in sorted(listed - there)]
    problems += [f"{name}: not in book/_toc.yml" for name in sorted(there - listed)]
    if problems:
        lines = [f"no book under profile {profile_name!r} from these notebooks:", *(f"  {p}" for p in problems)]
        raise RunError("\n".join([*lines, f"Run: inflate reproduce --profile {profile_name}"]))


def check_built() -> None:
    """Refuse to go on where no book was built, or where a notebook that it shows is gone."""
    whole = paths.BOOK / "_build" / "complete"
    gone = [name for name in _toc_notebooks() if not (paths.EXECUTED / f"{name}.ipynb").is_file()]
    if gone or not whole.is_file():
        raise RunError("there is no book yet: build it first, with `inflate book`")


def _warnings_in(executed: Path) -> list[str]:
    """What an executed notebook wrote to stderr, an entry for each cell that did."""
    cells = [cell for cell in nbformat.read(executed, as_version=4).cells if cell.cell_type == "code"]
    texts = ["".join(o.text for o in cell.outputs if o.get("name") == "stderr").strip() for cell in cells]
    return [f"  {executed.stem}, code cell {n}: {strip_colour(text)}" for n, text in enumerate(texts, 1) if text]


def _toc_notebooks() -> list[str]:
    contents = yaml.safe_load((paths.BOOK / "_toc.yml").read_text(encoding="utf-8"))
    chapters = [*contents.get("chapters", []), *(c for part in contents.get("parts", []) for c in part["chapters"])]
    return [Path(c["file"]).name for c in chapters if c.get("file", "").startswith("notebooks/")]
