"""What ``inflate simulate`` does: image files in; descriptors, pictures, ParaView files and MOOSE cases out.

Every image gets its record, and one that cannot be read or inflated does not stop the others.
"""

import json
import re
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from inflate_lib import mechanics
from inflate_lib._checks import choice, positive_number
from inflate_lib._files import check_outputs, naming
from inflate_lib.alternatives.patterns import from_picture, is_picture, stiffness_of
from inflate_lib.alternatives.stabilised import check_element, inflate_with
from inflate_lib.descriptors import describe
from inflate_lib.descriptors.registry import basic
from inflate_lib.io import moose, pictures
from inflate_lib.io.pictures import PICTURES, in_one_line, read_images, with_ending
from inflate_lib.io.vtk import vtk_files, write_vtk
from inflate_lib.mechanics.buildable import find_flaw
from inflate_lib.mechanics.inflation import LAMBDA, MU, PRESSURE, check_lame, load_history
from inflate_lib.mechanics.mesh import build_mesh
from inflate_lib.mechanics.stress import QUANTITIES
from inflate_lib.structures.labels import THICKNESS, stages, turns_to_bottom

_ENGINES = ("built-in", "moose")
_SIZES = {one.variable: one.title for one in basic() if one.is_size}  # in records, and in the heading of the table


@dataclass(frozen=True)
class Options:
    """What to compute and what to write; the defaults are the paper's structure, and nothing written."""

    lame: tuple[float, float] = (LAMBDA, MU)
    pressure: float | tuple[float, ...] = PRESSURE  # a history where there are several
    n_steps: int | None = None  # ten, or as many as the history has
    rubbers: float | None = None  # stiffness of the second rubber, where pictures show two
    wall: int = THICKNESS
    clamped: str = "bottom"
    refine: int = 1
    element: str = "mean-dilatation"
    contact: bool = False
    resize: bool = False
    invert: bool = False
    colour: str = "von-mises"
    engine: str = "built-in"
    plot: Path | None = None
    gif: Path | None = None
    vtk: Path | None = None
    moose: Path | None = None


def simulate_files(files, options, inputs=()):
    """Inflate the structures in image files and write what the options ask for.

    Parameters
    ----------
    files : list of path_like
        PNG or another picture, or ``.npy`` with one image or a stack of them.
    options : Options
    inputs : list of path_like
        Further files that were read, which no output may replace either.

    Yields
    ------
    dict
        One record per image: name, file, note, converged, reason (why it failed: the image, the equilibrium, or a file
        that cannot be written), flaw (why what was inflated cannot be built all the same), height, width, hull_area,
        medial_axis (None where not converged), load_steps (those with an equilibrium: time, pressure, height, width,
        hull_area of each), seconds, files.

    Raises
    ------
    ValueError
        For options that make no sense with any image.
    RuntimeError
        Where MOOSE is asked for and not there.
    OSError
        For outputs that ``inflate_lib._files.check_outputs`` refuses.
    """
    choice("colour", options.colour, QUANTITIES)
    check_element(options.element, options.contact)
    check_lame(options.lame)
    if choice("engine", options.engine, _ENGINES) == "moose":
        if options.moose is None:
            raise ValueError("engine moose needs a folder for its files: --moose DIR")
        moose.find_program()
    if options.rubbers is not None:
        positive_number("rubbers", options.rubbers)
        if options.resize or options.invert:
            raise ValueError(
                "rubbers: they are told by grey levels, which --resize and --invert change; leave these out"
            )
    if options.contact and options.moose is not None:
        raise ValueError("contact: the cases for MOOSE have none, leave out --contact or --moose")
    for path, endings in ((options.plot, PICTURES), (options.gif, (".gif",)), (options.vtk, (".pvd", ".vtu"))):
        if path is not None:
            with_ending(path, *endings)
    times, _ = load_history(options.pressure, options.n_steps)
    turns_to_bottom(options.clamped)
    images = [image for file in files for image in _images(Path(file), options)]
    ends = ("",) if options.moose is None else ("", "_out")  # MOOSE adds this one to the name of a case
    named = list(zip(_distinct([name for name, *_ in images], ends), images, strict=True))
    alone = len(images) == 1
    good = [name for name, (_, _, image, _) in named if not isinstance(image, ValueError)]
    outputs = [path for name in good for path in _outputs(name, options, alone, len(times))]
    check_outputs(outputs, [*files, *inputs])
    for name, (_, file, image, note) in named:
        yield _record(name, file, image, note, options, alone)


