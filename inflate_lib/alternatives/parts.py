"""Data sets larger than memory: netCDF files of some thousand structures, kept as they are simulated, read as one.

Each part is an expensive step of its own in the cache, so that a run that is killed goes on from the parts that are
there, and from the finished pieces of the next one; in memory there is never more than one part.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from inflate_lib import _progress
from inflate_lib._cache import cached, digest, step_version
from inflate_lib._checks import whole_number
from inflate_lib.alternatives.blends import Family
from inflate_lib.datasets.simulate import check_workers, code_of_dataset, simulate_dataset
from inflate_lib.datasets.storage import save_dataset
from inflate_lib.structures.sources import load_digits

if TYPE_CHECKING:
    import xarray as xr

PART = 4096  # structures per file, of about 5 MB


def simulated_digits(
    digits: str | Sequence[int] = "all",
    source: str = "auto",
    n_structures: int | None = None,
    test: bool = False,
    blends: int = 0,
    seed: int = 0,
    n_jobs: int | None = None,
    backend: str | None = None,
) -> list[Path]:
    """Digits of any kind, and blends of them, simulated once and kept on disk in parts.

    Parameters
    ----------
    digits, source, n_structures, test
        Which digits, see :func:`inflate_lib.structures.load_digits`.
    blends, seed
        So many blends of two of them, mirrored and shifted, follow the digits: see
        :class:`Family`.
    n_jobs, backend
        Who works, see :func:`inflate_lib.simulate_dataset`.

    Returns
    -------
    list of Path
        The netCDF files in order, alone with their notes in one folder of the cache; :func:`open_parts` reads them as
        one. Each is a data set as of :func:`inflate_lib.simulate_dataset`, with two more variables: ``digit``, which
        digit the image shows (-1: it is a blend), and the coordinate ``structure``, its number among all.
    """
    whole_number("n_structures", n_structures, 1, optional=True)
    whole_number("blends", blends, 0)
    check_workers(n_jobs, backend)
    found = load_digits(digits, source, n_structures, test)
    images = Family(found.images, blends, seed)
    labels = np.concatenate([found.labels.astype(np.int8), np.full(blends, -1, np.int8)])
    about = {
        "source": found.source,
        "source_description": found.description + (f", {blends} blends of two, seed {seed}" if blends else ""),
        "code_version": code_of_dataset(),
    }
    key = {**about, "images": digest(found.images), "structures": len(images), "steps": 10}
    if blends:  # which are not made by the code of a data set
        key["blending"] = step_version("alternative")
    folder = f"digits/{digest(repr(key))[:16]}"

    def parts() -> Iterator[tuple[int, Path]]:
        for start in range(0, len(images), PART):
            rows = np.arange(start, min(start + PART, len(images)))
            yield len(rows), cached(folder, {**key, "part": rows[[0, -1]].tolist()}, partial(make, rows), ".nc")

    def make(rows, target, scratch):
        part = np.stack([images[row] for row in rows])
        data = simulate_dataset(part, n_jobs, progress_text=False, folder=scratch, backend=backend)
        data = data.assign_coords(structure=rows).assign(digit=("structure", labels[rows]))
        data["digit"].attrs |= {"long_name": "digit that the image shows; -1: it is a blend", "units": "1"}
        data.attrs |= about
        save_dataset(data, target)

    return list(_progress.track(parts(), len(images), "inflating structures"))


def open_parts(files: Sequence[Path]) -> "xr.Dataset":
    """The parts as one data set whose values are read when they are asked for (Dask arrays); ``.load()`` reads all.

    Raises
    ------
    RuntimeError
        Where Dask is not installed.
    """
    import xarray as xr

    try:
        import dask.array  # noqa: F401
    except ImportError:
        raise RuntimeError("Dask is not installed here: pip install 'inflate-lib[dask]'") from None
    return xr.open_mfdataset(
        files, engine="h5netcdf", combine="nested", concat_dim="structure", data_vars="minimal", chunks=-1
    )
