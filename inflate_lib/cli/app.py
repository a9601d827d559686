"""The command ``inflate``: what its commands share, and where they are called from.

Each command has a module of its own, which imports what it needs when it is called, so that ``--help`` is instant.
"""

import errno
import os
import signal
import sys
import threading
from importlib import import_module
from typing import Annotated

import typer

from inflate_lib._progress import degrade

#: In the order in which --help lists them.
_COMMANDS = ("reproduce", "book", "dataset", "simulate", "design", "train", "card", "export", "info")

app = typer.Typer(
    help="Inverse design of inflatable structures with denoising diffusion: the runnable companion of the paper.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
ProfileName = Annotated[str, typer.Option(help="A file in notebooks/profiles, without .yml: laptop, ci, paper.")]
Jobs = Annotated[int, typer.Option(help="Notebooks side by side.")]
Force = Annotated[bool, typer.Option("--force", help="Execute fresh notebooks too.")]
Source = Annotated[str, typer.Option(help="What 'auto' means in the profile: auto, mnist or digits.")]
Retrain = Annotated[bool, typer.Option("--retrain", help="Train the models, though data/pretrained has their weights.")]


def _tell_version(wanted: bool) -> None:
    if wanted:
        import inflate_lib

        print(f"inflate {inflate_lib.__version__}")
        raise typer.Exit


@app.callback()
def main(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_tell_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Set the way in which errors are shown."""
    if debug:
        os.environ["INFLATE_DEBUG"] = "1"


def kill_is_ctrl_c() -> None:
    """From here on a plain `kill`, or a closed terminal, ends the command in the same orderly way as Ctrl-C."""
    if threading.current_thread() is threading.main_thread():
        for number in {getattr(signal, name, signal.SIGTERM) for name in ("SIGTERM", "SIGHUP")}:
            if signal.getsignal(number) == signal.SIG_DFL:  # not under nohup
                signal.signal(number, signal.default_int_handler)


def _load_commands() -> typer.Typer:
    """The application with all its commands."""
    for command in _COMMANDS:
        import_module(f"inflate_lib.cli.{command}")
    return app


def run() -> None:
    """Entry point: an error that the library foresaw is one clear message and exit code 1, not a traceback."""
    os.environ |= {"MPLBACKEND": "Agg", "MATPLOTLIBRC": os.devnull}  # pictures need no screen and nobody's settings
    degrade(sys.stdout)
    _load_commands()
    try:
        app()
    except ModuleNotFoundError as error:  # SVG outlines and Dask name their extras themselves
        if os.environ.get("INFLATE_DEBUG"):
            raise
        sys.exit(f"inflate: this command needs {error.name}: pip install 'inflate-lib[book]'")
    except (ValueError, RuntimeError, OSError, FloatingPointError) as error:
        if os.environ.get("INFLATE_DEBUG"):
            raise
        sys.exit(f"inflate: {_told(error)}")


def _told(error: Exception) -> str:
    """The text of an error; that of a full disk which is not named says where there is room."""
    if isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None:
        from inflate_lib._cache import tell_full  # here, so that --help is instant

        return tell_full(error)
    return str(error)
