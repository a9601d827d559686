"""The examples run as a newcomer runs them: in any folder, and with nothing to download."""

import os
import re
import subprocess
import sys

import pytest
from PIL import Image

from inflate_lib import paths


def test_quickstart_draws_verifies_and_shows(tmp_path):
    script = paths.ROOT / "examples" / "quickstart.py"
    assert len(script.read_text(encoding="utf-8").splitlines()) <= 40
    environment = {name: value for name, value in os.environ.items() if name != "INFLATE_MNIST_DIR"}
    environment |= {"INFLATE_HOME": str(paths.ROOT), "INFLATE_CACHE": str(tmp_path / "cache"), "MPLBACKEND": "Agg"}
    done = subprocess.run(
        [sys.executable, script, "seen.png"], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    inflated, mean = re.search(r"(\d+) of 50 drawings inflate, to height ([\d.]+)", done.stdout).groups()
    wanted, best, error = re.search(r"wanted ([\d.]+), .* the best ([\d.]+): ([\d.]+) % off", done.stdout).groups()
    assert int(inflated) >= 45 and float(mean) == pytest.approx(float(wanted), rel=0.03)
    assert float(error) < 0.5
    assert float(best) == pytest.approx(float(wanted), rel=0.006)
    with Image.open(tmp_path / "seen.png") as picture:
        assert min(picture.size) > 200
    assert sorted(os.listdir(tmp_path)) == ["cache", "seen.png"], "nothing else is written"
    assert os.listdir(tmp_path / "cache") == ["written"], "nothing is downloaded; the record of the picture is kept"
