"""What the chapters and pages say about the library is so: the names that they mention are there."""

import json
import re
from dataclasses import asdict
from pkgutil import iter_modules, resolve_name

import jupytext
import pandas as pd
import pytest

import inflate_lib
from inflate_lib import paths
from inflate_lib.book.run import find_notebooks, reading_minutes
from inflate_lib.models.recipe import load_recipe

CHAPTERS = find_notebooks()
PAGES = sorted([*paths.BOOK.glob("**/*.md"), *paths.ROOT.glob("*.md"), *paths.ROOT.glob("*/README.md")])
PAGES = [
    page for page in PAGES if page.relative_to(paths.ROOT).parts[:2] not in (("book", "_build"), ("book", "notebooks"))
]
PACKAGES = [module.name for module in iter_modules(inflate_lib.__path__) if module.ispkg]
NAME = re.compile(rf"\binflate_lib((?:\.\w+)+)|(?<=`)((?:{'|'.join(PACKAGES)})(?:\.\w+)+)(?=[`(])")
FILE = re.compile(r"(?<!\})`((?:inflate_lib|notebooks|book|benchmarks|data|tests|examples|figures)/[\w./-]+)`")
#: Not in the repository: what commands make, what a reader would write, and what CHANGES.md says is gone.
MADE = ("book/_build/", "book/notebooks/", "data/cache/", "figures/runs/", "data/pretrained/paper/")
MADE += ("notebooks/NN_name.md/", "notebooks/profiles/nightly.yml/", "figures/ci/")
WIDTH = 88  # characters of code that the page of the book shows without scrolling
WALK = re.compile(r"This chapter walks through `([\w.]+)`: `([\w.]+(?: → [\w.]+)*)`\.")


def missing(names):
    """Those of `names` that cannot be imported."""
    absent = []
    for name in sorted(names):
        try:
            resolve_name(name)
        except (ImportError, AttributeError):
            absent.append(name)
    return absent


@pytest.mark.parametrize("chapter", CHAPTERS, ids=lambda path: path.stem)
def test_a_chapter_opens_with_the_part_of_the_library_that_it_walks_through(chapter):
    title, _, line, *_ = jupytext.read(chapter).cells[0].source.split("\n\n")
    walk = WALK.fullmatch(line)
    assert title.startswith("# ") and walk, f"below the first paragraph stands: {line}"
    place, steps = walk.groups()
    assert missing(f"{place}.{step}" for step in steps.split(" → ")) == []


def read(page):
    """The text of a page; of CHANGES.md without the table of the names that version 0.1.0 had."""
    lines = page.read_text(encoding="utf-8").splitlines()
    return "\n".join(line for line in lines if page.name != "CHANGES.md" or not line.lstrip().startswith("|"))


@pytest.mark.parametrize("page", [*CHAPTERS, *PAGES], ids=lambda path: str(path.relative_to(paths.ROOT)))
def test_names_and_files_in_the_documents_exist(page):
    text = read(page)
    assert missing({f"inflate_lib{dotted or '.' + relative}" for dotted, relative in NAME.findall(text)}) == []
    named = {name for name in FILE.findall(text) if not f"{name}/".startswith(MADE)}
    assert [name for name in sorted(named) if not (paths.ROOT / name).exists()] == []


def test_what_the_paper_leaves_to_future_work_has_a_row_each():
    text = (paths.NOTEBOOKS / "13_comparison.md").read_text(encoding="utf-8")
    section = text.split("## What the paper leaves to future work")[1].split("\n## ")[0]
    head, _, *rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("|")]
    assert head[1:3] == ["where", "here"]
    for named in (
        "stress and strain fields", "contours, images", "several targets", "ranking by a surrogate", "by simulation",
        "heterogeneous stiffness", "plasticity", "actuation", "base shapes", "descriptor loss",
    ):  # fmt: skip
        assert sum(named in row[0] for row in rows) == 1, named
    for what, where, here, how in rows:
        assert where.startswith("Sec") and here in ("done", "partly", "no"), what
        assert here == "no" or "{doc}`" in how, f"{what}: no chapter is named"
        recorded = re.findall(r"\{glue:text\}`(\w+)", how)
        assert here != "done" or recorded or "23_extending" in how, f"{what}: no number is given"


def departures():
    """The rows of the table of departures from the paper, without the headings of its parts."""
    text = (paths.NOTEBOOKS / "13_comparison.md").read_text(encoding="utf-8")
    section = text.split("(sec-departures)=")[1].split("## What the paper leaves to future work")[0]
    head, _, *rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("|")]
    assert head == ["paper", "here", "reason", "measured effect"]
    return [row for row in rows if not row[0].startswith("**")]


