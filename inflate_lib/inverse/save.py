"""What a design is handed out as: pictures, an outline to cut, solids to print, files for ParaView and MOOSE, a record.

The solids and the outline are the very mesh that was simulated, in millimetres: pixels, or quadrilaterals between
smooth borders.
"""

import json
import os
import platform
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from PIL import Image

import inflate_lib
from inflate_lib._checks import positive_number
from inflate_lib._files import check_outputs, file_digest, hand_out_folder, locked, made, naming, sweep, written_before
from inflate_lib._provenance import package_versions
from inflate_lib.alternatives.patterns import picture_of
from inflate_lib.inverse.search import Designs
from inflate_lib.inverse.smooth import pixel_plan
from inflate_lib.io import moose, pictures
from inflate_lib.io.vtk import vtk_files, write_vtk
from inflate_lib.mechanics.inflation import PRESSURE, load_history
from inflate_lib.mechanics.mesh import boundary_loops
from inflate_lib.plotting.style import COLOURS
from inflate_lib.structures.labels import FRAME, THICKNESS

_SIZE_MM, _DEPTH_MM, _BASE_MM = 100.0, 20.0, 3.0
_RUBBERS = ("soft", "stiff")
_SEARCH_FILES = ("contact_sheet.png", "designs.csv", "designs.json")


def save_designs(
    designs: Designs,
    folder: str | Path,
    size_mm: float = _SIZE_MM,
    depth_mm: float = _DEPTH_MM,
    overwrite: bool = False,
) -> list[Path]:
    """Write a contact sheet, a table and a folder for each design.

    ``contact_sheet.png``, ``designs.csv``, ``designs.json`` (the search, and the SHA-256 of every file), and in
    ``design_01``, …: ``structure.png`` (28 × 28, what ``inflate simulate`` reads; of a
    smooth design the pixels that it comes from), ``picture.png``, ``outline.svg``
    (mm), ``mould.stl`` (a tray in which the structure is cast) and ``part.stl`` (the structure itself),
    ``inflated.pvd`` with its series, ``moose/``, and ``design.json`` with seed and provenance. Where walls are of two
    rubbers, ``structure.png`` has a grey level for each (:data:`inflate_lib.alternatives.patterns.LEVELS`),
    ``outline.svg`` a layer for each, and ``part_soft.stl`` and ``part_stiff.stl`` are what is cast of each.

    Everything is written aside first, and moved to its place when it is whole.

    Parameters
    ----------
    designs : Designs
    folder : path_like
        Must not exist yet, or be empty, unless `overwrite`. A link to a folder is followed.
    size_mm, depth_mm : float
        Side of the frame, and thickness of the structure out of the plane, in millimetres.
    overwrite : bool
        Replace the designs of an earlier run, the files that its ``designs.json`` lists and that are as it wrote them.
        Everything else in the folder stays.

    Returns
    -------
    list of Path
        The contact sheet, the table, and the folder of each design.

    Raises
    ------
    ValueError
        For sizes that are none, and where there is nothing to write.
    OSError
        Where the folder is not empty, or cannot be written, or another run is writing there, or a file of another
        origin has the name of one of these; then nothing has changed.
    """
    check_sizes(size_mm=size_mm, depth_mm=depth_mm)
    with claimed_folder(folder, len(designs.designs), overwrite) as claimed:
        write_designs(designs, claimed, size_mm, depth_mm)
    names = ("contact_sheet.png", "designs.csv", *_names(len(designs.designs)))
    return [Path(folder) / name for name in names]


@contextmanager
def claimed_folder(
    folder: str | Path, n: int, overwrite: bool = False, inputs: Iterable[str | Path] = ()
) -> Iterator[Path]:
    """Hold a folder for up to `n` designs, before they are looked for: made, locked, and checked.

    Errors are those of :func:`save_designs`; none of the inputs is replaced either.
    """
    folder = Path(os.path.realpath(folder))
    if folder.exists() and not folder.is_dir():
        raise FileExistsError(f"{folder}: there is a file of this name; give a folder")
    with made(folder), locked(folder):
        sweep(folder)
        if not overwrite and any(folder.iterdir()):
            raise FileExistsError(f"{folder}: the folder is not empty; give another one or --overwrite")
        ours = _ours(folder)
        files = [folder / name for name in _SEARCH_FILES]
        files += [folder / name / file for name in _names(n) for file in _design_files(name)]
        files += filter(ours, (folder / name for name in _listed(folder)))  # they will be removed
        check_outputs(dict.fromkeys(files), inputs, ours)
        yield folder


