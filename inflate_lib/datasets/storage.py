"""A data set of inflated structures as one netCDF file."""

from pathlib import Path
from typing import TYPE_CHECKING

from inflate_lib._files import hand_out
from inflate_lib.descriptors import get_descriptor
from inflate_lib.descriptors.registry import PARTS

if TYPE_CHECKING:
    import xarray as xr


def save_dataset(data: "xr.Dataset", path: str | Path) -> None:
    """Write a data set as one netCDF file, compressed.

    Raises
    ------
    OSError
        Where the file cannot be written, or would replace one that is not as this library wrote it; nothing is left
        behind then.
    """
    encoding = {name: {"zlib": True, "complevel": 4} for name in data.data_vars if data[name].dtype.kind in "fiu"}
    with hand_out(path) as place:
        data.to_netcdf(place, engine="h5netcdf", encoding=encoding)


def load_dataset(path: str | Path) -> "xr.Dataset":
    """Read a data set that :func:`save_dataset` wrote.

    Raises
    ------
    ValueError
        Where the file is missing, or is no data set of inflated structures.
    """
    import xarray as xr

    try:
        data = xr.load_dataset(path, engine="h5netcdf")
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as a netCDF data set: {error}") from None
    needed = {"image", "converged", "reason", "buildable", "flaw"}
    needed |= {get_descriptor(part).variable for part in PARTS}
    if missing := needed - set(data.variables):
        raise ValueError(f"{path} is no data set of inflated structures; it lacks {', '.join(sorted(missing))}")
    return data
