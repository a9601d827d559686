"""``inflate dataset``: simulate the data set."""

from typing import Annotated

import typer

from inflate_lib.cli.app import app


@app.command()
def dataset(
    source: Annotated[str, typer.Option(help="auto, mnist or digits.")] = "auto",
    structures: Annotated[int | None, typer.Option(help="How many sevens (all by default).")] = None,
    jobs: Annotated[int | None, typer.Option(help="Processes (one per core by default).")] = None,
    backend: Annotated[str | None, typer.Option(help="loky, threading, multiprocessing, sequential.")] = None,
    dask: Annotated[str | None, typer.Option(help="Address of a Dask scheduler that works: tcp://host:8786.")] = None,
) -> None:
    """Inflate the sevens, store the data set, print a summary."""
    from inflate_lib.datasets.simulate import simulated_sevens

    if backend and dask:
        raise ValueError("--backend says who works here, --dask who works elsewhere: give one of them")
    print(simulated_sevens(source=source, n_structures=structures, n_jobs=jobs, backend=dask or backend))
