"""The commands that the documentation shows exist, and give the output that it shows."""

import re
import shlex
import shutil

import click
import pytest
from typer.main import get_command
from typer.testing import CliRunner

from inflate_lib import paths
from inflate_lib.cli.app import _load_commands
from inflate_lib.models.recipe import load_recipe

PAGES = [*paths.ROOT.glob("*.md"), *paths.BOOK.glob("*.md"), *paths.BOOK.glob("commands/*.md")]
#: A command in a line: its name, and the rest.
COMMAND = re.compile(r"(?:^|[ `/])inflate(?:_lib)? ([a-z]+)( .*)?$")


@pytest.fixture(scope="module")
def commands():
    return get_command(_load_commands()).commands


def consoles(page):
    """The blocks of a page that show a console."""
    return re.findall(r"^```console\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def sessions(page):
    """Commands that are typed after a `$`, each with what it printed."""
    parts = [part for block in consoles(page) for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]]
    return [part.split("\n", 1) for part in parts]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(paths.ROOT)))
def test_shown_commands_can_be_typed(page, commands):
    for line in "".join(consoles(page)).splitlines():
        if found := COMMAND.search(line.split(" | ")[0].split(" > ")[0]):
            name, rest = found.groups()
            words = shlex.split(rest or "", comments=True)
            try:
                commands[name].make_context(name, words)
            except click.UsageError as error:
                pytest.fail(f"{line}: {error.format_message()}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(paths.ROOT)))
def test_shown_targets_of_make_exist(page):
    makefile = (paths.ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z-]+):", makefile, flags=re.MULTILINE))
    shown = re.findall(r"^(?:\$ )?make ([a-z-]+)", "".join(consoles(page)), flags=re.MULTILINE)
    shown += re.findall(r"`make ([a-z-]+)", page.read_text(encoding="utf-8"))
    assert set(shown) <= targets


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(paths.ROOT)))
def test_options_named_in_the_text_exist(page, commands):
    for code in re.findall(r"`(inflate [^`\n]+)`", page.read_text(encoding="utf-8")):
        if found := COMMAND.search(code):
            name, rest = found.groups()
            options = {option for parameter in commands[name].params for option in parameter.opts}
            assert set(re.findall(r"--[a-z-]+", rest or "")) <= options | {"--help"}, code


QUICK = [
    (command, output)
    for page in PAGES
    for command, output in sessions(page)
    if output and re.match(r"inflate (simulate|info|dataset --source)\b[^|>]*$", command)
]


@pytest.mark.parametrize(("command", "output"), QUICK, ids=[command for command, _ in QUICK])
def test_quick_commands_print_what_is_shown(command, output, tmp_path, monkeypatch):
    """Where a page has `…`, anything may stand, and above lines of progress; seconds may differ."""
    shutil.copytree(paths.ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(_load_commands(), shlex.split(command)[1:])
    assert done.exit_code == 0, done.output
    shown, printed = (re.sub(r"│ \d+\.\d\d +│", "│ seconds │", text.strip()) for text in (output, done.output))
    pattern = re.escape(shown).replace("…", "(?s:.*?)")
    assert re.fullmatch(rf"(?:inflating structures: .*\n)*{pattern}", printed), printed


def test_the_dry_run_that_is_shown_is_of_the_recipe_of_today():
    (command, output), *_ = sessions(paths.BOOK / "commands" / "train.md")
    seconds, steps, rate, hours = map(float, output.splitlines()[2].split()[1:5])
    recipe = load_recipe(re.search(r"--profile (\w+)", command).group(1))
    assert steps == recipe.training["steps"]
    assert rate == pytest.approx(recipe.training["batch_size"] / seconds, rel=1e-3)
    assert hours == pytest.approx(steps * seconds / 3600, rel=1e-2)


def test_every_command_is_shown_in_use(commands):
    pages = [page for page in PAGES if page.parent.name == "commands"]
    typed = "\n".join(command for page in pages for command, _ in sessions(page))
    assert not [name for name in commands if len(re.findall(rf"\b(?:inflate|make) {name}\b", typed)) < 3]
