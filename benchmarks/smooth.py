"""From stairs to curves: how far the descriptors of 200 MNIST sevens change where borders are smooth.

    python benchmarks/smooth.py

takes the sevens of mesh_error.py, gives each the smooth borders that `inflate design --smooth` cuts, with a wall of two
pixels everywhere, and inflates it. It writes data/reference/smooth.csv, which the chapter on design reads, and
smooth.json. The curves' own mesh is halved for every twentieth seven. About two minutes on an idle core.
"""

import time

import numpy as np
import pandas as pd
from stored import store

from inflate_lib import describe, inflate, label_image, load_sevens, paths
from inflate_lib.inverse.constraints import Constraints
from inflate_lib.inverse.refine import attempt, refine
from inflate_lib.inverse.smooth import smooth_cavity, smooth_plan, smoothed
from inflate_lib.inverse.targets import Targets, deviations
from inflate_lib.structures.labels import VOID, WALL

REFINED, CORRECTED = 30, 12
SIZES = ["height", "width", "hull_area"]


def measured(mesh):
    """Sizes inflated and at rest, and the area of the wall; NaN where there is no equilibrium."""
    result = inflate(mesh, 1)
    x, y = np.moveaxis(result.nodes[result.cells], -1, 0)
    wall = np.sum((x[:, 2] - x[:, 0]) * (y[:, 3] - y[:, 1]) - (x[:, 3] - x[:, 1]) * (y[:, 2] - y[:, 0])) / 2
    values = [describe(result), describe(result.nodes)] if result.converged else []
    sizes = [getattr(shape, name) for shape in values for name in SIZES] or [np.nan] * 6
    return dict(zip([*SIZES, *(f"{name} at rest" for name in SIZES)], sizes, strict=True)) | {"wall": wall}


def refined(images, n, seed=1):
    """Largest error and crumbs of n sevens refined towards sizes up to 3 % away, by whether crumbs are allowed."""
    rng, rows, done = np.random.default_rng(seed), [], 0
    for number in rng.permutation(len(images)):
        reason, label, result = attempt(images[number], Constraints())
        if reason:
            continue
        shape, factor = describe(result), 1 + rng.uniform(-0.03, 0.03, 2)
        for asked in (
            {"height": factor[0] * shape.height},
            {"height": factor[0] * shape.height, "width": factor[1] * shape.width},
        ):
            for crumbs in (True, False):
                trace = []
                found, after, _ = refine(
                    label, result, Targets(**asked), Constraints(), 1e-3, 60, trace=trace, crumbs=crumbs
                )
                error = max(deviations(Targets(**asked), describe(after)).values())
                rows.append({
                    "structure": int(number), "targets": " and ".join(asked), "crumbs allowed": crumbs,
                    "error": error, "crumbs": count_crumbs(found == VOID), "tries": len(trace),
                })  # fmt: skip
        done += 1
        if done == n:
            return pd.DataFrame(rows)
    return pd.DataFrame(rows)


def corrected(images, n, seed=2):
    """Largest error before and after the correction of n smooth sevens towards what their pixels inflate to."""
    rows, done = [], 0
    for number in np.random.default_rng(seed).permutation(len(images)):
        reason, label, result = attempt(images[number], Constraints())
        if reason:
            continue
        shape = describe(result)
        kinds = {"area": shape.hull_area, "axis": shape.medial_axis, "outline": shape.vector("outline")}
        for asked in ({"height": shape.height, "width": shape.width}, *({name: kinds[name]} for name in kinds)):
            targets, start = Targets(**asked), time.process_time()
            made = smoothed(label, targets, Constraints(), 0.005)
            spent = time.process_time() - start
            error = max(deviations(targets, describe(made[1])).values()) if made else np.nan
            row = {"structure": int(number), "targets": " and ".join(asked), "error": error, "seconds": spent}
            rows.append(row)
            print(row, flush=True)
        done += 1
        if done == n:
            break
    return pd.DataFrame(rows)


def count_crumbs(void):
    """Pixels with at most one of their four neighbours on their own side of the cavity's border."""
    padded = np.pad(void, 1)
    beside = [np.roll(padded, step, axis)[1:-1, 1:-1] != void for step in (-1, 1) for axis in (0, 1)]
    return int((np.sum(beside, axis=0) >= 3).sum())


def main():
    sevens = load_sevens("mnist")
    crumbs = refined(sevens.images, REFINED)
    made = corrected(sevens.images, CORRECTED)
    store(made, "corrected", "smooth.py", data=f"{sevens.description}: {CORRECTED} at random", goal=0.005)
    store(crumbs, "crumbs", "smooth.py", data=f"{sevens.description}: {REFINED} at random", goal=1e-3, tries=60)
    numbers = pd.read_csv(paths.REFERENCE / "mesh_error.csv").structure.unique()
    rows, halved = [], []
    for place, number in enumerate(numbers):
        label = label_image(sevens.images[number])
        columns = np.flatnonzero(label[-1] == WALL)
        line, base = smooth_cavity(label), (columns[0], columns[-1] + 1)
        curves = measured(smooth_plan(line, base).mesh())
        for borders, values in (("pixels", measured(label)), ("curves", curves)):
            rows.append({"structure": int(number), "borders": borders} | values)
        if place % 20 == 0:
            finer = measured(smooth_plan(line, base, per_pixel=4).mesh())
            halved.append([100 * abs(curves[name] / finer[name] - 1) for name in SIZES])
    frame = pd.DataFrame(rows)
    store(
        frame, "smooth", "smooth.py", data=f"{sevens.description}: {len(numbers)}, those of mesh_error.csv",
        no_equilibrium=int(frame.height.isna().sum()),
        halved_mesh_changes_percent={
            name: [round(float(np.nanmedian(part)), 3), round(float(np.nanmax(part)), 3)]
            for name, part in zip(SIZES, np.transpose(halved), strict=True)
        },
    )  # fmt: skip


if __name__ == "__main__":
    main()
