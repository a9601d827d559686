"""The boxes *What we found*: sentences whose numbers come from the tables of the edition when a page is built.

In a chapter stands::

    ```{findings}
    Held-out heights are missed by [[held_out_scalars("median error / target", "height") | .1f]] % in the median.
    % held_out_scalars("median error / target", "height") < 3
    ```

Each paragraph is a sentence, or several that belong together. Between brackets stand an expression and the format of
its value. ``name(label, …, column)`` is a cell of ``name.csv``: the row in which all labels stand, and the column;
``name[column]`` is a whole column. Tables are those of the edition, and with ``stored.`` before their name those of
``data/reference``. A line that begins with % says what must hold for the words to be true: it is not shown, but tested.
"""

import re
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective

from inflate_lib import paths
from inflate_lib.book.run import executed_under
from inflate_lib.models.recipe import EDITION

NUMBER = re.compile(r"\[\[(.+?) \| (\S+)\]\]", re.DOTALL)
_WORDS = {word.__name__: word for word in (abs, all, any, len, max, min, sum, zip)}


class Finding(NamedTuple):
    """A paragraph of a box, and the expressions that have to be true for it."""

    text: str
    conditions: list[str]


class Measured(float):
    """A number of a table, with the ends of its interval where the table has them."""

    low = high = float("nan")


class Tables(dict):
    """The CSV files of some folders by name; of two of one name that of the earlier folder."""

    def __init__(self, *folders: Path) -> None:
        super().__init__(_WORDS, __builtins__={})
        self.folders = folders

    def __missing__(self, name):
        if name == "stored":
            return Tables(paths.REFERENCE)
        for file in (folder / f"{name}.csv" for folder in self.folders):
            if file.is_file():
                return self.setdefault(name, _Table(name, pd.read_csv(file, dtype=str).fillna("")))
        raise LookupError(f"there is no table {name}.csv in {' or '.join(map(str, self.folders))}")

    __getattr__ = __missing__

    def value(self, expression: str):
        """What an expression of a finding is; LookupError where a table, a row or a column is missing."""
        return eval(expression, self, self)  # its author is that of the chapter

    def filled(self, text: str) -> str:
        """The text with its numbers; a dash stands for one that no table has."""

        def number(found):
            try:
                return format(self.value(found[1]), found[2]).replace("-", "−")
            except LookupError:
                return "–"

        return NUMBER.sub(number, text)


class _Table(NamedTuple):
    name: str
    frame: pd.DataFrame

    def __call__(self, *labels):
        *labels, column = map(str, labels)
        rows = self.frame[[not Counter(labels) - Counter(row) for row in self.frame.to_numpy()]]
        if len(rows) != 1 or not (numbers := _numbers(self._cells(column, rows)[0])):
            raise LookupError(f"{self.name}.csv has {len(rows)} rows with {labels}, or no number in {column!r}")
        names = [f"{column} low", f"{column} high"], ["low", "high"]
        ends = [
            float(rows[name].item())
            for pair in names
            if {*pair} <= {*rows} and all(rows[[*pair]].iloc[0])
            for name in pair
        ]
        value = Measured(numbers[0])
        value.low, value.high = (numbers[1:] or ends or [value, value])[:2]
        return value

    def __getitem__(self, column):
        return [numbers[0] for cell in self._cells(column, self.frame) if (numbers := _numbers(cell))]

    def _cells(self, column, rows):
        if column not in rows:
            raise LookupError(f"{self.name}.csv has no column {column!r}, but {', '.join(rows)}")
        return list(rows[column])


def _numbers(cell):
    """The numbers of a cell: one, or one with its interval, as of "−0.1 [−0.5, 0.3]"."""
    return [float(number.replace("−", "-")) for number in re.findall(r"[-−]?\d+\.?\d*(?:e[-+]\d+)?", cell)]


def read_findings(text: str) -> list[Finding]:
    """The paragraphs of a box."""
    found = []
    for block in re.split(r"\n\s*\n", text.strip()):
        lines = block.splitlines()
        conditions = [line[1:].strip() for line in lines if line.startswith("%")]
        found.append(Finding("\n".join(line for line in lines if not line.startswith("%")), conditions))
    return found


class FindingsBox(SphinxDirective):
    """``{findings}``: the box with the edition's numbers; under another profile those of this run stand in brackets."""

    has_content = True

    def run(self):
        profile = (executed_under(Path(self.env.doc2path(self.env.docname))) or {}).get("profile", EDITION)
        here = Tables(paths.FIGURES / profile, paths.EDITION)
        edition = here if profile == EDITION else Tables(paths.EDITION)
        for file in [*paths.EDITION.glob("*.csv"), *paths.REFERENCE.glob("*.csv")]:
            self.env.note_dependency(str(file))

        def both(number):
            ours, theirs = edition.filled(number[0]), here.filled(number[0])
            return ours if ours == theirs else f"{ours} ({theirs})"

        texts = [NUMBER.sub(both, finding.text) for finding in read_findings("\n".join(self.content))]
        if profile != EDITION:
            texts.append(f"*The edition is the profile {EDITION}; in brackets: this page, profile {profile}.*")
        box = nodes.admonition("", nodes.title("", "What we found"), classes=["important", "findings"])
        lines = StringList("\n\n".join(texts).splitlines(), source=self.env.docname)
        self.state.nested_parse(lines, self.content_offset, box)
        return [box]
