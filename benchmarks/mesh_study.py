"""Mesh study: three MNIST sevens with plain and mean dilatation elements, and biquadratic ones (FElupe) as the truth.

    python benchmarks/mesh_study.py

writes data/reference/mesh_study.csv, which the appendix "Verification" reads, and mesh_study.json beside it, which says
where it comes from. FElupe comes with the test extras; its finest mesh takes minutes per structure.
"""

import json
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd

from inflate_lib import build_mesh, describe, descriptors, inflate, inflation, label_image, mesh, paths, structures
from inflate_lib.cache import code_version
from inflate_lib.inflation import ELEMENTS, LAMBDA, MU, PRESSURE, Inflation
from inflate_lib.publishing import package_versions
from inflate_lib.sources import load_sevens

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from mechanics_peers import inflate_with_felupe

STRUCTURES = (0, 1, 2)
REFINEMENTS = {"mean-dilatation": (1, 2, 4, 8), "q1": (1, 2, 4, 8), "q2": (1, 2, 4)}


def biquadratic(label, refine):
    """The structure inflated with FElupe's biquadratic elements, as a result of ours."""
    cells = build_mesh(label, refine)
    deformed = inflate_with_felupe(cells, n_steps=2, order=2, tolerance=1e-8)[-1]
    corners = deformed[: len(cells.nodes)]  # extent and hull of the corners, as for the bilinear elements
    one = np.ones(1)
    return Inflation(cells, "q2", one, PRESSURE * one, (corners - cells.nodes)[None], True, "", 0, (LAMBDA, MU))


def main():
    sevens, rows = load_sevens("mnist"), []
    order = [(r, e, s) for e in (*ELEMENTS, "q2") for r in REFINEMENTS[e] for s in STRUCTURES]
    for refine, element, structure in sorted(order, key=lambda case: (case[1] == "q2", case[0])):
        label = label_image(sevens.images[structure])
        if element == "q2":
            result = biquadratic(label, refine)
        else:
            result = inflate(label, n_steps=2, element=element, refine=refine)
        assert result.converged, (structure, element, refine)
        shape = describe(result)
        sizes = {"height": shape.height, "width": shape.width, "hull_area": shape.hull_area}
        rows.append({"structure": structure, "element": element, "refine": refine} | sizes)
        print(rows[-1], flush=True)
        table = pd.DataFrame(rows).sort_values(["structure", "element", "refine"])
        table.to_csv(paths.REFERENCE / "mesh_study.csv", index=False, float_format="%.10g")
    note = {
        "made_by": "benchmarks/mesh_study.py",
        "data": f"{sevens.description}, numbers {', '.join(map(str, STRUCTURES))}; two load steps",
        "q2": "biquadratic elements of FElupe on the same cells; sizes are those of the corner nodes",
        "code_version": code_version(structures, mesh, inflation, descriptors),
        "packages": package_versions() | {"felupe": version("felupe")},
    }
    (paths.REFERENCE / "mesh_study.json").write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
