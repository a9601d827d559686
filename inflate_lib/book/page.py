"""What a notebook publishes: figures, tables and numbers, each with where it came from.

A notebook makes one :class:`Page` right after its parameters cell and hands it everything that the book shows. Files go
to ``figures/runs/<profile>/``; recorded numbers stay in the executed notebook, where the book (``{glue:text}``) and the
tests (:func:`recorded`) read them.
"""

import ast
import io
import json
import math
import os
import platform
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from IPython.display import Image, publish_display_data
from matplotlib.figure import Figure

from inflate_lib import paths
from inflate_lib._cache import digest
from inflate_lib._files import draft
from inflate_lib._progress import RUNNER
from inflate_lib._provenance import code_state, package_versions
from inflate_lib.book.profiles import declared_parameters
from inflate_lib.models.recipe import Recipe, load_recipe
from inflate_lib.plotting.style import use_style

SOURCES = {"mnist": "MNIST training sevens", "digits": "scikit-learn digits, embedded (no MNIST here)"}
_RECORD = "application/papermill.record/"  # the mark under which myst-nb looks for glued values


class Page:
    """The published side of one notebook; figures that are drawn after it was made have the book's style.

    Parameters
    ----------
    notebook
        The notebook's name without its suffix: ``"06_descriptors"``.
    namespace
        ``globals()`` of the notebook; its declared parameters are read from there.

    Attributes
    ----------
    profile
        As in the notebook's parameters.
    parameters : dict
        Every declared parameter with its value in this run.
    recipe : inflate_lib.models.recipe.Recipe
        The profile's, with what the notebook's names change: a parameter ``seed = 1``, ``training = {"steps": 500}``,
        or any other value of the recipe, declared or not; None changes nothing.
    seed, source
        Of the recipe; the source is ``"mnist"`` or ``"digits"``, "auto" being resolved.
    folder : Path
        ``figures/runs/<profile>/``.
    """

    def __init__(self, notebook: str, namespace: Mapping[str, Any]) -> None:
        self.notebook = notebook
        self.parameters = _parameters(notebook, namespace)
        self.profile = str(self.parameters.get("profile", "interactive"))
        changes = {field.name: namespace.get(field.name) for field in fields(Recipe)}
        self.recipe = load_recipe(self.profile).changed(**changes)
        self.seed, self.source = self.recipe.seed, _resolve(self.recipe.source)
        self.folder = paths.FIGURES / self.profile
        self._kinds: dict[str, tuple[str, ...]] = {}
        use_style()
        print(f"Profile: {self.profile} · data source: {SOURCES[self.source]}")

    def figure(self, fig: Figure, name: str, dpi: int = 200) -> Image:
        """Write ``<name>.png``, ``<name>.svg`` and the provenance; return the picture for display and close `fig`.

        The same picture gives the same bytes: no dates, no random identifiers inside.
        """
        fig = getattr(fig, "figure", fig)  # axes and seaborn grids know their figure
        if not isinstance(fig, Figure):
            raise ValueError(f"page.figure takes a matplotlib figure, not {type(fig).__name__}")
        with matplotlib.rc_context({"svg.hashsalt": name}):
            png, svg = io.BytesIO(), io.BytesIO()
            fig.savefig(png, format="png", dpi=dpi, metadata={"Software": None})
            fig.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
        plt.close(fig)
        self._write(name, {".png": png.getvalue(), ".svg": svg.getvalue()})
        return Image(data=png.getvalue(), format="png")

    def table(self, frame: pd.DataFrame, name: str, digits: int = 3) -> "Table":
        """Write ``<name>.csv`` (eight digits) and the provenance; return the table for display, floats to `digits`."""
        if not isinstance(frame, pd.DataFrame):
            raise ValueError(f"page.table takes a pandas DataFrame, not {type(frame).__name__}")
        shown = Table(frame, digits)
        self._write(name, {".csv": frame.to_csv(index=shown.has_index, float_format="%.8g").encode()})
        return shown

    def script(self, text: str, name: str) -> None:
        """Write ``<name>.js``, data for a page that draws by itself in the browser, and the provenance."""
        self._write(name, {".js": text.encode()})

    def record(self, name: str, value: float | bool | str) -> None:
        """Keep a number or short text in the executed notebook, for ``{glue:text}`` in the prose and for the tests."""
        value = value.item() if isinstance(value, np.generic | np.ndarray) and np.size(value) == 1 else value
        if not isinstance(value, bool | int | float | str):
            raise ValueError(f"page.record({name!r}) takes one number or text, not {type(value).__name__}")
        text = value if isinstance(value, str) else repr(value)
        publish_display_data(
            {_RECORD + "text/plain": text},
            metadata={"scrapbook": {"name": name, "mime_prefix": _RECORD}, "inflate": {"type": type(value).__name__}},
        )

    def provenance(self) -> dict[str, Any]:
        """Where this run's results come from; holds no date, so that equal runs give equal files."""
        return {
            "notebook": self.notebook,
            "profile": self.profile,
            "parameters": self.parameters,
            "recipe": asdict(self.recipe),
            "data_source": self.source,
            "seed": self.seed,
            "python": platform.python_version(),
            "packages": package_versions(),
        } | code_state()

    def _write(self, name: str, files: Mapping[str, bytes]) -> None:
        if not name or Path(name).name != name:
            raise ValueError(f"{name!r} is no file name; give one without folders and suffix, like 'fig03_descriptors'")
        if self._kinds.setdefault(name, tuple(files)) != tuple(files):
            had, has = " and ".join(self._kinds[name]), " and ".join(files)
            raise ValueError(f"{name!r} names {had} already; {has} would share its record: choose another name")
        for suffix, content in files.items():
            _replace(self.folder / f"{name}{suffix}", content)
        note = {"name": name, "files": {f"{name}{suffix}": digest(content) for suffix, content in files.items()}}
        note |= self.provenance()
        record = f"{name}.json"
        _replace(self.folder / record, (json.dumps(note, indent=2, ensure_ascii=False) + "\n").encode())
        if manifest := os.environ.get(RUNNER):
            with open(manifest, "a", encoding="utf-8") as stream:
                stream.writelines(f"{self.profile}/{file}\n" for file in [*note["files"], record])


