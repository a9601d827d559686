"""``inflate design``: structures for a target of one's own."""

import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from inflate_lib.cli.app import app, kill_is_ctrl_c

#: Options that a structure which is carried on does not leave without effect.
_OF_DRAWN = ("from_file", "out", "tolerance", "refine", "smooth", "seed", "size_mm", "depth_mm", "overwrite")


@app.command()
def design(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="Folder for the designs; new or empty, or --overwrite.")],
    height: Annotated[float | None, typer.Option(help="Height of the inflated structure; the frame is 1.")] = None,
    width: Annotated[float | None, typer.Option(help="Width of the inflated structure.")] = None,
    area: Annotated[float | None, typer.Option(help="Area of its convex hull.")] = None,
    stress: Annotated[
        float | None, typer.Option(help="Peak von Mises stress, where μ is 0.1644: 0.2 is σ/μ = 1.22.")
    ] = None,
    stretch: Annotated[float | None, typer.Option(help="Largest principal stretch.")] = None,
    axis: Annotated[Path | None, typer.Option(help="Medial axis: CSV, x,y per line from bottom to top.")] = None,
    outline: Annotated[Path | None, typer.Option(help="The inflated shape, drawn: SVG, or a two-coloured PNG.")] = None,
    outline_unit: Annotated[
        float | None, typer.Option(help="User units of that SVG (pixels of the PNG) per side of the frame [--size-mm].")
    ] = None,
    from_file: Annotated[
        Path | None, typer.Option("--from", help="Carry on a structure that the book's laboratory saved as JSON.")
    ] = None,
    number: Annotated[int, typer.Option("-n", "--number", min=1, max=1000, help="How many designs.")] = 12,
    tolerance: Annotated[float, typer.Option(help="Largest relative error of every target.")] = 0.01,
    prefer: Annotated[str | None, typer.Option(help="low-stress or high-stress, among those that fit.")] = None,
    min_void_mm: Annotated[float, typer.Option(help="Least width of the cavity.")] = 0.0,
    max_material_mm2: Annotated[float | None, typer.Option(help="Largest area of the wall.")] = None,
    symmetric: Annotated[
        bool, typer.Option("--symmetric", help="Only structures that are their own mirror image.")
    ] = False,
    keep_out_mm: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="Left, bottom, right, top of a region to keep out of."),
    ] = None,
    size_mm: Annotated[float, typer.Option(help="Side of the 28-pixel frame.")] = 100.0,
    depth_mm: Annotated[float, typer.Option(help="Thickness out of the plane.")] = 20.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the noise.")] = 0,
    seconds: Annotated[float, typer.Option(help="Stop the search after so long.")] = 90.0,
    candidates: Annotated[int, typer.Option(min=1, help="Stop the search after so many.")] = 4096,
    refine: Annotated[int, typer.Option(min=0, help="Inflations spent on each near miss, pixel by pixel.")] = 60,
    smooth: Annotated[
        bool,
        typer.Option("--smooth/--no-smooth", help="Smooth borders to cut; they meet an axis or outline less often."),
    ] = False,
    rubbers: Annotated[
        bool, typer.Option("--rubbers", help="Walls of two rubbers, one four times as stiff as the other.")
    ] = False,
    start_from: Annotated[
        str, typer.Option(help="Candidates: drawings of the model, the nearest training structures, or both.")
    ] = "both",
    profile: Annotated[
        str | None, typer.Option(help="Weights of this profile (the best in data/pretrained, else ci).")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the designs of an earlier run there; all else stays.")
    ] = False,
) -> None:
    """Design structures that inflate to a size or a shape of your own; every one is verified by inflating it.

    Give any of --height, --width, --area, --axis, or an --outline, in sides of the frame; the rest is in mm. With the
    joint model (data/pretrained/laptop, or inflate train --descriptor joint) --stress and --stretch may be asked for as
    well, or alone.
    """
    from inflate_lib.inverse.constraints import from_millimetres
    from inflate_lib.inverse.save import check_sizes, claimed_folder, write_designs
    from inflate_lib.inverse.search import design
    from inflate_lib.inverse.targets import read_targets

    check_sizes(size_mm=size_mm, depth_mm=depth_mm)
    if from_file is not None:
        source = context.get_parameter_source
        others = [one for one in context.command.params if one.name not in _OF_DRAWN]
        given = [one for one in others if (source(one.name or "") or source("out")) is source("from_file")]
        if given:
            names = ", ".join(max(one.opts, key=len) for one in given)
            raise ValueError(f"--from carries on one drawing, towards the targets in its file: leave out {names}")
        _carry_on(from_file, out, tolerance, refine, seed, smooth, size_mm, depth_mm, overwrite)
        return
    if outline_unit is not None and outline is None:
        raise ValueError("--outline-unit is the unit of a drawn outline: leave it out, or give --outline")
    unit = size_mm if outline_unit is None else outline_unit
    targets = read_targets(axis, outline, unit, height=height, width=width, area=area, stress=stress, stretch=stretch)
    constraints = from_millimetres(size_mm, min_void_mm, max_material_mm2, symmetric, keep_out_mm)
    inputs = [path for path in (axis, outline) if path is not None]
    kill_is_ctrl_c()
    try:
        with claimed_folder(out, number, overwrite, inputs) as folder:
            found = design(
                targets, number, profile=profile, start_from=start_from, constraints=constraints, tolerance=tolerance,
                prefer=prefer, seed=seed, seconds=seconds, max_candidates=candidates, refine=refine,
                smooth=smooth, rubbers=rubbers,
            )  # fmt: skip
            print(found.summary())
            if found.designs:
                print(found.table().to_string(index=False, float_format="{:.4g}".format))
            start = time.monotonic()
            write_designs(found, folder, size_mm, depth_mm)
    except KeyboardInterrupt:
        print(f"inflate: interrupted; nothing was written to {out}", file=sys.stderr)
        raise typer.Exit(130) from None
    print(f"written in {time.monotonic() - start:.1f} s: {out / 'contact_sheet.png'}, and a folder for each design")
    if sum(one.within for one in found.designs) < number:
        raise typer.Exit(2)


def _carry_on(file, out, tolerance, refine, seed, smooth, size_mm, depth_mm, overwrite):
    """Write the structure of a file as a design."""
    from inflate_lib.inverse.drawn import continue_drawn
    from inflate_lib.inverse.save import claimed_folder, write_designs

    with claimed_folder(out, 1, overwrite, [file]) as folder:
        found = continue_drawn(file, tolerance, refine, seed, smooth)
        print(found.table().to_string(index=False, float_format="{:.4g}".format))
        write_designs(found, folder, size_mm, depth_mm)
    print(f"written: {out / 'contact_sheet.png'}, and the folder {out / 'design_01'}")
    if not found.designs[0].within:
        raise typer.Exit(2)
