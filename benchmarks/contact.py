"""What contact between walls costs and what it changes, over all MNIST sevens.

    python benchmarks/contact.py [--n 6265]

Each seven is inflated as in the paper and with `contact=True`. Writes data/reference/contact.csv, one row for all, for
those whose walls come near one another, and for those whose walls do not; and contact_table1.csv, the centroids of the
paper's Table 1 with and without contact; the appendix "Verification" reads both. Two minutes on an idle core; every
hundred sevens are kept in the cache, so that a run that was stopped goes on where it was.
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
from inflate_lib.mechanics import find_flaw, first_contact

STEPS = ("structures", "mechanics", "descriptors")
CHUNK = 100
SIZES = ["height", "width", "hull_area"]


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


def main(n: int = 6265):
    images = load_sevens("mnist").images[:n]
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
    ratio = every["seconds 1"] / every["seconds 0"]
    made_by, data = "contact.py", f"MNIST training sevens: {len(every)}"
    dearest = round(float(ratio[every.touching].quantile(0.95)), 2)
    store(pd.DataFrame(summary), "contact", made_by, data=data, cost_of_touching_95_percent=dearest)

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
