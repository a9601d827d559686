"""A run of `simulate_dataset` in its own process, killed at random moments, with a log of every piece simulated."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter

import numpy as np

from inflate_lib._cache import digest
from inflate_lib.datasets.storage import load_dataset

PIECE = 2
RUN = """
import sys
import numpy as np
from inflate_lib.datasets import simulate
from inflate_lib._cache import digest
from inflate_lib.datasets.simulate import _simulate
from inflate_lib.datasets.storage import save_dataset

folder, backend = sys.argv[1:]

def logged(images, *rest):  # travels to the workers by value
    with open(folder + "/log", "a") as log:
        log.write(digest(images) + "\\n")
    return _simulate(images, *rest)

simulate.PIECE, simulate.ALONE, simulate._simulate = 2, 0, logged
data = simulate.simulate_dataset(np.load(folder + "/images.npy"), 2, folder=folder + "/pieces", backend=backend)
save_dataset(data, folder + "/data.nc")
"""


def run_and_kill(folder, images, backend, kills, seed=0):
    """Kill a run `kills` times and let the next one end.

    Returns the data set, how many pieces were simulated more than once, and the number of pieces that were stored at
    each kill. Fails where a piece that was stored is simulated again.
    """
    rng = np.random.default_rng(seed)
    np.save(folder / "images.npy", images)
    (folder / "log").touch()
    (folder / "pieces").mkdir()
    numbers = {digest(images[start : start + PIECE]): start for start in range(0, len(images), PIECE)}
    command = [sys.executable, "-c", RUN, str(folder), backend]

    def simulated():
        return [numbers[line] for line in (folder / "log").read_text().split()]

    def stored():
        return {int(path.name.split("-")[0]) for path in (folder / "pieces").glob("[0-9]*.npz")}

    stored_at_kills = []
    for _ in range(kills):
        before, known = stored(), len(simulated())
        pieces = len(before) + rng.integers(1, max(2, len(numbers) // (kills + 1)))
        process = subprocess.Popen(command, start_new_session=True)
        limit = time.monotonic() + 120
        while len(stored()) < pieces and process.poll() is None and time.monotonic() < limit:
            time.sleep(0.001)
        time.sleep(rng.uniform(0, 0.1))
        os.kill(process.pid, signal.SIGKILL)
        os.killpg(process.pid, signal.SIGKILL)  # loky's processes would wait five minutes for more work
        process.wait()
        assert process.returncode == -signal.SIGKILL, "the run ended before it was killed"
        assert not before & set(simulated()[known:])
        stored_at_kills.append(len(stored()))
    before, known = stored(), len(simulated())
    subprocess.run(command, check=True, timeout=300)
    assert not before & set(simulated()[known:])
    counts = Counter(simulated())
    assert set(counts) == stored() == set(numbers.values())
    return load_dataset(folder / "data.nc"), counts.total() - len(counts), stored_at_kills
