"""The wheel, installed where there is no checkout and nothing but what it asks for."""

import os
import re
import subprocess
import sys
import venv
from importlib.metadata import PathDistribution, distribution

import numpy as np
import pytest
from packaging.requirements import Requirement

from inflate_lib import load_sevens, paths

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def outside(tmp_path_factory):
    """``outside(command, …)`` runs in a folder with an environment of its own, in which the wheel is installed.

    That has what `pip install` of the wheel would bring and no more, linked from where the tests run: PyTorch is large.
    """
    folder = tmp_path_factory.mktemp("outside")
    wheel = build_wheel(folder)
    venv.create(folder / "venv", with_pip=False)
    python = folder / "venv" / "bin" / "python"
    packages = next((folder / "venv" / "lib").glob("python*/site-packages"))
    pip("--python", python, "install", "--no-deps", "--no-index", wheel)
    (installed,) = packages.glob("inflate_lib-*.dist-info")
    for name in needed(PathDistribution(installed)):
        link(distribution(name), packages)
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("INFLATE", "PYTHON"))}
    environment = kept | {"HOME": str(folder), "XDG_CACHE_HOME": "", "MPLBACKEND": "agg"}

    def call(*command, **more):
        program, *words = map(str, command)
        return subprocess.run(
            [python.parent / program, *words], cwd=folder, env=environment | more, capture_output=True, text=True
        )

    call.folder, call.packages = folder, packages
    return call


def build_wheel(folder):
    """Built from a copy: setuptools leaves a folder ``build`` behind, and takes in what it finds there."""
    source = folder / "source"
    listing = subprocess.run(
        ["git", "-C", paths.ROOT, "ls-files", "-z", "--cached", "--others", "--exclude-standard"], capture_output=True
    )
    if listing.returncode:
        pytest.skip("not a git checkout")
    for name in listing.stdout.decode().split("\0")[:-1]:
        original, copy = paths.ROOT / name, source / name
        if original.is_file():
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.symlink_to(original)
    pip("wheel", "--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir", folder, source)
    (wheel,) = folder.glob("*.whl")
    return wheel


def pip(*words):
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def needed(wanted):
    """Names of all the packages that `pip install` of this one, without extras, would bring."""
    found, waiting = set(), [(wanted, frozenset())]
    while waiting:
        package, extras = waiting.pop()
        for line in package.requires or []:
            requirement = Requirement(line)
            fits = requirement.marker is None or any(
                requirement.marker.evaluate({"extra": extra}) for extra in {"", *extras}
            )
            if fits and (requirement.name, *sorted(requirement.extras)) not in found:
                found.add((requirement.name, *sorted(requirement.extras)))
                waiting.append((distribution(requirement.name), frozenset(requirement.extras)))
    return {name for name, *_ in found}


def link(package, packages):
    """Make an installed package visible in another environment."""
    for top in {file.parts[0] for file in package.files} - {"..", "__pycache__"}:
        if not (packages / top).exists():
            (packages / top).symlink_to(package.locate_file(top))


@pytest.fixture(scope="module")
def structure(outside):
    np.save(outside.folder / "seven.npy", load_sevens("digits").images[0])
    return "seven.npy"


def test_info_names_versions_and_a_cache_of_the_users(outside):
    done = outside("inflate", "info")
    assert done.returncode == 0, done.stderr
    assert re.search(r"^torch \d", done.stdout, flags=re.M)
    assert "no checkout" in done.stdout
    assert f"cache {outside.folder / '.cache' / 'inflate-lib'}" in done.stdout


def test_simulate(outside, structure):
    done = outside("inflate", "simulate", structure, "--json", "--plot", "seven.png", "--vtk", "seven.vtu")
    assert done.returncode == 0, done.stderr
    assert '"height"' in done.stdout
    assert (outside.folder / "seven.png").is_file()


def test_design_with_the_committed_weights(outside):
    done = outside("inflate", "design", "--height", "1.05", "-n", "2", "--out", "designs")
    assert done.returncode == 0, done.stdout + done.stderr
    assert (outside.folder / "designs" / "contact_sheet.png").is_file()


def test_every_module_but_the_book_needs_the_base_packages_alone(outside):
    code = """
import importlib, pkgutil, inflate_lib
for module in pkgutil.walk_packages(inflate_lib.__path__, "inflate_lib."):
    if not module.name.startswith(("inflate_lib.book", "inflate_lib.__main__")):
        importlib.import_module(module.name)
"""
    done = outside("python", "-c", code)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", ["reproduce", "book", "pdf", "train", "card"])
def test_what_only_the_repository_can_do_says_so(outside, command):
    done = outside("inflate", command)
    assert done.returncode == 1
    assert f"inflate {command} works in a checkout of the repository alone" in done.stderr


def test_a_missing_extra_is_named(outside):
    done = outside("inflate", "reproduce", INFLATE_HOME=str(paths.ROOT))
    assert done.returncode == 1
    assert "pip install 'inflate-lib[book]'" in done.stderr
    (outside.folder / "shape.svg").write_text("<svg xmlns='http://www.w3.org/2000/svg'/>", encoding="utf-8")
    done = outside("inflate", "design", "--outline", "shape.svg", "--out", "drawn")
    assert done.returncode == 1
    assert "pip install 'inflate-lib[design]'" in done.stderr
