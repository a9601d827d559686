"""What a large data set costs: seconds, memory and bytes of any number of structures, kept in parts.

    python benchmarks/large.py 4000 20000 60000
    python benchmarks/large.py 300000

Up to 60,000 these are MNIST's training digits in the order of the files; what is beyond are blends of two of them,
mirrored and moved (`inflate_lib.alternatives.Family`). Each size runs in a process of its own with a cache of its own,
which goes away afterwards, unless --folder keeps it. Sizes that were measured before stay in data/reference/large.csv.
The time of a run that went on after a kill is that of its last part only: measure it again for a time that counts.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer
from joblib.externals.loky import get_reusable_executor
from stored import store

from inflate_lib import paths
from inflate_lib.alternatives import open_parts, simulated_digits

CORES, DIGITS = 2, 60_000


def measured(size):
    """One row of the table; the data set is made in the cache of this process."""
    start = time.perf_counter()
    files = simulated_digits("all", "mnist", min(size, DIGITS), blends=max(0, size - DIGITS), n_jobs=CORES)
    wall = time.perf_counter() - start
    get_reusable_executor().shutdown(wait=True)  # only then do the processes count
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    data = open_parts(files)
    return {
        "structures": size,
        "blends": max(0, size - DIGITS),
        "converged": int(data.converged.sum()),
        "buildable": int(data.buildable.sum()),
        "seconds": wall,
        "core seconds": sum(one.ru_utime + one.ru_stime for one in used),
        "peak MB": used[0].ru_maxrss / 1e3,
        "peak MB of a worker": used[1].ru_maxrss / 1e3,
        "parts": len(files),
        "MB": sum(file.stat().st_size for file in files) / 1e6,
    }


def main(
    sizes: Annotated[list[int], typer.Argument(help="Numbers of structures.")],
    folder: Annotated[
        Path | None, typer.Option(help="Keep the data sets there, and go on with those of a run that was killed.")
    ] = None,
    inside: Annotated[bool, typer.Option("--inside", hidden=True)] = False,
):
    """Measure each size and add it to the table."""
    if inside:
        paths.CACHE.mkdir(parents=True, exist_ok=True)
        (paths.CACHE / "row.json").write_text(json.dumps(measured(sizes[0])))
        return
    file, rows = paths.REFERENCE / "large.csv", []
    with tempfile.TemporaryDirectory() as elsewhere:
        for size in sizes:
            cache = (folder or Path(elsewhere)).absolute() / str(size)
            if not (cache / "row.json").is_file():
                command = [sys.executable, __file__, "--inside", str(size)]
                subprocess.run(command, check=True, env={**os.environ, "INFLATE_CACHE": str(cache)})
            rows.append(json.loads((cache / "row.json").read_text()))
    table = pd.DataFrame(rows)
    if file.is_file():
        before = pd.read_csv(file)
        table = pd.concat([before[~before.structures.isin(table.structures)], table])
    table = table.sort_values("structures")
    store(
        table,
        "large",
        "large.py",
        data="MNIST training digits; beyond 60,000 blends of two of them, mirrored and moved",
        times=f"{CORES} processes on a machine that had other work to do: core seconds count, wall clock is longer",
    )


if __name__ == "__main__":
    typer.run(main)
