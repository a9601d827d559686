"""The runner: what succeeds is whole and attributed; what fails leaves nothing that could be taken for a result."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import nbformat
import pytest
from rich.console import Console

from inflate_lib import paths
from inflate_lib._cache import CacheError
from inflate_lib.book import _execution, _fork, build
from inflate_lib.book import run as reproduce
from inflate_lib.book._execution import NotebookFailed
from inflate_lib.book.build import build_book, check_book
from inflate_lib.book.page import SOURCES, recorded
from inflate_lib.book.profiles import ProfileError
from inflate_lib.book.run import RunError, _Stale, plan
from inflate_lib.cli import app
from inflate_lib.cli.book import book
from inflate_lib.structures import sources

HEADER = """\
---
jupytext:
  text_representation:
    extension: .md
    format_name: myst
language_info:
  name: python
  pygments_lexer: ipython3
---

# Title

```{code-cell} ipython3
:tags: [parameters]

profile = "interactive"  # set by the runner
steps = 10  # load steps
```
"""
RECIPE = (
    "recipe: {source: digits, seed: 0, n_structures: null, n_augmented: 50, n_calibration: 0, training: {steps: 4}, "
    "sampling: {sampler: ddim, steps: 2}}\n"
)
CELL = "\n```{code-cell} ipython3\n%s\n```\n"
PUBLISHING = """\
import matplotlib.pyplot as plt
from inflate_lib._cache import cached
from inflate_lib.book.page import Page

page = Page("%s", globals())
print("kept")
cached("step", {"a": 1}, lambda target, scratch: (print("half way"), target.write_text("")), ".txt")
print("also kept")
page.record("third", 1 / 3)
page.record("steps", steps)
page.record("word", "seven")
page.figure(plt.figure(), "fig_%s")"""


def add(home, name, *cells, head=HEADER):
    (home / "notebooks" / f"{name}.md").write_text(head + "".join(CELL % cell for cell in cells))


def make_home(folder, files=("01_first", "02_second")):
    """A checkout in small: notebooks, profiles, table of contents."""
    (folder / "notebooks" / "profiles").mkdir(parents=True)
    (folder / "book").mkdir()
    for name in files:
        add(folder, name, PUBLISHING % (name, name))
    chapters = [{"file": f"notebooks/{name}"} for name in files]
    contents = {"format": "jb-book", "root": "index", "parts": [{"caption": "All", "chapters": chapters}]}
    (folder / "book" / "_toc.yml").write_text(json.dumps(contents))
    (folder / "notebooks" / "profiles" / "ci.yml").write_text(f"name: ci\n{RECIPE}")
    (folder / "notebooks" / "profiles" / "laptop.yml").write_text(f"name: laptop\n{RECIPE}common: {{steps: 20}}\n")
    return folder


def point_to(home, patch):
    below = {"ROOT": "", "NOTEBOOKS": "notebooks", "PROFILES": "notebooks/profiles", "BOOK": "book"}
    below |= {"EXECUTED": "book/notebooks", "REPORTS": "book/_build/reports", "FIGURES": "figures/runs", "DATA": "data"}
    below |= {"REFERENCE": "data/reference", "PRETRAINED": "data/pretrained", "CACHE": "data/cache"}
    for name, folder in below.items():
        patch.setattr(paths, name, home / folder)


def run(profile="ci", **options):
    console = Console(file=io.StringIO(), width=120)
    reproduce.reproduce(profile, console=console, **options)
    return console.file.getvalue()


@pytest.fixture
def home(tmp_path, monkeypatch):
    point_to(make_home(tmp_path), monkeypatch)
    return tmp_path


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Two notebooks executed side by side, once for the tests that look at the result."""
    home = make_home(tmp_path_factory.mktemp("finished"))
    with pytest.MonkeyPatch.context() as patch:
        point_to(home, patch)
        output = run(jobs=2)
    return home, output


@pytest.fixture
def done(finished, monkeypatch):
    """The finished checkout; what a test changes in it is put back."""
    home, _ = finished
    point_to(home, monkeypatch)
    before = {path: path.read_bytes() for path in home.rglob("*") if path.is_file()}
    yield home
    for path, content in before.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def stale():
    return [job.stale() for job in plan("ci")]


