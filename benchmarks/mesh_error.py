"""The error of the pixel mesh over 200 MNIST sevens without a joint of one node, by element.

    python benchmarks/mesh_error.py [--n 200]

writes data/reference/mesh_error.csv, which the appendix "Verification" and README read, and mesh_error.json beside it.
Biquadratic elements would take hours for so many. The truth is extrapolated instead from two meshes of mean dilatation
elements that are graded towards the corners of the pixels, of two and of four elements per pixel side, of which the
second has a third of the error of the first. How near that comes is measured on the sevens of mesh_study.py, whose
biquadratic truth is known. A minute on an idle core; every seven is kept in the cache.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import typer
from stored import store

from inflate_lib import describe, inflate, label_image, load_sevens, paths
from inflate_lib._cache import cached, code_version, digest
from inflate_lib.alternatives.stabilised import inflate_with
from inflate_lib.structures.labels import point_joints

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "helpers"))
from mechanics_peers import GRADING, graded_mesh

SIZES = ["height", "width", "hull_area"]
VARIANTS = {
    ("mean-dilatation", 1): {},
    ("mean-dilatation", 2): {"refine": 2},
    ("q1", 1): {"element": "q1"},
    ("q1", 2): {"element": "q1", "refine": 2},
    ("stabilised", 1): {"element": "stabilised"},
}
STEPS = ("structures", "mechanics", "descriptors", "alternatives.stabilised")


def measured(result):
    if not result.converged:
        return [np.nan] * 3
    shape = describe(result)
    return [shape.height, shape.width, shape.hull_area]


def sizes_of(label):
    """Element and refinement → height, width and hull area; "truth" is extrapolated."""
    rows = {f"{element} {n}": measured(inflate_with(label, n_steps=1, **how)) for (element, n), how in VARIANTS.items()}
    coarse, fine = (np.array(measured(inflate(graded_mesh(label, layers), 1))) for layers in (1, 2))
    return rows | {"truth 0": (fine + (fine - coarse) / 2).tolist()}


def main(n: int = 200):
    sevens = load_sevens("mnist")
    code = code_version(*(f"inflate_lib.{name}" for name in STEPS), Path(__file__))
    study = pd.read_csv(paths.REFERENCE / "mesh_study.csv")
    known = study[(study.element == "q2") & (study.refine == 8)].set_index("structure")[SIZES]

    def found(label):
        def make(target, scratch):
            target.write_text(json.dumps(sizes_of(label)), encoding="utf-8")

        kept = cached("mesh-error", {"label": digest(label), "code": code}, make, ".json")
        return json.loads(kept.read_text(encoding="utf-8"))

    off = [100 * (np.array(found(label_image(sevens.images[k]))["truth 0"]) / known.loc[k] - 1) for k in known.index]
    rows, failed = [], 0
    for number in np.random.default_rng(0).permutation(len(sevens.images)):
        label = label_image(sevens.images[number])
        if point_joints(label):
            continue
        one = found(label)
        if not np.isfinite(list(one.values())).all():
            failed += 1
            continue
        for name, values in one.items():
            element, refine = name.split()
            row = {"structure": int(number), "element": element, "refine": int(refine)}
            rows.append(row | dict(zip(SIZES, values, strict=True)))
        if len(rows) == n * (len(VARIANTS) + 1):
            break
    frame = pd.DataFrame(rows).sort_values(["structure", "element", "refine"])
    store(
        frame, "mesh_error", "mesh_error.py", data=f"{sevens.description}: {n} at random without a joint of one node",
        left_out=f"{failed} whose graded meshes found no equilibrium",
        truth=f"b + (b − a) / 2, with meshes of two (a) and four (b) elements per pixel side, graded by {GRADING}",
        largest_difference_from_biquadratic_percent=round(float(np.abs(off).max()), 4),
    )  # fmt: skip


if __name__ == "__main__":
    typer.run(main)
