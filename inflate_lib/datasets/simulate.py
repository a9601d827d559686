"""Data sets of inflated structures (paper sec. 3): many images → label, inflate, describe → one netCDF file.

Nothing is dropped: an image that gives no structure, or a structure without an equilibrium, keeps its row with
``converged = False`` and the reason.
"""

import platform
import zlib
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import BadZipFile

import numpy as np
from joblib.parallel import get_active_backend

import inflate_lib
from inflate_lib import _progress
from inflate_lib._cache import cached, digest, kept, step_version
from inflate_lib._checks import positive_number, whole_number, workers
from inflate_lib._files import draft
from inflate_lib.datasets import _workers
from inflate_lib.datasets.storage import load_dataset, save_dataset
from inflate_lib.descriptors import Shape
from inflate_lib.descriptors.registry import added_version, basic
from inflate_lib.mechanics import contact, inflation
from inflate_lib.mechanics.buildable import Flaw, find_flaw
from inflate_lib.structures import labels, sources
from inflate_lib.structures.labels import FRAME

if TYPE_CHECKING:
    import xarray as xr

# xarray is imported where it is used: the processes that simulate need none, and start in half the time without.

PIECE = 32  # structures per unit of work, which is what a killed run can lose; fewer where there are few in all
ALONE = 128  # as many structures are done in this process before others have started
TIME_LIMIT = 1.0, 0.1  # seconds allowed for a structure, or per load step if that is more; see `inflation.inflate`

#: What the variables besides the descriptors hold, and their units.
_UNITS = {
    "image": ("grey image of the undeformed structure", "1"),
    "label": ("label image: 0 outside, 0.5 wall, 1 void", "1"),
    "converged": ("every load step reached equilibrium", "1"),
    "reason": ("why not converged; empty where converged", ""),
    "buildable": ("one wall without a joint of one node, and no walls that cross at any load step", "1"),
    "flaw": ("why not buildable, by the names of inflate_lib.mechanics.Flaw; empty where buildable", ""),
    "factorisations": ("factorisations of the tangent", "1"),
    "self_contact": ("pairs of boundary edges that cross at the last load step: walls overlap where positive", "1"),
    "contact_step": ("first load step, from 1, at which boundary edges cross; 0 where they never do", "1"),
}


def simulate_dataset(
    images: np.ndarray,
    n_jobs: int | None = None,
    n_steps: int = 10,
    progress_text: bool = True,
    folder: Path | None = None,
    backend: str | None = None,
    time_limit: float | None = None,
    stiffness: np.ndarray | None = None,
) -> "xr.Dataset":
    """Label, inflate and describe many images.

    Parameters
    ----------
    images : (n, 28, 28) array_like, or a sequence of images
        uint8, or float in [0, 1]. What is no usable image is not an error: its row holds the reason.
    n_jobs : int, optional
        Processes; -1 for one per core, 1 for none besides this one. By default what an active
        ``joblib.parallel_config`` says, else one per core. Up to `ALONE` images never leave this process.
    n_steps : int
        Load steps of each inflation.
    progress_text : bool
        Print a line every few seconds.
    folder : path_like, optional
        Where finished pieces are kept: a run that was killed goes on from them.
    backend : str, optional
        Who works: a backend of joblib by name (``"loky"``, ``"threading"``, ``"multiprocessing"``, ``"sequential"``,
        or one that was registered), or the address of the scheduler of a Dask cluster, ``"tcp://host:8786"``, whose
        workers need this version of ``inflate_lib``, and no access to `folder`. By default what an active
        ``joblib.parallel_config`` says, else local processes (loky). The data set is the same to the last bit.
    time_limit : float, optional
        Seconds of a nominal core after which a structure is given up, see :func:`inflate_lib.inflate`; by default 1,
        or 0.1 per load step if that is more.
    stiffness : (n, 28, 28) array_like, optional
        Of each pixel of the label images, see :func:`inflate_lib.inflate`.

    Returns
    -------
    xarray.Dataset
        One row per image, in order, along ``structure``: image, label, converged, reason (empty where converged),
        buildable, flaw (empty where buildable, else the name of a :class:`inflate_lib.mechanics.Flaw` in small
        letters), height, width, hull_area, medial_axis (structure, point, axis), peak_stress, peak_stretch (see
        :func:`inflate_lib.mechanics.stress.peaks`), factorisations, self_contact, contact_step (see
        :mod:`inflate_lib.mechanics.contact`). Descriptors are in lengths and areas of the unit square, NaN where not
        converged.

    Raises
    ------
    ValueError
        Where `images` is no sequence of images at all, or another argument is out of range or unknown.
    RuntimeError
        Where a local process dies, or the Dask cluster does not answer or fails (a worker of it that dies is no
        failure). What is in `folder` by then is not done again.
    """
    images = _as_sequence(images)
    if stiffness is not None and len(stiffness) != len(images):
        raise ValueError(f"stiffness: there are {len(stiffness)} of them for {len(images)} images")
    if n_jobs is None:
        n_jobs = get_active_backend()[1] or -1
    workers(n_jobs)
    whole_number("n_steps", n_steps, 1, inflation.MAX_STEPS)
    if time_limit is None:
        time_limit = max(TIME_LIMIT[0], TIME_LIMIT[1] * n_steps)
    positive_number("time_limit", time_limit, "seconds")
    address = _workers.check_backend(backend)
    if folder is not None:
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)

    def run(tasks):
        if address is not None:
            return _workers.run_on_cluster(address, _simulate, tasks)
        return _workers.run_here(_simulate, tasks, 1 if len(images) <= ALONE else n_jobs, backend)

    done = _pieces(images, n_steps, time_limit, folder, run, stiffness)
    if progress_text:
        done = _progress.track(((len(rows["image"]), rows) for rows in done), len(images), "inflating structures")
    return _assemble(list(done), n_steps)


