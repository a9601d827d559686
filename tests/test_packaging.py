"""Things said in two places agree: dependencies, commands, the contents of the book."""

import os
import re
import shlex
import subprocess
import sys
import tomllib

import pytest
import yaml

import inflate_lib
from inflate_lib import paths
from inflate_lib.book.run import find_notebooks

CONDA_NAMES = {
    "matplotlib-base": "matplotlib",
    "python-build": "build",
    "pytorch-cpu": "torch",
    "seaborn-base": "seaborn",
}


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def read(name):
    return (paths.ROOT / name).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def project():
    return tomllib.loads(read("pyproject.toml"))["project"]


@pytest.fixture(scope="module")
def wanted(project):
    """Requirement by name, of the library and all its extras."""
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    named = {normal(re.split(r"[<>=!~\[]", line)[0]): line for lines in groups for line in lines}
    del named[project["name"]]  # an extra that takes in others
    return named


@pytest.fixture(scope="module")
def pins():
    lines = [line for line in read("constraints.txt").splitlines() if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.]+", line) for line in lines), "only name==version"
    pairs = [line.split("==") for line in lines]
    assert len({normal(name) for name, _ in pairs}) == len(pairs)
    return {normal(name): version for name, version in pairs}


def test_every_dependency_is_pinned_within_its_range(wanted, pins):
    from packaging.requirements import Requirement

    for name, line in wanted.items():
        assert name in pins, f"constraints.txt lacks {name}"
        assert pins[name] in Requirement(line).specifier, f"{name} {pins[name]} is outside {line}"


def test_no_pin_ties_to_one_machine(pins):
    assert not [name for name in pins if re.match(r"nvidia|triton|cuda|inflate", name)]
    assert pins["torch"] == "2.13.0"


def test_the_installed_packages_are_the_pinned_ones(wanted, pins):
    """In the environment of make; elsewhere (conda) versions may differ, and this says nothing."""
    from importlib.metadata import distributions

    if not (paths.ROOT / ".venv" / "installed-dev").exists():
        pytest.skip("not in the environment that make creates")
    installed = {normal(d.metadata["Name"]): d.version.split("+")[0] for d in distributions()}
    assert {name: installed[name] for name in wanted if name in installed} == {
        name: pins[name] for name in wanted if name in installed
    }


def test_conda_environment_is_in_step(wanted, pins):
    *listed, from_pip = yaml.safe_load(read("environment.yml"))["dependencies"]
    conda = dict(entry.split("=") for entry in listed if "=" in entry)
    assert conda.pop("python") in {"3.11", "3.12"}
    here = {normal(CONDA_NAMES.get(name, name)): version for name, version in conda.items()}
    with_pip = dict(entry.split("==") for entry in from_pip["pip"] if "==" in entry)
    assert set(here) | set(with_pip) == set(wanted)
    assert here == {name: ".".join(pins[name].split(".")[:2]) for name in here}
    assert with_pip == {name: pins[name] for name in with_pip}
    assert "--editable ." in from_pip["pip"]


def test_python_versions_agree_everywhere(project):
    assert project["requires-python"] == ">=3.11,<3.13"
    assert "(3, 11), (3, 12)" in read("Makefile")
    workflow = yaml.safe_load(read(".github/workflows/book.yml"))
    assert workflow["jobs"]["tests"]["strategy"]["matrix"]["python"] == ["3.11", "3.12"]


def test_versions_agree_everywhere(project, pins):
    cited = yaml.safe_load(read("CITATION.cff"))["version"]
    assert cited == project["version"] == inflate_lib.__version__
    ruff, *others = yaml.safe_load(read(".pre-commit-config.yaml"))["repos"]
    assert ruff["rev"] == f"v{pins['ruff']}"
    assert not others


def test_ci_runs_what_the_readme_says():
    script = read(".ci/run")
    made = [script.index(step) for step in ("make test", "make reproduce PROFILE=ci", "make book", '-m "book or slow"')]
    assert made == sorted(made)
    assert "run: .ci/run" in read(".github/workflows/book.yml")
    assert (paths.ROOT / ".ci" / "run").stat().st_mode & 0o111


def test_a_release_carries_the_edition_as_a_pdf():
    steps = yaml.safe_load(read(".github/workflows/release.yml"))["jobs"]["pdf"]["steps"]
    commands = [step.get("run", "") for step in steps]
    made = next(number for number, command in enumerate(commands) if command.startswith("make pdf PROFILE=laptop"))
    assert "book/_build/pdf/book.pdf" in commands[made + 1] and "gh release upload" in commands[made + 1]


