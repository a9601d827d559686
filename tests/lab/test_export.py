"""The page's copy of the joint model is that of the committed weights."""

import json
import math

import pytest

from inflate_lib.io import browser
from inflate_lib.models import load_model


@pytest.fixture(scope="module")
def model():
    return load_model("joint")


def test_the_page_has_the_committed_weights(model):
    """And all that is told beside them, such as the calibrations."""
    current = browser.FILE.read_text() == browser.model_script(model, "laptop")
    assert current, "run `inflate export`"


def test_a_script_says_all_that_the_page_needs(model, tmp_path):
    file = browser.export(model, "laptop", tmp_path / "model.js")
    told = json.loads(file.read_text().removeprefix("window.inflateModel = ").removesuffix(";\n"))
    student = model.made_for("quick")
    assert browser.fingerprint(file) == told["fingerprint"] == student.trained.fingerprint
    assert sum(part["length"] for part in told["parts"]) == len(told["conditionMin"])
    assert {name: way["sampling"] for name, way in told["ways"].items()} == {
        name: dict(model.made_for(name).sampling) for name in ("quick", "varied")
    }
    assert told["reach"]["structures"] == model.reach.sizes["structure"]
    last = told["tensors"][-1]
    assert last["at"] + math.prod(last["shape"]) == student.trained.net.n_parameters
    browser.export(model, "laptop", file)  # its own file may be replaced


def test_a_foreign_file_stays(model, tmp_path):
    file = tmp_path / "model.js"
    file.write_text("window.mine = 1;\n")
    with pytest.raises(OSError, match=r"model\.js"):
        browser.export(model, "laptop", file)
    assert file.read_text() == "window.mine = 1;\n"