def simulated_sevens(
    source: str = "auto", n_structures: int | None = None, n_jobs: int | None = None, backend: str | None = None
) -> "xr.Dataset":
    """The simulated sevens, computed once and kept on disk.

    Parameters
    ----------
    source : {"auto", "mnist", "digits"}
        See :func:`inflate_lib.structures.sources.load_sevens`.
    n_structures : int, optional
        Only the first ones.
    n_jobs, backend
        Who works, see :func:`simulate_dataset`.

    Returns
    -------
    xarray.Dataset
        See :func:`simulate_dataset`.
    """
    return load_dataset(simulated_sevens_file(source, n_structures, n_jobs, backend))


def simulated_before(source: str) -> "xr.Dataset | None":
    """The simulated sevens of a source, "mnist" or "digits", if they are at hand: nothing is downloaded or simulated.

    Returns
    -------
    xarray.Dataset or None
    """
    if not sources.at_hand(source):
        return None
    file = kept("dataset", _key(sources.load_sevens(source)), ".nc")
    return load_dataset(file) if file else None


def simulated_sevens_file(source="auto", n_structures=None, n_jobs=None, backend=None):
    """Path of the netCDF file that :func:`simulated_sevens` reads."""
    check_workers(n_jobs, backend)
    whole_number("n_structures", n_structures, 1, optional=True)
    sevens = sources.load_sevens(source, limit=n_structures)

    def make(target, scratch):
        data = simulate_dataset(sevens.images, n_jobs=n_jobs, folder=scratch, backend=backend)
        data.attrs |= {
            "source": sevens.source,
            "source_description": sevens.description,
            "code_version": code_of_dataset(),
        }
        save_dataset(data, target)

    return cached("dataset", _key(sevens), make, ".nc")


def _key(sevens):
    return {"images": digest(sevens.images), "steps": 10, "code": code_of_dataset()}


def check_workers(n_jobs, backend):
    """A ValueError where nobody can work so, whether or not there is something left to do."""
    if n_jobs is not None:
        workers(n_jobs)
    _workers.check_backend(backend)


def code_of_dataset():
    """Version of all that lies between an image and its descriptors."""
    return step_version("dataset") + added_version()


def _as_sequence(images):
    """`images` as something that can be cut into parts; the single images are not judged here."""
    if getattr(images, "ndim", 3) in (0, 2):  # an array, a tensor, a data frame
        raise ValueError("images: a stack (n, 28, 28) is needed; put a single image in a list")
    no_sequence = isinstance(images, str | bytes | Mapping)
    if no_sequence or not hasattr(images, "__len__") or not hasattr(images, "__getitem__"):
        raise ValueError(f"images: a sequence of images is needed, not {type(images).__name__}")
    if len(images) == 0:
        raise ValueError("images: the sequence is empty")
    return images


