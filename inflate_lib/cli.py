"""The command ``inflate``: reproduce the notebooks, build the book, simulate, make the data set, train a model."""

import os
import platform
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    help="Inverse design of inflatable structures with denoising diffusion: the runnable companion of the paper.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
ProfileName = Annotated[str, typer.Option(help="A file in notebooks/profiles, without .yml: ci, laptop, paper.")]
Jobs = Annotated[int, typer.Option(help="Notebooks side by side.")]
Force = Annotated[bool, typer.Option("--force", help="Execute fresh notebooks too.")]
Retrain = Annotated[bool, typer.Option("--retrain", help="Train the models, though data/pretrained has their weights.")]


@app.callback()
def main(debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False) -> None:
    """Set the way in which errors are shown."""
    if debug:
        os.environ["INFLATE_DEBUG"] = "1"


@app.command()
def reproduce(
    profile: ProfileName = "ci",
    only: Annotated[list[str] | None, typer.Option(help="One notebook, by number or name; may be repeated.")] = None,
    jobs: Jobs = 2,
    force: Force = False,
    retrain: Retrain = False,
) -> None:
    """Execute the notebooks under a profile and regenerate their figures and tables."""
    from inflate_lib.reproduce import reproduce

    _set_retrain(retrain)
    reproduce(profile, only or (), jobs, force)


@app.command()
def book(profile: ProfileName = "ci", jobs: Jobs = 2, force: Force = False, retrain: Retrain = False) -> None:
    """Execute what is not fresh, then build the book with warnings as errors."""
    from inflate_lib.reproduce import build_book, reproduce

    _set_retrain(retrain)
    reproduce(profile, (), jobs, force)
    build_book(profile)


@app.command()
def pdf() -> None:
    """Print the book that was built last as one PDF file, with Chromium."""
    from inflate_lib.printing import print_book

    print(f"The book on paper: {print_book()}")


@app.command()
def dataset(
    source: Annotated[str, typer.Option(help="auto, mnist or digits.")] = "auto",
    structures: Annotated[int | None, typer.Option(help="How many sevens (all by default).")] = None,
    jobs: Annotated[int | None, typer.Option(help="Processes (one per core by default).")] = None,
    backend: Annotated[str | None, typer.Option(help="loky, threading, multiprocessing, sequential.")] = None,
    dask: Annotated[str | None, typer.Option(help="Address of a Dask scheduler that works: tcp://host:8786.")] = None,
) -> None:
    """Inflate the sevens, store the data set, print a summary."""
    from inflate_lib.datasets import simulated_sevens

    if backend and dask:
        raise ValueError("--backend says who works here, --dask who works elsewhere: give one of them")
    print(simulated_sevens(source=source, n_structures=structures, n_jobs=jobs, backend=dask or backend))


