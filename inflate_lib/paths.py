"""Where files live: every path of the project is resolved here, never relative to the working folder.

Use the names through the module (``paths.CACHE``), so that a test can point them elsewhere.
Two environment variables move them:

``INFLATE_HOME``
    The checkout. Found by itself in an editable install, and from any folder inside a checkout.
``INFLATE_CACHE``
    The cache of expensive steps (default ``data/cache`` in the checkout); any disk with room will do.
"""

import os
from pathlib import Path


def _find_root() -> Path:
    """The checkout: ``INFLATE_HOME``, else the folder above the package, else one above the working folder."""
    if home := os.environ.get("INFLATE_HOME"):
        return Path(home).expanduser().resolve()
    package = Path(__file__).resolve().parent.parent
    for folder in (package, Path.cwd(), *Path.cwd().parents):
        if (folder / "notebooks" / "profiles").is_dir():
            return folder
    return package


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
CACHE = Path(os.environ.get("INFLATE_CACHE") or DATA / "cache").expanduser().resolve()
