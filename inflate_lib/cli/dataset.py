"""``inflate dataset``: simulate the data set."""

from typing import Annotated

import typer

from inflate_lib.cli.app import app


@app.command()
def dataset(
    source: Annotated[str, typer.Option(help="auto, mnist or digits.")] = "auto",
    digits: Annotated[str, typer.Option(help="The sevens by default; all, or some: 0 3 7.")] = "",
    more: Annotated[list[str] | None, typer.Argument(hidden=True)] = None,
    structures: Annotated[int | None, typer.Option(help="How many digits (all by default).")] = None,
    test: Annotated[bool, typer.Option("--test", help="MNIST's test digits instead of its training digits.")] = False,
    blends: Annotated[int, typer.Option(min=0, help="Besides, so many blends of two, mirrored and shifted.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Of the blends.")] = 0,
    jobs: Annotated[int | None, typer.Option(help="Processes (one per core by default).")] = None,
    backend: Annotated[str | None, typer.Option(help="loky, threading, multiprocessing, sequential.")] = None,
    dask: Annotated[str | None, typer.Option(help="Address of a Dask scheduler that works: tcp://host:8786.")] = None,
) -> None:
    """Inflate the sevens, store the data set, print a summary.

    With --digits, --test or --blends the data set is kept in parts, and any number of structures fits into memory.
    """
    from inflate_lib.alternatives import simulated_digits
    from inflate_lib.datasets import simulated_sevens

    if backend and dask:
        raise ValueError("--backend says who works here, --dask who works elsewhere: give one of them")
    workers = jobs, dask or backend
    if not (digits or more or test or blends):
        print(simulated_sevens(source, structures, *workers))
        return
    text = "".join([digits, *(more or [])]).replace(",", "").replace(" ", "") or "7"
    if text != "all" and not text.isdecimal():
        raise ValueError(
            f"--digits takes all, or digits such as 0 3 7, not {' '.join([digits, *(more or [])]).strip()}"
        )
    wanted = text if text == "all" else [int(one) for one in text]
    files = simulated_digits(wanted, source, structures, test, blends, seed, *workers)
    size = sum(file.stat().st_size for file in files)
    print(f"{len(files)} parts, {size / 1e6:.1f} MB: {files[0].parent}/*.nc; xarray.open_mfdataset reads them as one")