def test_a_run_executes_and_says_what_it_did(finished):
    home, output = finished
    for name in ("01_first", "02_second"):
        assert f"{name}: {_Stale.ABSENT}" in output
        assert f"{name}: done in" in output
        assert (home / "figures" / "runs" / "ci" / f"fig_{name}.png").is_file()
    assert "seconds" in output
    assert sorted(p.name for p in (home / "book" / "notebooks").glob("*.*nb*")) == ["01_first.ipynb", "02_second.ipynb"]
    assert not list((home / "data" / "cache" / "runs").iterdir())


def test_an_executed_notebook_is_valid_tidy_and_keeps_its_records(done):
    path = done / "book" / "notebooks" / "01_first.ipynb"
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert str(done) not in path.read_text()
    injected = [cell for cell in notebook.cells if "injected-parameters" in cell.metadata.get("tags", [])]
    assert len(injected) == 1
    assert 'profile = "ci"' in injected[0].source
    assert "remove-cell" in injected[0].metadata.tags
    pictures = [out for cell in notebook.cells for out in cell.get("outputs", []) if "image/png" in out.get("data", {})]
    assert len(pictures) == 1
    assert recorded(path) == {"third": 1 / 3, "steps": 10, "word": "seven"}
    published = notebook.metadata.inflate.published
    assert published == ["ci/fig_01_first.json", "ci/fig_01_first.png", "ci/fig_01_first.svg"]


def test_progress_of_a_step_is_not_kept_whether_it_ran_or_was_in_the_cache(done):
    texts = []
    for name in ("01_first", "02_second"):
        notebook = nbformat.read(done / "book" / "notebooks" / f"{name}.ipynb", as_version=4)
        outputs = [out for cell in notebook.cells for out in cell.get("outputs", []) if out.output_type == "stream"]
        texts.append("".join(out.text for out in outputs))
    assert texts[0] == texts[1] == f"Profile: ci · data source: {SOURCES['digits']}\nkept\nalso kept\n"


def test_nothing_runs_again_while_nothing_changes(done):
    path = done / "book" / "notebooks" / "01_first.ipynb"
    before = path.stat().st_mtime_ns
    output = run()
    assert output.count(": fresh") == 2
    assert path.stat().st_mtime_ns == before
    check_book("ci")


def test_a_book_is_refused_for_every_kind_of_staleness(done, monkeypatch):
    executed = done / "book" / "notebooks"
    assert stale() == ["", ""]
    with pytest.raises(RunError, match=r"(?s)01_first: It was executed under the profile ci\..*02_second"):
        check_book("laptop")
    (done / "figures" / "runs" / "ci" / "fig_01_first.svg").unlink()
    assert stale() == [_Stale.INCOMPLETE.format("figures/runs/ci/fig_01_first.svg"), ""]
    source = done / "notebooks" / "02_second.md"
    source.write_text(source.read_text() + "\nOne more word.\n")
    assert stale()[1] == _Stale.CHANGED.format("notebook")
    (done / "notebooks" / "profiles" / "ci.yml").write_text(
        f"name: ci\n{RECIPE}notebooks: {{02_second: {{steps: 11}}}}\n"
    )
    assert stale()[1] == _Stale.CHANGED.format("notebook, parameters")
    monkeypatch.setattr(reproduce, "step_version", lambda step: "other")
    assert stale()[1] == _Stale.CHANGED.format("notebook, parameters, library")
    (executed / "01_first.ipynb").write_text((executed / "01_first.ipynb").read_text().replace("kept", "edited"))
    assert stale()[0].startswith("What it depends on has changed: library")
    monkeypatch.undo()
    point_to(done, monkeypatch)
    assert stale()[0] == _Stale.EDITED
    (executed / "02_second.ipynb").write_text("{")
    assert stale()[1] == _Stale.FOREIGN
    (executed / "02_second.ipynb").unlink()
    with pytest.raises(
        RunError, match=r"02_second: It has not been executed yet(?s:.*)Run: inflate reproduce --profile ci"
    ):
        build_book("ci")
    assert not (done / "book" / "_build" / "html").exists()