def write_designs(designs: Designs, folder: Path, size_mm: float = _SIZE_MM, depth_mm: float = _DEPTH_MM) -> None:
    """Write designs into a folder from :func:`claimed_folder`; see :func:`save_designs`."""
    import matplotlib.pyplot as plt

    from inflate_lib.plotting import in_style
    from inflate_lib.plotting.designs import plot_designs

    check_sizes(size_mm=size_mm, depth_mm=depth_mm)
    if not designs.designs:
        raise ValueError("there is no design to write: no candidate was a structure that can be built")
    ours, digests = _ours(folder), {}
    earlier = [Path(name) for name in _listed(folder) if ours(folder / name)]
    try:
        with hand_out_folder(folder, ours) as place:
            for name, one in zip(_names(len(designs.designs)), designs.designs, strict=True):
                _write_design(one, place / name, name, designs, size_mm, depth_mm)
            with in_style():
                fig = plot_designs(designs)
                try:
                    fig.savefig(place / "contact_sheet.png")
                finally:
                    plt.close(fig)
            designs.table().to_csv(place / "designs.csv", index=False, float_format="%.8g")
            files = [file for file in sorted(place.rglob("*")) if file.is_file()]
            digests |= {file.relative_to(place).as_posix(): file_digest(file) for file in files}
            _write_json(place / "designs.json", _search_record(designs) | {"files": digests})
    except OSError as error:
        if error.errno is None:
            raise
        reason = f"{error.strerror}; no designs were written: make room, or give another folder"
        raise OSError(error.errno, reason, str(error.filename or folder)) from error
    for file in earlier:
        if file.as_posix() not in digests:
            (folder / file).unlink()
            for parent in file.parents[:-1]:
                with suppress(OSError):  # there is something else in it
                    (folder / parent).rmdir()


def check_sizes(**sizes):
    """Raise a ValueError where one of the sizes, by name, is no length."""
    for name, value in sizes.items():
        positive_number(name, value, "millimetres")


def _names(n):
    """Names of the folders of so many designs."""
    return [f"design_{number:02d}" for number in range(1, n + 1)]


def _design_files(name):
    """What :func:`_write_design` writes."""
    own = ["structure.png", "picture.png", "outline.svg", "mould.stl", "part.stl", "design.json"]
    own += [f"part_{rubber}.stl" for rubber in _RUBBERS]
    times, _ = load_history(PRESSURE)
    return [*own, *vtk_files("inflated.pvd", len(times)), *moose.case_files("moose", name)[:2]]


def _listed(folder):
    """What an earlier run wrote into a folder: name → SHA-256; its record ``designs.json`` says so."""
    try:
        record = json.loads((folder / "designs.json").read_text(encoding="utf-8"))
        files = record["files"] if record["versions"]["inflate_lib"] else {}
        return {name: digest for name, digest in files.items() if ".." not in Path(name).parts and name[:1] != "/"}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return {}


def _ours(folder):
    """Whether a file in a folder is as an earlier run wrote it, perhaps on another machine."""
    listed = _listed(folder)

    def ours(path):
        name = os.path.relpath(path, folder)
        if name == "designs.json":
            return bool(listed)
        return written_before(path) or (path.is_file() and listed.get(Path(name).as_posix()) == file_digest(path))

    return ours


def _search_record(designs):
    """The search in plain values: targets, constraints, model, sampling, versions, counts; no times, no dates."""
    return {
        "targets": designs.targets.as_dict(),
        "constraints": designs.constraints.as_dict(),
        "tolerance": designs.tolerance,
        "prefer": designs.prefer,
        "asked": designs.asked,
        "found": sum(one.within for one in designs.designs),
        "within_tolerance": designs.within,
        "refined": designs.refined,
        "candidates": designs.tried,
        "candidates_from": dict(designs.sources),
        "rejected": [_told(reason) | {"drawings": number} for reason, number in designs.rejected.most_common()],
        "stopped": _told(designs.stopped),
        "seed": designs.seed,
        "model": designs.model,
        "sampling": designs.sampling,
        "versions": {
            "inflate_lib": inflate_lib.__version__,
            "python": platform.python_version(),
            **package_versions(),
        },
    }


def _told(reason):
    """A member of an enumeration of reasons: a name for programs, a sentence for people."""
    return {"reason": reason.name.lower(), "sentence": reason.value}


def _outline_svg(plan, size_mm=_SIZE_MM, stiff=None):
    """SVG text of a structure's outline: one path for the wall, its cavity cut out; user units are millimetres.

    Of two rubbers, told by :func:`_stiff_quads`, each has a path in a layer of its own.
    """
    points = size_mm * (plan.points * [1, -1] + [0, 1])  # y downwards

    def path(wall, colour):
        parts = []
        for loop in boundary_loops(plan.quads[wall]):
            corner = _turns(points[loop])
            parts.append("M " + " L ".join(f"{a:.6g},{b:.6g}" for a, b in points[loop][corner]) + " Z")
        return f'<path d="{" ".join(parts)}" fill="{colour}" fill-rule="evenodd" stroke="none"/>\n'

    size = f"{size_mm:.6g}"
    paths = path(plan.wall, COLOURS.wall)
    if stiff is not None:
        parts = {"soft": (plan.wall & ~stiff, COLOURS.wall), "stiff": (stiff, COLOURS.stiff)}
        paths = "".join(
            f'<g id="{name}" inkscape:groupmode="layer" inkscape:label="{name}">\n{path(*part)}</g>\n'
            for name, part in parts.items()
        )
    layers = ' xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape"' if stiff is not None else ""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg"{layers} width="{size}mm" height="{size}mm" '
        f'viewBox="0 0 {size} {size}">\n{paths}</svg>\n'
    )


