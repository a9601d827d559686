"""How far work is: plain lines that read well in a terminal, a log and a notebook alike; in a terminal also bars."""

import io
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import IO, Any

MARK = "\x01"  # begins a line that the runner shows while a notebook runs, and does not keep in it
RUNNER = "INFLATE_MANIFEST"  # set by the runner, to the file in which it wants to be told what was published


def degrade(stream: Any) -> None:
    """Let a stream write a question mark for what its encoding lacks, where it would raise an error."""
    if isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors="replace")


def _print(text: str) -> None:
    print(text, flush=True)


class Progress:
    """Tells how far one piece of work is, at most every few seconds.

    Parameters
    ----------
    what
        What is being done: ``"inflating structures"``.
    total
        Work in all.
    unit
        What is counted, where `what` does not say it: ``"steps"``.
    done
        Work that was done before.
    every
        Seconds between two lines; short work prints nothing.
    say
        Takes the lines.
    """

    def __init__(
        self, what: str, total: int, unit: str = "", done: int = 0, every: float = 5.0, say: Callable = _print
    ):
        self.what, self.total, self.unit, self.before = what, total, unit, done
        self.every, self.say = every, say
        self.started = self.said = time.monotonic()

    def due(self) -> bool:
        """Whether it is time for another line."""
        return time.monotonic() - self.said >= self.every

    def rate(self, done: int) -> float:
        """Work per second."""
        return (done - self.before) / max(time.monotonic() - self.started, 1e-9)

    def tell(self, done: int, *facts: str) -> None:
        """A line: how much is done, and other facts."""
        self.said = time.monotonic()
        count = f"{done} of {self.total} {self.unit}".rstrip()
        self.say(", ".join([f"{self.what}: {count} ({100 * done // self.total} %)", *filter(None, facts)]))

    def tell_time(self, done: int, *facts: str) -> None:
        """A line with the time that is left; at the end, with the time that was taken."""
        left = (self.total - done) / max(self.rate(done), 1e-9)
        passed = time.monotonic() - self.started
        self.tell(done, *facts, f"{_duration(left)} left" if done < self.total else _duration(passed))


def track(items: Iterable[tuple[int, Any]], total: int, what: str) -> Iterator[Any]:
    """Yield from `items`, pairs of an amount of work and the item that it makes, and tell how far they are."""
    progress, done = Progress(what, total), 0
    for amount, item in items:
        yield item
        done += amount
        if progress.due():
            progress.tell_time(done)


class Schedule:
    """How long notebooks that run side by side still take: their budgets, at the pace of those that are done.

    Parameters
    ----------
    budgets
        Notebook → seconds; empty where nobody knows.
    jobs
        Notebooks side by side.
    then
        Seconds of what follows when all are done.
    """

    def __init__(self, budgets: Mapping[str, float], jobs: int = 1, then: float = 0.0):
        self.budgets, self.jobs, self.then = budgets, jobs, then
        self.began, self.took = {}, {}

    def pace(self) -> float:
        """What a second of a budget takes here; one minute at the budget's own pace steadies the first few."""
        allowed = sum(self.budgets[name] for name in self.took)
        return (60 + sum(self.took.values())) / (60 + allowed)

    def left(self) -> float:
        """Seconds until everything is done."""
        now, pace = time.monotonic(), self.pace()
        rest = {name: pace * seconds for name, seconds in self.budgets.items() if name not in self.took}
        rest |= {name: max(rest[name] - (now - began), 0.0) for name, began in self.began.items() if name in rest}
        return max([sum(rest.values()) / self.jobs, *rest.values()]) + pace * self.then

    def words(self) -> str:
        """The time that is left for all, in words; nothing where no budgets are known."""
        return f"{_duration(self.left())} left for all" if self.budgets else ""

    def budget(self, notebook: str) -> str:
        """A notebook's budget in words."""
        return f"budget {self.budgets[notebook]:.0f} s" if notebook in self.budgets else ""


class Display:
    """Told how notebooks that run side by side get on; this one is silent."""

    def __init__(self, schedule: Schedule | None = None):
        self.schedule = schedule or Schedule({})

    def __enter__(self) -> "Display":
        return self

    def __exit__(self, *exception) -> None: ...
    def started(self, notebook: str, cells: int) -> None:
        self.schedule.began[notebook] = time.monotonic()

    def cell(self, notebook: str, number: int) -> None: ...
    def text(self, notebook: str, text: str) -> None: ...
    def finished(self, notebook: str, seconds: float) -> None:
        self.schedule.took[notebook] = seconds


