"""ARCHITECTURE.md, the contract of imports and the reference speak of the library as it is."""

import ast
import inspect
import pkgutil
import re
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

import inflate_lib
from inflate_lib import paths

PACKAGES = {module.name for module in pkgutil.iter_modules(inflate_lib.__path__) if module.ispkg}


def read(name):
    return (paths.ROOT / name).read_text(encoding="utf-8")


def test_every_package_has_its_line_in_the_order_of_the_contract():
    (contract,) = (
        c for c in tomllib.loads(read("pyproject.toml"))["tool"]["importlinter"]["contracts"] if "layers" in c
    )
    *layers, _ground = contract["layers"]
    order = [name for layer in reversed(layers) for name in layer.split(" | ")]
    assert re.findall(r"^\| `(\w+)` \|", read("ARCHITECTURE.md"), flags=re.M) == order
    assert set(order) == PACKAGES


def test_every_place_to_change_something_is_there():
    table = read("ARCHITECTURE.md").split("## Where do I change")[1].split("\n## ")[0]
    rows = [row for row in table.splitlines() if row.startswith("| ") and "`" in row]
    assert len(rows) >= 10
    for row in rows:
        folder = None
        for name in re.findall(r"`([\w./]+)`", row):
            place = paths.ROOT / name if "/" in name or folder is None else folder / name
            assert place.exists() or place.with_suffix(".py").is_file(), name
            folder = place.parent


def test_the_reference_has_every_package_that_is_no_command():
    listed = re.findall(r"^\.\. public:: inflate_lib\.(\w+)$", read("book/api.md"), flags=re.M)
    assert len(set(listed)) == len(listed)
    assert set(listed) == PACKAGES - {"cli"}


def imported(path):
    """Modules and names that a file of the library imports, in full, those inside functions as well."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{name.name}" for name in node.names)
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names)


def test_a_module_with_an_underscore_is_for_its_own_package():
    root = Path(inflate_lib.__file__).parent
    private = re.compile(r"inflate_lib\.(\w+)(?:\.\w+)*\._\w+")
    for path in root.rglob("*.py"):
        own = path.relative_to(root).parts[0]
        for name in imported(path):
            found = private.match(name)
            assert not found or found[1] == own or found[1].startswith("_"), f"{path.relative_to(root)} imports {name}"


def test_a_function_with_an_underscore_is_for_its_own_module():
    for path in [*Path(inflate_lib.__file__).parent.rglob("*.py"), *paths.ROOT.glob("benchmarks/*.py")]:
        for name in imported(path):
            place = paths.ROOT.joinpath(*name.split("."))
            private = name.startswith("inflate_lib.") and place.name.startswith("_")
            assert not private or place.with_suffix(".py").is_file(), f"{path.name} imports {name}"


@pytest.mark.parametrize("name", sorted(PACKAGES - {"cli"}))
def test_a_package_hands_on_a_handful(name):
    assert len(import_module(f"inflate_lib.{name}").__all__) <= 13


@pytest.mark.parametrize("name", sorted(PACKAGES - {"cli"}))
def test_public_names_are_typed_and_no_module_hides_them(name):
    package = import_module(f"inflate_lib.{name}")
    assert not set(package.__all__) & {module.name for module in pkgutil.iter_modules(package.__path__)}
    for public in package.__all__:
        if inspect.isfunction(function := getattr(package, public)):
            hints = inspect.signature(function)
            kinds = [hints.return_annotation, *(parameter.annotation for parameter in hints.parameters.values())]
            assert inspect.Signature.empty not in kinds, f"{public} lacks type hints"
