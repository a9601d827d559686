"""Public names that are imported on first use (PEP 562), so that importing a package is instant."""

import ast
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any


def attach(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package whose imports stand where type checkers alone see them.

    One list serves both: what ``__init__.py`` imports under ``if TYPE_CHECKING:`` is imported here on first use.

    Parameters
    ----------
    package, file : str
        ``__name__`` and ``__file__`` of the package.
    """
    tree = ast.parse(Path(file).read_text(encoding="utf-8"))
    unseen = [line for block in tree.body if isinstance(block, ast.If) for line in block.body]
    home = {name.name: str(line.module) for line in unseen if isinstance(line, ast.ImportFrom) for name in line.names}

    def load(name: str) -> Any:
        if name in home:
            return getattr(import_module(home[name]), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return load, lambda: sorted(home)