def test_a_book_lists_the_notebooks_that_exist(done):
    contents = done / "book" / "_toc.yml"
    contents.write_text(contents.read_text().replace("02_second", "03_third"))
    with pytest.raises(RunError, match=r"(?s)03_third: in book/_toc.yml, but.*02_second: not in book/_toc.yml"):
        check_book("ci")


@pytest.mark.slow
def test_a_book_with_a_warning_is_no_book_the_second_time_either(done):
    """Sphinx would not look at the page again: after a failed build it has to start afresh."""
    config = "title: T\nonly_build_toc_files: true\nexecute: {execute_notebooks: 'off'}\n"
    (done / "book" / "_config.yml").write_text(config)
    (done / "book" / "index.md").write_text("# Title\n\n{doc}`notebooks/03_absent`\n")
    for _ in range(2):
        with pytest.raises(
            RunError, match=r"(?s)warnings or errors.*\.md:3: WARNING: unknown document: '?notebooks/03_"
        ):
            build_book("ci")


def test_a_notebook_that_warned_is_named_with_its_warning(done, monkeypatch):
    executed = done / "book" / "notebooks" / "02_second.ipynb"
    notebook = nbformat.read(executed, as_version=4)
    cell = [cell for cell in notebook.cells if cell.cell_type == "code"][-1]
    cell.outputs.append(nbformat.v4.new_output("stream", name="stderr", text="UserWarning: too much\n"))
    nbformat.write(notebook, executed)
    notebook.metadata["inflate"]["cells"] = reproduce._content(json.loads(executed.read_text()))
    nbformat.write(notebook, executed)
    said = io.StringIO()
    monkeypatch.setattr(build, "run_jupyter_book", lambda builder: done / "book")
    (done / "book" / "_build").mkdir(exist_ok=True)
    build_book("ci", Console(file=said))
    assert re.search(r"left out of the book:\s+02_second, code cell \d: UserWarning: too much", said.getvalue())


def test_a_book_is_built_again_where_something_that_it_shows_has_changed(done, monkeypatch):
    pages = done / "book" / "_build" / "html"
    pages.mkdir(parents=True, exist_ok=True)
    (pages / "index.html").touch()
    (done / "book" / "_build" / "complete").unlink(missing_ok=True)
    built = []

    def build_pages(builder):
        pages.mkdir(exist_ok=True)
        (pages / "index.html").touch()
        built.append(builder)
        return pages / "index.html"

    monkeypatch.setattr(build, "run_jupyter_book", build_pages)

    def builds():
        build_book("ci", Console(file=io.StringIO()))
        return len(built)

    assert [builds(), builds()] == [1, 1]
    (done / "book" / "index.md").write_text("# Another title\n")
    assert [builds(), builds()] == [2, 2]
    (done / "figures" / "runs" / "ci" / "glance.png").write_bytes(b"another picture")
    assert [builds(), builds()] == [3, 3]
    (pages / "index.html").unlink()
    assert [builds(), builds()] == [4, 4]


def test_a_raising_cell_stops_the_run_and_is_shown(home, monkeypatch):
    add(home, "01_first", "x = 1", "y = 0\nx / y", "z = 2")
    executed = home / "book" / "notebooks" / "01_first.ipynb"
    executed.parent.mkdir()
    executed.write_text("the old version")
    add(home, "02_second", "import time\ntime.sleep(60)")
    monkeypatch.setattr(sys, "argv", ["inflate", "reproduce", "--profile", "ci", "--jobs", "2"])
    start = time.monotonic()
    with pytest.raises(SystemExit) as exit_:
        app.run()
    assert time.monotonic() - start < 45, "the other notebook should have been ended"
    message = str(exit_.value.code)
    line = (home / "notebooks" / "01_first.md").read_text().splitlines().index("y = 0") + 1
    assert f"01_first.md, code cell 3, line {line}: ZeroDivisionError: division by zero" in message
    assert "y = 0\nx / y" in message
    assert "Traceback" in message
    assert "\x1b" not in message
    assert not list(executed.parent.glob("*.ipynb"))
    report = home / "book" / "_build" / "reports" / "01_first.ipynb"
    assert str(report) in message
    assert "ZeroDivisionError" in report.read_text()


