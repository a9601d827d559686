"""What the benchmarks share: clocks, the machine's name, and tables in data/reference with a note beside each."""

import json
import os
import platform
import time
from contextlib import suppress
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from rich.console import Console
from rich.table import Table

from inflate_lib import paths
from inflate_lib._cache import code_version
from inflate_lib._provenance import PACKAGES

PEERS = ("felupe", "scikit-fem", "diffusers", "denoising-diffusion-pytorch")


def seconds(task, *arguments):
    """Processor time of one call and its result. Other programs on the machine do not count, nor does waiting."""
    start = time.process_time()
    result = task(*arguments)
    return time.process_time() - start, result


def machine():
    """Processor and number of cores, in words."""
    model = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else ():
        if line.startswith("model name"):
            model = line.split(":")[1].strip()
            break
    return {"processor": model, "cores": os.cpu_count(), "system": f"{platform.system()} {platform.machine()}"}


def _versions(*packages):
    """Of those that are installed."""
    found = {}
    for package in packages:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def store(frame, name, made_by, digits=6, **note):
    """Print a table, write it to data/reference/<name>.csv to so many digits, and its origin to <name>.json."""
    table = Table(title=name)
    for column in frame:
        table.add_column(column, justify="left" if frame[column].dtype == object else "right")
    for row in frame.itertuples(index=False):
        table.add_row(*(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row))
    Console(width=160).print(table)
    for title, value in note.items():
        print(f"  {title}: {value}")
    frame.to_csv(paths.REFERENCE / f"{name}.csv", index=False, float_format=f"%.{digits}g")
    note = {
        "made_by": f"benchmarks/{made_by}",
        **note,
        "machine": machine(),
        "date": date.today().isoformat(),
        "python": platform.python_version(),
        "packages": _versions(*PACKAGES, *PEERS),
        "code_version": code_version("inflate_lib.structures", "inflate_lib.mechanics"),
    }
    (paths.REFERENCE / f"{name}.json").write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")
