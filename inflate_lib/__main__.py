"""``python -m inflate_lib`` is the command ``inflate``."""

from inflate_lib.cli import run

run()
