"""The boxes "What we found": their numbers are those of the tables, and their words are true of the edition."""

import re

import jupytext
import pytest
from sphinx.application import Sphinx
from sphinx.util.docutils import docutils_namespace

from inflate_lib import paths
from inflate_lib.book import findings
from inflate_lib.book.findings import Tables, read_findings
from inflate_lib.book.run import find_notebooks

BOX = re.compile(r"^```\{findings\}\n(.*?)\n```$", re.DOTALL | re.MULTILINE)
BOXES = {path.stem: BOX.findall(jupytext.read(path).cells[0].source) for path in find_notebooks()}
FOUND = {
    f"{name}, {finding.text[:60]}": finding
    for name, boxes in BOXES.items()
    for box in boxes
    for finding in read_findings(box)
}
RESULTS = ("08", "09", "10", "11", "12", "13", "14", "15", "16", "17", "18", "19", "21", "24", "25")


@pytest.mark.parametrize("number", RESULTS)
def test_a_chapter_with_results_opens_with_what_was_found(number):
    """Three to six findings below the line that names the part of the library, every one with a number."""
    (name,) = (name for name in BOXES if name.startswith(number))
    assert len(BOXES[name]) == 1
    found = read_findings(BOXES[name][0])
    assert 3 <= len(found) <= 6
    assert all("[[" in finding.text for finding in found)
    assert sum(bool(finding.conditions) for finding in found) >= 2
    opening = jupytext.read(paths.NOTEBOOKS / f"{name}.md").cells[0].source.split("\n\n")
    assert opening[3].startswith("```{findings}")


@pytest.mark.parametrize("finding", FOUND.values(), ids=FOUND)
def test_what_a_box_says_is_true_of_the_edition(finding):
    tables = Tables(paths.EDITION)
    expressions = [found[0] for found in findings.NUMBER.findall(finding.text)] + finding.conditions
    values = {expression: tables.value(expression) for expression in expressions}
    false = [condition for condition in finding.conditions if not values[condition]]
    assert not false, f"no longer true: {tables.filled(finding.text)}"
    assert "–" not in tables.filled(finding.text) and "[[" not in tables.filled(finding.text)


@pytest.fixture
def tables(tmp_path):
    (tmp_path / "errors.csv").write_text(
        'of,by,error,error low,error high,R²\nheight,a,2.25,2,3,"−0.5 [−0.9, −0.1]"\nheight,b,1e-3,,,–\n'
    )
    (tmp_path / "scores.csv").write_text("measure,value,low,high\nvalid,99,97,100\n")
    return Tables(tmp_path)


def test_a_number_is_found_by_the_labels_of_its_row_and_brings_its_interval(tables):
    error = tables["errors"]("height", "a", "error")
    assert (error, error.low, error.high) == (2.25, 2, 3)
    worse = tables["errors"]("a", "R²")
    assert (worse, worse.low, worse.high) == (-0.5, -0.9, -0.1)
    share = tables["scores"]("valid", "value")
    assert (share, share.low, share.high) == (99, 97, 100)
    assert tables.value('max(errors["error"]) + min(x for x in scores["value"])') == 101.25
    assert tables.value('stored.table1("height", 1, "height")') == 0.93  # the paper's


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ('absent("a", "b")', "there is no table absent.csv in"),
        ('errors("height", "error")', r"errors.csv has 2 rows with \['height'\]"),
        ('errors("c", "error")', "errors.csv has 0 rows"),
        ('errors("b", "R²")', "or no number in 'R²'"),
        ('errors("a", "mistake")', "errors.csv has no column 'mistake', but of, by, error"),
        ('errors["mistake"]', "errors.csv has no column 'mistake'"),
    ],
)
def test_what_is_not_there_is_named_and_becomes_a_dash_on_the_page(tables, expression, message):
    with pytest.raises(LookupError, match=message):
        tables.value(expression)
    assert tables.filled(f"It is [[{expression} | .1f]] %.") == "It is – %."


def test_conditions_are_not_shown():
    first, second = read_findings("One is [[a | .1f]] %,\nor two.\n% a < 2\n\nThree.\n")
    assert first == ("One is [[a | .1f]] %,\nor two.", ["a < 2"])
    assert second == ("Three.", [])


@pytest.mark.parametrize(
    ("profile", "shown"), [("laptop", "R² is −0.5, of 2.2 %"), ("ci", "R² is −0.5 (−0.7), of 2.2 %")]
)
def test_a_box_shows_the_edition_and_beside_it_another_run(tables, tmp_path, monkeypatch, profile, shown):
    monkeypatch.setattr(paths, "EDITION", tables.folders[0])
    monkeypatch.setattr(paths, "FIGURES", tmp_path / "runs")
    monkeypatch.setattr(findings, "executed_under", lambda path: {"profile": profile})
    (tmp_path / "runs" / "ci").mkdir(parents=True)
    (tmp_path / "runs" / "ci" / "errors.csv").write_text("of,by,error,R²\nheight,a,2.25,−0.7\n")
    source = tmp_path / "source"
    source.mkdir()
    (source / "conf.py").write_text(
        "from inflate_lib.book.findings import FindingsBox\n"
        "extensions = ['myst_parser']\n"
        "def setup(app):\n    app.add_directive('findings', FindingsBox)\n"
    )
    sentence = 'R² is [[errors("a", "R²") | .1f]], of [[errors("a", "error") | .1f]] %.\n% 1 < 2'
    (source / "index.md").write_text(f"# Title\n\n```{{findings}}\n{sentence}\n\n**Another**.\n```\n")
    with docutils_namespace():
        Sphinx(source, source, tmp_path / "html", tmp_path / "trees", "html", status=None, warningiserror=True).build()
    page = (tmp_path / "html" / "index.html").read_text(encoding="utf-8")
    assert "What we found" in page and shown in page and "<strong>Another</strong>" in page and "1 &lt; 2" not in page
    assert ("this page, profile ci" in page) == (profile == "ci")