def test_every_departure_has_a_reason_an_effect_and_a_chapter():
    for row in departures():
        assert len(row) == 4 and all(row), row
        effect = row[3]
        named = re.findall(r"\{doc\}`(\w+)`", effect)
        assert named and all((paths.NOTEBOOKS / f"{name}.md").is_file() for name in named), row
        said = "{glue:text}" in effect or "{numref}" in effect
        assert said or effect.startswith(("not measured", "none")) or "below" in effect or "MOOSE" in effect, row


def test_the_table_of_departures_misses_no_box_and_no_option_of_a_recipe():
    chapters = "\n".join(row[3] for row in departures())
    for chapter in CHAPTERS:
        if "{admonition} Departure from the paper" in chapter.read_text(encoding="utf-8"):
            assert chapter.stem == "13_comparison" or f"`{chapter.stem}`" in chapters, f"no row names {chapter.stem}"
    here = "\n".join(row[1] for row in departures())
    paper = asdict(load_recipe("paper"))
    for profile in ("ci", "laptop"):
        recipe = asdict(load_recipe(profile))
        changed = {key for key in recipe if key not in ("source", "training", "sampling") and recipe[key] != paper[key]}
        training = recipe["training"].items()
        changed |= {key for key, value in training if value != paper["training"].get(key)}
        changed |= {key for key in ("sampler", "guidance") if recipe["sampling"][key] != paper["sampling"][key]}
        assert [key for key in sorted(changed) if f"`{key}`" not in here] == [], profile


def test_two_other_settings_fit_the_papers_table_1_as_well_as_the_default():
    """As the chapter on verification says in words."""
    table = pd.read_csv(paths.REFERENCE / "calibration.csv").set_index(["element", "refine", "threshold", "pad"])
    as_well = table.index[table["change_low"] <= 0]
    default, moose, fine = [("mean-dilatation", 1, 0.5, True), ("stabilised", 1, 0.5, True), ("q1", 4, 0.5, True)]
    assert set(as_well) == {default, moose, fine}
    assert abs(table.loc[moose, "change_percent"]) < 0.1
    light, dark, finer = (table.loc[("mean-dilatation", *rest, True)] for rest in ((1, 0.4), (1, 0.6), (2, 0.5)))
    assert light["width_low"] > table.loc[default, "width_percent"] and dark["area_high"] < 0
    assert abs(finer["height_percent"]) < 0.2 and finer["width_low"] > table.loc[default, "width_percent"]


def test_retrieval_is_the_better_start_and_drawings_are_newer():
    """As the chapter on design says in words, of joint models as well."""
    table = pd.read_csv(paths.REFERENCE / "opponents.csv").query("targets == 'all'").set_index("start")
    retrieved, drawn = table.loc["training"], table.loc["model"]
    assert retrieved["met"] > drawn["met"] and retrieved["designs"] > drawn["designs"]
    assert retrieved["first"] < drawn["first"] and retrieved["novelty"] < drawn["novelty"]
    paired = json.loads((paths.REFERENCE / "opponents.json").read_text(encoding="utf-8"))["paired"]
    assert paired["p"] > 0.05 and paired["more designs"][1] > 0  # the first could be luck, the second hardly
    error = pd.read_csv(paths.REFERENCE / "joint.csv").set_index(["targets", "model", "n"])["median error"]
    assert error["box", "box", 1] < error["box", "joint", 1]
    ends = pd.read_csv(paths.REFERENCE / "joint.csv").set_index(["targets", "model", "n"])
    ends = ends[["median error low", "median error high"]]
    for name in ("height", "width", "area", "axis"):
        own, all_in_one = ends.loc[(name, name, 1)], ends.loc[(name, "joint", 1)]
        assert max(own.iloc[0], all_in_one.iloc[0]) < min(own.iloc[1], all_in_one.iloc[1])
        assert (error[name, "joint", 1] < error[name, name, 1]) == (name in ("height", "width"))
    assert error["height and width and area", "box", 4] < error["height and width and area", "joint", 4]
    assert error["height and stress", "joint", 1] < error["height and stress", "height", 1]
    assert error["area and axis", "joint", 4] < error["area and axis", "axis", 4]
    one = pd.read_csv(paths.REFERENCE / "joint.csv").query("model == 'joint' and group == 'one target'")
    buildable = one.set_index("targets")["buildable"]
    peaks = ["stress", "stretch"]
    assert buildable[peaks].between(55, 65).all() and buildable.drop(peaks).min() > 70
    outlines = pd.read_csv(paths.REFERENCE / "joint.csv").query("group == 'outline'").set_index("targets")
    whole, reduced = outlines.loc["outline"], outlines.loc["height and width and area and axis"]
    assert whole["median error"] < reduced["median error"]
    assert max(whole["median error low"], reduced["median error low"]) < min(
        whole["median error high"], reduced["median error high"]
    )