def test_a_dying_kernel_is_told_from_a_raising_cell(home, monkeypatch):
    """The cache is on another disk where there is one: a broken notebook gets from there to the reports as well."""
    add(home, "01_first", "import os, signal\nos.kill(os.getpid(), signal.SIGKILL)")
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as cache:
        monkeypatch.setattr(paths, "CACHE", Path(cache))
        with pytest.raises(NotebookFailed, match=r"01_first\.md, code cell 2, line 21: the kernel died"):
            run(only=["1"])
    assert not list((home / "book" / "notebooks").glob("*.ipynb"))
    assert "os.kill" in (home / "book" / "_build" / "reports" / "01_first.ipynb").read_text()


def test_a_kernel_that_never_lived_is_quoted(home, monkeypatch):
    """Whatever goes wrong before the first cell: here another package is in the way of the kernel's."""
    add(home, "01_first", "x = 1")
    (home / "ipykernel_launcher.py").write_text("import sys\nsys.exit('no kernel today')")
    monkeypatch.setenv("PYTHONPATH", str(home))
    with pytest.raises(
        NotebookFailed,
        match=r"01_first\.md, before its first cell: the kernel died\s+Its last words:\s+no kernel today$",
    ):
        run(only=["1"])


def test_any_name_will_do_for_the_cache(home, monkeypatch):
    add(home, "01_first", "x = 1")
    monkeypatch.setattr(paths, "CACHE", home / "{x} 100 % [é]")
    run(only=["1"])
    assert (home / "book" / "notebooks" / "01_first.ipynb").is_file()


def test_settings_of_a_user_do_not_reach_the_figures(finished, home, monkeypatch):
    """Neither matplotlib's, wherever they are read from, nor IPython's."""
    settings = home / "settings"
    (settings / "profile_default" / "startup").mkdir(parents=True)
    (settings / "profile_default" / "startup" / "00.py").write_text("print('good morning')")
    (settings / "matplotlibrc").write_text(
        "axes.grid: True\nfigure.facecolor: yellow\ntext.usetex: True\nnonsense: 1\n"
    )
    (home / "matplotlibrc").write_text("figure.facecolor: yellow\nfigure.figsize: 1, 1\n")
    monkeypatch.setenv("MATPLOTLIBRC", str(settings))
    monkeypatch.setenv("IPYTHONDIR", str(settings))
    monkeypatch.setenv("MPLBACKEND", "TkAgg")
    run(only=["1"])
    executed = nbformat.read(home / "book" / "notebooks" / "01_first.ipynb", 4)
    streams = [output for cell in executed.cells for output in cell.get("outputs", []) if "name" in output]
    assert {output.name for output in streams} == {"stdout"} and "good morning" not in str(streams)
    for suffix in ("png", "svg"):
        file = f"figures/runs/ci/fig_01_first.{suffix}"
        assert (home / file).read_bytes() == (finished[0] / file).read_bytes()


@pytest.mark.parametrize("name", ["01_first copy", "01_first-Copy1", "01_other"])
def test_a_duplicated_notebook_is_pointed_out(home, name):
    add(home, name, "x = 1")
    for only in ("1", "01"):
        with pytest.raises(RunError, match=f"there are '01_first' and '{name}'|there are '{name}' and '01_first'"):
            plan("ci", [only])
    for only in ("first", "01_first", "02"):
        assert [job.name for job in plan("ci", [only])] == ["02_second" if only == "02" else "01_first"]
    assert [job.name for job in plan("ci", [name])] == [name]
    with pytest.raises(RunError, match="two have the number 01, "):
        plan("ci")


@pytest.mark.parametrize("device", ["mps", "cuda", "meta", "gpu", "7"])
def test_a_device_of_the_profile_that_is_not_there_is_found_before_anything_runs(home, device, monkeypatch):
    for module in ("cuda", "backends.mps"):
        monkeypatch.setattr(f"torch.{module}.is_available", lambda: False)
    path = home / "notebooks" / "profiles" / "ci.yml"
    path.write_text(path.read_text().replace("{steps: 4}", f"{{steps: 4, device: '{device}'}}"))
    with pytest.raises(ProfileError, match=f"recipe.training: device '{device}' cannot be used here.*has cpu$"):
        plan("ci")
    monkeypatch.setattr(sys, "argv", ["inflate", "train"])
    with pytest.raises(SystemExit, match=f"profile ci, recipe.training: device '{device}'"):
        app.run()
    monkeypatch.setattr(sys, "argv", ["inflate", "train", "--profile", "laptop", "--device", device])
    with pytest.raises(SystemExit, match=f"--device: device '{device}' cannot be used here, where PyTorch has cpu"):
        app.run()


