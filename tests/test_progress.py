"""Lines of progress: how much is done, how long the rest takes, and no line too many."""

import io

import pytest
from rich.console import Console

from inflate_lib import _progress
from inflate_lib._progress import MARK, RUNNER, Aside, Bars, Lines, Progress, Schedule, track


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass only when a test says so."""
    now = [100.0]
    monkeypatch.setattr(_progress.time, "monotonic", lambda: now[0])
    return now


def test_items_pass_through_with_a_line_every_five_seconds(clock, capsys):
    def work():
        for item in "abcd":
            clock[0] += 3
            yield 10, item

    assert list(track(work(), 40, "inflating structures")) == list("abcd")
    assert capsys.readouterr().out.splitlines() == [
        "inflating structures: 20 of 40 (50 %), 6 s left",
        "inflating structures: 40 of 40 (100 %), 12 s",
    ]


def test_short_work_is_silent(capsys):
    assert list(track(((1, item) for item in range(3)), 3, "counting")) == [0, 1, 2]
    assert capsys.readouterr().out == ""


def test_the_rest_is_reckoned_from_what_this_run_has_done(clock):
    lines = []
    progress = Progress("training", 1000, "steps", done=600, say=lines.append)
    clock[0] += 60
    assert progress.due() and progress.rate(700) == pytest.approx(100 / 60)
    progress.tell_time(700, "loss 0.1", "")
    assert not progress.due()
    assert lines == ["training: 700 of 1000 steps (70 %), loss 0.1, 3 min 00 s left"]


def test_a_log_gets_the_start_the_end_and_now_and_then_a_line(clock):
    text = io.StringIO()
    with Lines(Console(file=text, width=200)) as lines:
        lines.started("01_first", 4)
        lines.cell("01_first", 1)
        clock[0] += 30
        lines.text("01_first", "one\ntwo\n")
        lines.text("01_first", "three\n")
        lines.finished("01_first", 30.0)
    assert [line.split("] ")[1] for line in text.getvalue().splitlines()] == [
        "01_first: started, 4 cells",
        "01_first: 1 of 4 cells (25 %), two",
        "01_first: done in 30.0 s",
    ]


def test_the_time_left_is_what_the_budgets_leave_at_the_pace_so_far(clock):
    schedule = Schedule({"01_first": 60, "02_second": 40, "03_third": 20}, jobs=2, then=30)
    assert schedule.left() == 60 + 30  # 120 s of two notebooks side by side
    display = Lines(Console(file=io.StringIO()), schedule)
    display.started("01_first", 4)
    display.started("02_second", 4)
    clock[0] += 40
    assert schedule.left() == (20 + 0 + 20) / 2 + 30
    display.finished("02_second", 40.0)
    display.started("03_third", 1)
    clock[0] += 20
    display.finished("01_first", 160.0)  # slower than it should be: so is the rest
    assert schedule.pace() == (60 + 40 + 160) / (60 + 40 + 60)
    assert schedule.left() == pytest.approx(1.625 * (20 + 30) - 20)


def test_every_line_of_a_log_says_how_long_all_of_it_takes(clock):
    text = io.StringIO()
    lines = Lines(Console(file=text, width=200), Schedule({"01_first": 60, "02_second": 300}))
    lines.started("01_first", 4)
    clock[0] += 30
    lines.text("01_first", "drawing: 3 of 9\n")
    clock[0] += 30
    lines.finished("01_first", 60.0)
    assert [line.split("] ")[1] for line in text.getvalue().splitlines()] == [
        "01_first: started, 4 cells, budget 60 s",
        "01_first: 0 of 4 cells (0 %), drawing: 3 of 9, 5 min 30 s left for all",
        "01_first: done in 60.0 s, budget 60 s, 5 min 00 s left for all",
    ]


def test_a_terminal_gets_bars():
    text = io.StringIO()
    schedule = Schedule({"01_first": 60, "02_second": 300})
    with Bars(Console(file=text, force_terminal=True, width=120), schedule) as bars:
        bars.started("01_first", 4)
        bars.cell("01_first", 2)
        bars.text("01_first", "one\ntwo\n")
        bars.bars.refresh()
        assert "cell 2/4" in text.getvalue() and "two" in text.getvalue()
        assert "notebook 0/2" in text.getvalue() and "left for all" in text.getvalue()
        bars.finished("01_first", 3.0)
    assert "01_first: done in 3.0 s, budget 60 s" in text.getvalue()


@pytest.mark.parametrize("under_runner", [False, True])
def test_the_runner_finds_a_mark_on_each_line(monkeypatch, under_runner):
    monkeypatch.setenv(RUNNER, "manifest") if under_runner else monkeypatch.delenv(RUNNER, raising=False)
    text = io.StringIO()
    print("a\nb", "c", file=Aside(text))
    mark = MARK if under_runner else ""
    assert text.getvalue() == f"{mark}a\n{mark}b c\n"