@pytest.mark.parametrize("name", ["book", "release"])
def test_a_workflow_runs_what_is_there(name):
    """Jobs wait for jobs that exist; their commands can be read by the shell, and name targets and files that exist."""
    jobs = yaml.safe_load(read(f".github/workflows/{name}.yml"))["jobs"]
    targets = set(re.findall(r"^([a-z-]+):", read("Makefile"), flags=re.M))
    for job in jobs.values():
        needs = job.get("needs", [])
        assert set([needs] if isinstance(needs, str) else needs) <= set(jobs)
        for step in job["steps"]:
            assert ("run" in step) != ("uses" in step), step
            command = step.get("run", "")
            assert subprocess.run(["bash", "-n", "-c", command], check=False).returncode == 0, command
            assert set(re.findall(r"\bmake ([a-z-]+)", command)) <= targets, command
            for file in re.findall(r"(?<![\w/])(?:\.ci|tests)/[\w./-]+", command):
                assert (paths.ROOT / file).is_file(), command


@pytest.mark.parametrize(("tag", "heading"), [("{}", "{}"), ("{}.1", "{}"), ("{}", "Unreleased")])
def test_a_release_is_of_the_version_that_its_tag_names(project, tag, heading, tmp_path):
    (tmp_path / "pyproject.toml").write_text(read("pyproject.toml"), encoding="utf-8")
    (tmp_path / "CHANGES.md").write_text(f"# Changes\n\n## {heading.format(project['version'])}\n\n## 0.0.1\n")
    steps = yaml.safe_load(read(".github/workflows/release.yml"))["jobs"]["build"]["steps"]
    check = next(step["run"] for step in steps if "agree" in step.get("name", ""))
    environment = os.environ | {"GITHUB_REF_NAME": f"v{tag.format(project['version'])}"}
    command = ["bash", "-e", "-c", check.replace("python -c", f"{shlex.quote(sys.executable)} -c")]
    passed = subprocess.run(command, cwd=tmp_path, env=environment, check=False).returncode == 0
    assert passed == (tag == heading)


def test_the_table_of_contents_lists_every_notebook_once():
    contents = yaml.safe_load(read("book/_toc.yml"))
    files = [chapter["file"] for part in contents["parts"] for chapter in part["chapters"]]
    listed = [file.removeprefix("notebooks/") for file in files if file.startswith("notebooks/")]
    assert sorted(listed) == [path.stem for path in find_notebooks()]
    for name in listed:
        assert f"notebooks/{name}" in read("book/index.md")


def test_no_tracked_text_knows_a_machine():
    listing = ["git", "-C", paths.ROOT, "ls-files", "--cached", "--others", "--exclude-standard"]
    done = subprocess.run(listing, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip("not a git checkout")
    machine = re.compile(r"(?<![\w.:])/(root|home|Users|work|scratch|mnt)/\w")
    found = []
    for name in done.stdout.splitlines():
        path = paths.ROOT / name
        if path.suffix in {".png", ".svg", ".safetensors", ".npz", ".nc"} or not path.is_file():
            continue
        hits = machine.findall(path.read_text(encoding="utf-8"))
        found += [f"{name}: {hit}" for hit in hits]
    assert not found


def test_reference_numbers_name_their_place():
    numbers = yaml.safe_load(read("data/reference/paper.yml"))
    assert all(set(entry) >= {"value", "where"} for entry in numbers.values())
    assert all(re.search(r"Sec\. |Fig\. |Figs\. |Table ", entry["where"]) for entry in numbers.values())
    assert numbers["simulations"]["value"] == 6265
    assert numbers["augmented_samples"]["value"] == 71616
    assert numbers["shear_modulus"]["value"] * 100 == pytest.approx(numbers["lame_lambda"]["value"])


def test_every_reference_in_the_bibliography_is_whole():
    entries = re.findall(r"@\w+\{(\w+),(.*?)\n\}", read("book/references.bib"), flags=re.S)
    assert len(entries) >= 15
    for key, body in entries:
        fields = set(re.findall(r"^\s*(\w+)\s*=", body, flags=re.M))
        assert {"author", "title", "year"} <= fields, key
