"""How long somebody waits for designs: the command ``inflate design``, from the prompt to the files on the disk.

    python benchmarks/design.py

asks for one design and for twelve, for several kinds of targets, with the committed weights and all candidates from the
model, each in a process of its own, and writes data/reference/design.csv and design.json beside it. Seconds are those
of the clock on the wall: they mean what they say on a machine that does nothing else.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pandas as pd
from stored import store

TARGETS = {
    "height 1.05, width 0.95": ["--height", "1.05", "--width", "0.95"],
    "height 1.15": ["--height", "1.15"],
    "area 0.8": ["--area", "0.8"],
    "height 1.1, stress 0.26": ["--height", "1.1", "--stress", "0.26"],
}


def run(words, n):
    """One row: the command, timed, and what it found."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "designs"
        start = time.monotonic()
        words = [*words, "--start-from", "model", "-n", str(n), "--out", out]
        command = [sys.executable, "-m", "inflate_lib", "design", *words]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        seconds = time.monotonic() - start
        if done.returncode not in (0, 2):  # 2: fewer than asked for are within the tolerance
            raise SystemExit(done.stderr)
        table = pd.read_csv(out / "designs.csv")
    errors = table[[name for name in table if name.startswith("error")]].max(axis=1)
    return {"seconds": seconds, "within 1 %": int((errors <= 1).sum()), "median of the largest errors": errors.median()}


def main():
    load = os.getloadavg()[0]
    rows = [{"targets": name, "n": n} | run(words, n) for name, words in TARGETS.items() for n in (1, 12)]
    store(pd.DataFrame(rows), "design", "design.py", load_average=[round(load, 1), round(os.getloadavg()[0], 1)])


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.partition("\n")[0]).parse_args()
    main()
