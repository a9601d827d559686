"""The frame of the book: where each page says its numbers come from, and what it prints with."""

import ast
import json
import os
import stat
from types import SimpleNamespace

import jupytext
import pytest
import yaml
from docutils import nodes
from docutils.utils import new_document
from PIL import Image as Picture

from inflate_lib import paths
from inflate_lib.book import pdf, sphinx_ext
from inflate_lib.book.run import executed_under, find_notebooks


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "PRETRAINED", tmp_path / "pretrained")
    monkeypatch.setattr(paths, "BOOK", tmp_path / "book")
    monkeypatch.setattr(paths, "EXECUTED", tmp_path / "book" / "notebooks")
    monkeypatch.setattr(paths, "FIGURES", tmp_path / "figures")
    paths.EXECUTED.mkdir(parents=True)
    return tmp_path


def executed(name, profile, source, **numbers):
    stamp = {"inflate": {"fingerprint": {"profile": profile, "data source": source}}}
    outputs = [
        {
            "data": {"application/papermill.record/text/plain": repr(value)},
            "metadata": {"scrapbook": {"name": key}, "inflate": {"type": type(value).__name__}},
        }
        for key, value in numbers.items()
    ]
    (paths.EXECUTED / f"{name}.ipynb").write_text(json.dumps({"cells": [{"outputs": outputs}], "metadata": stamp}))


def test_a_page_knows_its_run_only_from_its_own_notebook(home):
    executed("01_first", "ci", "mnist")
    assert executed_under(paths.EXECUTED / "01_first.ipynb") == {"profile": "ci", "source": "mnist"}
    (paths.EXECUTED / "02_second.ipynb").write_text("{}")
    for name in ("02_second.ipynb", "absent.ipynb", "../index.md"):
        assert executed_under(paths.EXECUTED / name) is None


@pytest.mark.parametrize("profile", ["ci", "laptop", "paper"])
def test_the_badge_names_profile_and_data_and_has_a_colour_of_its_own(profile):
    line = sphinx_ext.badge({"profile": profile, "source": "digits"})
    assert line.astext().startswith(f"{profile} profile")
    assert "embedded" in line.astext()
    css = (paths.BOOK / "_static" / "book.css").read_text(encoding="utf-8")
    assert f".{line['classes'][-1]} {{ --profile:" in css


def test_the_footer_names_profile_commit_and_date(monkeypatch):
    monkeypatch.setattr(sphinx_ext, "code_state", lambda: {"commit": "0123456789abcdef", "uncommitted_changes": True})
    text = sphinx_ext.footer("laptop")
    assert "<strong>laptop</strong>" in text
    assert "commit 0123456789 with uncommitted changes" in text
    assert text.rstrip("</p>")[-10:].count("-") == 2


def test_what_depends_on_the_run_comes_from_its_own_profile(home):
    """The picture and the data of another profile must not get into the book."""
    for profile in ("ci", "laptop"):
        folder = paths.FIGURES / profile
        folder.mkdir(parents=True)
        (folder / "glance.png").write_text("")
        (folder / "explorer_sheet.png").write_text("")
        (folder / "explorer_data.js").write_text("")
    executed("22_explorer", "laptop", "mnist", glance_n=24, glance_error_percent=1.26)
    config = SimpleNamespace(html_theme_options={}, myst_substitutions={}, html_static_path=["_static"])
    sphinx_ext._configure(None, config)
    assert "../figures/laptop/glance.png" in config.myst_substitutions["hero"]
    assert ":alt:" in config.myst_substitutions["hero"]
    assert "../figures/laptop/explorer_sheet.png" in config.myst_substitutions["explorer_sheet"]
    assert "24 structures were drawn for this height; their median error is 1.3 %." in config.myst_substitutions["hero"]
    explorers = [path for path in config.html_static_path if "explorer" in path]
    assert explorers == [str(paths.FIGURES / "laptop" / "explorer_data.js")]
    (paths.FIGURES / "laptop" / "glance.png").unlink()
    config = SimpleNamespace(html_theme_options={}, myst_substitutions={}, html_static_path=["_static"])
    sphinx_ext._configure(None, config)
    assert config.myst_substitutions["hero"] == ""


def test_model_cards_come_into_their_page_one_level_down(home):
    noted = []
    app = SimpleNamespace(env=SimpleNamespace(note_dependency=noted.append))
    page = [f"# Weights\n\n{sphinx_ext._MODEL_CARDS}\n"]
    sphinx_ext._add_model_cards(app, "data_and_weights", page)
    assert sphinx_ext._NO_WEIGHTS in page[0]
    (paths.PRETRAINED / "ci").mkdir(parents=True)
    card = paths.PRETRAINED / "ci" / "README.md"
    card.write_text("# Card\n\n## Recipe\n\n```python\n# a comment\n```\n\n# Limits\n")
    page = [f"# Weights\n\n{sphinx_ext._MODEL_CARDS}\n"]
    sphinx_ext._add_model_cards(app, "data_and_weights", page)
    assert page[0] == "# Weights\n\n## Card\n\n### Recipe\n\n```python\n# a comment\n```\n\n## Limits\n\n"
    assert noted == [str(card)]


def test_a_named_table_is_numbered_as_a_table_with_its_caption_first():
    document = new_document("chapter")
    for name in ("tab-sizes", "fig-sizes"):
        shown = nodes.figure("", nodes.container(), nodes.caption("", "Sizes of ten structures."), names=[name])
        document.note_explicit_target(shown, shown)
        document += shown
    sphinx_ext._CaptionTables(document).apply()
    table, figure = document.children
    assert isinstance(table, sphinx_ext._CaptionedTable) and document.ids["tab-sizes"] is table
    assert [type(part) for part in table] == [sphinx_ext._TableCaption, nodes.container]
    assert type(figure) is nodes.figure and [type(part) for part in figure] == [nodes.container, nodes.caption]


