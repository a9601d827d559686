"""What is committed in figures/laptop: the accuracy that the book claims for the committed weights, and its origin."""

import json

import pandas as pd
import pytest

from inflate_lib import paths
from inflate_lib.cache import digest

FOLDER = paths.FIGURES / "laptop"
SCALARS = ("height", "width", "box", "area")
NOTES = sorted(FOLDER.glob("*.json"))


def measured(measure, name):
    """A value without its interval, of the 200 held-out targets."""
    table = pd.read_csv(FOLDER / "held_out_scalars.csv").set_index("measure")
    return float(table.loc[measure, name].split()[0].replace("−", "-"))


@pytest.mark.parametrize("name", SCALARS)
def test_unseen_targets_are_met(name):
    assert measured("R²", name) >= 0.75
    assert measured("valid", name) >= 90


def test_every_file_is_named_by_a_record_of_where_it_comes_from():
    named = {}
    for note in map(json.loads, (path.read_text(encoding="utf-8") for path in NOTES)):
        assert (note["profile"], note["data_source"] or "mnist") == ("laptop", "mnist"), note["name"]
        assert note["uncommitted_changes"] is False, note["name"]
        named |= note["files"]
    files = {path.name for path in FOLDER.iterdir() if path.suffix != ".json"}
    assert files == set(named)
    assert not [name for name in files if digest((FOLDER / name).read_bytes()) != named[name]]
