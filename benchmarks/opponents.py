"""Why a generative model at all? Designs that start from its drawings, or from the nearest training structures.

    python benchmarks/opponents.py --targets 5

asks for held-out targets in both ways, at equal processor time and with the same search, refinement and choice, and
writes data/reference/opponents.csv, which the chapter "Ask for your own shape" shows, and opponents.json beside it,
which says where it comes from. Everything runs in one thread; the clock starts when the weights and the simulated
structures are in memory. Finished targets are kept in the cache: a script that was stopped goes on where it was.
"""

import argparse
import json
import os
import time
from collections import Counter

import numpy as np
import pandas as pd
import torch
from scipy.stats import binomtest
from stored import store

from inflate_lib._cache import cached, code_version, digest
from inflate_lib.datasets.pairs import held_out, training_rows
from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.descriptors import Shape, descriptor_matrix, get_descriptor
from inflate_lib.experiments.metrics import bootstrap
from inflate_lib.experiments.run import model_digest
from inflate_lib.inverse.candidates import Drawings, Neighbours, differences
from inflate_lib.inverse.constraints import Constraints
from inflate_lib.inverse.search import Designs, Search, choose, find_model
from inflate_lib.inverse.targets import as_targets
from inflate_lib.mechanics.inflation import inflate
from inflate_lib.models.reach import check_reach
from inflate_lib.models.weights import load_model
from inflate_lib.structures.labels import FRAME, PIXEL, VOID, label_image

STARTS = "model", "training"
DESIGNS = 12  # asked for; twice as many hits are enough to choose from, as in `inflate design`
BATCH = {"model": 8, "training": 2}  # candidates; few, so that a search can be stopped close to its time
STRETCH = 0.1  # outlines are hulls of held-out structures, stretched or squeezed by up to so much each way
VOID_WIDTH, LID = 2, 1.03  # pixels; times the height of the structure that the target belongs to
TOLERANCE = {"outline": 0.03}


def options():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--profile", default="laptop", help="whose committed weights are asked")
    parser.add_argument("--targets", type=int, default=24, help="held-out targets of each kind")
    parser.add_argument("--seconds", type=float, default=3.0, help="processor time for each target and way")
    parser.add_argument("--tolerance", type=float, default=0.01, help="largest relative error; 0.03 for outlines")
    parser.add_argument("--source", default="mnist")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--remark", default="", help="what else the machine did, for the record")
    parser.add_argument("--name", default="opponents", help="of the files in data/reference")
    return parser.parse_args()


