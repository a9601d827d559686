"""Inflation against peers: seconds per structure on one core, the same mesh and element, interleaved in one run.

    python benchmarks/inflation.py --structures 10 --repeats 3

FElupe and scikit-fem are libraries for any problem; peers.py says in which two ways each is used. "Solves" are the
linear systems of one inflation. Our default element, which none of the peers has, is timed as well. The median over the
repeats counts for each structure, and the mean over structures is printed; "ratio" is the ratio of the means.
"""

import numpy as np
import pandas as pd
import typer
from peers import felupe_as_documented, felupe_tuned, scikit_fem_as_documented, scikit_fem_tuned
from stored import seconds, store
from threadpoolctl import threadpool_limits

from inflate_lib import build_mesh, inflate, label_image, load_sevens


def _ours(element):
    def solve(mesh, n_steps):
        result = inflate(mesh, n_steps, element)
        assert result.converged, result.reason
        return result.displacement[-1], result.factorisations

    return solve


SOLVERS = {
    "inflate_lib, plain": _ours("q1"),
    "FElupe, as documented": felupe_as_documented,
    "FElupe, tuned by us": felupe_tuned,
    "scikit-fem, as documented": scikit_fem_as_documented,
    "scikit-fem, tuned by us": scikit_fem_tuned,
    "inflate_lib, mean dilatation (default)": _ours("mean-dilatation"),
}


def compare(meshes, n_steps, repeats):
    """One row per solver: time per structure, ratio to ours, linear solves, and distance of the displacements."""
    shape = len(SOLVERS), len(meshes)
    times, solves, apart = np.zeros((repeats, *shape)), np.zeros(shape), np.zeros(shape)
    for repeat in range(repeats):
        for k, mesh in enumerate(meshes):
            for s, solver in enumerate(SOLVERS.values()):
                times[repeat, s, k], (u, solves[s, k]) = seconds(solver, mesh, n_steps)
                if s == 0:
                    ours = u
                apart[s, k] = np.abs(u - ours).max()
    mean = np.median(times, axis=0).mean(axis=1)
    table = pd.DataFrame({"load_steps": n_steps, "solver": list(SOLVERS), "ms": 1e3 * mean, "ratio": mean / mean[0]})
    table["solves"], table["largest_difference"] = solves.mean(axis=1), apart.max(axis=1)
    table.loc[table.solver.str.contains("default"), "largest_difference"] = np.nan  # another element
    return table


def main(structures: int = 10, repeats: int = 3):
    sevens = load_sevens(limit=structures)
    meshes = [build_mesh(label_image(image)) for image in sevens.images]
    with threadpool_limits(1):  # one core for everybody
        compare(meshes[:1], 1, 1)  # compiles and imports before the clock starts
        table = pd.concat([compare(meshes, n_steps, repeats) for n_steps in (10, 1)])
    times = f"processor time on one core, solvers interleaved; median of {repeats} repeats, mean over structures"
    data = f"{sevens.description}, the first {len(meshes)}; plain bilinear quadrilaterals but for the default"
    store(table, "speed_peers", "inflation.py", data=data, times=times)


if __name__ == "__main__":
    typer.run(main)
