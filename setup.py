"""A wheel carries the committed weights and the paper's numbers; everything else stands in pyproject.toml."""

from pathlib import Path
from shutil import copytree

from setuptools import setup
from setuptools.command.build_py import build_py


class WithData(build_py):
    """Copies ``data/`` into the package, where :mod:`inflate_lib.paths` finds it outside of a checkout."""

    def run(self):
        super().run()
        if not self.editable_mode:  # which works with the checkout's own
            for part in ("pretrained/laptop", "reference"):
                copytree(Path("data", part), Path(self.build_lib, "inflate_lib", "data", part), dirs_exist_ok=True)


setup(cmdclass={"build_py": WithData})