def test_a_book_is_printed_after_it_was_built(home, monkeypatch):
    monkeypatch.setattr(build, "run_jupyter_book", lambda *_: pytest.fail("Sphinx was asked"))
    monkeypatch.setattr(sys, "argv", ["inflate", "pdf"])
    with pytest.raises(SystemExit, match="build it first, with `inflate book`"):
        app.run()


@pytest.mark.parametrize(
    ("profile", "only", "message"),
    [
        ("common: {stps: 1}", [], "common.stps: no notebook declares"),
        ("notebooks: {01_first: {stps: 1}}", [], "01_first.stps: the notebook does not declare it"),
        ("notebooks: {03_third: {steps: 1}}", [], "there is no such notebook"),
        ("notebooks: {02_second: {steps: many}}", ["01"], "02_second.steps: 'many' is str"),
        ("", ["07"], "--only 07: there is no such notebook; there are: 01_first, 02_second"),
    ],
)
def test_mistakes_are_found_before_anything_is_touched(home, profile, only, message):
    (home / "notebooks" / "profiles" / "ci.yml").write_text(f"name: ci\n{RECIPE}{profile}\n")
    old = home / "book" / "notebooks" / "01_first.ipynb"
    old.parent.mkdir()
    old.write_text("the old version")
    with pytest.raises((ProfileError, RunError), match=message):
        run(only=only)
    assert old.read_text() == "the old version"


def test_missing_data_are_found_before_anything_runs(home, monkeypatch):
    add(home, "01_first", "x = 1", head=HEADER.replace("steps = 10", 'source = "auto"  # data\nsteps = 10'))
    monkeypatch.setenv("INFLATE_MNIST_DIR", str(home / "nowhere"))
    monkeypatch.setattr(sys, "argv", ["inflate", "reproduce"])
    reproduce._resolved.cache_clear()
    with pytest.raises(SystemExit, match="nowhere, which does not exist"):
        app.run()
    assert "01_first.ipynb" not in os.listdir(home / "book" / "notebooks")


def test_other_data_are_used_only_where_they_are_asked_for(home, monkeypatch):
    for number, name in enumerate(("01_first", "02_second")):
        add(home, name, f"x = {number}", head=HEADER.replace("steps = 10", 'source = "auto"  # data\nsteps = 10'))
    for name in sources._FILES:  # to see whether MNIST can be had, nobody reads it
        (home / name).write_text("")
    monkeypatch.setenv("INFLATE_MNIST_DIR", str(home))
    monkeypatch.setenv("INFLATE_SOURCE", "digits")
    reproduce._resolved.cache_clear()  # a command asks once
    run()
    monkeypatch.delenv("INFLATE_SOURCE")
    reproduce._resolved.cache_clear()
    with pytest.raises(
        RunError, match=r"01_first was executed on the embedded digits.*means MNIST now.*--source mnist"
    ):
        run()
    monkeypatch.setenv("INFLATE_SOURCE", "digits")
    reproduce._resolved.cache_clear()
    assert run().count(": fresh") == 2
    monkeypatch.setenv("INFLATE_SOURCE", "mnist")
    reproduce._resolved.cache_clear()
    assert f"01_first: {_Stale.CHANGED.format('data source')}" in run()


def test_a_profile_that_names_its_data_gets_no_others(home, monkeypatch):
    add(home, "01_first", "x = 1", head=HEADER.replace("steps = 10", 'source = "digits"  # data\nsteps = 10'))
    monkeypatch.setenv("INFLATE_SOURCE", "mnist")
    with pytest.raises(RunError, match="--source mnist: this profile names its source itself, digits"):
        run()


