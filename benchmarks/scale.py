"""What a data set costs beyond its inflations: wall time × cores per structure, against the same steps in a bare loop.

    python benchmarks/scale.py --structures 640 --repeats 3

The bare loop labels, inflates, describes and looks for contact, one image after the other; everything above it is the
price of `simulate_dataset`: reading and checking, starting processes, sending, collecting, assembling. All run in turn
in each round, and the median counts. Then all sevens on two processes, started for the purpose, in ten load steps and
in one. Writes data/reference/scale.csv and scale.json, which says where it comes from.
"""

import time
from typing import Annotated

import numpy as np
import pandas as pd
import typer
from distributed import LocalCluster
from joblib.externals.loky import get_reusable_executor
from stored import store
from threadpoolctl import threadpool_limits

from inflate_lib import descriptors, simulate_dataset
from inflate_lib.datasets import simulate
from inflate_lib.mechanics import contact, inflation
from inflate_lib.structures import labels, sources

CORES = 2
WHOLE = {10: 60, 1: 35}  # load steps → seconds in which all sevens are to be done on two cores


def bare_loop(images, n_steps):
    for image in images:
        result = inflation.inflate(labels.label_image(image), n_steps=n_steps)
        descriptors.describe(result)
        if contact.first_contact(result) is not None:
            contact.self_contact(result)


def nominal_second(images):
    """Seconds that the inflations take here for each second that a time limit counts for them."""
    structures = [labels.label_image(image) for image in images]
    start = time.perf_counter()
    results = [inflation.inflate(label) for label in structures]
    taken, counted = time.perf_counter() - start, 0.0
    for result in results:
        system = inflation.build_system(result.mesh, result.element, result.lame)
        counted += result.factorisations * inflation.nominal_seconds(system)
    return taken / counted


def stop_processes():
    get_reusable_executor().shutdown(wait=True)


def seconds(function, *arguments, **options):
    start = time.perf_counter()
    function(*arguments, **options)
    return time.perf_counter() - start


def in_turn(images, n_steps, repeats, address):
    """Median seconds of each way to work, and the cores that it had."""
    options = {"n_steps": n_steps, "progress_text": False}
    ways = {
        "bare loop": (1, lambda: bare_loop(images, n_steps)),
        "1 process": (1, lambda: simulate_dataset(images, 1, **options)),
        "2 processes, to be started": (CORES, lambda: simulate_dataset(images, CORES, backend="loky", **options)),
        "2 processes, there already": (CORES, lambda: simulate_dataset(images, CORES, backend="loky", **options)),
        "2 threads": (CORES, lambda: simulate_dataset(images, CORES, backend="threading", **options)),
        "Dask, 2 workers": (CORES, lambda: simulate_dataset(images, backend=address, **options)),
    }
    taken = {name: [] for name in ways}
    for _ in range(repeats):
        stop_processes()
        for name, (_, work) in ways.items():
            taken[name].append(seconds(work))
    return {name: (cores, float(np.median(taken[name]))) for name, (cores, _) in ways.items()}


def row(way, n_steps, n, cores, taken, bare=np.nan):
    """One line of the table; `bare` is the bare loop's milliseconds per structure."""
    each = 1e3 * taken * cores / n
    return {
        "way": way, "load_steps": n_steps, "structures": n, "cores": cores, "seconds": taken, "ms": each,
        "overhead_ms": each - bare, "overhead_percent": 100 * (each / bare - 1),
    }  # fmt: skip


def main(
    n_structures: Annotated[
        int, typer.Option("--structures", help="Sevens with which the ways to work are compared.")
    ] = 640,
    repeats: Annotated[int, typer.Option(help="Rounds; the median counts.")] = 3,
    whole: Annotated[bool, typer.Option(help="Then time all sevens on two processes.")] = True,
):
    """Print the overhead per structure and how long all sevens take, and write both down."""
    sevens = sources.load_sevens("mnist")
    images, rows = sevens.images[:n_structures], []
    options = {"n_workers": CORES, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0", "host": "127.0.0.1"}
    with LocalCluster(**options) as cluster:
        simulate_dataset(images[:64], n_steps=1, backend=cluster.scheduler_address)  # load the solver everywhere
        bare_loop(images[:8], 1)
        for n_steps in WHOLE:
            taken = in_turn(images, n_steps, repeats, cluster.scheduler_address)
            bare = 1e3 * taken["bare loop"][1] / len(images)
            rows += [row(way, n_steps, len(images), cores, each, bare) for way, (cores, each) in taken.items()]
    for n_steps in WHOLE if whole else ():
        stop_processes()
        taken = seconds(simulate_dataset, sevens.images, CORES, n_steps, progress_text=False)
        rows.append(row("2 processes, to be started", n_steps, len(sevens.images), CORES, taken))

    print(f"bars: all sevens in {WHOLE[10]} s (ten load steps) and {WHOLE[1]} s (one)")
    second = nominal_second(images[:200])
    print(f"a second of a time limit took {second:.2f} s here")
    note = {"data": sevens.description, "repeats": repeats, "nominal_second": round(second, 3)}
    store(pd.DataFrame(rows), "scale", "scale.py", times="wall clock, median of the rounds", **note)


if __name__ == "__main__":
    simulate.ALONE = 0  # share out even a short benchmark
    with threadpool_limits(1):  # one core for everybody
        typer.run(main)
