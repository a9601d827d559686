"""The book as one PDF file: its pages joined into one by Sphinx, and printed by Chromium. No LaTeX."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from inflate_lib import paths
from inflate_lib._files import draft
from inflate_lib.book.build import check_built, run_jupyter_book

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_APPLICATIONS = ("Chromium.app/Contents/MacOS/Chromium", "Google Chrome.app/Contents/MacOS/Google Chrome")  # macOS
_FLAGS = ("--headless=new", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars", "--no-first-run")
_PATIENCE = 300_000  # milliseconds of the page's own clock that MathJax may take
_TIMEOUT = 1800  # seconds after which Chromium is ended


def _find_chromium() -> Path | None:
    """The browser that ``INFLATE_CHROMIUM`` names, else a Chromium or Chrome where one is usually found, else None."""
    if named := os.environ.get("INFLATE_CHROMIUM"):
        found = shutil.which(named)
        if found is None:
            raise ValueError(f"INFLATE_CHROMIUM is {named}, which is no program")
        return Path(found)
    found = next(filter(None, map(shutil.which, _BROWSERS)), None)
    applications = (Path("/Applications", name) for name in _APPLICATIONS)
    return Path(found) if found else next((path for path in applications if path.is_file()), None)


def _sandbox_flags() -> list[str]:
    """Chromium refuses to run as root with its sandbox."""
    return ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []


def print_book() -> Path:
    """Write ``book/_build/pdf/book.pdf`` from the executed notebooks.

    Raises
    ------
    RuntimeError
        No book was built yet, there is no Chromium, Sphinx found something to complain about, or the browser wrote no
        PDF.
    """
    check_built()
    chromium = _find_chromium()
    if chromium is None:
        raise RuntimeError("no Chromium or Chrome found; install one (Debian: chromium), or set INFLATE_CHROMIUM to it")
    target = paths.BOOK / "_build" / "pdf" / "book.pdf"
    _print_page(chromium, run_jupyter_book("singlehtml"), target)
    return target


def _print_page(chromium: Path, page: Path, target: Path) -> None:
    """Print one HTML file, after its equations have been set, to a PDF file."""
    with tempfile.TemporaryDirectory() as folder:
        printed = Path(folder) / "book.pdf"
        words = [*_FLAGS, *_sandbox_flags(), f"--user-data-dir={folder}/profile", f"--virtual-time-budget={_PATIENCE}"]
        words += ["--no-pdf-header-footer", "--generate-pdf-document-outline"]
        words += [f"--print-to-pdf={printed}", page.resolve().as_uri()]
        try:
            done = subprocess.run([chromium, *words], capture_output=True, text=True, timeout=_TIMEOUT, check=False)
        except subprocess.TimeoutExpired:
            raise RuntimeError(f"{chromium} did not print {page} within {_TIMEOUT} s") from None
        if not printed.is_file() or not printed.read_bytes().startswith(b"%PDF"):
            raise RuntimeError(f"{chromium} wrote no PDF of {page}: {done.stderr.strip()[-500:]}")
        with draft(target) as place:
            shutil.copyfile(printed, place)
