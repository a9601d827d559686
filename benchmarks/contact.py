"""What contact between walls costs and what it changes, over all MNIST sevens.

    python benchmarks/contact.py [--n 6265] [--only-verify]

Each seven is inflated as in the paper and with `contact=True`. Writes data/reference/contact.csv, one row for all, for
those whose walls come near one another, and for those whose walls do not; and contact_table1.csv, the centroids of the
paper's Table 1 with and without contact; the appendix "Verification" reads both. Two minutes on an idle core; every
hundred sevens are kept in the cache, so that a run that was stopped goes on where it was.

Two more tables verify the barrier. contact_convergence.csv: what contact changes in some structures, in percent of the
size without it on the same mesh, as the gap, the stiffness and the mesh change. contact_newton.csv: the residual in
each iteration of Newton's method, with the exact tangent, from one load step in contact to the next.
"""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import typer
from stored import seconds, store

from inflate_lib import describe, inflate, label_image, load_sevens
from inflate_lib._cache import cached, code_version, digest
from inflate_lib.experiments.targets import TABULATED, compare_with_paper, find_clusters
from inflate_lib.mechanics import _barrier, contact, find_flaw, first_contact
from inflate_lib.mechanics.contact import coupled_system, walls_of
from inflate_lib.mechanics.inflation import assemble, build_system, solve

STEPS = ("structures", "mechanics", "descriptors")
CHUNK = 100
SIZES = ["height", "width", "hull_area"]
SEVENS = (8, 15, 16)  # without a joint of one node, for which a finer mesh has no limit
GAPS, STIFFNESSES, REFINEMENTS = (0.2, 0.1, 0.05, 0.025, 0.0125), (0.03, 0.1, 0.3, 1.0), (1, 2, 4)


def row_of(label):
    """What is kept of one structure: the same quantities without contact (0) and with it (1)."""
    row, moved = {}, []
    for which, how in enumerate((inflate, partial(inflate, contact=True))):
        spent, result = seconds(how, label)
        shape = describe(result) if result.converged else None
        row |= {f"{size} {which}": getattr(shape, size) if shape else np.nan for size in SIZES}
        row |= {f"seconds {which}": spent, f"failed {which}": not result.converged}
        row |= {f"crossing {which}": first_contact(result) is not None}
        row |= {f"buildable {which}": find_flaw(result) is None}
        moved.append(result.displacement)
    return row | {"touching": not np.array_equal(*moved, equal_nan=True)}


def verify(images):
    """The two tables of the barrier itself."""
    rows, residuals = [], []
    for number in SEVENS:
        label = label_image(images[number])
        studies = [("gap (pixels)", gap, {"contact": gap / 28}) for gap in GAPS]
        studies += [("stiffness (μ)", stiffness, {"contact": True}) for stiffness in STIFFNESSES]
        studies += [("elements per pixel side", n, {"contact": 0.1 / 28, "refine": n}) for n in REFINEMENTS]
        for study, value, how in studies:
            stiffness, contact.STIFFNESS = contact.STIFFNESS, value if study.startswith("stiff") else contact.STIFFNESS
            result = inflate(label, **how)
            contact.STIFFNESS = stiffness
            shape, free = describe(result), describe(inflate(label, refine=how.get("refine", 1)))
            changes = {f"{size} (%)": 100 * (getattr(shape, size) / getattr(free, size) - 1) for size in SIZES}
            crossing = first_contact(result) is not None
            rows.append({"structure": number, "study": study, "value": value, **changes, "crossing": crossing})
    for number in SEVENS[:2]:
        found = newton(inflate(label_image(images[number]), contact=True))
        residuals += [{"structure": number, "iteration": i, "residual": size} for i, size in enumerate(found)]
    store(pd.DataFrame(rows), "contact_convergence", "contact.py")
    store(pd.DataFrame(residuals), "contact_newton", "contact.py", digits=3, load_step="9 to 10 of 10")


def newton(result):
    """Largest residual in each iteration, from the last load step but one to the last."""
    x, residuals = result.deformed(-2), []
    walls = walls_of(result.mesh, result.gap, result.lame[1])
    while not residuals or (residuals[-1] > 1e-13 and len(residuals) < 20):
        system, _ = coupled_system(lambda pairs: build_system(result.mesh, couplings=pairs), walls, x)
        state, load = assemble(system, x, result.pressures[-1], walls), np.zeros_like(x)
        load[system.order] = -state.residual.reshape(-1, 2)
        residuals.append(np.abs(load).max())
        walls.step[:] = solve(system, state, load)
        x += _barrier.share_before_touch(walls, _barrier.on_the_way(walls, 1.0), 1.0) * walls.step
    return residuals


def main(n: int = 6265, only_verify: bool = False):
    images = load_sevens("mnist").images[:n]
    verify(images)
    if only_verify:
        return
    code = code_version(*(f"inflate_lib.{name}" for name in STEPS), Path(__file__))
    row_of(label_image(images[0])), row_of(label_image(images[4]))  # compiled before the clock runs
    rows = []
    for start in range(0, len(images), CHUNK):
        chunk = images[start : start + CHUNK]

        def make(target, scratch, chunk=chunk):
            target.write_text(json.dumps([row_of(label_image(image)) for image in chunk]), encoding="utf-8")

        kept = cached("contact", {"images": digest(chunk), "code": code}, make, ".json")
        rows += json.loads(kept.read_text(encoding="utf-8"))
    keep(pd.DataFrame(rows))


def keep(every):
    """Both tables, from one row for each structure."""
    summary = []
    for name, part in {"all": every, "touching": every[every.touching], "apart": every[~every.touching]}.items():
        row = {"structures": name, "n": len(part)}
        for which, suffix in enumerate(("", "_contact")):
            for count in ("failed", "crossing", "buildable"):
                row[f"{count}{suffix}"] = int(part[f"{count} {which}"].sum())
            row[f"ms{suffix}"] = 1e3 * part[f"seconds {which}"].mean()
            row |= {f"{size}{suffix}": part[f"{size} {which}"].mean() for size in SIZES}
        row["cost"] = row["ms_contact"] / row["ms"]
        for size in SIZES:
            change = 100 * (part[f"{size} 1"] / part[f"{size} 0"] - 1).abs()
            row[f"{size}_change"], row[f"{size}_largest"] = change.mean(), change.max()
        summary.append(row)
    ratio = (every["seconds 1"] / every["seconds 0"])[every.touching]
    made_by, data = "contact.py", f"MNIST training sevens: {len(every)}"
    note = {f"cost_of_touching_{q}_percent": round(float(ratio.quantile(q / 100)), 2) for q in (50, 95)}
    store(pd.DataFrame(summary), "contact", made_by, data=data, **note)

    tables = {}
    for which, suffix in enumerate(("without", "contact")):
        whole = every[[f"{size} {which}" for size in SIZES]].to_numpy()
        height, width, area = whole[np.isfinite(whole).all(axis=1)].T[:, :, None]
        matrices = dict(zip(TABULATED, (height, width, np.hstack([height, width]), area), strict=True))
        tables[suffix] = compare_with_paper({name: find_clusters(each).centroids for name, each in matrices.items()})
    table = tables["without"].rename(columns={"here": "without", "deviation_percent": "without_percent"})
    table["contact"], table["contact_percent"] = tables["contact"].here, tables["contact"].deviation_percent
    note = {f"mean_deviation_{name}_percent": round(float(one.deviation_percent.abs().mean()), 3)
            for name, one in tables.items()}  # fmt: skip
    store(table, "contact_table1", made_by, data=data, **note)


if __name__ == "__main__":
    typer.run(main)