def test_a_cache_without_room_for_the_run_is_named(home):
    add(home, "01_first", "x = 1")
    (home / "data").mkdir()
    (home / "data" / "cache").write_text("a file where the folder should be")
    with pytest.raises(CacheError, match="set INFLATE_CACHE"):
        run()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--descriptor nonsense", "unknown descriptor 'nonsense'"),
        ("--steps 3 --out weights", "--steps is a dry run, which keeps nothing"),
        ("--steps 3 --log logs", "--steps is a dry run, which keeps nothing"),
        ("--pack pairs.safetensors --steps 3", "--pack trains nothing"),
    ],
)
def test_a_training_of_nothing_is_refused_before_anything_is_simulated(words, message, monkeypatch):
    monkeypatch.setattr("inflate_lib.datasets.simulate.simulated_sevens", lambda *_: pytest.fail("it simulated"))
    monkeypatch.setattr(sys, "argv", ["inflate", "train", *words.split()])
    with pytest.raises(SystemExit, match=message):
        app.run()


def test_a_notebook_without_mnist_says_so_and_warns_of_nothing(home, monkeypatch):
    """Anything on standard error would be a warning of the book, and the end of it."""
    monkeypatch.delenv("INFLATE_MNIST_DIR", raising=False)
    unreachable = "sources.MIRRORS = ('http://127.0.0.1:9/',)"
    add(home, "01_first", f"from inflate_lib.structures import sources\n{unreachable}\nsources.resolve_source()")
    run(only=["1"])
    executed = nbformat.read(home / "book" / "notebooks" / "01_first.ipynb", 4)
    streams = {output.name: output.text for output in executed.cells[-1].outputs if output.output_type == "stream"}
    assert list(streams) == ["stdout"]
    assert "embedded scikit-learn digits" in streams["stdout"]


def test_retraining_reaches_the_notebooks_and_makes_them_run_again(home, monkeypatch):
    add(home, "01_first", "x = 1")
    add(home, "02_second", "import os\nprint('INFLATE_RETRAIN' in os.environ)")
    monkeypatch.setattr(build, "build_book", lambda profile: None)
    monkeypatch.setenv("INFLATE_RETRAIN", "")  # so that whatever happens to it is undone
    monkeypatch.delenv("INFLATE_RETRAIN")
    for retrain in (False, True):
        book(retrain=retrain)
        executed = nbformat.read(home / "book" / "notebooks" / "02_second.ipynb", 4)
        assert executed.cells[-1].outputs[0].text == f"{retrain}\n"


def test_the_longest_notebooks_begin(home, monkeypatch):
    with (home / "notebooks" / "profiles" / "ci.yml").open("a") as stream:
        stream.write("budget: {01_first: 10, 02_second: 30}\n")
    begun = []
    monkeypatch.setattr(reproduce, "_run", lambda todo, *_: begun.extend(job.name for job in todo) or {})
    run()
    assert begun == ["02_second", "01_first"]


def test_two_runs_do_not_share_a_checkout(home):
    with reproduce._only_run(), pytest.raises(RunError, match=r"another .* is at work"):
        run()


def test_a_figure_that_a_notebook_no_longer_makes_goes_away(home):
    folder = home / "figures" / "runs" / "ci"
    folder.mkdir(parents=True)
    (folder / "old.json").write_text('{"notebook": "01_first", "files": {"old.png": ""}}')
    (folder / "old.png").write_text("")
    (folder / "kept.json").write_text('{"notebook": "02_second", "files": {}}')
    (home / "manifest").write_text("ci/fig_01_first.png\n")
    notebook = nbformat.v4.new_notebook()
    reproduce._stamp(plan("ci")[0], notebook, home / "manifest")
    assert [path.name for path in folder.iterdir()] == ["kept.json"]
    assert notebook.metadata.inflate["published"] == ["ci/fig_01_first.png"]


def test_the_notebook_that_the_others_wait_for_runs_alone_before_them(home):
    for name in ("01_first", "02_second"):
        add(
            home, name, f"import time\nstart = time.time()\nopen('{name}.txt', 'w').write(f'{{start}} {{time.time()}}')"
        )
    (home / "notebooks" / "profiles" / "ci.yml").write_text(f"name: ci\nfirst: 02_second\n{RECIPE}")
    run(jobs=2)
    (start, _), (_, end) = (
        map(float, (home / f"{name}.txt").read_text().split()) for name in ("01_first", "02_second")
    )
    assert end < start