class Lines(Display):
    """For a log: start and end of each notebook, and now and then where it is, with the last line that it printed."""

    def __init__(self, console, schedule: Schedule | None = None, every: float = 20.0):
        super().__init__(schedule)
        self.console, self.every, self.started_at = console, every, time.monotonic()
        self.notebooks, self.at = {}, {}

    def say(self, *facts: str) -> None:
        line = f"[{time.monotonic() - self.started_at:6.1f} s] {', '.join(filter(None, facts))}"
        self.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def started(self, notebook: str, cells: int) -> None:
        super().started(notebook, cells)
        self.notebooks[notebook] = Progress(notebook, cells, "cells", every=self.every, say=self.say)
        self.at[notebook] = 0
        self.say(f"{notebook}: started, {cells} cells", self.schedule.budget(notebook))

    def cell(self, notebook: str, number: int) -> None:
        self.at[notebook] = number
        self.text(notebook, "")

    def text(self, notebook: str, text: str) -> None:
        if self.notebooks[notebook].due():
            self.notebooks[notebook].tell(self.at[notebook], _last_line(text), self.schedule.words())

    def finished(self, notebook: str, seconds: float) -> None:
        super().finished(notebook, seconds)
        self.say(f"{notebook}: done in {seconds:.1f} s", self.schedule.budget(notebook), self.schedule.words())


class Bars(Display):
    """For a terminal: a bar for each notebook at work, with the last line that it printed, and one for all of them."""

    def __init__(self, console, schedule: Schedule | None = None):
        from rich import progress
        from rich.progress import TextColumn

        super().__init__(schedule)
        columns = "{task.fields[notebook]}", "{task.fields[unit]} {task.completed}/{task.total}", "{task.fields[text]}"
        name, count, text = (TextColumn(column, markup=False) for column in columns)
        shown = progress.SpinnerColumn("line"), name, progress.BarColumn(20), count, progress.TimeElapsedColumn(), text
        self.bars = progress.Progress(*shown, console=console)
        self.tasks = {}

    def __enter__(self) -> "Bars":
        self.bars.start()
        if total := len(self.schedule.budgets):
            self.all = self.bars.add_task("", total=total, notebook="all", unit="notebook", text=self.schedule.words())
        return self

    def __exit__(self, *exception) -> None:
        self.bars.stop()

    def started(self, notebook: str, cells: int) -> None:
        super().started(notebook, cells)
        self.tasks[notebook] = self.bars.add_task("", total=cells, notebook=notebook, unit="cell", text="")
        self._tell_all()

    def cell(self, notebook: str, number: int) -> None:
        self.bars.update(self.tasks[notebook], completed=number, text="")
        self._tell_all()

    def text(self, notebook: str, text: str) -> None:
        self.bars.update(self.tasks[notebook], text=_last_line(text)[:60])
        self._tell_all()

    def finished(self, notebook: str, seconds: float) -> None:
        super().finished(notebook, seconds)
        self.bars.remove_task(self.tasks[notebook])
        facts = f"{notebook}: done in {seconds:.1f} s", self.schedule.budget(notebook)
        self.bars.console.print(", ".join(filter(None, facts)), highlight=False)
        self._tell_all()

    def _tell_all(self) -> None:
        if self.schedule.budgets:
            self.bars.update(self.all, completed=len(self.schedule.took), text=self.schedule.words())


class Aside(io.TextIOBase):
    """Marks what is printed under the runner: progress would come and go in the book with the state of the cache."""

    def __init__(self, stream: IO[str]):
        self.stream, self.at_start = stream, True
        self.mark = MARK if RUNNER in os.environ else ""

    def write(self, text: str) -> int:
        for line in text.splitlines(keepends=True):
            self.stream.write(self.mark + line if self.at_start else line)
            self.at_start = line.endswith(("\n", "\r"))
        return len(text)

    def flush(self) -> None:
        self.stream.flush()


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds // 60:.0f} min {seconds % 60:02.0f} s"


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.replace("\r", "\n").splitlines() if line.strip()]
    return lines[-1] if lines else ""
