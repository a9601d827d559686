"""Beyond the sevens: what structures of all digits reach, in a table that is small enough for the repository."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import KDTree

from inflate_lib import paths
from inflate_lib._files import draft
from inflate_lib.datasets.simulate import simulate_dataset
from inflate_lib.descriptors import get_descriptor
from inflate_lib.descriptors.registry import implied
from inflate_lib.structures.sources import at_hand, load_digits

if TYPE_CHECKING:
    import xarray as xr

MET = 0.02  # a target counts as met where height and width are missed by no more than this
_STEP = 0.005  # of the grid on which targets stand, in sides
_KEPT = ("digit", "height", "width", "hull_area", "peak_stress", "peak_stretch", "buildable", "flaw", "reason")
_PACKED = {"dtype": "int16", "scale_factor": 2e-4, "_FillValue": -32768, "zlib": True, "complevel": 9}


def compact(data: "xr.Dataset") -> "xr.Dataset":
    """Of a data set with a variable ``digit`` all that takes no room: a few numbers per structure, without its image.

    The medial axis is replaced by two numbers: ``lean``, the sideways position of its last point, and ``bow``, its
    largest distance from the straight line between its ends, both in sides.
    """
    table, axis = data[[*_KEPT]].load(), data["medial_axis"].values
    ends = axis[:, -1]
    with np.errstate(invalid="ignore"):
        across = (axis[..., 0] * ends[:, None, 1] - axis[..., 1] * ends[:, None, 0]) / np.hypot(*ends.T)[:, None]
    named = {"lean": (ends[:, 0], "sideways position of the last point of the medial axis")}
    named["bow"] = np.abs(across).max(axis=1), "largest distance of the medial axis from the line between its ends"
    return table.assign({name: ("structure", values, {"long_name": text, "units": "1"})
                         for name, (values, text) in named.items()})  # fmt: skip


def save_compact(table: "xr.Dataset", path: Path) -> None:
    """Write such a table as a netCDF file, its numbers to four digits behind the point."""
    encoding: dict[str, dict] = {str(name): _PACKED for name, values in table.items() if values.dtype.kind == "f"}
    encoding |= {name: {"zlib": True, "complevel": 9} for name in ("digit", "buildable")}
    encoding |= {name: {"dtype": "S1", "zlib": True, "complevel": 9} for name in ("flaw", "reason")}
    with draft(path) as place:
        table.drop_vars("structure", errors="ignore").to_netcdf(place, engine="h5netcdf", encoding=encoding)


def stored_digits() -> "xr.Dataset":
    """The table of MNIST's 60,000 training digits, in the order of the file, that ``benchmarks/all_digits.py`` made."""
    import xarray as xr

    return xr.load_dataset(paths.REFERENCE / "all_digits.nc", engine="h5netcdf")


def nearest_digits(wanted: Mapping[str, np.ndarray], n: int = 512, n_jobs: int = -1) -> "xr.Dataset | None":
    """The training digits of MNIST whose numbers come nearest to targets, simulated; None where MNIST is not at hand.

    Parameters
    ----------
    wanted : Mapping
        Name of a descriptor → its vector (N,). An axis and an outline count by what they say about the others.
    n : int
        How many; 512 take two seconds of a core.

    Returns
    -------
    xarray.Dataset
        As of :func:`inflate_lib.simulate_dataset`, with the place in MNIST's file as the coordinate ``structure``.
    """
    if not at_hand("mnist"):
        return None
    table, known = stored_digits(), {**implied(wanted), **wanted}
    numbers = {get_descriptor(name).variable: vector for name, vector in known.items() if len(vector) == 1}
    miss = np.max([np.abs(table[name].values / value - 1) for name, value in numbers.items()], axis=0)
    rows = np.argsort(miss, kind="stable")[:n]  # what did not inflate comes last
    data = simulate_dataset(load_digits("all", "mnist").images[rows], n_jobs, progress_text=False)
    return data.assign_coords(structure=rows)


def sizes_of(table: "xr.Dataset") -> np.ndarray:
    """Heights and widths of the structures that inflate, (n, 2)."""
    sizes = np.column_stack([table["height"].values, table["width"].values])
    return sizes[np.isfinite(sizes).all(axis=1)]


def nearest_miss(sizes: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """How far the nearest of some structures, (n, 2), is from each target (..., 2), a height and a width.

    The larger of the two relative errors counts.
    """
    far, _ = KDTree(np.log(sizes)).query(np.log(targets), p=np.inf)
    return np.expm1(far)


def met_targets(sizes: np.ndarray, tolerance: float = MET, step: float = _STEP) -> np.ndarray:
    """The targets (k, 2) on a grid of heights and widths that some structure of these sizes meets."""
    ends = sizes.min(axis=0) / (1 + 2 * tolerance), sizes.max(axis=0) * (1 + 2 * tolerance)
    grid = np.stack(np.meshgrid(*(np.arange(*pair, step) for pair in zip(*ends, strict=True))), axis=-1)
    return grid[nearest_miss(sizes, grid) <= tolerance]


def reachable_area(sizes: np.ndarray, tolerance: float = MET, step: float = _STEP) -> float:
    """How large the region of the plane of height and width is in which targets are met, in sides²."""
    return len(met_targets(sizes, tolerance, step)) * step**2
