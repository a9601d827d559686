"""How far work is: plain lines that read well in a terminal, a log and a notebook alike; in a terminal also bars."""

import io
import os
import time
from collections.abc import Callable, Iterable, Iterator
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


class Display:
    """Told how notebooks that run side by side get on; this one is silent."""

    def __enter__(self) -> "Display":
        return self

    def __exit__(self, *exception) -> None: ...
    def started(self, notebook: str, cells: int) -> None: ...
    def cell(self, notebook: str, number: int) -> None: ...
    def text(self, notebook: str, text: str) -> None: ...
    def finished(self, notebook: str, seconds: float) -> None: ...


class Lines(Display):
    """For a log: start and end of each notebook, and now and then where it is, with the last line that it printed."""

    def __init__(self, console, every: float = 20.0):
        self.console, self.every, self.began = console, every, time.monotonic()
        self.notebooks, self.at = {}, {}

    def say(self, text: str) -> None:
        line = f"[{time.monotonic() - self.began:6.1f} s] {text}"
        self.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def started(self, notebook: str, cells: int) -> None:
        self.notebooks[notebook] = Progress(notebook, cells, "cells", every=self.every, say=self.say)
        self.at[notebook] = 0
        self.say(f"{notebook}: started, {cells} cells")

    def cell(self, notebook: str, number: int) -> None:
        self.at[notebook] = number
        self.text(notebook, "")

    def text(self, notebook: str, text: str) -> None:
        if self.notebooks[notebook].due():
            self.notebooks[notebook].tell(self.at[notebook], _last_line(text))

    def finished(self, notebook: str, seconds: float) -> None:
        self.say(f"{notebook}: done in {seconds:.1f} s")


class Bars(Display):
    """For a terminal: a bar for each notebook at work, with the last line that it printed."""

    def __init__(self, console):
        from rich import progress
        from rich.progress import TextColumn

        columns = "{task.fields[notebook]}", "cell {task.completed}/{task.total}", "{task.fields[text]}"
        name, count, text = (TextColumn(column, markup=False) for column in columns)
        shown = progress.SpinnerColumn("line"), name, progress.BarColumn(20), count, progress.TimeElapsedColumn(), text
        self.bars = progress.Progress(*shown, console=console)
        self.tasks = {}

    def __enter__(self) -> "Bars":
        self.bars.start()
        return self

    def __exit__(self, *exception) -> None:
        self.bars.stop()

    def started(self, notebook: str, cells: int) -> None:
        self.tasks[notebook] = self.bars.add_task("", total=cells, notebook=notebook, text="")

    def cell(self, notebook: str, number: int) -> None:
        self.bars.update(self.tasks[notebook], completed=number, text="")

    def text(self, notebook: str, text: str) -> None:
        self.bars.update(self.tasks[notebook], text=_last_line(text)[:60])

    def finished(self, notebook: str, seconds: float) -> None:
        self.bars.remove_task(self.tasks[notebook])
        self.bars.console.print(f"{notebook}: done in {seconds:.1f} s", highlight=False)


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
