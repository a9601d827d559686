"""Calibration study: how far the centroids of all MNIST sevens are from Table 1, for other choices than the default.

    python benchmarks/calibration.py [processes]

writes data/reference/calibration.csv, which the appendix "Verification" reads, and calibration.json beside it, which
says where it comes from. Several minutes.
"""

import argparse
import json
from dataclasses import asdict

import numpy as np
import pandas as pd

from inflate_lib import paths
from inflate_lib._cache import code_version
from inflate_lib._provenance import package_versions
from inflate_lib.datasets.settings import SETTINGS, simulate_setting
from inflate_lib.experiments.targets import deviation_from_paper, find_clusters
from inflate_lib.structures.sources import load_sevens


def main(n_jobs):
    sevens = load_sevens("mnist")
    rows = []
    for setting in SETTINGS:
        sizes = simulate_setting(sevens.images, setting, n_jobs)
        good = sizes[np.isfinite(sizes).all(axis=1)]
        columns = {"height": good[:, :1], "width": good[:, 1:2], "box": good[:, :2], "area": good[:, 2:]}
        centroids = {name: find_clusters(matrix).centroids for name, matrix in columns.items()}
        mean, largest = deviation_from_paper(centroids)
        rows.append(
            asdict(setting)
            | {"n_simulated": len(good), "mean_deviation_percent": mean, "largest_deviation_percent": largest}
            | dict(zip(("mean_height", "mean_width", "mean_hull_area"), good.mean(axis=0), strict=True))
        )
        print(rows[-1], flush=True)
    pd.DataFrame(rows).to_csv(paths.REFERENCE / "calibration.csv", index=False, float_format="%.8g")
    note = {
        "made_by": "benchmarks/calibration.py",
        "data": sevens.description,
        "n_images": len(sevens.images),
        "code_version": code_version("inflate_lib.structures", "inflate_lib.mechanics", "inflate_lib.descriptors"),
        "packages": package_versions(),
    }
    (paths.REFERENCE / "calibration.json").write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("processes", type=int, nargs="?", default=1)
    main(parser.parse_args().processes)
