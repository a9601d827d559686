"""Pages: what they write is complete, attributed, and the same when nothing changed."""

import json

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from inflate_lib import paths
from inflate_lib.book import page as publishing
from inflate_lib.book.page import Page

NOTEBOOK = """\
# Title

```{code-cell} ipython3
:tags: [parameters]

profile = "interactive"  # set by the runner
source = "digits"  # data
seed = 0  # random numbers
steps = 10  # load steps
```
"""


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "NOTEBOOKS", tmp_path)
    monkeypatch.setattr(paths, "FIGURES", tmp_path / "figures")
    (tmp_path / "05_example.md").write_text(NOTEBOOK)
    return tmp_path


def page(**changes):
    names = {"profile": "ci", "source": "digits", "seed": 3, "steps": 10, "unrelated": object()}
    return Page("05_example", names | changes)


def picture(height=1.0):
    fig, axes = plt.subplots()
    axes.plot([0, height])
    axes.fill_between([0, 1], [0, height], hatch="/")  # hatches carry random identifiers unless salted
    return fig


def test_page_knows_its_parameters_and_says_where_data_come_from(capsys):
    example = page()
    assert example.parameters == {"profile": "ci", "source": "digits", "seed": 3, "steps": 10}
    assert (example.profile, example.source, example.seed) == ("ci", "digits", 3)
    assert "Profile: ci · data source: scikit-learn digits" in capsys.readouterr().out


def test_a_copy_of_a_notebook_does_not_publish_as_the_original(home, monkeypatch):
    monkeypatch.setenv("INFLATE_MANIFEST", str(home / "05_example.published.txt"))
    page()
    monkeypatch.setenv("INFLATE_MANIFEST", str(home / "05_example copy.published.txt"))
    with pytest.raises(ValueError, match=r"'05_example copy' must not publish as Page\('05_example', …\)"):
        page()


def test_a_figure_and_a_table_do_not_share_a_record(home):
    example = page()
    example.figure(picture(), "both")
    example.figure(picture(2.0), "both")  # a cell that is run again
    with pytest.raises(ValueError, match=r"'both' names \.png and \.svg already.*choose another name"):
        example.table(pd.DataFrame({"a": [1.0]}), "both")


def test_figure_has_both_formats_and_its_provenance(home):
    shown = page().figure(picture(), "fig01")
    folder = home / "figures" / "ci"
    note = json.loads((folder / "fig01.json").read_text())
    assert shown.data == (folder / "fig01.png").read_bytes()
    assert (folder / "fig01.svg").read_text().startswith("<?xml")
    assert note["notebook"] == "05_example"
    assert note["parameters"]["steps"] == 10
    assert (note["data_source"], note["seed"], note["profile"]) == ("digits", 3, "ci")
    assert note["packages"]["numpy"] == np.__version__
    assert note["commit"]
    assert set(note["files"]) == {"fig01.png", "fig01.svg"}
    assert not plt.get_fignums()


def test_the_same_figure_gives_the_same_bytes(home):
    def content():
        page().figure(picture(), "fig01")
        return [path.read_bytes() for path in sorted((home / "figures" / "ci").iterdir())]

    first = content()
    assert content() == first
    page().figure(picture(2.0), "fig01")
    assert [path.read_bytes() for path in sorted((home / "figures" / "ci").iterdir())] != first


def test_table_keeps_full_numbers_in_the_file_and_few_digits_on_the_page(home):
    frame = pd.DataFrame({"name": ["a_b", "c"], "value": [1 / 3, np.nan]})
    shown = page().table(frame, "table1", digits=2)._repr_mimebundle_()
    assert "0.33" in shown["text/html"]
    assert "0.333" not in shown["text/html"]
    assert "–" in shown["text/html"]
    assert r"a\_b" in shown["text/latex"]
    again = pd.read_csv(home / "figures" / "ci" / "table1.csv")
    assert again.value[0] == pytest.approx(1 / 3, rel=1e-7)
    assert list(again.columns) == ["name", "value"]


def test_an_interval_and_an_exponent_stay_on_one_line(home):
    frame = pd.DataFrame({"R²": ["0.5 [−0.1, 0.7]"], "first β": ["4.1e-05"], "widths": ["0.9, 1.1"]})
    shown = page().table(frame, "table1")._repr_mimebundle_()["text/html"]
    assert "<td>0.5 [−0.1,\u00a00.7]</td>" in shown
    assert "<td>4.1e−05</td>" in shown
    assert "<td>0.9, 1.1</td>" in shown


def test_runner_is_told_what_was_published(tmp_path, monkeypatch):
    monkeypatch.setenv(publishing.RUNNER, str(tmp_path / "05_example.published.txt"))
    page().figure(picture(), "fig01")
    assert (tmp_path / "05_example.published.txt").read_text().split() == [
        "ci/fig01.png",
        "ci/fig01.svg",
        "ci/fig01.json",
    ]


def test_mistakes_are_named(home):
    with pytest.raises(ValueError, match="matplotlib figure, not list"):
        page().figure([], "fig01")
    with pytest.raises(ValueError, match="no file name"):
        page().figure(picture(), "folder/fig01")
    plt.close("all")
    with pytest.raises(ValueError, match="DataFrame, not dict"):
        page().table({}, "table1")
    with pytest.raises(ValueError, match="one number or text, not list"):
        page().record("name", [1, 2])
    with pytest.raises(ValueError, match=r"no notebook 06_absent\.md"):
        Page("06_absent", {})
    with pytest.raises(ValueError, match="run the parameters cell first: steps"):
        Page("05_example", {"profile": "ci", "source": "digits", "seed": 0})
    with pytest.raises(ValueError, match="not an executed notebook"):
        publishing.recorded(home / "absent.ipynb")