@dataclass
class Table:
    """A data frame for display: HTML for the book and the browser, LaTeX and plain text elsewhere."""

    frame: pd.DataFrame
    digits: int = 3

    @property
    def has_index(self) -> bool:
        """Whether the row labels say something (a plain 0, 1, 2 … does not)."""
        return not isinstance(self.frame.index, pd.RangeIndex)

    def _format(self, value: float) -> str:
        return "–" if math.isnan(value) else f"{value:.{self.digits}f}".replace("-", "−")

    def _repr_mimebundle_(self, include=None, exclude=None) -> dict[str, str]:
        options = {"index": self.has_index, "float_format": self._format, "na_rep": "–"}
        return {
            "text/html": _unbroken(self.frame.to_html(border=0, **options)),
            "text/latex": self.frame.to_latex(escape=True, **options),
            "text/plain": self.frame.to_string(**options),
        }


def _unbroken(html: str) -> str:
    """Keep an interval in brackets on one line, and a number with its exponent."""
    return re.sub(r"(\de)-(\d)", r"\1−\2", re.sub(r"\[(\S+), (\S+)\]", "[\\1,\u00a0\\2]", html))


def recorded(notebook: str | Path) -> dict[str, Any]:
    """Read what :meth:`Page.record` kept in an executed notebook: ``{name: value}``.

    Raises
    ------
    ValueError
        The file is missing or is no notebook.
    """
    try:
        cells = json.loads(Path(notebook).read_text(encoding="utf-8"))["cells"]
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(f"{notebook} is not an executed notebook; make it with `inflate reproduce`") from error
    values = {}
    for output in (output for cell in cells for output in cell.get("outputs", [])):
        if scrap := output.get("metadata", {}).get("scrapbook"):
            text = "".join(output["data"][_RECORD + "text/plain"])
            kind = output["metadata"].get("inflate", {}).get("type", "str")
            values[scrap["name"]] = {"str": str, "float": float}.get(kind, ast.literal_eval)(text)
    return values


def _parameters(notebook: str, namespace: Mapping[str, Any]) -> dict[str, Any]:
    """The values that the notebook's declared parameters have now."""
    path = paths.NOTEBOOKS / f"{notebook}.md"
    if not path.is_file():
        raise ValueError(f"no notebook {path.name} in {paths.NOTEBOOKS}; Page takes the notebook's own name")
    running = Path(os.environ.get(RUNNER, "")).name.removesuffix(".published.txt")
    if running not in ("", notebook):
        raise ValueError(f"the notebook {running!r} must not publish as Page({notebook!r}, …), which is another one")
    if lost := [name for name in declared_parameters(path) if name not in namespace]:
        raise ValueError(f"run the parameters cell first: {', '.join(lost)} not defined; then Page(name, globals())")
    return {name: namespace[name] for name in declared_parameters(path)}


def _resolve(source: str) -> str:
    from inflate_lib.structures.sources import resolve_source  # here, so that a page without data needs no data module

    return resolve_source(source)


def _replace(path: Path, content: bytes) -> None:
    with draft(path) as place:
        place.write_bytes(content)
