"""How the cost of one inflation grows with refinement and with the size of the image, on one core.

    python benchmarks/growth.py --repeats 3

Two ways to get more unknowns; one load step, default element:

* refined: the same structure with 1 to 8 elements per pixel side. A picture of it with 56, 112 or 224 pixels a side,
  its wall 4, 8 or 16 pixels thick, has the very same mesh.
* thin wall: the digit scaled up to 28 to 224 pixels a side, in a wall of two pixels whatever the size. The stiffness of
  a wall falls with the cube of its thickness, and so must the pressure (a thirtieth of the paper's, to begin with):
  with more, the slender walls buckle, and Newton's method has a harder problem, not a larger one.
"""

import numpy as np
import pandas as pd
import typer
from floor import multiply_adds
from scipy import ndimage
from stored import seconds, store
from threadpoolctl import threadpool_limits

from inflate_lib import build_mesh, inflate, label_image, load_sevens
from inflate_lib.mechanics.inflation import PRESSURE
from inflate_lib.structures.labels import THICKNESS, VOID

SCALES = (1, 2, 4, 8)


def scaled_label(label, scale):
    """The structure on `scale` times as many pixels a side, its wall as many pixels thick as before."""
    void = np.kron(label == VOID, np.ones((scale, scale), dtype=bool))
    void = np.roll(void, THICKNESS * (scale - 1), axis=0)  # down, so that the thinner wall stands on the bottom row
    wall = ndimage.maximum_filter(void, size=2 * THICKNESS + 1, mode="constant")
    return np.where(void, 1.0, np.where(wall, 0.5, 0.0))


def grown(label, scale):
    """Mesh and pressure for each way to grow."""
    yield "refined", build_mesh(label, scale), PRESSURE
    yield "thin wall", build_mesh(scaled_label(label, scale)), PRESSURE / 30 / scale**3


def slopes(table):
    """Exponents e of cost ∝ unknowns^e: straight lines through the logarithms, for an inflation and a factorisation."""
    return {
        f"{way}, {column}": float(np.polyfit(np.log(rows.unknowns), np.log(rows[column]), 1)[0])
        for way, rows in table[table.converged].groupby("grown")
        for column in ("ms", "ms_per_factorisation", "multiply_adds")
    }


def main(structures: int = 3, repeats: int = 3):
    sevens, rows = load_sevens(limit=structures), []
    with threadpool_limits(1):
        for structure, image in enumerate(sevens.images):
            label = label_image(image)
            inflate(label, 1)  # compiles before the clock starts
            for scale in SCALES:
                for way, mesh, pressure in grown(label, scale):
                    runs = [seconds(lambda m, p: inflate(m, 1, pressure=p), mesh, pressure) for _ in range(repeats)]
                    ms, result = 1e3 * float(np.median([run[0] for run in runs])), runs[0][1]
                    row = {"grown": way, "structure": structure, "scale": scale}
                    row |= {"unknowns": 2 * int(np.sum(~mesh.clamped)), "converged": result.converged}
                    row |= {"factorisations": result.factorisations, "multiply_adds": multiply_adds(mesh)}
                    rows.append(row | {"ms": ms, "ms_per_factorisation": ms / result.factorisations})
    table = pd.DataFrame(rows).sort_values(["grown", "structure", "scale"])
    store(
        table,
        "speed_growth",
        "growth.py",
        data=f"{sevens.description}, the first {len(sevens)}; one load step, mean dilatation",
        times=f"processor time on one core, median of {repeats} repeats",
        slopes=slopes(table),
    )


if __name__ == "__main__":
    typer.run(main)
