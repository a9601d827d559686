"""What the 60,000 training digits of MNIST reach beyond the sevens, and what becomes of those without an equilibrium.

    python benchmarks/all_digits.py

Simulates the digits (a few minutes on two cores) or finds them in the cache. Writes data/reference/all_digits.nc, a few
numbers per structure and no image; all_digits.csv, a row per digit; and snapping.csv: the path of equilibrium of the
structures for which none is found at the full pressure, followed by its arc length, past the largest pressure.
"""

import numpy as np
import pandas as pd
from scipy.sparse import bmat, csc_array
from scipy.sparse.linalg import splu
from stored import store

from inflate_lib import build_mesh, inflate, label_image, paths
from inflate_lib.alternatives import open_parts, simulated_digits
from inflate_lib.alternatives.all_digits import (
    MET,
    compact,
    nearest_miss,
    reachable_area,
    save_compact,
    sizes_of,
    stored_digits,
)
from inflate_lib.mechanics.contact import boundary_edges, first_crossing
from inflate_lib.mechanics.inflation import PRESSURE, assemble, build_system

NAMES = ("zeros", "ones", "twos", "threes", "fours", "fives", "sixes", "sevens", "eights", "nines")
AXIS_MET = 0.02  # of the height


def nearest_axis(axes, sevens, own):
    """Mean distance of the points of each axis (n, 30, 2) from those of the nearest axis of a seven, over the height.

    Sevens count in both orientations; `own` (n,) is the number of the seven that does not count, -1 where all do.
    """
    both = np.concatenate([sevens, sevens * [-1, 1]]).astype(np.float32)
    flat, squares = both.reshape(len(both), -1), (both**2).sum(axis=(1, 2))
    apart = np.empty(len(axes))
    for start in range(0, len(axes), 1000):
        rows = slice(start, start + 1000)
        part = axes[rows].astype(np.float32)
        distance = squares - 2 * part.reshape(len(part), -1) @ flat.T
        mine = np.flatnonzero(own[rows] >= 0)
        for shift in (0, len(sevens)):
            distance[mine, own[rows][mine] + shift] = np.inf
        nearest = both[distance.argmin(axis=1)]
        height = axes[rows, -1, 1] * 30 / 29  # the axis ends an increment below the top
        apart[rows] = np.linalg.norm(part - nearest, axis=-1).mean(axis=1) / height
    return apart


def by_digit(table, seed=0):
    """A row for each digit, for all, and for as many of all as there are sevens."""
    sevens = sizes_of(table.where(table.digit == 7))
    some = np.random.default_rng(seed).permutation(table.sizes["structure"])[: len(sevens)]
    parts = {name: np.flatnonzero(table.digit == digit) for digit, name in enumerate(NAMES)}
    parts |= {"all": np.arange(table.sizes["structure"]), "as many as sevens": some}
    rows = []
    for name, numbers in parts.items():
        part = table.isel(structure=numbers)
        sizes, inflated = sizes_of(part), int(part.height.notnull().sum())
        rows.append({
            "digits": name, "structures": len(numbers), "inflated": inflated,
            "no equilibrium": int((part.flaw == "no_equilibrium").sum()),
            "buildable %": 100 * float(part.buildable.mean()),
            **{one: float(part[one].median()) for one in ("height", "width", "hull_area", "bow")},
            "h / w": float((part.height / part.width).median()),
            "reach": reachable_area(sizes),
            "beyond sevens %": 100 * float((nearest_miss(sevens, sizes) > MET).mean()),
            "axis beyond sevens %": 100 * float((part.axis_apart > AXIS_MET).sum() / inflated),
        })  # fmt: skip
    return pd.DataFrame(rows)


def matrix(system, blocks):
    """The tangent of a system, whose lower half stands in blocks of 2 × 2, as a sparse matrix."""
    pattern, n = system.pattern, len(system.order)
    column = np.concatenate([np.repeat(np.arange(n), np.diff(pattern.column_start)), np.arange(n)])
    row = np.concatenate([pattern.rows, np.arange(n)])
    place = (2 * row[:, None] + [0, 0, 1, 1]).ravel(), (2 * column[:, None] + [0, 1, 0, 1]).ravel()
    lower = csc_array((blocks.ravel(), place), shape=(2 * n, 2 * n))
    below = csc_array((blocks[: len(pattern.rows)].ravel(), tuple(part[: 4 * len(pattern.rows)] for part in place)),
                      shape=lower.shape)  # fmt: skip
    return lower + below.T