LONG_STEP = """\
import os, time
from pathlib import Path
from inflate_lib._cache import cached
from inflate_lib import paths

def make(target, scratch):
    part = scratch / "part"
    if not part.exists():
        part.write_text(f"first half by {os.getpid()}, ")
        (paths.ROOT / "kernel.pid").write_text(str(os.getpid()))
        time.sleep(120)
    target.write_text(part.read_text() + "resumed")

print(cached("steps", {"steps": steps}, make, ".txt").read_text())"""


def alive(process):
    try:
        os.kill(process, 0)
        return "Z" not in Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except ProcessLookupError:
        return False
    except FileNotFoundError:  # no /proc: macOS
        return True


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kill", "forked"),
    [(signal.SIGTERM, False), (signal.SIGKILL, False), (signal.SIGKILL, True)],
    ids=["SIGTERM", "SIGKILL", "SIGKILL, forked"],
)
def test_a_killed_run_ends_its_kernel_leaves_nothing_and_is_resumed(home, kill, forked):
    add(home, "01_first", LONG_STEP)
    environment = {**os.environ, "INFLATE_HOME": str(home), "INFLATE_CACHE": str(home / "data" / "cache")}
    code = f"from inflate_lib.book._fork import ForkServer\nForkServer.ready.__defaults__ = ({60 * forked},)\n"
    code += "from inflate_lib.cli.app import run; run()"
    command = [sys.executable, "-c", code, "reproduce", "--profile", "ci"]
    command += ["--jobs", "1"] if forked else ["--only", "01_first"]
    if forked:  # which it is where several follow one another
        add(home, "03_third", "print(3)")
    first = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    mark = home / "kernel.pid"
    deadline = time.monotonic() + 90
    while not (mark.exists() and mark.read_text()) and time.monotonic() < deadline and first.poll() is None:
        time.sleep(0.1)
    kernel = int(mark.read_text())
    first.send_signal(kill)
    output = first.communicate(timeout=30)[0]
    if kill == signal.SIGTERM:
        assert first.returncode == 1
        assert "stopped; run the same command again" in output
        assert "Traceback" not in output
    deadline = time.monotonic() + 15
    while alive(kernel) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not alive(kernel)
    assert not [path for path in (home / "book" / "notebooks").iterdir() if "ipynb" in path.name]
    run(only=["first"])  # in a kernel that is started
    assert f"first half by {kernel}, resumed" in (home / "book" / "notebooks" / "01_first.ipynb").read_text()


ABOUT_ITSELF = """\
import os, sys, threading
import matplotlib, numpy, torch
from joblib import Parallel, delayed
import inflate_lib

def square(k):
    return k * k

print(os.getcwd(), sys.path, __name__, os.getpid() == os.getpgid(0), sys.flags.hash_randomization)
print({k: v for k, v in sorted(os.environ.items()) if k.startswith(("INFLATE", "PYTHON", "MPL")) or "THREADS" in k})
print(matplotlib.get_backend(), torch.get_num_threads(), torch.arange(9.0).reshape(3, 3).svd()[1])
print(Parallel(2)(delayed(square)(k) for k in range(4)), signal if "signal" in globals() else "own names only")
matplotlib.pyplot.plot(numpy.arange(3));"""


@pytest.mark.slow
def test_a_forked_kernel_is_like_one_that_was_started(home, monkeypatch):
    names, pages = ["01_first", "02_second", "03_third"], {}
    for name in names:
        add(home, name, "import matplotlib.pyplot", ABOUT_ITSELF)
    for forked in (True, False):
        monkeypatch.setattr(_execution, "POSSIBLE", forked)
        monkeypatch.setattr(_fork.ForkServer.ready, "__defaults__", (60.0,))  # the first notebook waits for it as well
        run(jobs=1, force=True)
        pages[forked] = [nbformat.read(paths.EXECUTED / f"{name}.ipynb", 4).cells[-1].outputs for name in names]
    assert pages[True] == pages[False]
    kinds = [output.get("data", {}).keys() for output in pages[True][0]]
    assert any("image/png" in kind for kind in kinds)


def test_without_a_fork_server_kernels_are_started(home):
    add(home, "03_third", "print(3)")
    (home / "torch.py").write_text("import sys\nsys.exit('no torch today')")
    run(jobs=1)
    assert "3\\n" in (paths.EXECUTED / "03_third.ipynb").read_text()
