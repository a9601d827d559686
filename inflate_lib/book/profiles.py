"""Profiles: how much computing a run of the notebooks may cost, checked before anything runs.

A profile is a file ``notebooks/profiles/<name>.yml``::

    name: ci
    description: minutes on two cores
    recipe: {…}              # see inflate_lib.models.recipe; a notebook asks for it by the profile's name
    first: 08_dataset        # runs alone before the others: it makes, on all cores, what most of them wait for
    budget:                  # seconds that a notebook may take beside another one; 60 where nothing is said
      08_dataset: 45
    common:                  # given to every notebook that declares the parameter
      n_per_target: 50
    notebooks:
      09_training:           # one section per notebook
        n_losses: 500

A notebook declares its parameters, with their defaults, in the cell tagged ``parameters``. Those that have the name of
something in the recipe change it.
"""

import ast
import functools
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from inflate_lib._yaml import hint
from inflate_lib.descriptors import DESCRIPTORS
from inflate_lib.models.recipe import Recipe, read_profile

# Read here: every notebook asks for its parameters, and jupytext takes two seconds to import.
_CELL = re.compile(
    r"^(`{3,})\{code-cell\}[^\n]*\n(?P<options>---\n.*?^---\n|(?::[^\n]*\n)*)(?P<source>.*?)^\1$",
    re.MULTILINE | re.DOTALL,
)
BUDGET = 60.0  # seconds: what takes longer is made cheap, or computed once by a script in benchmarks/


class ProfileError(ValueError):
    """A profile, or the parameters cell of a notebook, that cannot be used as it is written."""