@app.command()
def simulate(
    images: Annotated[
        list[Path], typer.Argument(help="PNG, …: 28 × 28, white on black; or .npy with one image or a stack.")
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
    wall: Annotated[int, typer.Option(min=1, max=12, help="Thickness of the wall in pixels.")] = 2,
    clamp: Annotated[str, typer.Option(help="Clamped edge: bottom, left, top or right.")] = "bottom",
    refine: Annotated[int, typer.Option(min=1, max=16, help="Elements per pixel and direction.")] = 1,
    element: Annotated[str, typer.Option(help="mean-dilatation or q1.")] = "mean-dilatation",
    resize: Annotated[bool, typer.Option("--resize", help="Fit pictures of another size into 28 × 28.")] = False,
    invert: Annotated[bool, typer.Option("--invert", help="For black on white.")] = False,
) -> None:
    """Inflate the structures in image files: descriptors, picture, animation, ParaView, MOOSE.

    With several structures, the name of each goes into the names of its files. Exit code 1 where one failed.
    """
    from inflate_lib.inflation import PRESSURE
    from inflate_lib.simulate import Options, read_history, report, simulate_files

    if history is not None and (pressure, steps) != (None, None):
        raise ValueError("history gives the pressures and their number: leave out --pressure and --steps")
    if history is not None:
        pressure = read_history(history)
    options = Options(
        lame=lame, pressure=PRESSURE if pressure is None else pressure, n_steps=steps, wall=wall, clamped=clamp,
        refine=refine, element=element, resize=resize, invert=invert, colour=colour, engine=engine, plot=plot, gif=gif,
        vtk=vtk, moose=moose,
    )  # fmt: skip
    if report(simulate_files(images, options), json, options):
        raise typer.Exit(1)


@app.command()
def design(
    out: Annotated[Path, typer.Option(help="Folder for the designs; new or empty.")],
    height: Annotated[float | None, typer.Option(help="Height of the inflated structure; the frame is 1.")] = None,
    width: Annotated[float | None, typer.Option(help="Width of the inflated structure.")] = None,
    area: Annotated[float | None, typer.Option(help="Area of its convex hull.")] = None,
    stress: Annotated[
        float | None, typer.Option(help="Peak von Mises stress, in the units of λ and μ (16.44 and 0.1644).")
    ] = None,
    stretch: Annotated[float | None, typer.Option(help="Largest principal stretch.")] = None,
    axis: Annotated[Path | None, typer.Option(help="Medial axis: CSV, x,y per line from bottom to top.")] = None,
    outline: Annotated[Path | None, typer.Option(help="The inflated shape, drawn: SVG, or a two-coloured PNG.")] = None,
    outline_unit: Annotated[
        float | None, typer.Option(help="User units of that SVG (pixels of the PNG) per side of the frame [--size-mm].")
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
    profile: Annotated[
        str | None, typer.Option(help="Weights of this profile (the best in data/pretrained, else ci).")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is in the folder.")] = False,
) -> None:
    """Design structures that inflate to a size or a shape of your own; every one is verified by inflating it.

    Give any of --height, --width, --area, --axis, or an --outline, in sides of the frame; the rest is in mm. With the
    joint model (data/pretrained/laptop, or inflate train --descriptor joint) --stress and --stretch may be asked for as
    well, or alone.
    """
    from inflate_lib.constraints import from_millimetres
    from inflate_lib.design_files import check_folder, check_sizes, save_designs
    from inflate_lib.design_targets import read_targets
    from inflate_lib.inverse_design import design

    check_sizes(size_mm=size_mm, depth_mm=depth_mm)
    unit = size_mm if outline_unit is None else outline_unit
    targets = read_targets(height, width, area, axis, outline, unit, stress, stretch)
    constraints = from_millimetres(size_mm, min_void_mm, max_material_mm2, symmetric, keep_out_mm)
    check_folder(out, overwrite)
    try:
        found = design(
            targets, number, profile=profile, constraints=constraints, tolerance=tolerance, prefer=prefer, seed=seed,
            seconds=seconds, max_candidates=candidates, refine=refine,
        )  # fmt: skip
        print(found.summary())
        if found.designs:
            print(found.table().to_string(index=False, float_format="{:.4g}".format))
        start = time.monotonic()
        save_designs(found, out, size_mm, depth_mm, overwrite)
    except KeyboardInterrupt:
        print(f"inflate: interrupted; nothing was written to {out}", file=sys.stderr)
        raise typer.Exit(130) from None
    print(f"written in {time.monotonic() - start:.1f} s: {out / 'contact_sheet.png'}, and a folder for each design")
    if sum(one.within for one in found.designs) < number:
        raise typer.Exit(2)


@app.command()
def train(
    descriptor: Annotated[str, typer.Option(help="height, width, box, area, axis, joint, or all but joint.")] = "all",
    profile: ProfileName = "ci",
    device: Annotated[str | None, typer.Option(help="cpu, cuda or mps; found by itself otherwise.")] = None,
    compile: Annotated[bool, typer.Option("--compile", help="With torch.compile.")] = False,
    steps: Annotated[int | None, typer.Option(min=2, help="A dry run of so many steps: what would it cost?")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the weights in 16 bits: name.safetensors.")] = None,
    log: Annotated[Path | None, typer.Option(help="Folder for CSV and TensorBoard logs.")] = None,
    pack: Annotated[Path | None, typer.Option(help="Train nothing: write data and recipe, to train elsewhere.")] = None,
) -> None:
    """Train the models of a profile, or find them trained in the cache. A killed training goes on where it was.

    Several GPUs or machines: torchrun --nproc-per-node 2 -m -- inflate_lib train … (-- keeps torchrun from --log)

    A machine that has little but PyTorch: --pack pairs.safetensors, and there python -m inflate_lib.remote …
    """
    from inflate_lib import experiments, paths
    from inflate_lib.datasets import simulated_sevens
    from inflate_lib.descriptors import DESCRIPTORS, check_name
    from inflate_lib.diffusion import ranks
    from inflate_lib.profiles import load_profile

    if pack is not None and (steps, out, log) != (None, None, None):
        raise ValueError("--pack trains nothing: leave out --steps, --out and --log")
    if steps is not None and (out, log) != (None, None):
        raise ValueError("--steps is a dry run, which keeps nothing: leave out --out and --log")
    names = list(DESCRIPTORS) if descriptor == "all" else [check_name(descriptor)]
    given = load_profile(profile).parameters(paths.NOTEBOOKS / "08_training.md")
    training = given["training"] | ({"device": device} if device else {}) | ({"compile": True} if compile else {})
    ranks.start(training.get("device", "auto"))
    data = simulated_sevens(given["source"], given["n_structures"] or None)
    basis = names, training, data, given["n_augmented"], given["seed"]
    if pack is not None:
        experiments.pack(pack, *basis, profile)
        text = f"{', '.join(names)}: {pack}, {pack.stat().st_size / 1e6:.1f} MB"
    elif steps:
        cost = experiments.training_cost(*basis, steps)
        at_a_time = cost["side by side"][0]
        text = f"{cost.to_string(index=False, float_format='{:.4g}'.format)}\nthe whole training: about "
        text += f"{cost['hours'].sum() / at_a_time:.3g} h, {at_a_time} at a time"
    else:
        log = log or paths.CACHE / "logs" / profile
        files = experiments.train_models(*basis, log)
        text = "\n".join(_export(Path(file), name, profile, out) for name, file in files.items() if file)
    if ranks.rank() == 0:
        print(text)
    ranks.finish()


def _export(file: Path, name: str, profile: str, out: Path | None) -> str:
    """Copy a trained model in 16 bits to `out`; a line about it."""
    from inflate_lib.diffusion import TrainedModel

    model = TrainedModel.load(file)
    if out is not None:
        model.metadata |= {"profile": profile}
        file = out / f"{name}.safetensors"
        model.save(file, half=True)
    about, loss = model.metadata, model.history["loss"][-1]
    unseen = f", held out {about['held_out_loss']:.4f}" if "held_out_loss" in about else ""
    return f"{name}: {about['seconds'] / 60:.1f} min on {about['device']}, loss {loss:.4f}{unseen}: {file}"


@app.command()
def card(
    profile: ProfileName = "laptop",
    folder: Annotated[Path | None, typer.Option(help="Folder of the weights; data/pretrained/<profile>.")] = None,
    targets: Annotated[
        int | None, typer.Option(min=2, help="Held-out targets for each model; all, by default.")
    ] = None,
) -> None:
    """Measure the weights of a profile on held-out targets, and write the model card beside them."""
    from inflate_lib import paths
    from inflate_lib.cards import write_card
    from inflate_lib.datasets import simulated_sevens
    from inflate_lib.profiles import load_profile

    given = load_profile(profile).parameters(paths.NOTEBOOKS / "10_scalar_targets.md")
    data = simulated_sevens(given["source"], given["n_structures"] or None)
    print(write_card(folder or paths.PRETRAINED / profile, data, given["sampling"], given["n_calibration"], targets))


@app.command()
def info() -> None:
    """Print versions, folders and the device that training would use."""
    from inflate_lib import paths
    from inflate_lib.publishing import package_versions

    print(f"Python {platform.python_version()} on {platform.platform()}")
    for name, version in package_versions().items():
        print(f"{name} {version}")
    print(f"checkout {paths.ROOT}\ncache {paths.CACHE}\nMNIST {os.environ.get('INFLATE_MNIST_DIR', 'by download')}")


def _set_retrain(retrain: bool) -> None:
    """Tell the notebooks, which run in processes of their own."""
    from inflate_lib.cache import RETRAIN

    if retrain:
        os.environ[RETRAIN] = "1"


def run() -> None:
    """Entry point: an error that the library foresaw is one clear message and exit code 1, not a traceback."""
    try:
        app()
    except (ValueError, RuntimeError, OSError, FloatingPointError) as error:
        if os.environ.get("INFLATE_DEBUG"):
            raise
        sys.exit(f"inflate: {error}")