class Study:
    """The targets of each kind, and the searches for them."""

    def __init__(self, given):
        torch.set_num_threads(1)
        self.given, self.data = given, simulated_sevens(given.source)
        self.library = self.data["label"].values[training_rows(self.data)]
        self.rows = np.flatnonzero(self.data["buildable"].values & held_out(self.data.sizes["structure"]))

    def targets(self, kind):
        """Held-out targets of a kind that are within reach, each with its constraints."""
        numbers = np.random.default_rng([self.given.seed, list(KINDS).index(kind)])
        found = []
        for row in numbers.permutation(self.rows):
            wanted, constraints = KINDS[kind](self, row, len(found), numbers)
            if wanted is None:
                continue
            targets = as_targets(wanted)
            try:
                check_reach(targets.vectors, self.data.isel(structure=training_rows(self.data)))
            except ValueError:
                continue
            found.append((targets, constraints))
            if len(found) == self.given.targets:
                return found
        raise SystemExit(f"{kind}: {len(found)} targets are within reach")

    def values(self, row, *names):
        """Descriptors of a structure, as targets."""
        values = {name: descriptor_matrix(self.data.isel(structure=[row]), name)[0] for name in names}
        return {
            name: value.reshape(-1, 2) if get_descriptor(name).is_line else float(value[0])
            for name, value in values.items()
        }

    def search(self, kind, start, number, targets, constraints):
        """What a search has found, batch by batch, and the designs in the end."""
        given, model = self.given, find_model(targets, self.given.profile).made_for("steered")
        tolerance = TOLERANCE.get(kind, given.tolerance)

        seed = int(np.random.SeedSequence([given.seed, list(KINDS).index(kind), number]).generate_state(1)[0])

        def make(target, scratch):
            began = time.process_time()
            found = Designs([], [], targets, constraints, tolerance, DESIGNS, None, seed)
            search = Search(found, n_jobs=1)
            search.start_from(
                Drawings(model, targets, found.seed)
                if start == "model"
                else Neighbours(self.data, targets, constraints)
            )
            states = [(0.0, [], [])]  # seconds, the nearest, hits
            while states[-1][0] < given.seconds and len(states[-1][2]) < 2 * DESIGNS:
                if not search.go_on(BATCH[start]):
                    break
                states.append((time.process_time() - began, search.best[:DESIGNS], found.pool))
            if start == "training":  # in favour of the drawings, a batch of them that was begun in time counts
                states = [state for state in states if state[0] <= given.seconds]
            record = {"tried": found.tried, "rejected": {reason.name: n for reason, n in found.rejected.items()}}
            record["states"] = [
                [seconds, len(pool), min((one.error for one in best), default=None)] for seconds, best, pool in states
            ]
            target.write_text(json.dumps(record | self.measured(choose(states[-1][2], DESIGNS))))

        key = {"kind": kind, "start": start, "number": number, "seed": seed, "model": model_digest(model.trained)}
        key |= {"targets": digest(*targets.vectors.values()), "constraints": constraints.as_dict()}
        key |= {"sampling": dict(model.sampling), "seconds": given.seconds, "tolerance": tolerance, "n": DESIGNS}
        key |= {"data": digest(self.library), "batch": BATCH[start], "code": code_version("inflate_lib.inverse")}
        if start == "model":
            key["last batch"] = "counts"
        return json.loads(cached("opponents", key, make, ".json").read_text())

    def measured(self, designs):
        """The designs that would be handed out: errors, how they differ from one another, and their cavities."""
        labels = np.array([one.label for one in designs]).reshape(-1, FRAME, FRAME)
        apart = differences(labels, labels)[np.triu_indices(len(labels), 1)]
        return {
            "errors": [one.error for one in designs],
            "apart": float(apart.mean()) if len(apart) else None,
            "refined": ["flipped" in one.origin for one in designs],
            "cavities": [np.packbits(label == VOID).tobytes().hex() for label in labels],
        }

    def novelty(self, found):
        """Differences of all designs in some records from the training structures that are nearest to them."""
        bits = [np.frombuffer(bytes.fromhex(one), np.uint8) for record in found for one in record["cavities"]]
        labels = [label_image(np.unpackbits(one).reshape(FRAME, FRAME).astype(bool)) for one in bits]
        return differences(np.reshape(labels, (-1, FRAME, FRAME)), self.library).min(axis=1)


def one_number(study, row, number, rng):
    return study.values(row, ("height", "width", "area")[number % 3]), Constraints()


def several(*names):
    return lambda study, row, number, rng: (study.values(row, *names), Constraints())


def outline(study, row, number, rng):
    hull = Shape.of(inflate(study.data["label"].values[row].astype(float))).hull
    return {"outline": hull * rng.uniform(1 - STRETCH, 1 + STRETCH, 2)}, Constraints()


def under_a_constraint(study, row, number, rng):
    return (wide_void, symmetric, keep_out)[number % 3](study, row, number, rng)


def wide_void(study, row, number, rng):
    constraints = Constraints(min_void=VOID_WIDTH * PIXEL)
    narrow = constraints.broken_by(study.data["label"].values[row])
    return None if narrow else study.values(row, "height", "width"), constraints


def symmetric(study, row, number, rng):
    return study.values(row, "height"), Constraints(symmetric=True)


def keep_out(study, row, number, rng):
    lid = LID * float(study.data["height"][row])
    return study.values(row, "width"), Constraints(keep_out=(-1.0, lid, 2.0, 3.0))


KINDS = {
    "one number": one_number,
    "box": several("height", "width"),
    "axis": several("axis"),
    "height, width, area": several("height", "width", "area"),
    "height, width, area, axis": several("height", "width", "area", "axis"),
    "outline": outline,
    "under a constraint": under_a_constraint,
}


