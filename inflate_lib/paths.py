"""Where files live: every path of the project is resolved here, never relative to the working folder.

Use the names through the module (``paths.CACHE``), so that a test can point them elsewhere.
Two environment variables move them:

``INFLATE_HOME``
    The checkout. Found by itself in an editable install, and from any folder inside a checkout.
``INFLATE_CACHE``
    The cache of expensive steps (default ``data/cache`` in the checkout, ``~/.cache/inflate-lib`` without one); any
    disk with room will do.

Without a checkout, ``ROOT`` is the installed package, which carries the committed weights and the paper's numbers.
"""

import os
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def _find_root() -> Path:
    """The checkout: ``INFLATE_HOME``, else the folder above the package, else one above the working folder."""
    if home := os.environ.get("INFLATE_HOME"):
        return Path(home).expanduser().resolve()
    for folder in (_PACKAGE.parent, Path.cwd(), *Path.cwd().parents):
        if (folder / "notebooks" / "profiles").is_dir():
            return folder
    return _PACKAGE


def _find_cache() -> Path:
    if given := os.environ.get("INFLATE_CACHE"):
        return Path(given).expanduser().resolve()
    if ROOT != _PACKAGE:
        return DATA / "cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser().resolve() / "inflate-lib"


ROOT = _find_root()
NOTEBOOKS = ROOT / "notebooks"
PROFILES = NOTEBOOKS / "profiles"
BOOK = ROOT / "book"
EXECUTED = BOOK / "notebooks"
REPORTS = BOOK / "_build" / "reports"  # notebooks that failed, kept for a look, never part of the book
FIGURES = ROOT / "figures" / "runs"  # a folder for each profile, made by whoever runs its notebooks
EDITION = ROOT / "figures" / "laptop"  # the published edition, which git keeps
DATA = ROOT / "data"
REFERENCE = DATA / "reference"
PRETRAINED = DATA / "pretrained"
CACHE = _find_cache()


def in_checkout() -> bool:
    """Whether notebooks, profiles and the book are there; an installed package has none of them."""
    return PROFILES.is_dir()


def need_checkout(what: str) -> None:
    """RuntimeError, with what to do, where there is no checkout.

    Parameters
    ----------
    what : str
        What was asked for, as the subject of the message: ``"inflate book"``.
    """
    if not in_checkout():
        raise RuntimeError(
            f"{what} works in a checkout of the repository alone, which has the notebooks and their profiles: call it "
            f"there, or let INFLATE_HOME name that folder (it is {ROOT} now)"
        )
