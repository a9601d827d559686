"""The command ``inflate``, one module per command."""

from inflate_lib.cli.app import run

__all__ = ["run"]