def row_of(kind, start, found, novelty, seconds):
    """One row of the table, from the records of the same kind and start."""
    n = len(found)
    numbers = [len(one["errors"]) for one in found]
    nearest = [one["states"][-1][2] for one in found]
    first = [next((at for at, hits, _ in one["states"] if hits), np.inf) for one in found]
    apart = [one["apart"] for one in found if one["apart"] is not None]
    row = {"targets": kind, "start": start, "n": n}
    for part, share in {"met at a quarter": 0.25, "met at half": 0.5}.items():
        row[part] = sum(at <= share * seconds for at in first)
    row["met"] = int(np.isfinite(first).sum())
    met = row["met"]
    row |= dict(zip(("met low", "met high"), map(float, binomtest(met, n).proportion_ci(method="wilson")), strict=True))
    low, high = bootstrap(lambda rows: np.mean(np.array(numbers)[rows]), n)
    row |= {"designs": float(np.mean(numbers)), "designs low": float(low), "designs high": float(high)}
    row["error"] = 100 * float(np.median([np.inf if error is None else error for error in nearest]))
    row["seconds"] = float(np.median([one["states"][-1][0] for one in found]))
    row["first"] = float(np.median(first))
    row["apart"] = 100 * float(np.median(apart)) if apart else np.nan
    row["novelty"] = 100 * float(np.median(novelty)) if len(novelty) else np.nan
    row["copies"] = 100 * float(np.mean(novelty == 0)) if len(novelty) else np.nan
    return row | {"tried": float(np.mean([one["tried"] for one in found]))}


def paired(found):
    """Both ways on the same targets: where only one of them succeeds, and how many designs more the training gives."""
    met = {start: np.array([one["states"][-1][1] > 0 for one in found[start]]) for start in STARTS}
    more = np.array(
        [len(b["errors"]) - len(a["errors"]) for a, b in zip(found["model"], found["training"], strict=True)]
    )
    only = {start: int((met[start] & ~met[other]).sum()) for start, other in (STARTS, STARTS[::-1])}
    low, high = bootstrap(lambda rows: more[rows].mean(), len(more))
    p = binomtest(only["training"], max(1, sum(only.values()))).pvalue
    return {
        "both": int((met["model"] & met["training"]).sum()),
        "neither": int((~met["model"] & ~met["training"]).sum()),
        "only": only,
        "p": float(p),
        "more designs": [float(more.mean()), float(low), float(high)],
        "fewer designs": int((more < 0).sum()),
    }


def main():
    given = options()
    load = os.getloadavg()[0]
    study = Study(given)
    kinds = {kind: study.targets(kind) for kind in KINDS}
    found = {(kind, start): [] for kind in KINDS for start in STARTS}
    for number in range(given.targets):
        for kind, targets in kinds.items():
            for start in STARTS:
                found[kind, start].append(study.search(kind, start, number, *targets[number]))
                print(f"{number} {kind}, {start}: {found[kind, start][-1]['states'][-1]}", flush=True)
    together = {start: [one for kind in KINDS for one in found[kind, start]] for start in STARTS}
    found |= {("all", start): records for start, records in together.items()}
    rows = [
        row_of(kind, start, records, study.novelty(records), given.seconds) for (kind, start), records in found.items()
    ]
    real = differences(study.data["label"].values[study.rows], study.library).min(axis=1)
    flaws = {start: sum((Counter(one["rejected"]) for one in together[start]), Counter()) for start in STARTS}
    store(
        pd.DataFrame(rows),
        given.name,
        "opponents.py",
        data=f"{study.data.attrs['source']}, {study.data.sizes['structure']} structures",
        profile=given.profile,
        sampling=dict(load_model(profile=given.profile).made_for("steered").sampling),
        seconds_per_target=given.seconds,
        designs=DESIGNS,
        tolerance={"outline": TOLERANCE["outline"], "all others": given.tolerance},
        paired=paired(together),
        rejected={start: {reason: int(n) for reason, n in flaws[start].most_common()} for start in STARTS},
        novelty_of_held_out_structures=[round(100 * float(q), 2) for q in np.quantile(real, [0.01, 0.5])],
        seed=given.seed,
        threads=1,
        remark=given.remark,
        load_average=[round(load, 1), round(os.getloadavg()[0], 1)],
    )


if __name__ == "__main__":
    main()