def _pieces(images, n_steps, time_limit, folder, run, stiffness=None):
    """The rows of all images piece by piece, in order.

    Each piece is stored here, where the results come together, as soon as it is there: workers need not see `folder`.
    """
    size = min(PIECE, -(-len(images) // 16))  # 16: even a few images are shared out evenly
    starts = range(0, len(images), size)

    def read(number):
        rows = slice(starts[number], min(starts[number] + size, len(images)))
        return *_read(images, rows.start, rows.stop), None if stiffness is None else np.asarray(stiffness[rows])

    def file(number):
        piece, reasons, stiff = read(number)
        told = repr((reasons, n_steps, float(time_limit)))
        key = digest(piece, told, code_of_dataset(), *([] if stiff is None else [stiff]))
        return folder / f"{starts[number]:06d}-{key[:16]}.npz"

    files = {} if folder is None else {number: file(number) for number in range(len(starts))}
    there = {number: rows for number, path in files.items() if (rows := _stored(path)) is not None}
    missing = [number for number in range(len(starts)) if number not in there]
    new = run((*read(number), n_steps, time_limit, basic()) for number in missing) if missing else iter(())
    for number in range(len(starts)):
        while number not in there:
            task, rows = next(new)
            if folder is not None:
                _store(files[missing[task]], rows)
            there[missing[task]] = rows
        yield there.pop(number)


def _read(images, start, stop):
    """Images as one array, zero where one is unusable, and the reasons, empty where it is usable.

    Whatever an image may be, workers get numbers.
    """
    whole_numbers = getattr(images, "dtype", None) == np.uint8
    usable = np.zeros((stop - start, FRAME, FRAME), dtype=np.uint8 if whole_numbers else float)
    reasons = [""] * len(usable)
    for i in range(len(usable)):
        try:
            grey = labels.as_grey(images[start + i])
            usable[i] = images[start + i] if whole_numbers else grey
        except ValueError as error:
            reasons[i] = str(error)
        except Exception as error:  # a foreign object may raise anything when it is taken for an array
            reasons[i] = f"image cannot be read ({type(error).__name__}: {error})"
    return usable, reasons


def _simulate(images, reasons, stiffness, n_steps, time_limit, measured):
    """The rows of a few images, as a dict of arrays.

    The descriptors that are `measured` come along, since those that a user registered are unknown to other processes.
    """
    n = len(images)
    rows = {
        "image": images if images.dtype == np.uint8 else images.astype(np.float32),
        "label": np.zeros((n, FRAME, FRAME), dtype=np.float32),
        "converged": np.zeros(n, dtype=bool),
        "reason": list(reasons),
        "buildable": np.zeros(n, dtype=bool),
        "flaw": [Flaw.NO_STRUCTURE.name.lower()] * n,
        **{one.variable: np.full((n, *one.sizes.values()), np.nan) for one in measured},
        "factorisations": np.zeros(n, dtype=np.int32),
        "self_contact": np.zeros(n, dtype=np.int32),
        "contact_step": np.zeros(n, dtype=np.int32),
    }
    for i, image in enumerate(images):
        if rows["reason"][i]:
            continue
        try:
            rows["label"][i] = label = labels.label_image(image)
            relative = None if stiffness is None else stiffness[i]
            result = inflation.inflate(label, n_steps=n_steps, time_limit=time_limit, stiffness=relative)
            rows["factorisations"][i], rows["reason"][i] = result.factorisations, result.reason
            flaw = find_flaw(result)
            rows["flaw"][i] = flaw.name.lower() if flaw else ""
            if not result.converged:
                continue
            shape = Shape.of(result)
            values = {one.variable: one.of(shape) for one in measured}
        except ValueError as error:
            rows["reason"][i] = str(error)
            continue
        rows["converged"][i], rows["buildable"][i] = True, not flaw
        for name, value in values.items():
            rows[name][i] = value
        if flaw and (first := contact.first_contact(result)) is not None:
            rows["contact_step"][i], rows["self_contact"][i] = first + 1, contact.self_contact(result)
    rows["reason"], rows["flaw"] = np.array(rows["reason"]), np.array(rows["flaw"])
    return rows


def _stored(path):
    """Rows from a file, or None where it is not there or damaged."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            return dict(stored)
    except (OSError, ValueError, EOFError, KeyError, BadZipFile, zlib.error):
        return None


def _store(path, rows):
    with draft(path) as place:
        np.savez(place, **rows)


def _assemble(parts, n_steps):
    import xarray as xr

    dims = {one.variable: ("structure", *one.sizes) for one in basic()}
    dims |= {"image": ("structure", "row", "column"), "label": ("structure", "row", "column")}
    variables = {
        name: (dims.get(name, ("structure",)), np.concatenate([part[name] for part in parts])) for name in parts[0]
    }
    data = xr.Dataset(variables, coords={"axis": ["x", "y"]})
    for name in ("reason", "flaw"):
        data[name] = data[name].astype(object)
    for name, (text, units) in ({one.variable: (one.meaning, "1") for one in basic()} | _UNITS).items():
        data[name].attrs |= {"long_name": text} | ({"units": units} if units else {})
    data.attrs = {
        "title": "Inflated structures and their descriptors",
        "length_unit": "side of the unit square that the image fills",
        "element": "bilinear quadrilateral with mean dilatation, one per wall pixel, plane strain",
        "lambda": inflation.LAMBDA,
        "mu": inflation.MU,
        "pressure": inflation.PRESSURE,
        "load_steps": n_steps,
        "inflate_lib": inflate_lib.__version__,
        **{package: version(package) for package in ("numpy", "scipy", "numba", "xarray")},
        "python": platform.python_version(),
        "references": "arXiv:2508.13097, section 3",
    }
    return data
