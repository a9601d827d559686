"""A file of the laboratory becomes a design with all its files; what is none is refused."""

import json

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from inflate_lib import describe, inflate, label_image, load_sevens
from inflate_lib.cli.app import _load_commands
from inflate_lib.inverse.drawn import continue_drawn, read_drawn
from inflate_lib.mechanics import find_flaw


@pytest.fixture(scope="module")
def structure():
    """A seven that can be built: its cavity, its descriptors."""
    labels = (label_image(image) for image in load_sevens("digits", limit=20).images)
    label, result = next((label, r) for label in labels if find_flaw(r := inflate(label)) is None)
    return label == 1, describe(result)


def told(cavity, **changes):
    rows = ["".join("1" if pixel else "0" for pixel in row) for row in cavity]
    return {"format": "inflate-lab 1", "image": rows, "settings": {"pressure": 0.01}, "targets": {}} | changes


def test_it_is_refined_towards_its_targets(structure, tmp_path):
    cavity, shape = structure
    file = tmp_path / "structure.json"
    file.write_text(json.dumps(told(cavity, targets={"height": 1.03 * shape.height})))
    found = continue_drawn(file)
    (one,) = found.designs
    assert one.within
    assert one.shape.height == pytest.approx(1.03 * shape.height, rel=0.01)
    assert one.origin["flipped"]
    assert found.refined == 1


def test_the_command_writes_all_its_files(structure, tmp_path):
    cavity, shape = structure
    file, out = tmp_path / "structure.json", tmp_path / "designs"
    file.write_text(json.dumps(told(cavity)))
    done = CliRunner().invoke(_load_commands(), ["design", "--from", str(file), "--out", str(out)])
    assert done.exit_code == 0, done.output
    written = np.asarray(Image.open(out / "design_01" / "structure.png"))
    assert np.array_equal(written > 200, cavity)
    record = json.loads((out / "design_01" / "design.json").read_text())
    assert record["achieved"]["height"] == pytest.approx(shape.height)
    assert record["origin"] == {"drawn": "structure.json", "flipped": []}
    assert (out / "design_01" / "mould.stl").is_file()


@pytest.mark.slow
def test_its_borders_can_be_smooth(structure, tmp_path):
    cavity, shape = structure
    file, out = tmp_path / "structure.json", tmp_path / "designs"
    file.write_text(json.dumps(told(cavity, targets={"height": shape.height})))
    done = CliRunner().invoke(_load_commands(), ["design", "--smooth", "--from", str(file), "--out", str(out)])
    assert done.exit_code == 0, done.output
    record = json.loads((out / "design_01" / "design.json").read_text())
    assert record["borders"] == "smooth" and record["errors"]["height"] <= 0.01
    assert record["achieved"]["height"] == pytest.approx(shape.height, rel=0.01)
    file.write_text(json.dumps(told(cavity, targets={"stress": 0.2})))
    with pytest.raises(ValueError, match=r"stress cannot be asked of smooth borders.*--no-smooth"):
        continue_drawn(file, smooth=True)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "other"}, "none of the laboratory's"),
        ({"image": ["0" * 28] * 27}, "28 rows of 28"),
        ({"image": [["0"] * 28] * 28}, "28 rows of 28"),
        ({"settings": {"pressure": 0.02}}, "pressure is 0.02, but designs have 0.01"),
        ({"settings": {"colour": "red"}}, "no such setting"),
        ({"targets": {"height": -1}}, "height must be"),
        ({"targets": {"beauty": 1}}, "unknown target"),
        ({"targets": {"height": 1, "drawing": 5}}, "unknown target 'drawing'"),
        ({"targets": {"self": 5}}, "unknown target 'self'"),
        ({"targets": {"outline": [[0, 0], [1, 1]]}}, "outline: three points that are not on one line"),
        ({"targets": {"outline": [[0, 0], [1, 1], [2, 2], [0.5, 0.5]]}}, "outline: three points"),
        ({"goal": {"height": 1}}, "goal is no part of such a file"),
        ({"image": ["0" * 28] * 28}, "cannot be built"),
    ],
)
def test_what_is_no_such_file_is_refused(structure, tmp_path, changes, message):
    file = tmp_path / "structure.json"
    file.write_text(json.dumps(told(structure[0], **changes)))
    with pytest.raises(ValueError, match=message) as error:
        continue_drawn(file)
    assert "structure.json" in str(error.value)


@pytest.mark.parametrize(
    "options",
    [
        ["--symmetric"], ["--keep-out-mm", "0", "0", "9", "9"], ["--prefer", "low-stress"], ["--height", "1"],
        ["--number", "12"], ["--seconds", "90"], ["--candidates", "9"], ["--start-from", "both"], ["--profile", "ci"],
        ["--outline-unit", "5"],
    ],
)  # fmt: skip
def test_options_without_effect_on_a_drawing_are_refused(structure, options, tmp_path):
    file, out = tmp_path / "structure.json", tmp_path / "designs"
    file.write_text(json.dumps(told(structure[0])))
    done = CliRunner().invoke(_load_commands(), ["design", "--from", str(file), "--out", str(out), *options])
    assert isinstance(done.exception, ValueError)
    assert str(done.exception).endswith(f"leave out {options[0]}")
    assert not out.exists()


@pytest.mark.parametrize("text", ["{", "[" * 100_000])
def test_what_is_no_json_is_refused(text, tmp_path):
    (tmp_path / "file.json").write_text(text)
    with pytest.raises(ValueError, match=r"file\.json cannot be read as JSON"):
        read_drawn(tmp_path / "file.json")
