"""Where the time of an inflation goes, and how far its factorisations are from what the machine can multiply.

    python benchmarks/floor.py --repeats 3

The compiled march through the load steps is run once as plain Python, so that every compiled function that it calls
can be counted and timed by itself; what a call from Python costs is measured on an empty function and subtracted. The
rest, loops of the march itself and the set-up of the system, is what is missing from the time of a usual, compiled run.
"""

import time
from contextlib import contextmanager
from unittest import mock

import numpy as np
import pandas as pd
import typer
from numba import njit
from numba.core.dispatcher import Dispatcher
from stored import seconds, store
from threadpoolctl import threadpool_limits

from inflate_lib import build_mesh, inflate, label_image, load_sevens
from inflate_lib.mechanics import _kernels
from inflate_lib.mechanics.inflation import build_system

REFINEMENTS = (1, 4)
INTERPRETED = ("march", "_newton")  # what calls the parts


@njit
def _nothing(*arguments):
    return 0


@contextmanager
def counted(calls):
    """Within this context each compiled part of the march appends the seconds of each call to `calls[name]`."""

    def timed(name, function):
        def call(*arguments):
            begin = time.process_time()
            result = function(*arguments)
            end = time.process_time()
            _nothing(*arguments)
            calls.setdefault(name, []).append(2 * end - begin - time.process_time())
            return result

        return call

    parts = {name: part for name, part in vars(_kernels).items() if isinstance(part, Dispatcher)}
    plain = {name: parts.pop(name).py_func for name in INTERPRETED}
    with mock.patch.multiple(_kernels, **plain, **{name: timed(name, part) for name, part in parts.items()}):
        yield


def shares(mesh, repeats):
    """Calls, microseconds per call and share of the whole for each compiled function of one inflation."""
    with counted({}):
        inflate(mesh, 10)  # compiles `_nothing`
    totals, runs = [], []
    for _ in range(repeats):
        totals.append(seconds(inflate, mesh, 10)[0])
        runs.append({})
        with counted(runs[-1]):
            inflate(mesh, 10)
    total = float(np.median(totals))
    rows = []
    for name, calls in runs[0].items():
        one = max(0.0, float(np.median([run[name] for run in runs])))
        rows.append({"part": name.lstrip("_"), "calls": len(calls), "us_per_call": 1e6 * one})
        rows[-1]["share"] = len(calls) * one / total
    rows.sort(key=lambda row: -row["share"])
    rest = 1 - sum(row["share"] for row in rows)
    return pd.DataFrame([*rows, {"part": "rest", "calls": 1, "us_per_call": 1e6 * total * rest, "share": rest}])


def multiply_adds(mesh):
    """Multiply-adds of one LDLᵀ factorisation: s (s + 1) / 2 for a column with s entries below the diagonal.

    The two columns of a node with b blocks of 2 × 2 below have 2 b + 1 and 2 b, which makes (2 b + 1)².
    """
    pattern = build_system(mesh).pattern
    return int(np.sum((2 * np.diff(pattern.column_start) + 1) ** 2))


@njit(fastmath={"reassoc", "contract"})
def _dense_blocks(row, column, times):
    """`times` × the inner loop of the factorisation, on dense rows of 2 × 2 blocks that stay in the nearest cache."""
    for t in range(times):
        x00, x01, x10, x11 = row[t % 8, 0], row[t % 8, 1], row[t % 8, 2], row[t % 8, 3]
        for k in range(8, len(row)):
            l00, l01, l10, l11 = column[k, 0], column[k, 1], column[k, 2], column[k, 3]
            row[k, 0] -= x00 * l00 + x01 * l01
            row[k, 1] -= x00 * l10 + x01 * l11
            row[k, 2] -= x10 * l00 + x11 * l01
            row[k, 3] -= x10 * l10 + x11 * l11


def rates(repeats):
    """Multiply-adds per second of that loop and of NumPy's matrix product, one core."""
    n, blocks, times = 512, 136, 20_000
    a, row, column = np.random.default_rng(0).random((n, n)), np.full((blocks, 4), 1e-9), np.full((blocks, 4), 1e-9)
    _dense_blocks(row, column, 1)
    loop = min(seconds(_dense_blocks, row, column, times)[0] for _ in range(repeats))
    product = min(seconds(np.matmul, a, a)[0] for _ in range(repeats + 3))
    return {"dense blocks, compiled": 8 * (blocks - 8) * times / loop, "matrix product, NumPy": n**3 / product}


def main(repeats: int = 3):
    sevens = load_sevens(limit=1)
    label = label_image(sevens.images[0])
    with threadpool_limits(1):
        inflate(label)
        attainable = rates(repeats)
        parts, floors = [], []
        for refine in REFINEMENTS:
            mesh = build_mesh(label, refine)
            part = shares(mesh, repeats)
            parts.append(part.assign(refine=refine))
            one = float(part.us_per_call[part.part == "factorise"].iloc[0]) / 1e6
            count = multiply_adds(mesh)
            row = {"refine": refine, "unknowns": 2 * int(np.sum(~mesh.clamped)), "multiply_adds": count}
            row |= {"us": 1e6 * one, "giga_per_second": count / one / 1e9}
            floors.append(row | {f"fraction of {name}": count / one / rate for name, rate in attainable.items()})
    note = {"data": f"{sevens.description}, number 0; ten load steps, mean dilatation"}
    note["times"] = f"processor time on one core, median of {repeats} repeats"
    store(pd.concat(parts)[["refine", "part", "calls", "us_per_call", "share"]], "speed_parts", "floor.py", **note)
    rate = {f"{name}, 1e9 multiply-adds per second": value / 1e9 for name, value in attainable.items()}
    store(pd.DataFrame(floors), "speed_floor", "floor.py", **note, attainable=rate)


if __name__ == "__main__":
    typer.run(main)