def positive_definite(sparse):
    try:
        np.linalg.cholesky(sparse.toarray())
    except np.linalg.LinAlgError:
        return False
    return True


def follow(label, longest=0.2, n_steps=500):
    """The path of equilibrium of a structure by its arc length: pressure, height, mean sideways move, stability.

    Unknowns are the positions x of the free nodes, in sides, and the pressure p, as a share of the full one. The next
    state has to be in equilibrium, r(x, p) = 0, and the step's length along the path's direction is given.
    """
    mesh = build_mesh(label)
    system, edges = build_system(mesh), boundary_edges(mesh.cells)
    positions, rows = mesh.nodes.copy(), []

    def equations(at):
        """Residual, tangent, and what the residual changes by with the pressure, in which it is linear."""
        positions[system.order] = at[:-1].reshape(-1, 2)
        state = assemble(system, positions, at[-1] * PRESSURE)
        r, tangent = state.residual.copy(), matrix(system, state.tangent)
        return r, tangent, assemble(system, positions, (at[-1] + 1) * PRESSURE).residual - r

    def solved(tangent, slope, right):
        """Solution of the equations of a step, the last of which is for its length; NaN where they are singular."""
        whole = bmat([[tangent, slope[:, None]], [direction[None, :-1], direction[None, -1:]]], format="csc")
        try:
            return splu(whole).solve(right)
        except RuntimeError:
            return np.full(len(right), np.nan)

    def corrected(at, length):
        """Newton's method from the point that lies ahead in the path's direction; None where it fails."""
        new = at + length * direction
        for _ in range(10):
            r, tangent, slope = equations(new)
            move = solved(tangent, slope, -np.append(r, direction @ (new - at) - length))
            if not np.abs(move).max() < 0.1:
                return None
            new = new + move
            if np.abs(move).max() < 1e-10:
                return new
        return None

    at, length = np.append(mesh.nodes[system.order].ravel(), 0.0), longest
    direction = np.append(np.zeros(len(at) - 1), 1.0)  # at first the pressure alone says where to go
    while at[-1] < 1 and len(rows) < n_steps:
        _, tangent, slope = equations(at)
        ahead = solved(tangent, slope, np.append(np.zeros(len(at) - 1), 1.0))
        direction = ahead / np.linalg.norm(ahead)
        with np.errstate(all="ignore"):
            while (new := corrected(at, length)) is None:
                length /= 2
                if length < 1e-4:
                    return rows
        at, length = new, min(1.5 * length, longest)
        stable = positive_definite(equations(at)[1])
        height, aside = positions[:, 1].max(), (positions - mesh.nodes)[:, 0].mean()
        row = {"pressure": at[-1] * PRESSURE, "height": height, "aside": aside, "stable": stable}
        rows.append(row | {"crossing": first_crossing(positions[None], edges) == 0})
    return rows


def main():
    data = open_parts(simulated_digits("all", "mnist", n_jobs=2))
    table = compact(data)
    axes, seven = data.medial_axis.values, table.digit.values == 7
    own = np.where(seven, np.cumsum(seven) - 1, -1)
    apart = nearest_axis(axes, axes[seven], own)
    meaning = "distance from the nearest axis of a seven, over the height"
    table["axis_apart"] = "structure", apart, {"long_name": meaning, "units": "1"}
    save_compact(table, paths.REFERENCE / "all_digits.nc")
    size = (paths.REFERENCE / "all_digits.nc").stat().st_size
    note = {"data": data.attrs["source_description"], "bytes": size}
    store(by_digit(stored_digits()), "all_digits", "all_digits.py", axis_met=AXIS_MET, **note)

    lost = np.flatnonzero((table.height.isnull() & (table.flaw == "no_equilibrium")).values)
    states = []
    for number in lost:
        label = label_image(data.image[number].values)
        states += [{"structure": int(number), "digit": int(table.digit[number]), **row} for row in follow(label)]
        for n_steps in (1, 40):
            result = inflate(label, n_steps)
            print(number, n_steps, "load steps:", result.reason or "an equilibrium at the full pressure")
    store(pd.DataFrame(states), "snapping", "all_digits.py", structures=len(lost), **note)


if __name__ == "__main__":
    main()
