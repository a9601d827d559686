"""Mesh study: MNIST sevens with plain and mean dilatation elements, and FElupe's biquadratic ones as the truth.

    python benchmarks/mesh_study.py

writes data/reference/mesh_study.csv, which the appendix "Verification" reads, and mesh_study.json beside it, which says
where it comes from. FElupe comes with the extra `dev`. Ten minutes on an idle core; every inflation is kept in the
cache, so that a run that was stopped goes on where it was.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import pandas as pd

from inflate_lib import build_mesh, describe, inflate, label_image
from inflate_lib._cache import cached, code_version, digest
from inflate_lib.structures.labels import point_joints
from inflate_lib.structures.sources import load_sevens

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "helpers"))
import mechanics_peers
from mechanics_peers import GRADING, graded_mesh, inflate_with_felupe
from stored import store

STEPS = ("structures", "mechanics", "descriptors")  # what a row depends on
REFINEMENTS = {"mean-dilatation": (1, 2, 4, 8), "q1": (1, 2, 4, 8), "q2": (1, 2, 4, 6, 8)}
N_WHOLE = 3  # the first sevens without a joint of one node; and the first with one, for which there is no truth


def sizes(label, element, refine):
    """Height, width and hull area at full pressure."""
    if element == "q2":
        cells = build_mesh(label) if refine == 1 else graded_mesh(label, refine // 2)
        shape = describe(inflate_with_felupe(cells, n_steps=1, order=2, tolerance=1e-8)[-1])
    else:
        shape = describe(inflate(label, n_steps=2, element=element, refine=refine))
    return {"height": shape.height, "width": shape.width, "hull_area": shape.hull_area}


def main():
    sevens = load_sevens("mnist")
    labels = [label_image(image) for image in sevens.images[:50]]
    joints = [point_joints(label) for label in labels]
    whole = [number for number, n in enumerate(joints) if n == 0][:N_WHOLE]
    jointed = next(number for number, n in enumerate(joints) if n > 0)
    code = code_version(*(f"inflate_lib.{name}" for name in STEPS), mechanics_peers, Path(__file__))
    cases = [(number, e, n) for number in whole for e in REFINEMENTS for n in REFINEMENTS[e]]
    cases += [(jointed, "q2", n) for n in REFINEMENTS["q2"][:-1]]

    rows = []
    for number, element, refine in sorted(cases, key=lambda case: (case[1] == "q2", case[2])):
        started = time.monotonic()

        def make(target, scratch, case=(labels[number], element, refine)):
            target.write_text(json.dumps(sizes(*case)), encoding="utf-8")

        key = {"label": digest(labels[number]), "element": element, "refine": refine, "code": code}
        found = json.loads(cached("mesh-study", key, make, ".json").read_text(encoding="utf-8"))
        rows.append({"structure": number, "joints": joints[number], "element": element, "refine": refine} | found)
        seconds = time.monotonic() - started
        print(f"{len(rows)} of {len(cases)}, {seconds:.0f} s: {rows[-1]}", flush=True)

    table = pd.DataFrame(rows).sort_values(["structure", "element", "refine"])
    store(
        table, "mesh_study", "mesh_study.py", digits=10,
        data=f"{sevens.description}: the first {N_WHOLE} without a joint of one node, and the first with one",
        q2=f"biquadratic elements of FElupe, from two per pixel side on graded by {GRADING} towards its ends",
    )  # fmt: skip


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.partition("\n")[0]).parse_args()
    main()
