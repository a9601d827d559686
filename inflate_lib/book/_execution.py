"""Execute one notebook with papermill, so that either a whole executed notebook comes out or none."""

import contextlib
import logging
import os
import re
import shutil
import signal
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager
from jupyter_core.utils import ensure_event_loop

with warnings.catch_warnings():  # papermill's optional cloud parts warn on import
    warnings.simplefilter("ignore")
    import papermill

from inflate_lib import paths
from inflate_lib._cache import CacheError, writing
from inflate_lib._files import draft
from inflate_lib._progress import MARK, RUNNER, Display
from inflate_lib.book._fork import POSSIBLE, ForkedKernel, ForkServer
from inflate_lib.book.profiles import declared_parameters

logging.getLogger("papermill").setLevel(logging.CRITICAL)  # what it would say, NotebookFailed says
_INJECTED = "injected-parameters"  # papermill's tag for the cell that it adds
_KERNEL = {"display_name": "Python 3", "language": "python", "name": "python3"}  # a source names its language only


class NotebookFailed(RuntimeError):
    """A notebook that did not run to its end; the text names the cell and the error."""


class Kernels:
    """The kernels of one run: started with this Python in the repository root, and ended together.

    No settings of the user's reach them: neither those of matplotlib nor those of IPython.

    Parameters
    ----------
    environment
        Variables for the kernels, on top of this process's own.
    forked
        Fork them from one process, where that is possible: it pays where many follow one another.
    """

    def __init__(self, environment: Mapping[str, str], forked: bool = False):
        self._folder = tempfile.TemporaryDirectory(prefix="inflate-kernels-")
        own = {"MPLBACKEND": "module://matplotlib_inline.backend_inline", "MATPLOTLIBRC": os.devnull}
        self.environment = {**os.environ, **own, "IPYTHONDIR": self._folder.name, **environment}
        self.stopped = False
        self._processes: set[int] = set()
        self._lock = threading.Lock()
        self._server = ForkServer(self.environment, str(paths.ROOT)) if forked and POSSIBLE else None

    def manager(self, environment: Mapping[str, str], words: Path) -> type[AsyncKernelManager]:
        """A kernel manager class for nbclient: whatever kernels are registered on the machine, this Python is used.

        What its process itself says, past the notebook, goes to the file `words`.
        """
        kernels = self

        class ThisPython(AsyncKernelManager):
            @property
            def kernel_spec(self):
                command = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}", "--log-level=ERROR"]
                return KernelSpec(argv=command, display_name="Python 3", language="python")

            async def start_kernel(self, **options):
                if kernels.stopped:
                    raise NotebookFailed("stopped")
                options |= {"env": {**kernels.environment, **environment}, "cwd": str(paths.ROOT)}
                if kernels._server and kernels._server.ready():
                    self.provisioner = ForkedKernel(
                        kernels._server, str(words), parent=self, kernel_id="", kernel_spec=self.kernel_spec
                    )
                with words.open("wb") as said:
                    await super().start_kernel(**options, stdout=said, stderr=said)
                with kernels._lock:
                    kernels._processes.add(self.provisioner.pid)
                if kernels.stopped:  # stop() came while this one started
                    kernels.stop()

        return ThisPython

    def stop(self) -> None:
        """End every kernel with the workers that it started."""
        self.stopped = True
        with self._lock:
            for process in self._processes:
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(process, signal.SIGKILL)  # a kernel leads its own process group
            self._processes.clear()
        if self._server:
            self._server.stop()

    def __enter__(self) -> "Kernels":
        return self

    def __exit__(self, *exception) -> None:
        self.stop()
        with contextlib.suppress(OSError):  # a kernel that is just ending may write there
            self._folder.cleanup()


