"""What can be reached: targets that contradict themselves, or that no structure comes near, are refused.

What is compared with is a data set of simulated structures, or the *table* of their descriptors alone, which lies
beside committed weights (``reach.npz``), so that a model can be asked where no image is at hand.
"""

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from inflate_lib._files import check_outputs, draft, read_by
from inflate_lib.descriptors import POINT_DISTANCE, descriptor_matrix, get_descriptor
from inflate_lib.descriptors.registry import OWN, basic, implied, registered

FILE = "reach.npz"  # beside the weights
_AGREE = 1e-3  # relative difference up to which two statements of the same length count as one
_REACH = 0.1  # a target is within reach if a structure of the data set misses it by no more than this


def reach_of(data):
    """The table of a data set: its descriptors, of the structures that inflate, as a data set without the rest."""
    kept = [one.variable for one in basic() if one.variable in data]
    return data[[*kept, "converged"]].isel(structure=np.flatnonzero(data["converged"].values))


def save_reach(data, folder: Path) -> Path:
    """Write the table of a data set beside the weights in a folder, in 32 bits."""
    check_reach_file(folder)
    file, table = Path(folder) / FILE, reach_of(data).drop_vars("converged")
    with draft(file) as place:
        np.savez_compressed(place, **{name: values.values.astype(np.float32) for name, values in table.items()})
    return file


def check_reach_file(folder: Path) -> None:
    """An OSError where the table cannot be written into a folder, or would replace a file that is none."""
    check_outputs([Path(folder) / FILE], ours=read_by(lambda file: load_reach(file.parent)))


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
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as stored:
            known = [one for one in basic() if one.name in OWN or one.variable in stored]
            table = xr.Dataset(
                {one.variable: (("structure", *one.sizes), stored[one.variable].astype(float)) for one in known}
            )
        return table.assign(converged=("structure", np.ones(table.sizes["structure"], dtype=bool)))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
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
    lines = [name for name in wanted if get_descriptor(name).is_line]
    numbers = [name for name in wanted if name not in lines]
    asked = _by_component(numbers, wanted)
    for label, reached in _by_component(numbers, values).items():
        least, most = reached.min(), reached.max()
        if not problem and not least - _AGREE * abs(least) <= asked[label] <= most + _AGREE * abs(most):
            problem = f"{label} {asked[label]:.4g} is out of reach"
    if not problem and miss[nearest] > _REACH:
        alone = len(asked) + len(lines) == 1
        problem = f"the {next(iter(wanted))} cannot be reached" if alone else "the targets cannot be reached together"
        problem += f": the closest of all structures misses by {miss[nearest]:.0%}"
    if not problem:
        return
    spoken_of = {*numbers, *(other for name in lines for other in get_descriptor(name).bounds)}
    shown = {one.name: descriptor_matrix(data, one.name) for one in basic() if one.name in spoken_of}
    reach = {label: (reached, reached[nearest]) for label, reached in _by_component(shown, shown).items()}
    if len(asked) == 1 and not lines:
        ((label, value),) = asked.items()
        reach[label] = reach[label][0], np.clip(value, reach[label][0].min(), reach[label][0].max())
    there = [f"{label} {value:.3f}" for label, (_, value) in reach.items()]
    points = [name for name in lines if get_descriptor(name).error is POINT_DISTANCE]
    there += [f"{name} ({np.abs(values[name][nearest, ::2]).max():.3f} sideways)" for name in points]
    ranges = [f"{label} {reached.min():.3f} to {reached.max():.3f}" for label, (reached, _) in reach.items()]
    raise ValueError(
        f"{problem}. The {len(miss)} inflated structures of the data set reach {', '.join(ranges) or 'others'}; the "
        f"nearest reachable target is {', '.join(there)}."
    )


def _contradiction(wanted: Mapping[str, np.ndarray]) -> str:
    """Why no shape at all can meet what :func:`check_reach` takes, or an empty text."""
    known = {**implied(wanted), **wanted}
    for one in registered():
        if not set(one.parts) <= set(known):
            continue
        vector = np.concatenate([known[part] for part in one.parts])
        giver = f"the {one.name}" if one.is_line else " and ".join(f"{part} {known[part][0]:.4g}" for part in one.parts)
        for name, bound in one.bounds.items():
            if name not in wanted:
                continue
            (value,), (least, most) = wanted[name], bound(vector)
            if least * (1 - _AGREE) <= value <= most * (1 + _AGREE):
                continue
            limit = least if value < least else most
            word = "" if least == most else "at least " if value < least else "at most "
            return f"{name} {value:.4g} contradicts {giver}, with which it is {word}{limit:.4g}"
    return ""


def _by_component(names, values):
    """Values (…, N) of descriptors as one of each component, by what it is called in a message."""
    components = {name: get_descriptor(name).components for name in names}
    return {
        f"{name} {component}" if len(components[name]) > 1 else name: values[name][..., k]
        for name in names
        for k, component in enumerate(components[name])
    }