class Profile(BaseModel):
    """One parameter set for all notebooks."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    name: str = Field(pattern=r"^[a-z][a-z0-9_-]*$")
    description: str = ""
    recipe: dict[str, Any]
    first: str | None = None
    budget: dict[str, float] | None = None
    common: dict[str, Any] = {}
    notebooks: dict[str, dict[str, Any]] = {}

    @field_validator("recipe")
    @classmethod
    def _whole_recipe(cls, value: dict[str, Any]) -> dict[str, Any]:
        Recipe.from_dict(value)
        return value

    @field_validator("common", "notebooks", mode="before")
    @classmethod
    def _empty_heading(cls, value: Any) -> Any:
        """A heading with nothing below it, which YAML reads as null, is an empty section."""
        return {} if value is None else value

    @field_validator("notebooks", mode="before")
    @classmethod
    def _empty_section(cls, value: Any) -> Any:
        return {k: {} if v is None else v for k, v in value.items()} if isinstance(value, dict) else value

    def budgets(self, notebooks: Iterable[Path]) -> dict[str, float]:
        """Seconds that each notebook may take; empty where the profile has no budget."""
        return {path.stem: self.budget.get(path.stem, BUDGET) for path in notebooks} if self.budget is not None else {}

    def recipe_of(self, notebook: Path) -> Recipe:
        """The recipe as the parameters of a notebook change it."""
        values = self.parameters(notebook)
        return Recipe.from_dict(self.recipe).changed(**{name: values[name] for name in self.recipe.keys() & values})

    def parameters(self, notebook: Path) -> dict[str, Any]:
        """All parameters of a notebook under this profile: its defaults, then `common`, then its own section.

        Of a mapping only the entries that a layer names are replaced.
        """
        values = declared_parameters(notebook)
        for layer in (self.common, self.notebooks.get(notebook.stem, {}), {"profile": self.name}):
            for name in values.keys() & layer.keys():
                value = _converted(layer[name], values[name])
                both_mappings = isinstance(value, Mapping) and isinstance(values[name], Mapping)
                values[name] = {**values[name], **value} if both_mappings else value
        return values


def load_profile(name: str, folder: Path | None = None) -> Profile:
    """Read ``<name>.yml``; ProfileError names the file and what to change where it does not follow the layout."""
    try:
        content, path = read_profile(name, folder)
    except ValueError as error:
        raise ProfileError(str(error)) from error
    try:
        profile = Profile.model_validate(content)
    except ValidationError as error:
        lines = [f"  {'.'.join(map(str, e['loc'])) or 'the file'}: {e['msg']}" for e in error.errors()]
        head = f"{path} is no profile (name, description, recipe, common, notebooks):"
        raise ProfileError("\n".join([head, *lines])) from error
    if profile.name != name:
        raise ProfileError(f"{path} calls itself {profile.name!r}: name and file name must agree")
    return profile


def check_profile(profile: Profile, notebooks: list[Path]) -> None:
    """Compare a profile with what all the notebooks declare; ProfileError lists everything that does not fit."""
    from inflate_lib.diffusion.training import choose_device  # here, so that a page without a model needs no PyTorch

    declared = {path.stem: declared_parameters(path) for path in notebooks}
    problems = []
    try:
        choose_device(Recipe.from_dict(profile.recipe).config(DESCRIPTORS[0]).device)
    except ValueError as error:
        problems.append(f"recipe.training: {error}")
    for name, value in profile.common.items():
        users = [parameters[name] for parameters in declared.values() if name in parameters]
        if name == "profile":
            problems.append("common.profile: the runner sets this one itself")
        elif not users:
            problems.append(f"common.{name}: no notebook declares this parameter")
        found = (_mismatch(f"common.{name}", value, default) for default in users)
        problems += dict.fromkeys(filter(None, found))
    if profile.first and profile.first not in declared:
        problems.append(f"first: there is no notebook {profile.first}; there are: {', '.join(declared)}")
    for notebook in profile.budget or ():
        if notebook not in declared:
            problems.append(f"budget.{notebook}: there is no such notebook; there are: {', '.join(declared)}")
    for notebook, section in profile.notebooks.items():
        if notebook not in declared:
            problems.append(f"notebooks.{notebook}: there is no such notebook; there are: {', '.join(declared)}")
            continue
        for name, value in section.items():
            where = f"notebooks.{notebook}.{name}"
            if name == "profile":
                problems.append(f"{where}: the runner sets this one itself")
            elif name not in declared[notebook]:
                problems.append(f"{where}: the notebook does not declare it; it has {', '.join(declared[notebook])}")
            elif problem := _mismatch(where, value, declared[notebook][name]):
                problems.append(problem)
    if problems:
        head = f"profile {profile.name!r} does not fit the notebooks:"
        raise ProfileError("\n".join([head, *(f"  {problem}" for problem in problems)]))


def declared_parameters(notebook: Path) -> dict[str, Any]:
    """Names and defaults from the cell tagged ``parameters`` of a MyST notebook; empty where it has none.

    Raises
    ------
    ProfileError
        Something other than ``name = literal`` stands in that cell, or there are two such cells.
    """
    state = notebook.stat()
    return dict(_declared(notebook, state.st_mtime_ns, state.st_size))


@functools.lru_cache(maxsize=256)
def _declared(notebook: Path, _changed: int, _size: int) -> dict[str, Any]:
    cells = [cell for cell in _CELL.finditer(notebook.read_text(encoding="utf-8")) if "parameters" in _tags(cell)]
    if len(cells) > 1:
        raise ProfileError(f"{notebook.name}: {len(cells)} cells are tagged 'parameters'; a notebook has one")
    found = {}
    try:
        for line in ast.parse(cells[0]["source"] if cells else "").body:
            match line:
                case ast.Assign([ast.Name(name)], value) | ast.AnnAssign(ast.Name(name), _, ast.expr() as value):
                    found[name] = ast.literal_eval(value)
                case _:
                    raise ValueError(ast.unparse(line))
    except (SyntaxError, ValueError) as error:
        raise ProfileError(f"{notebook.name}: the parameters cell may hold only lines `name = plain value`") from error
    if tuples := [name for name, value in found.items() if isinstance(value, tuple)]:
        raise ProfileError(f"{notebook.name}: {', '.join(tuples)}: papermill knows no tuples, write a list")
    return found


def _tags(cell: re.Match[str]) -> list[str]:
    """Of a code cell, whose options stand in lines that begin with a colon, or between two lines of hyphens."""
    return (yaml.safe_load(re.sub("^:|^---$", "", cell["options"], flags=re.MULTILINE)) or {}).get("tags", [])


def _mismatch(where: str, value: Any, default: Any) -> str | None:
    """What is wrong with a value, given the notebook's default; None where it fits.

    A mapping may leave out entries of the default, but have none of its own, unless the default is empty.
    """
    if isinstance(value, Mapping) and isinstance(default, Mapping) and default:
        if unknown := [name for name in value if name not in default]:
            return f"{where}: unknown {', '.join(unknown)}; there are: {', '.join(default)}"
        problems = (_mismatch(f"{where}.{name}", entry, default[name]) for name, entry in value.items())
        return next(filter(None, problems), None)
    if default is None:
        return f"{where}: {value!r} is str{hint(value)}" if hint(value) else None
    if _fits(value, default):
        return None
    kinds = type(value).__name__, type(default).__name__
    return f"{where}: {value!r} is {kinds[0]}, the notebook's default {default!r} is {kinds[1]}{hint(value)}"


def _fits(value: Any, default: Any) -> bool:
    if isinstance(default, bool) or isinstance(value, bool):
        return isinstance(value, bool) and isinstance(default, bool)
    if isinstance(default, float):
        return isinstance(value, int | float)
    if isinstance(default, list):
        like = default[0] if len({type(entry) for entry in default}) == 1 else None
        return isinstance(value, list) and all(like is None or _fits(entry, like) for entry in value)
    return isinstance(value, type(default))


def _converted(value: Any, default: Any) -> Any:
    """The value in the type of the default: a profile may write 1 for 1.0."""
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(default, Mapping) and isinstance(value, Mapping):
        return {name: _converted(entry, default.get(name)) for name, entry in value.items()}
    if isinstance(default, list) and default and isinstance(value, list):
        return [_converted(entry, default[0]) for entry in value]
    return value
