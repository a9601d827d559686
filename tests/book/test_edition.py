"""The edition in figures/laptop: replaced by a whole run of that profile on MNIST, and by nothing else."""

import json
from types import SimpleNamespace

import pytest

from inflate_lib import paths
from inflate_lib.book import edition
from inflate_lib.book.run import RunError
from inflate_lib.cli import app


@pytest.fixture(autouse=True)
def run(tmp_path, monkeypatch):
    """A finished run of two notebooks, whose execution is not tested here: what they made, and why each is stale."""
    monkeypatch.setattr(paths, "FIGURES", tmp_path / "runs")
    monkeypatch.setattr(paths, "EDITION", tmp_path / "laptop")
    jobs = [SimpleNamespace(name=name, stale=lambda: "") for name in ("01_first", "02_second")]
    monkeypatch.setattr(edition, "plan", lambda profile: jobs)
    for name in ("picture", "table", "script"):
        publish(name)
    return jobs


def publish(name, content="1", **changes):
    """Write what a notebook publishes into the folder of the run."""
    suffixes = {"picture": [".png", ".svg"], "table": [".csv"], "script": [".js"]}[name]
    files = {f"{name}{suffix}": f"digest of {content}" for suffix in suffixes}
    origin = {"notebook": "01_first", "data_source": "mnist", "commit": "first", "uncommitted_changes": False}
    folder = paths.FIGURES / "laptop"
    folder.mkdir(parents=True, exist_ok=True)
    for file in files:
        (folder / file).write_text(content)
    (folder / f"{name}.json").write_text(json.dumps({"name": name, "files": files, **origin, **changes}))


def published():
    return {path.name: path.read_text() for path in paths.EDITION.iterdir()}


def test_pictures_and_tables_are_published_with_records_of_these_files_alone():
    edition.publish_edition()
    assert set(published()) == {"picture.png", "picture.json", "table.csv", "table.json"}
    assert list(json.loads(published()["picture.json"])["files"]) == ["picture.png"]


def test_a_new_commit_alone_changes_nothing_and_a_new_number_all_that_belongs_to_it():
    edition.publish_edition()
    first = published()
    publish("picture", commit="second")
    edition.publish_edition()
    assert published() == first
    publish("picture", content="2", commit="second")
    edition.publish_edition()
    changed = {name for name, text in published().items() if first[name] != text}
    assert changed == {"picture.png", "picture.json"}
    assert json.loads(published()["picture.json"])["commit"] == "second"


def test_what_no_notebook_makes_any_longer_leaves_the_edition():
    edition.publish_edition()
    publish("table", notebook="03_gone")
    edition.publish_edition()
    assert set(published()) == {"picture.png", "picture.json"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"data_source": "digits"}, "table: made from the embedded digits"),
        ({"uncommitted_changes": True}, "table: made by code that was not committed"),
    ],
)
def test_a_run_that_is_no_edition_changes_nothing(change, message):
    edition.publish_edition()
    before = published()
    publish("picture", content="2")
    publish("table", content="2", **change)
    with pytest.raises(RunError, match=message):
        edition.publish_edition()
    assert published() == before


def test_a_notebook_that_is_not_fresh_is_named(run):
    run[1].stale = lambda: "not executed yet"
    with pytest.raises(RunError, match="02_second: not executed yet"):
        edition.publish_edition()
    assert not paths.EDITION.exists()


@pytest.mark.parametrize("options", [["--profile", "ci"], ["--profile", "laptop", "--only", "04"]])
def test_only_a_whole_run_of_the_laptop_profile_can_be_published(options, monkeypatch):
    monkeypatch.setattr("sys.argv", ["inflate", "reproduce", "--publish", *options])
    with pytest.raises(SystemExit, match="--publish is for a run of all notebooks under the profile laptop"):
        app.run()


def test_what_no_record_lists_stays():
    edition.publish_edition()
    for name in ("notes.md", "mine.json"):
        (paths.EDITION / name).write_text("{}")
    (paths.EDITION / "folder").mkdir()
    (paths.FIGURES / "laptop" / "table.json").unlink()
    edition.publish_edition()
    left = {path.name for path in paths.EDITION.iterdir()}
    assert left == {"picture.png", "picture.json", "notes.md", "mine.json", "folder"}
