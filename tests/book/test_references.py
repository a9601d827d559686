"""Figures and tables are cited, where they are, and by sentences that speak of what they show."""

import re
from itertools import pairwise

import jupytext
import pytest
import yaml

from inflate_lib import paths
from inflate_lib.book.run import find_notebooks

NUMREF = re.compile(r"\{numref\}`([\w-]+)`")
NAMED = re.compile(r"[Ff]ig(?:ure|s)?\.?\s*|[Tt]ables?\s*")
WORD = re.compile(r"[a-zäöü]{4,}")
# Words that say little about what a text is about.
EMPTY = frozenset(
    re.findall(
        r"\w+",
        """
        about above after also among another asked below beside book column columns computed data each every first from
        given have here inflate inflated into left mean most number numbers other over page paper part percent profile
        right same shown structure structures than that their them then these they this those three under what when
        where which with without""",
    )
)


def in_reading_order():
    """Files of the book as its table of contents lists them."""
    contents = yaml.safe_load((paths.BOOK / "_toc.yml").read_text(encoding="utf-8"))
    files = [contents["root"], *(entry["file"] for part in contents["parts"] for entry in part["chapters"])]
    folders = [paths.ROOT if file.startswith("notebooks/") else paths.BOOK for file in files]
    return [(folder / f"{file}.md") for folder, file in zip(folders, files, strict=True)]


def stems(text):
    """The words of a text that say what it is about, without their endings."""
    text = re.sub(r"\{(?:doc|eq|cite[:\w]*)\}`[^`]*`", " ", text)
    return {word[:5] for word in WORD.findall(text.replace("-", " ").lower()) if word not in EMPTY}


class Chapter:
    """The citations of a file in order, and where its figures and tables stand among them."""

    def __init__(self, path):
        self.path, self.labels, self.citations = path, {}, []
        section, place = "", 0
        for cell in jupytext.read(path).cells:
            if cell.cell_type == "code":
                figure = cell.metadata.get("mystnb", {}).get("figure")
                place += 1
                if figure:
                    shown = cell.metadata["mystnb"].get("image", {}).get("alt", "")
                    self.labels[figure["name"]] = (place, section, f"{figure['caption']} {shown}", cell.source)
                    self._cite(figure["caption"], place, section, True)
                continue
            for block in re.split(r"\n(?=#+ )|\n\n", cell.source):
                place += 1
                if block.startswith("#"):
                    section = block.splitlines()[0]
                rows = block.splitlines() if block.startswith("|") else [block]
                for text in rows:
                    self._cite(text, place, section, False)

    def _cite(self, text, place, section, in_caption):
        for found in NUMREF.finditer(text):
            self.citations.append((found[1], place, section, text, text[: found.start()], in_caption))


FILES = in_reading_order()
CHAPTERS = {path.stem: Chapter(path) for path in FILES if path.is_file()}
ORDER = {name: number for number, name in enumerate(CHAPTERS)}
HOME = {label: name for name, chapter in CHAPTERS.items() for label in chapter.labels}
CITED = [(name, *citation) for name, chapter in CHAPTERS.items() for citation in chapter.citations]
WITH_FIGURES = [path.stem for path in find_notebooks()]


def test_every_label_is_given_once_and_every_citation_finds_one():
    labels = [label for chapter in CHAPTERS.values() for label in chapter.labels]
    assert len(labels) == len(set(labels)) > 100
    assert {label for _, label, *_ in CITED} <= set(labels)


@pytest.mark.parametrize("name", WITH_FIGURES)
def test_every_figure_and_table_is_cited_by_its_chapter(name):
    chapter = CHAPTERS[name]
    cited = {label for label, *_, in_caption in chapter.citations if not in_caption}
    assert sorted(set(chapter.labels) - cited) == []


@pytest.mark.parametrize("name", WITH_FIGURES)
def test_a_label_says_what_it_belongs_to_and_the_text_does_not_repeat_it(name):
    for label, (_, _, _, source) in CHAPTERS[name].labels.items():
        assert ("page.figure(" in source) == label.startswith("fig-"), label
        assert label.startswith(("fig-", "tab-")), label
    for label, _, _, _, before, _ in CHAPTERS[name].citations:
        assert not NAMED.fullmatch(before[-8:].split("(")[-1].lstrip(" ,;")), f"the kind of {label} is said twice"


@pytest.mark.parametrize("name", list(CHAPTERS))
def test_what_is_yet_to_come_is_announced(name):
    """A figure further on is in this section, or said to be "below"; one of a later chapter comes with its name."""
    for label, place, section, text, _, _ in CHAPTERS[name].citations:
        home = HOME[label]
        if home == name:
            where, its_section, *_ = CHAPTERS[name].labels[label]
            assert where <= place or section == its_section or "below" in text, f"{label} is cited too early"
        elif home in WITH_FIGURES and ORDER[home] > ORDER[name]:
            assert f"{{doc}}`{home}`" in text, f"{label} is cited without its chapter, {home}, which is yet to come"


@pytest.mark.parametrize("name", list(CHAPTERS))
def test_a_paragraph_speaks_of_what_it_cites(name):
    """It shares words with the caption, or with the name, of the figure or table."""
    for label, _, _, text, _, _ in CHAPTERS[name].citations:
        _, _, caption, source = CHAPTERS[HOME[label]].labels[label]
        about = stems(NUMREF.sub(" ", text))
        words = stems(caption) | stems(label[4:]) | stems(source)
        assert about & words, f"{label} is cited by a text on something else: {text}"


@pytest.mark.parametrize("name", list(CHAPTERS))
def test_of_two_of_a_kind_the_right_one_is_cited(name):
    """A text on guidance that never speaks of samplers means tab-toy-guidance, not tab-toy-samplers."""
    for label, _, _, text, _, in_caption in CHAPTERS[name].citations:
        if in_caption or f"`{label}`, " in text:  # a caption may borrow from another table
            continue
        kind, _, own = label.rpartition("-")
        about = stems(NUMREF.sub(" ", text))
        for other in CHAPTERS[HOME[label]].labels:
            if "-" in kind and other != label and other.rpartition("-")[0] == kind and f"`{other}`" not in text:
                meant = stems(other.rpartition("-")[2])
                assert not meant & about or stems(own) & about, (
                    f"{label} is cited where {other} seems to be meant: {text}"
                )


def test_a_chapter_leads_to_the_next():
    chapters = [path.stem for path in FILES if path in find_notebooks()]
    for name, following in pairwise(chapters):
        cells = jupytext.read(paths.NOTEBOOKS / f"{name}.md").cells
        last = [cell.source for cell in cells if cell.cell_type == "markdown"][-1]
        assert f"{{doc}}`{following}`" in last, f"{name} ends without a word on {following}"
