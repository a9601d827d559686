"""Data sets of inflated structures (paper sec. 3): many images → label, inflate, describe → one netCDF file.

Nothing is dropped: an image that gives no structure, or a structure without an equilibrium, keeps its row with
``converged = False`` and the reason.
"""

import os
import platform
import zlib
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import xarray as xr
from joblib import Parallel, delayed

import inflate_lib
from inflate_lib import contact, descriptors, inflation, material, mesh, progress, skyline, sources, structures
from inflate_lib.cache import cached, code_version, digest
from inflate_lib.descriptors import AXIS_POINTS

SIZE = 28  # pixels
CHUNK = 64  # structures per unit of work, which is what a killed run can lose

_UNITS = {
    "height": ("deformed height h", "1"),
    "width": ("deformed width w", "1"),
    "hull_area": ("area A of the deformed convex hull", "1"),
    "medial_axis": ("medial axis of the deformed shape, bottom to top, first point at the origin", "1"),
    "image": ("grey image of the undeformed structure", "1"),
    "label": ("label image: 0 outside, 0.5 wall, 1 void", "1"),
    "converged": ("every load step reached equilibrium", "1"),
    "reason": ("why not converged; empty where converged", ""),
    "factorisations": ("factorisations of the tangent", "1"),
    "self_contact": ("pairs of boundary edges that cross at the last load step: walls overlap where positive", "1"),
    "contact_step": ("first load step, from 1, at which boundary edges cross; 0 where they never do", "1"),
}


def simulate_dataset(images, n_jobs=-1, n_steps=10, progress_text=True, folder=None, cluster=None):
    """Label, inflate and describe many images.

    Parameters
    ----------
    images : (n, 28, 28) array_like, or a sequence of images
        uint8, or float in [0, 1]. What is no usable image is not an error: its row holds the reason.
    n_jobs : int
        Processes; -1 for one per core, 1 for none besides this one.
    n_steps : int
        Load steps of each inflation.
    progress_text : bool
        Print a line every few seconds.
    folder : path_like, optional
        Where finished parts are kept: a run that was killed goes on from them.
    cluster : str, optional
        Address of the scheduler of a Dask cluster, ``tcp://host:8786``, that works instead of local processes. Its
        workers need this version of ``inflate_lib``, and no access to `folder`.

    Returns
    -------
    xarray.Dataset
        One row per image, in order, along ``structure``: image, label, converged, reason (empty where converged),
        height, width, hull_area, medial_axis (structure, point, axis), factorisations, self_contact, contact_step
        (see :mod:`inflate_lib.contact`). Descriptors are in lengths and
        areas of the unit square, NaN where not converged.

    Raises
    ------
    ValueError
        Where `images` is no sequence of images at all, or `n_jobs` or `n_steps` is out of range.
    RuntimeError
        Where the Dask cluster does not answer or fails; a worker that dies is no failure.
    """
    images = _as_sequence(images)
    if isinstance(n_jobs, bool) or not isinstance(n_jobs, int | np.integer) or n_jobs == 0:
        raise ValueError(f"n_jobs must be 1, 2, … processes or -1 for one per core, not {n_jobs!r}")
    inflation.check_steps(n_steps)
    starts = range(0, len(images), CHUNK)
    parts = (images[start : start + CHUNK] for start in starts)
    if folder is None:
        jobs = (delayed(_simulate)(part, n_steps) for part in parts)
    else:
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        numbered = zip(parts, starts, strict=True)
        jobs = (delayed(_simulate_once)(part, n_steps, folder, start) for part, start in numbered)
    workers = 1 if len(images) <= CHUNK else n_jobs
    if cluster is None:
        done = Parallel(n_jobs=workers, return_as="generator")(jobs)
    else:
        done = _simulate_on_cluster(cluster, images, starts, n_steps, folder)
    if progress_text:
        done = progress.track(((len(part["height"]), part) for part in done), len(images), "inflating structures")
    return _assemble(list(done), n_steps)


def simulated_sevens(source="auto", n_structures=None, n_jobs=-1, cluster=None):
    """The simulated sevens, computed once and kept on disk.

    Parameters
    ----------
    source : {"auto", "mnist", "digits"}
        See :func:`inflate_lib.sources.load_sevens`.
    n_structures : int, optional
        Only the first ones.
    n_jobs : int
        Processes; -1 for one per core.
    cluster : str, optional
        Address of a Dask scheduler, see :func:`simulate_dataset`.

    Returns
    -------
    xarray.Dataset
        See :func:`simulate_dataset`.
    """
    return load_dataset(simulated_sevens_file(source, n_structures, n_jobs, cluster))


def simulated_sevens_file(source="auto", n_structures=None, n_jobs=-1, cluster=None):
    """Path of the netCDF file that :func:`simulated_sevens` reads."""
    sevens = sources.load_sevens(source, limit=n_structures)
    code = code_version(structures, mesh, skyline, material, inflation, descriptors, contact, __name__)

    def make(target, scratch):
        data = simulate_dataset(sevens.images, n_jobs=n_jobs, folder=scratch, cluster=cluster)
        data.attrs |= {"source": sevens.source, "source_description": sevens.description, "code_version": code}
        save_dataset(data, target)

    return cached("dataset", {"images": digest(sevens.images), "steps": 10, "code": code}, make, ".nc")