def read_history(text):
    """Pressures, a tuple, from numbers with commas between them, or from a file with one per line.

    The first line of the file may be the heading "pressure".

    Raises
    ------
    ValueError
        Naming the text or the file, where it is neither.
    """
    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError:
        path = Path(text)
    try:
        lines = [line.strip() for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    except (OSError, ValueError):
        raise ValueError(f"history: {text!r} is neither pressures, like 0.005,0.01,0, nor a file of them") from None
    if lines[:1] == ["pressure"]:
        del lines[0]
    try:
        return tuple(float(line) for line in lines)
    except ValueError:
        raise ValueError(f"history: {path} must have one pressure per line, and nothing else") from None


def report(records, as_json, options):
    """Print the records, a table or JSON, and a summary on stderr; return the number of structures that failed."""
    from rich.console import Console
    from rich.table import Table

    done = []
    say = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)
    for record in records:
        done.append(record)
        if record["reason"]:
            say.print(f"{record['name']}: {record['reason']}")
        elif record["flaw"]:
            say.print(f"{record['name']}: inflated, but it cannot be built. {record['flaw']}")
    failed = sum(bool(record["reason"]) for record in done)
    if as_json:
        parameters = {k: v for k, v in asdict(options).items() if k not in ("plot", "gif", "vtk", "moose")}
        print(json.dumps({"parameters": parameters, "structures": done}, indent=1, allow_nan=False))
    else:
        table = Table("structure", *_SIZES.values(), "seconds", "files", title=None)
        for record in done:
            if record["converged"]:
                numbers = [f"{record[key]:.4f}" for key in _SIZES]
                name = f"{record['name']} ({record['note']})" if record["note"] else record["name"]
                table.add_row(name, *numbers, f"{record['seconds']:.2f}", "\n".join(record["files"]))
        if failed < len(done):
            Console(width=None if sys.stdout.isatty() else 160, markup=False).print(table)
    say.print(f"{len(done) - failed} of {len(done)} structures inflated" + (f", {failed} failed" if failed else ""))
    return failed


def _images(path, options):
    """(name, file, image, note) of each image in a file; the image is a ValueError where the file is no good."""
    try:
        images, note = read_images(path, options.resize, options.invert)
    except ValueError as error:
        return [(path.stem, path, error, "")]
    if len(images) == 1:
        return [(path.stem, path, images[0], note)]
    return [(f"{path.stem}_{i:03d}", path, image, note) for i, image in enumerate(images)]


def _record(name, file, image, note, options, alone):
    """Inflate one image and write its files."""
    start = time.perf_counter()
    record = {"name": name, "file": str(file), "note": note, "converged": False, "reason": "", "flaw": ""}
    record |= dict.fromkeys((*_SIZES, "medial_axis")) | {"load_steps": []}
    written = []
    try:
        if isinstance(image, ValueError):
            raise image
        stiffness = None
        if options.rubbers is not None:
            image, stiff = from_picture(image, options.wall)
            stiffness = stiffness_of(image, stiff, options.rubbers, options.wall, options.clamped)
        elif is_picture(image):
            note = ", ".join(filter(None, (note, "two rubbers taken as one: --rubbers")))
        structure = stages(image, wall=options.wall, clamped=options.clamped)
        record["note"] = ", ".join(filter(None, (note, structure.note)))
        mesh = build_mesh(structure.domains, options.refine, options.clamped, stiffness)
        parameters = {name: getattr(options, name) for name in ("n_steps", "element", "pressure", "lame")}
        with naming(Path(mechanics.__file__).with_name("__pycache__")):  # where compiled code is kept
            result = inflate_with(mesh, contact=options.contact, **parameters)
        if options.moose is not None:
            case = moose.write_case(mesh, options.moose, name, **parameters)
            written += case
            if options.engine == "moose":
                result = moose.run_case(result, case[0])
        record |= {"converged": result.converged, "reason": result.reason}
        reached = int(np.isfinite(result.displacement).all(axis=(1, 2)).sum())
        shapes = [describe(result, step) for step in range(reached)]
        for t, p, shape in zip(result.load_steps, result.pressures, shapes, strict=False):
            record["load_steps"].append({"time": float(t), "pressure": float(p)} | _sizes(shape))
        if result.converged:
            record["flaw"] = str(find_flaw(result) or "")
            record |= _sizes(shapes[-1]) | {"medial_axis": shapes[-1].medial_axis.tolist()}
        if options.plot is not None:
            written.append(pictures.write_picture(result, _own(options.plot, name, alone), options.colour))
        if options.gif is not None:
            written.append(pictures.write_animation(result, _own(options.gif, name, alone), options.colour))
        if options.vtk is not None:
            pvd, *series = write_vtk(result, path := _own(options.vtk, name, alone))
            written += [pvd, *(file for file in series if file == path)]
    except (ValueError, OSError, RuntimeError) as error:
        record["reason"] = record["reason"] or in_one_line(error)  # a file that cannot be written counts as well
    return record | {"seconds": time.perf_counter() - start, "files": [str(path) for path in written]}


def _outputs(name, options, alone, n_steps):
    """All files that may be written for one structure."""
    files = [_own(path, name, alone) for path in (options.plot, options.gif) if path is not None]
    files += vtk_files(_own(options.vtk, name, alone), n_steps) if options.vtk is not None else []
    case = moose.case_files(options.moose, name) if options.moose is not None else []
    return files + (case if options.engine == "moose" else case[:2])


def _sizes(shape):
    """Height, width and hull area of a shape, by name."""
    return {name: getattr(shape, name) for name in _SIZES}


def _distinct(names, ends):
    """Names of safe characters, each one once, with any of the ends: a second "seven", or "Seven", is "seven-2"."""
    seen, distinct = set(), []
    for name in names:
        safe = candidate = re.sub(r"[^A-Za-z0-9._-]", "_", name) or "structure"
        number = 1
        while not seen.isdisjoint(taken := {f"{candidate}{end}".lower() for end in ends}):
            number += 1
            candidate = f"{safe}-{number}"
        seen |= taken
        distinct.append(candidate)
    return distinct


def _own(path, name, alone):
    """The path asked for, or with the name of the structure in it where there are several."""
    path = Path(path)
    return path if alone else path.with_name(f"{path.stem}_{name}{path.suffix}")