def test_tuned_students_are_more_accurate_and_nearly_as_varied():
    """As the chapter on training says in words."""
    keys = ["descriptor", "way"]
    students = pd.read_csv(paths.REFERENCE / "sampler_students.csv").set_index([*keys, "student"])
    distilled, tuned = (students.xs(name, level="student") for name in ("distilled", "tuned"))
    both = tuned.loc[distilled.index]
    assert (both["R²"] > distilled["R²"]).all() and (both["median error"] < distilled["median error"]).all()
    assert (distilled["variety"] - both["variety"]).max() < 0.02
    teacher = pd.read_csv(paths.REFERENCE / "sampler.csv").set_index(keys)
    shared = tuned.index.intersection(teacher.index)
    assert len(shared) >= 15 and (tuned.loc[shared, "R²"] > teacher.loc[shared, "R²"]).all()


def test_steered_students_are_nearer_and_as_varied():
    """As the chapter on control says in words."""
    keys = ["descriptor", "way"]
    students = pd.read_csv(paths.REFERENCE / "sampler_students.csv").set_index([*keys, "student"])
    steered = students.xs("steered", level="student")
    tuned = students.xs("tuned", level="student").loc[steered.index]
    sizes = steered.index.get_level_values("descriptor") != "axis"
    less, sizes = steered["median error"] / tuned["median error"], steered.drop("axis", level="descriptor").index
    assert len(sizes) == 8 and less[sizes].between(0.3, 0.5).all() and less["axis"].max() < 0.6
    assert (steered["R²"] > tuned["R²"]).all() and steered.loc["axis", "R²"].min() > 0.8
    assert (steered.loc[sizes, "variety"] - tuned.loc[sizes, "variety"]).abs().max() < 0.015
    assert (steered.loc[sizes, "novelty"] - tuned.loc[sizes, "novelty"]).abs().max() < 0.03
    assert (tuned["buildable"] - steered["buildable"])[sizes].max() < 3.5
    assert (steered["ms"] / tuned["ms"]).between(2, 3.1).all()
    many = steered.xs("second order, w = 2.5, 12 steps", level="way").drop("axis")
    few = steered.xs("second order, w = 5", level="way").drop("axis")
    assert (many["variety"] > few["variety"] + 0.03).all() and many["variety"].min() > 0.85
    assert (many["median error"] / few["median error"]).between(1, 1.15).all()


@pytest.mark.parametrize("chapter", CHAPTERS, ids=lambda path: path.stem)
def test_code_fits_the_page_and_what_is_not_to_be_read_is_folded(chapter):
    """Parameters, imports, and cells that do no more than record the error of a formula."""
    for cell in jupytext.read(chapter).cells:
        if cell.cell_type == "code":
            assert [line for line in cell.source.splitlines() if len(line) > WIDTH] == []
            tags = cell.metadata.get("tags", [])
            checks = '_error"' in cell.source and "mystnb" not in cell.metadata
            if checks or "parameters" in tags or cell.source.startswith(("import ", "from ")):
                assert {"hide-input", "hide-cell", "remove-cell"} & set(tags), cell.source.splitlines()[0]


@pytest.mark.parametrize(
    "page",
    ["README.md", "book/glossary.md", "inflate_lib/book/card.py", "data/pretrained/laptop/README.md"]
    + ["notebooks/11_scalar_targets.md", "notebooks/19_verification.md"],
)
def test_valid_and_buildable_are_defined_in_the_same_words_everywhere(page):
    text = " ".join(re.sub(r"\{term\}`(.*?)`", r"\1", (paths.ROOT / page).read_text(encoding="utf-8")).split())
    assert "gives one closed structure, fits the frame and has an equilibrium at every load step" in text
    assert "wall has no joint of one node and crosses no wall at any load step" in text


@pytest.mark.parametrize("chapter", CHAPTERS, ids=lambda path: path.stem)
def test_a_chapter_is_read_in_twenty_minutes(chapter):
    assert reading_minutes(chapter) <= 20