def held_out(n):
    """Which of n structures no model is trained on: every tenth, those with ``index % 10 == 9``.

    The rule looks at the position in the whole data set alone, before structures that did not converge are left out and
    before augmentation, so that no flip or shift of a held-out structure is ever seen in training.

    Returns
    -------
    (n,) bool
    """
    return np.arange(n) % 10 == 9


def save_dataset(data, path):
    """Write a data set as one netCDF file, compressed."""
    encoding = {name: {"zlib": True, "complevel": 4} for name in data.data_vars if data[name].dtype.kind in "fiu"}
    data.to_netcdf(path, engine="h5netcdf", encoding=encoding)


def load_dataset(path):
    """Read a data set that :func:`save_dataset` wrote.

    Raises
    ------
    ValueError
        Where the file is missing, or is no data set of inflated structures.
    """
    try:
        data = xr.load_dataset(path, engine="h5netcdf")
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as a netCDF data set: {error}") from None
    if missing := {"image", "converged", "reason", "height", "width", "hull_area", "medial_axis"} - set(data.variables):
        raise ValueError(f"{path} is no data set of inflated structures; it lacks {', '.join(sorted(missing))}")
    return data


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


def _simulate(images, n_steps):
    """The rows of a few images, as a dict of arrays."""
    n = len(images)
    rows = {
        "image": np.zeros((n, SIZE, SIZE), dtype=np.uint8),
        "label": np.zeros((n, SIZE, SIZE), dtype=np.float32),
        "converged": np.zeros(n, dtype=bool),
        "reason": [""] * n,
        "height": np.full(n, np.nan),
        "width": np.full(n, np.nan),
        "hull_area": np.full(n, np.nan),
        "medial_axis": np.full((n, AXIS_POINTS, 2), np.nan),
        "factorisations": np.zeros(n, dtype=np.int32),
        "self_contact": np.zeros(n, dtype=np.int32),
        "contact_step": np.zeros(n, dtype=np.int32),
    }
    whole_numbers = getattr(images, "dtype", None) == np.uint8
    if not whole_numbers:
        rows["image"] = np.zeros((n, SIZE, SIZE), dtype=np.float32)
    for i, image in enumerate(images):
        try:
            grey = structures.as_grey(image)
            rows["image"][i] = image if whole_numbers else grey
            rows["label"][i] = label = structures.label_image(image)
            result = inflation.inflate(label, n_steps=n_steps)
        except ValueError as error:
            rows["reason"][i] = str(error)
            continue
        rows["converged"][i], rows["reason"][i] = result.converged, result.reason
        rows["factorisations"][i] = result.factorisations
        if result.converged:
            shape = descriptors.describe(result)
            rows["height"][i], rows["width"][i], rows["hull_area"][i] = shape.height, shape.width, shape.hull_area
            rows["medial_axis"][i] = shape.medial_axis
            rows["self_contact"][i] = contact.self_contact(result)
            first = contact.first_contact(result)
            rows["contact_step"][i] = 0 if first is None else first + 1
    rows["reason"] = np.array(rows["reason"])
    return rows


def _simulate_once(images, n_steps, folder, start):
    """As `_simulate`, but read from `folder` where an earlier run finished it for the same images."""
    path = _part_file(images, n_steps, folder, start)
    rows = _stored(path)
    if rows is None:
        rows = _simulate(images, n_steps)
        _store(path, rows)
    return rows


def _simulate_on_cluster(address, images, starts, n_steps, folder):
    """Parts in order; each is stored here, where the results come together, as soon as it is there."""
    from inflate_lib.cluster import run

    parts = [images[start : start + CHUNK] for start in starts]
    files = [_part_file(part, n_steps, folder, start) for part, start in zip(parts, starts, strict=True)]
    there = {number: rows for number, file in enumerate(files) if (rows := _stored(file)) is not None}
    missing = [number for number in range(len(parts)) if number not in there]
    new = run(address, _simulate, ((parts[number], n_steps) for number in missing)) if missing else iter(())
    for number in range(len(parts)):
        while number not in there:
            task, rows = next(new)
            there[missing[task]] = rows
            _store(files[missing[task]], rows)
        yield there.pop(number)


def _part_file(images, n_steps, folder, start):
    """Where the rows of these images are kept; None where they are not."""
    try:
        return folder and folder / f"{start:06d}-{n_steps}-{digest(np.asarray(images))[:12]}.npz"
    except (TypeError, ValueError, RuntimeError):  # ragged or not numeric: nothing to recognise it by
        return None


def _stored(path):
    """Rows from a file, or None where it is not there or damaged."""
    if path is None:
        return None
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            return dict(stored)
    except (OSError, ValueError, EOFError, KeyError, BadZipFile, zlib.error):
        return None


def _store(path, rows):
    if path is None:
        return
    draft = path.with_name(f".{os.getpid()}-{path.name}")
    np.savez(draft, **rows)
    os.replace(draft, path)


def _assemble(parts, n_steps):
    dims = {"image": ("structure", "row", "column"), "label": ("structure", "row", "column")}
    dims["medial_axis"] = ("structure", "point", "axis")
    variables = {
        name: (dims.get(name, ("structure",)), np.concatenate([part[name] for part in parts])) for name in parts[0]
    }
    data = xr.Dataset(variables, coords={"axis": ["x", "y"]})
    data["reason"] = data["reason"].astype(object)
    for name, (text, units) in _UNITS.items():
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
