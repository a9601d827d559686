"""The command on terminals that know few characters: a question mark, never an error."""

import io
import sys

import pytest
from rich.console import Console

from inflate_lib import paths
from inflate_lib._progress import Bars, degrade
from inflate_lib.cli import app
from inflate_lib.cli.app import _COMMANDS


def output(monkeypatch, encoding, *words):
    """What a command prints to a terminal of this encoding, as bytes; errors end the test."""
    terminal = io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors="strict")
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setattr(sys, "argv", ["inflate", *words])
    with pytest.raises(SystemExit) as exit_:
        app.run()
    assert not exit_.value.code
    terminal.flush()
    return terminal.buffer.getvalue()


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
@pytest.mark.parametrize("command", _COMMANDS)
def test_help_is_read_everywhere(monkeypatch, encoding, command):
    assert b"Usage: " in output(monkeypatch, encoding, command, "--help")


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_tables_are_read_everywhere_and_so_are_names_that_are_no_text(monkeypatch, encoding, tmp_path):
    image = tmp_path / "siebenβ\udcff.png"  # a name with a byte that is not UTF-8
    image.write_bytes((paths.ROOT / "examples" / "seven.png").read_bytes())
    text = output(monkeypatch, encoding, "simulate", str(image), "--steps", "1")
    assert b"height" in text and b"sieben" in text


def test_bars_are_read_everywhere():
    terminal = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    degrade(terminal)
    with Bars(Console(file=terminal, force_terminal=True)) as bars:
        bars.started("05_inflation", 3)
        bars.text("05_inflation", "λ = 16.44 …")
        bars.finished("05_inflation", 1.0)
    terminal.flush()
    assert b"05_inflation: done" in terminal.buffer.getvalue()
