"""``python -m inflate_lib``, the same as the command ``inflate``; ``torchrun -m inflate_lib train`` needs it."""

from inflate_lib.cli.app import run

run()
