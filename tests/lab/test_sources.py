"""The laboratory's own tests, which need Node and its packages, and nothing of a browser."""

import shutil
import subprocess

import pytest

from inflate_lib import paths

LAB = paths.ROOT / "lab"
pytestmark = pytest.mark.skipif(
    shutil.which("npm") is None or not (LAB / "node_modules").is_dir(),
    reason="NO TEST OF THE LABORATORY'S SOURCES: needs Node, and `npm ci` in lab/",
)


@pytest.mark.parametrize("script", ["check", "test"])
def test_the_sources_pass(script):
    done = subprocess.run(["npm", "run", script], cwd=LAB, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
