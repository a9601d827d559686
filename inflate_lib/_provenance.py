"""Where a result comes from: versions of packages, the commit of the code."""

import functools
import subprocess
from importlib import metadata
from typing import Any

from inflate_lib import paths

PACKAGES = ("numpy", "scipy", "numba", "scikit-image", "scikit-learn", "torch", "xarray", "matplotlib")


@functools.cache
def package_versions() -> dict[str, str]:
    """Versions of the packages that results depend on."""
    return {name: metadata.version(name) for name in PACKAGES}


@functools.cache
def code_state() -> dict[str, Any]:
    """The commit, and whether the code differs from it; "unknown" outside a git checkout."""

    def git(*words: str) -> str | None:
        if not paths.in_checkout():  # the folder may yet lie in a repository of the user's
            return None
        try:
            done = subprocess.run(["git", "-C", paths.ROOT, *words], capture_output=True, text=True, timeout=10)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    commit = git("rev-parse", "HEAD")
    changes = git("status", "--porcelain", "--", "inflate_lib", "notebooks")
    return {"commit": commit or "unknown", "uncommitted_changes": bool(changes) if commit else None}
