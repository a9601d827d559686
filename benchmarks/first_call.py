"""Seconds from the start of Python to the first inflated structure, with compiled code at hand and without.

    python benchmarks/first_call.py --repeats 3

Each run is a process of its own. The first finds an empty numba cache (cold), and leaves what the others find (warm).
"""

import json
import os
import subprocess
import sys
import tempfile
import time

import numpy as np
import pandas as pd
import typer
from stored import store

from inflate_lib import paths

FIRST = """
import json, time
from inflate_lib import inflate, label_image
imported = time.time()
import numpy as np
image = np.zeros((28, 28))
image[5:8, 8:18] = image[5:23, 15:18] = 1
label = label_image(image)
assert inflate(label).converged
first = time.time()
inflate(label)
used = time.process_time()
print(json.dumps([imported, first, time.time(), used]))
"""


def first_call(cache):
    """Seconds until imported, until the first result, of the second call, and of processor time in all."""
    environment = os.environ | {"NUMBA_CACHE_DIR": cache, "PYTHONPATH": str(paths.ROOT), "OMP_NUM_THREADS": "1"}
    start = time.time()
    done = subprocess.run([sys.executable, "-c", FIRST], env=environment, capture_output=True, text=True, check=True)
    imported, first, second, used = json.loads(done.stdout)
    return imported - start, first - start, second - first, used


def main(repeats: int = 3):
    with tempfile.TemporaryDirectory() as cache:
        cold = first_call(cache)
        warm = np.median([first_call(cache) for _ in range(repeats)], axis=0)
    columns = ("import_s", "first_result_s", "second_call_s", "processor_s")
    table = pd.DataFrame([cold, warm], columns=columns)
    table.insert(0, "cache", ["cold", "warm"])
    note = f"wall-clock seconds; warm: median of {repeats} runs, cold: one run"
    store(table, "speed_first_call", "first_call.py", times=note)


if __name__ == "__main__":
    typer.run(main)
