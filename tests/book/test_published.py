"""What is committed in figures/laptop: the accuracy of the committed weights, and where every file comes from."""

import json

import pandas as pd
import pytest

from inflate_lib import paths
from inflate_lib._cache import digest
from inflate_lib.models.recipe import EDITION

SCALARS = ("height", "width", "box", "area")


def measured(measure, name):
    """A value without its interval, of the held-out targets."""
    table = pd.read_csv(paths.EDITION / "held_out_scalars.csv").set_index("measure")
    return float(table.loc[measure, name].split()[0].replace("−", "-"))


@pytest.mark.parametrize("name", SCALARS)
def test_unseen_targets_are_met(name):
    assert measured("R²", name) >= 0.75
    assert measured("median error / target", name) <= 4
    assert measured("valid", name) >= 90


@pytest.mark.parametrize("name", SCALARS)
def test_the_best_of_sixteen_is_close(name):
    best = pd.read_csv(paths.EDITION / "best_of_n.csv")
    best = best[(best["descriptor"] == name) & (best["by"] == "simulation") & (best["n"] == 16)]
    assert len(best) == 1 and best["median"].item() <= 0.5


def test_every_file_is_named_by_a_record_of_where_it_comes_from():
    named = {}
    for note in map(json.loads, (path.read_text(encoding="utf-8") for path in paths.EDITION.glob("*.json"))):
        assert (note["profile"], note["data_source"] or "mnist") == (EDITION, "mnist"), note["name"]
        assert note["uncommitted_changes"] is False, note["name"]
        named |= note["files"]
    files = {path.name for path in paths.EDITION.iterdir() if path.suffix != ".json"}
    assert files == set(named)
    assert {path.rpartition(".")[2] for path in files} == {"png", "csv"}
    assert not [name for name in files if digest((paths.EDITION / name).read_bytes()) != named[name]]