def test_every_table_of_a_notebook_has_a_caption_and_a_name_of_its_own():
    owner = {}
    for notebook in find_notebooks():
        for cell in jupytext.read(notebook).cells:
            if cell.cell_type != "code" or "page.table(" not in cell.source:
                continue
            where = f"{notebook.name}, {cell.source.splitlines()[-1]}"
            shown = ast.unparse(ast.parse(cell.source).body[-1])
            assert shown.startswith("page.table("), f"{where}: a cell ends with the table that it shows"
            options = cell.metadata.get("mystnb", {}).get("figure", {})
            name = options.get("name", "")
            assert name.startswith(sphinx_ext._TABLE), f"{where}: no name that begins with {sphinx_ext._TABLE}"
            assert len(options.get("caption", "")) > 40, f"{where}: no caption that can be read alone"
            assert owner.setdefault(name, where) is where, f"{where}: named like that of {owner[name]}"
    assert owner


def test_every_standing_page_is_in_the_contents():
    contents = yaml.safe_load((paths.BOOK / "_toc.yml").read_text(encoding="utf-8"))
    listed = {chapter["file"] for part in contents["parts"] for chapter in part["chapters"]} | {contents["root"]}
    pages = [*paths.BOOK.glob("*.md"), *paths.BOOK.glob("commands/*.md")]
    assert {path.relative_to(paths.BOOK).with_suffix("").as_posix() for path in pages} <= listed


def test_a_chapter_has_the_number_of_its_file():
    contents = yaml.safe_load((paths.BOOK / "_toc.yml").read_text(encoding="utf-8"))
    parts = [part for part in contents["parts"] if part.get("numbered", contents["defaults"]["numbered"])]
    numbered = [chapter["file"] for part in parts for chapter in part["chapters"]]
    assert numbered == [f"notebooks/{path.stem}" for path in find_notebooks()]
    assert [int(file.rpartition("/")[2][:2]) for file in numbered] == list(range(1, len(numbered) + 1))


def test_a_browser_is_found_where_it_is_named_or_usual(tmp_path, monkeypatch):
    program = tmp_path / "chromium"
    program.write_text("#!/bin/sh\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.delenv("INFLATE_CHROMIUM", raising=False)
    monkeypatch.setattr(pdf, "_APPLICATIONS", ())
    monkeypatch.setenv("PATH", str(tmp_path / "nowhere"))
    assert pdf._find_chromium() is None
    monkeypatch.setattr(pdf, "check_built", lambda: None)
    with pytest.raises(RuntimeError, match="no Chromium or Chrome found; install one"):
        pdf.print_book()
    monkeypatch.setenv("PATH", str(tmp_path))
    assert pdf._find_chromium() == program
    monkeypatch.setenv("INFLATE_CHROMIUM", str(tmp_path / "absent"))
    with pytest.raises(ValueError, match=r"INFLATE_CHROMIUM is .*absent, which is no program"):
        pdf._find_chromium()


def test_a_browser_that_prints_nothing_is_an_error(tmp_path):
    program = tmp_path / "chromium"
    program.write_text("#!/bin/sh\necho out of paper >&2\n")
    program.chmod(0o755)
    with pytest.raises(RuntimeError, match=r"wrote no PDF of .*page\.html: out of paper"):
        pdf._print_page(program, tmp_path / "page.html", tmp_path / "book.pdf")
    assert os.listdir(tmp_path) == ["chromium"]


@pytest.mark.parametrize(
    ("number", "printed"),
    [("-9.9", "−9.9"), ("2.4e-09", "2.4\u00a0·\u00a010⁻⁹"), ("1e+05", "1\u00a0·\u00a010⁵"),
     ("+0.4 [−1, -0.5]", "+0.4 [−1, −0.5]"), ("1.2 to 2.9", "1.2 to 2.9"),
     ("2025-11-28", "2025-11-28"), ("dpm-solver", "dpm-solver")],
)  # fmt: skip
def test_a_number_of_the_run_is_set_as_in_print(number, printed):
    assert sphinx_ext._typeset(number) == printed


def test_no_line_breaks_before_a_percent_sign_or_between_a_formula_and_its_comma():
    document = new_document("chapter")
    pasted = nodes.inline("", "-9.9", classes=["pasted-text"])
    line = nodes.paragraph("", "", nodes.math("", "x_t"), nodes.Text(", by "), pasted, nodes.Text(" % of "))
    line += [nodes.math("", "y"), nodes.Text(" or "), nodes.literal("", "5 % -1")]
    document += line
    sphinx_ext._keep_together(None, document, "chapter")
    assert document.astext() == "x_t, by −9.9\u00a0% of y or 5 % -1"
    assert [part.astext() for part in document.findall(nodes.inline) if "unbroken" in part["classes"]] == ["x_t,"]


def test_a_figure_is_as_wide_as_it_was_drawn_and_a_wide_one_scrolls_on_a_phone(tmp_path):
    document = new_document("chapter")
    for name, size in (("half", (669, 400)), ("whole", (1361, 400))):
        Picture.new("L", size).save(tmp_path / f"{name}.png", dpi=(200, 200))
        document += nodes.image(uri=f"{name}.png")
    sphinx_ext._size_pictures(SimpleNamespace(srcdir=tmp_path), document)
    half, whole = document.findall(nodes.image)
    assert (half["width"], whole["width"]) == ("50%", "100%")
    assert half.parent is document and "wide-picture" in whole.parent["classes"]