def execute(
    source: Path,
    output: Path,
    parameters: Mapping[str, Any],
    kernels: Kernels,
    display: Display,
    finish: Callable[[nbformat.NotebookNode, Path], None],
) -> None:
    """Run the MyST notebook `source` under `parameters` and put the result at `output`.

    ``finish(notebook, manifest)`` completes the executed notebook before it moves into place; the file `manifest` lists
    what the notebook published. A broken notebook goes to ``book/_build/reports``.

    Raises
    ------
    NotebookFailed
        A cell raised, or the kernel died.
    """
    name = source.stem
    folder = paths.CACHE / "runs"
    given, running = folder / f"{name}.input.ipynb", folder / f"{name}.running.ipynb"
    manifest, words = folder / f"{name}.published.txt", folder / f"{name}.kernel.txt"
    notebook = jupytext.read(source)
    notebook.metadata["kernelspec"] = _KERNEL
    with writing():
        folder.mkdir(parents=True, exist_ok=True)
        manifest.write_text("")
        nbformat.write(notebook, given)
    progress = _Progress(name, display)
    display.started(name, sum(cell.cell_type == "code" for cell in notebook.cells))
    try:
        with writing():
            executed = papermill.execute_notebook(
                _literal(given),
                _literal(running),
                parameters=dict(parameters),
                progress_bar=False,
                stdout_file=progress,
                on_cell_start=progress.cell_started,
                kernel_manager_class=kernels.manager({RUNNER: str(manifest)}, words),
                coalesce_streams=True,  # a progress line that rewrites itself leaves its last state only
            )
    except papermill.PapermillExecutionError as error:
        message = strip_colour(f"{error.ename}: {error.evalue}")
        where = strip_colour("\n".join(error.traceback))
        raise NotebookFailed(_report(source, running, progress, message, where)) from error
    except CacheError:
        raise
    except Exception as error:
        if kernels.stopped:
            raise NotebookFailed(f"{source.name} was stopped") from error
        said = _last_words(words)
        died = "DeadKernel" in type(error).__name__ or "Kernel died" in str(error)
        message = "the kernel died" + ": killed, or out of memory" * (not said) if died else repr(error)
        raise NotebookFailed(_report(source, running, progress, message, said)) from error
    finally:
        ensure_event_loop().close()  # papermill leaves this thread's loop open
    defaults = declared_parameters(source)
    _tidy(executed, as_shown=all(defaults[k] == v for k, v in parameters.items() if k != "profile"))
    finish(executed, manifest)
    with draft(output) as place:
        nbformat.write(executed, place)
    for leftover in (given, running, manifest, words):
        leftover.unlink(missing_ok=True)


class _Progress:
    """Follows papermill through the cells; also the file that it writes the cells' printed text to."""

    def __init__(self, notebook: str, display: Display):
        self.notebook, self.display = notebook, display
        self.number, self.source = 0, ""

    def cell_started(self, cell: nbformat.NotebookNode, cell_index: int) -> None:
        self.source = cell.source
        if cell.cell_type == "code" and _INJECTED not in cell.metadata.get("tags", []):
            self.number += 1
            self.display.cell(self.notebook, self.number)

    def write(self, text: str) -> None:
        self.display.text(self.notebook, text.replace(MARK, ""))

    def flush(self) -> None: ...


def _literal(path: Path) -> str:
    """A path for papermill, which would fill in what stands in braces."""
    return str(path).replace("{", "{{").replace("}", "}}")


def _last_words(words: Path) -> str:
    """What the process of a kernel said, past the notebook."""
    said = words.read_text(encoding="utf-8", errors="replace").strip() if words.is_file() else ""
    return f"Its last words:\n{strip_colour(said)}" if said else ""


def _report(source: Path, broken: Path, progress: _Progress, message: str, details: str = "") -> str:
    """Keep the broken notebook outside the book; say in which cell what went wrong."""
    cell, kept = progress.source.rstrip(), paths.REPORTS / f"{source.stem}.ipynb"
    where = "before its first cell"
    if cell:
        before, found, _ = source.read_text(encoding="utf-8").partition(cell)
        line = f", line {before.count(chr(10)) + 1}" if found else ""
        where = f"code cell {progress.number}{line}"
    lines = details.splitlines()
    shown = lines if len(lines) <= 40 else [*lines[:15], "    …", *lines[-24:]]
    parts = [f"{source.name}, {where}: {message}", *(["", cell] if cell else []), "", *shown]
    if cell and broken.is_file():
        with draft(kept) as place:
            shutil.move(broken, place)  # the cache may be on another disk
        parts += ["", f"The notebook as far as it came: {kept}"]
    return "\n".join(parts)


def _tidy(notebook: nbformat.NotebookNode, as_shown: bool) -> None:
    """Drop paths and times of this machine; hide the injected parameters, or only fold them if not `as_shown`."""
    notebook.metadata.pop("papermill", None)
    for cell in notebook.cells:
        for key in ("papermill", "execution", "lines_to_next_cell"):
            cell.metadata.pop(key, None)
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if _without_progress(output)]
        if _INJECTED in cell.metadata.get("tags", []):
            cell.metadata["tags"].append("remove-cell" if as_shown else "hide-input")


def _without_progress(output: nbformat.NotebookNode) -> bool:
    """Take the lines that only told of progress out of an output; whether anything is left of it."""
    if output.output_type != "stream":
        return True
    lines = re.split(r"(?<=[\r\n])", output.text)
    output.text = "".join(line for line in lines if not line.startswith(MARK))
    return bool(output.text.strip())


def strip_colour(text: str) -> str:
    """Text without a terminal's colour codes."""
    return re.sub("\x1b\\[[0-9;]*[A-Za-z]", "", text)
