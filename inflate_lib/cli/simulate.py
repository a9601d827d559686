"""``inflate simulate``: inflate structures in image files."""

from pathlib import Path
from typing import Annotated

import typer

from inflate_lib.cli.app import app, kill_is_ctrl_c


@app.command()
def simulate(
    images: Annotated[
        list[Path],
        typer.Argument(help="PNG, …: 28 × 28, white on black; or .npy. All pages, frames and rows are read."),
    ],
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Picture: undeformed, and deformed and coloured.")] = None,
    gif: Annotated[Path | None, typer.Option(help="Animation of the load steps (.gif).")] = None,
    vtk: Annotated[Path | None, typer.Option(help="ParaView: out.pvd with one out_000.vtu, … per load step.")] = None,
    moose: Annotated[Path | None, typer.Option(help="Folder for MOOSE's input (.i) and mesh (.e).")] = None,
    engine: Annotated[str, typer.Option(help="built-in, or moose where it is on the PATH.")] = "built-in",
    colour: Annotated[str, typer.Option(help="von-mises or stretch.")] = "von-mises",
    lame: Annotated[tuple[float, float], typer.Option(help="Lamé parameters λ and μ.")] = (16.44, 0.1644),
    pressure: Annotated[float | None, typer.Option(help="Pressure at t = 1 (0.01 by default).")] = None,
    steps: Annotated[int | None, typer.Option(min=1, max=10_000, help="Load steps (10 by default).")] = None,
    history: Annotated[
        str | None, typer.Option(help="One pressure per load step instead: 0.005,0.01,0, or a file with one per line.")
    ] = None,
    rubbers: Annotated[
        float | None,
        typer.Option(help="Walls of two rubbers, grey levels 64 (stiff) and 127: how stiff, in units of the soft one."),
    ] = None,
    wall: Annotated[int, typer.Option(min=1, max=12, help="Thickness of the wall in pixels.")] = 2,
    clamp: Annotated[str, typer.Option(help="Clamped edge: bottom, left, top or right.")] = "bottom",
    refine: Annotated[int, typer.Option(min=1, max=16, help="Elements per pixel and direction.")] = 1,
    element: Annotated[
        str, typer.Option(help="mean-dilatation, q1 (plain), or stabilised (MOOSE's).")
    ] = "mean-dilatation",
    contact: Annotated[bool, typer.Option("--contact", help="Walls push one another away, not through.")] = False,
    resize: Annotated[bool, typer.Option("--resize", help="Fit pictures of another size into 28 × 28.")] = False,
    invert: Annotated[bool, typer.Option("--invert", help="For black on white.")] = False,
) -> None:
    """Inflate the structures in image files: descriptors, picture, animation, ParaView, MOOSE.

    With several structures, the name of each goes into the names of its files. Exit code 1 where one failed.
    """
    kill_is_ctrl_c()
    from inflate_lib.cli._images import Options, read_history, report, simulate_files
    from inflate_lib.mechanics.inflation import PRESSURE

    if history is not None and (pressure, steps) != (None, None):
        raise ValueError("history gives the pressures and their number: leave out --pressure and --steps")
    if history is not None:
        pressure = read_history(history)
    options = Options(
        lame=lame, pressure=PRESSURE if pressure is None else pressure, n_steps=steps, wall=wall, clamped=clamp,
        refine=refine, element=element, contact=contact, resize=resize, invert=invert, colour=colour, engine=engine,
        plot=plot, gif=gif, vtk=vtk, moose=moose, rubbers=rubbers,
    )  # fmt: skip
    inputs = [] if history is None else [history]
    if report(simulate_files(images, options, inputs), json, options):
        raise typer.Exit(1)
