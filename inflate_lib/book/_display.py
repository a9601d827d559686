"""How a run of the notebooks shows its progress: bars in a terminal, plain lines in a log."""

import time

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from inflate_lib.book._execution import Listener


class Lines(Listener):
    """Progress as plain lines, for logs: start and end of a notebook, and now and then where it is."""

    def __init__(self, console: Console, every: float = 20.0):
        self.console, self.every = console, every
        self.begin, self.cells, self.at, self.said = time.monotonic(), {}, {}, {}

    def __enter__(self) -> "Lines":
        return self

    def __exit__(self, *exception) -> None: ...

    def say(self, notebook: str, text: str) -> None:
        now = time.monotonic()
        self.said[notebook] = now
        line = f"[{now - self.begin:6.1f} s] {notebook}: {text}"
        self.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def started(self, notebook: str, cells: int) -> None:
        self.cells[notebook] = cells
        self.say(notebook, f"started, {cells} cells")

    def cell(self, notebook: str, number: int) -> None:
        self.at[notebook] = number
        self.sometimes(notebook, "")

    def text(self, notebook: str, text: str) -> None:
        self.sometimes(notebook, _last_line(text))

    def sometimes(self, notebook: str, text: str) -> None:
        if time.monotonic() - self.said[notebook] > self.every:
            self.say(notebook, f"cell {self.at.get(notebook, 0)}/{self.cells[notebook]} {text}")

    def finished(self, notebook: str, seconds: float) -> None:
        self.say(notebook, f"done in {seconds:.1f} s")


class Bars(Listener):
    """Progress bars, one for each notebook at work, with the last line that it printed."""

    def __init__(self, console: Console):
        columns = "{task.fields[notebook]}", "cell {task.completed}/{task.total}", "{task.fields[text]}"
        name, count, text = (TextColumn(column, markup=False) for column in columns)
        shown = SpinnerColumn(), name, BarColumn(20), count, TimeElapsedColumn(), text
        self.progress = Progress(*shown, console=console)
        self.tasks = {}

    def __enter__(self) -> "Bars":
        self.progress.start()
        return self

    def __exit__(self, *exception) -> None:
        self.progress.stop()

    def started(self, notebook: str, cells: int) -> None:
        self.tasks[notebook] = self.progress.add_task("", total=cells, notebook=notebook, text="")

    def cell(self, notebook: str, number: int) -> None:
        self.progress.update(self.tasks[notebook], completed=number, text="")

    def text(self, notebook: str, text: str) -> None:
        self.progress.update(self.tasks[notebook], text=_last_line(text)[:60])

    def finished(self, notebook: str, seconds: float) -> None:
        self.progress.remove_task(self.tasks[notebook])
        self.progress.console.print(f"{notebook}: done in {seconds:.1f} s", highlight=False)


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.replace("\r", "\n").splitlines() if line.strip()]
    return lines[-1] if lines else ""