def _stiff_quads(one):
    """(m,) bool: which quadrilaterals of the pixels of a design are of the stiffer of two rubbers; None of one."""
    return None if one.stiff is None else np.pad(one.stiff, 1)[::-1].ravel()


def mould(plan, size_mm=_SIZE_MM, depth_mm=_DEPTH_MM, base_mm=_BASE_MM):
    """The tray in which a structure is cast, as a closed surface: the wall is its trough, the cavity a core in it.

    Parameters
    ----------
    plan : Plan
        Of its frame and the rim, which closes the trough on every side.
    size_mm, depth_mm, base_mm : float

    Returns
    -------
    points : (n, 3) float, mm
    triangles : (m, 3) int, counter-clockwise seen from outside
    """
    return _solid(size_mm * plan.points, plan.quads, np.where(plan.wall, base_mm, base_mm + depth_mm))


def part(plan, size_mm=_SIZE_MM, depth_mm=_DEPTH_MM, wall=None):
    """The structure itself, its wall (m,) bool or some of it extruded, as a closed surface; see :func:`mould`."""
    wall = plan.wall if wall is None else wall
    return _solid(size_mm * plan.points, plan.quads[wall], np.full(wall.sum(), depth_mm))


def _solid(corners, quads, height):
    """Closed surface, as of :func:`mould`, of columns of a height (m,) on quadrilaterals (m, 4) of corners (n, 2).

    At most two heights may occur, and no two columns of one height may meet at a corner only.
    """
    levels, n = np.unique(np.append(height, 0.0)), len(corners)
    points = np.concatenate([np.column_stack([corners, np.full(n, z)]) for z in levels])
    start, end = quads.ravel(), np.roll(quads, -1, axis=1).ravel()
    here, key, back = np.repeat(height, 4), start * n + end, end * n + start  # the neighbour runs along a side back
    order = np.argsort(key)
    place = order[np.searchsorted(key, back, sorter=order).clip(0, len(key) - 1)]
    beyond = np.where(key[place] == back, here[place], 0.0)
    face = here > beyond
    low, high = (np.searchsorted(levels, z[face]) * n for z in (beyond, here))
    first, second = start[face], end[face]
    upright = np.column_stack([first + low, second + low, second + high, first + high])
    top = quads + np.searchsorted(levels, height)[:, None] * n
    quads = np.concatenate([quads[:, [0, 3, 2, 1]], top, upright])  # each halved between its corners 0 and 2
    used, numbers = np.unique(quads, return_inverse=True)
    quads = numbers.reshape(quads.shape)
    return points[used], np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _write_stl(path, points, triangles):
    """Write a surface as binary STL, in the unit of its points."""
    import meshio

    with naming(path):
        meshio.Mesh(points, [("triangle", triangles)]).write(path, file_format="stl", binary=True)


def _write_design(one, folder, name, designs, size_mm, depth_mm):
    folder.mkdir()
    Image.fromarray(picture_of(one.label, one.stiff)).save(folder / "structure.png")
    pictures.write_picture(one.result, folder / "picture.png")
    plan, stiff = one.plan or pixel_plan(one.label), _stiff_quads(one)
    (folder / "outline.svg").write_text(_outline_svg(plan, size_mm, stiff), encoding="utf-8")
    _write_stl(folder / "mould.stl", *mould(plan, size_mm, depth_mm))
    _write_stl(folder / "part.stl", *part(plan, size_mm, depth_mm))
    if stiff is not None:
        parts = zip(_RUBBERS, (plan.wall & ~stiff, stiff), strict=True)
        for rubber, wall in ((rubber, wall) for rubber, wall in parts if wall.any()):
            _write_stl(folder / f"part_{rubber}.stl", *part(plan, size_mm, depth_mm, wall))
    write_vtk(one.result, folder / "inflated.pvd")
    moose.write_case(one.result.mesh, folder / "moose", name)
    record = {
        "achieved": one.shape.as_dict(),
        "errors": one.deviations,
        "within_tolerance": bool(one.within),
        "peak_von_mises_stress": one.shape.peak_stress,
        "peak_von_mises_stress_over_mu": one.shape.peak_stress / one.result.lame[1],
        "largest_principal_stretch": one.shape.peak_stretch,
        "candidate": one.candidate,
        "origin": one.origin,
        "novelty": one.novelty,
        "borders": "smooth" if one.plan else "pixels",
        "millimetres": {
            "frame": size_mm,
            "depth": depth_mm,
            "base of the mould": _BASE_MM,
            "least wall": size_mm * THICKNESS / FRAME,
        },
        "search": _search_record(designs),
    }
    _write_json(folder / "design.json", record)


def _write_json(path, record):
    path.write_text(json.dumps(_without_nan(record), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _without_nan(value):
    """The value with null for what is NaN or infinite, which JSON does not know."""
    if isinstance(value, dict):
        return {name: _without_nan(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _turns(points):
    """Which points of a closed polygon are corners, not on the way from the one before to the one after."""
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    return np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]) > 1e-12
