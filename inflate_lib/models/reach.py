"""What can be reached: targets that contradict themselves, or that no structure comes near, are refused.

What is compared with is a data set of simulated structures, or the *table* of their descriptors alone, which lies
beside committed weights (``reach.npz``), so that a model can be asked where no image is at hand.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from inflate_lib.descriptors import PARTS, axis_height, basic, descriptor_matrix, get_descriptor

FILE = "reach.npz"  # beside the weights
AGREE = 1e-3  # relative difference up to which two statements of the same length count as one
_REACH = 0.1  # a target is within reach if a structure of the data set misses it by no more than this
SIZES = ("height", "width", "area")  # what an axis also says something about


def reach_of(data):
    """The table of a data set: its descriptors, of the structures that inflate, as a data set without the rest."""
    kept = [one.variable for one in basic() if one.variable in data]
    return data[[*kept, "converged"]].isel(structure=np.flatnonzero(data["converged"].values))


def save_reach(data, folder: Path) -> Path:
    """Write the table of a data set beside the weights in a folder, in 32 bits."""
    file = Path(folder) / FILE
    table = reach_of(data)
    np.savez_compressed(file, **{one.variable: table[one.variable].values.astype(np.float32) for one in _stored()})
    return file


def load_reach(folder: Path):
    """Read the table that lies beside the weights in a folder.

    Raises
    ------
    ValueError
        The file is not there, or is none that :func:`save_reach` wrote.
    """
    import xarray as xr

    file = Path(folder) / FILE
    try:
        with np.load(file, allow_pickle=False) as stored:
            table = xr.Dataset(
                {one.variable: (("structure", *one.sizes), stored[one.variable].astype(float)) for one in _stored()}
            )
        return table.assign(converged=("structure", np.ones(table.sizes["structure"], dtype=bool)))
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise ValueError(f"{file} cannot be read; `inflate card` writes it beside the weights ({error})") from None


def check_reach(wanted: Mapping[str, np.ndarray], data) -> None:
    """Refuse a target that contradicts itself, or that no structure of the data set comes near.

    Parameters
    ----------
    wanted : Mapping
        Name of each descriptor that is asked for, each a basic one → its vector (N,).
    data : xarray.Dataset
        Simulated structures, from :func:`inflate_lib.simulate_dataset`, or their table.

    Raises
    ------
    ValueError
        With the reachable range and the nearest target within reach.
    """
    data = data.isel(structure=np.flatnonzero(data["converged"].values))
    values = {name: descriptor_matrix(data, name) for name in wanted}
    with np.errstate(divide="ignore", invalid="ignore"):  # a target of zero is infinitely far from everything
        miss = np.max([get_descriptor(name).error.share(values[name], wanted[name]) for name in wanted], axis=0)
        problem = _contradiction(wanted)
    nearest = int(np.argmin(miss))
    scalars = [one.name for one in basic() if one.name in wanted and one.length == 1]
    for name in scalars:
        value, least, most = wanted[name][0], values[name].min() * (1 - AGREE), values[name].max() * (1 + AGREE)
        if not problem and not least <= value <= most:
            problem = f"{name} {value:.4g} is out of reach"
    if not problem and miss[nearest] > _REACH:
        together = "together they" if scalars or len(wanted) > 1 else f"the {next(iter(wanted))}"
        problem = f"{together} cannot be reached: the closest of all structures misses by {miss[nearest]:.0%}"
    if not problem:
        return
    shown = [one.name for one in basic() if one.name in scalars or (one.name in SIZES and "axis" in wanted)]
    ranges = {name: descriptor_matrix(data, name) for name in shown}
    reach = ", ".join(f"{name} {v.min():.3f} to {v.max():.3f}" for name, v in ranges.items())
    if len(wanted) == 1 and scalars:
        (name,) = scalars
        there = f"{name} {np.clip(wanted[name][0], values[name].min(), values[name].max()):.3f}"
    else:
        there = ", ".join(f"{name} {v[nearest, 0]:.3f}" for name, v in ranges.items())
        if "axis" in wanted:
            lean = np.abs(values["axis"][nearest].reshape(-1, 2)[:, 0]).max()
            there += f" and an axis that moves {lean:.3f} sideways"
    raise ValueError(
        f"{problem}. The {len(miss)} inflated structures of the data set reach {reach}; the nearest reachable target "
        f"is {there}."
    )


def _contradiction(wanted: Mapping[str, np.ndarray]) -> str:
    """Why no shape at all can meet what :func:`check_reach` takes, or an empty text."""
    height, width, area = (wanted[name][0] if name in wanted else np.nan for name in SIZES)
    if "axis" in wanted:
        axis = wanted["axis"].reshape(-1, 2)
        height = axis_height(axis) if np.isnan(height) else height
        if abs(axis_height(axis) / height - 1) > AGREE:
            return f"height {height:.4g} contradicts the axis, which belongs to height {axis_height(axis):.4g}"
        if (span := np.ptp(axis[:, 0])) > width:
            return f"width {width:.4g} contradicts the axis, which alone is {span:.4g} wide"
    if area > height * width * (1 + AGREE):
        return f"area {area:.4g} is larger than the box of height {height:.4g} and width {width:.4g}"
    return ""


def _stored():
    """The descriptors whose values are stored, the library's own."""
    return [get_descriptor(part) for part in PARTS]
