"""The recipe of a profile: which structures models are trained on, how they are trained, and how they are asked.

It is the section ``recipe`` of ``notebooks/profiles/<name>.yml``::

    recipe:
      source: auto             # images: mnist, digits, or auto, which is MNIST where it can be had
      seed: 0
      n_structures: null       # all of them
      n_augmented: 6265        # pairs of image and descriptor
      training: {…}            # options of inflate_lib.diffusion.TrainingConfig
      sampling: {…}            # options of inflate_lib.diffusion.generate
      samplers: {quick: {…}}   # what differs for other purposes, by name; may be left out
      student: {strongest: 10} # guidance is distilled so, into a student for the other purposes; may be left out
      tuning: {steps: 1000}    # the student is tuned so, by a surrogate of the simulation; may be left out
      n_calibration: 200       # structures drawn to calibrate a model; 0: none

Whoever needs to know how models are made, a notebook, a command or a test, asks for the recipe by the profile's name.
"""

import json
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from inflate_lib import paths
from inflate_lib._checks import choice, number, positive_number, share, whole_number
from inflate_lib._yaml import read_yaml
from inflate_lib.descriptors import DESCRIPTORS, get_descriptor

if TYPE_CHECKING:
    from inflate_lib.diffusion import TrainingConfig

EDITION = "laptop"  # the profile of the published book, whose recipe a notebook that was opened by hand has
_INTERACTIVE = "interactive"  # the profile of such a notebook
#: What structures are drawn for: ``sampling`` says how for the first, ``samplers`` may for the others.
PURPOSES = ("faithful", "varied", "quick", "steered")
_STUDENT = ("strongest", "distillation_steps")
_TUNING = {
    "steps": 1000,
    "weight": 0.05,
    "blends": 30_000,
    "surrogate_steps": 6000,
    "drawings": 0,
}  # and their defaults
#: What is checked of each option of sampling; `generate` itself checks the rest.
_SAMPLING = {
    "sampler": partial(choice, among=("ancestral", "ddim", "dpm-solver++")),
    "steps": partial(whole_number, least=1),
    "eta": share,
    "guidance": number,
    "guided_from": share,
    "guided_to": share,
    "crowding": positive_number,
    "steering": partial(number, least=0),
}


@dataclass(frozen=True)
class Recipe:
    """How models are made and asked.

    Attributes
    ----------
    source : {"auto", "mnist", "digits"}
    seed : int
        Of the augmentation, the first weights, the training and the noise.
    n_structures : int, optional
        Only the first ones; None for all.
    n_augmented : int
        Pairs to train on; see :class:`inflate_lib.datasets.pairs.TrainingSet`.
    training : Mapping
        Options of :class:`inflate_lib.diffusion.TrainingConfig`; ``steps_of`` gives some descriptors a number of steps
        of their own: ``{"area": 20000}``. They are checked where they are changed and by :meth:`config`, since that
        needs PyTorch.
    sampling : Mapping
        Options of :func:`inflate_lib.diffusion.generate`: sampler, steps, eta, guidance. The experiments of the paper
        are made with them.
    n_calibration : int
        Training structures that are asked for to calibrate a model; 0 for none.
    samplers : Mapping
        Other ways of sampling, by the name of their purpose: the options of ``sampling`` that they change.
    student : Mapping
        Options of :class:`inflate_lib.diffusion.TrainingConfig` for a student: ``strongest``, ``distillation_steps``.
        Empty: there is none.
    tuning : Mapping
        How the student is tuned (:func:`inflate_lib.alternatives.distillation.tune`): ``steps`` and ``weight`` there;
        ``blends`` and ``surrogate_steps``, with which the surrogate is trained that judges it; ``drawings`` that
        another one learns from as well, which then steers (0: the same one steers); ``steps_of`` as there. Empty: it is
        not tuned.
    """

    source: str
    seed: int
    n_structures: int | None
    n_augmented: int
    training: Mapping[str, Any]
    sampling: Mapping[str, Any]
    n_calibration: int
    samplers: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    student: Mapping[str, Any] = field(default_factory=dict)
    tuning: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        choice("source", self.source, ("auto", "mnist", "digits"))
        for name, least in {"seed": 0, "n_structures": 1, "n_augmented": 1, "n_calibration": 0}.items():
            whole_number(name, getattr(self, name), least, optional=name == "n_structures")
        for name in ("training", "sampling", "samplers", "student", "tuning"):
            if not isinstance(getattr(self, name), Mapping):
                raise ValueError(f"{name} must be a mapping of options, not {getattr(self, name)!r}")
        if own := [name for name in ("seed", "parts") if name in self.training]:
            raise ValueError(f"training: {own[0]} follows from the recipe's seed and the descriptor; leave it out")
        _check_names("student", self.student, _STUDENT)
        _check_names("tuning", self.tuning, (*_TUNING, "steps_of"))
        for name, value in self.tuned().items():
            if name == "weight":
                positive_number(f"tuning.{name}", value)
            else:
                whole_number(f"tuning.{name}", value, 0 if name == "drawings" else 1)
        if self.tuning and not self.student:
            raise ValueError("tuning: there is no student to tune; give the section student as well")
        if not self.tuning and any(isinstance(way, Mapping) and way.get("steering") for way in self.samplers.values()):
            raise ValueError("samplers: steering needs the surrogate of the section tuning")
        _check_names("samplers", self.samplers, PURPOSES[1:])
        steered = self.samplers.get("steered")
        if self.tuned().get("drawings") and not (isinstance(steered, Mapping) and steered.get("steering")):
            raise ValueError("tuning.drawings needs a way to steer them: samplers.steered with the option steering")
        for where, options in {"sampling": self.sampling, **self.samplers}.items():
            if not isinstance(options, Mapping):
                raise ValueError(f"samplers.{where} must be a mapping of options, not {options!r}")
            _check_names(where, options, _SAMPLING)
            for name, value in options.items():
                _SAMPLING[name](f"{where}.{name}", value)

    @classmethod
    def from_dict(cls, values: Any) -> "Recipe":
        """A recipe from plain values, every one of which must be there."""
        if not isinstance(values, Mapping):
            raise ValueError(f"a recipe must be a mapping, not {values!r}")
        names = [field.name for field in fields(cls)]
        _check_names("recipe", values, names)
        needed = [field.name for field in fields(cls) if field.default_factory is MISSING]
        if missing := [name for name in needed if name not in values]:
            raise ValueError(f"recipe: {', '.join(missing)} missing")
        return cls(**values)

    def changed(self, **changes: Any) -> "Recipe":
        """The recipe with some values changed; None leaves one as it is.

        Of ``training`` and ``sampling`` only the options that are named are replaced: ``training={"steps": 500}``. A
        text is read as JSON, which is how ``papermill -p training '{"steps": 500}'`` hands it over.

        Raises
        ------
        ValueError
            There is no such value or option, with those that there are; or it is of another kind.
        """
        _check_names("recipe", changes, [field.name for field in fields(self)])
        changes = {name: value for name, value in changes.items() if value is not None}
        for name in changes.keys() & {"training", "sampling"}:
            changes[name] = {**getattr(self, name), **_options(name, changes[name])}
        recipe = replace(self, **changes)
        if recipe.training != self.training:
            recipe.config(DESCRIPTORS[0])
        return recipe

    def ways(self) -> dict[str, dict[str, Any]]:
        """Options of sampling for each purpose but the first, by its name."""
        return {name: {**self.sampling, **changes} for name, changes in self.samplers.items()}

    def tuned(self, descriptor: str = "") -> dict[str, Any]:
        """The options of ``tuning`` for one descriptor's student, all of them; empty where students are not tuned."""
        return _own_steps({**_TUNING, **self.tuning}, descriptor) if self.tuning else {}

    def config(self, descriptor: str) -> "TrainingConfig":
        """The training configuration of one descriptor's model."""
        from inflate_lib.diffusion import TrainingConfig

        options = _own_steps({**self.training, "seed": self.seed}, descriptor)
        one = get_descriptor(descriptor)
        options["parts"] = [get_descriptor(part).length for part in one.parts] if one.any_part else []
        return TrainingConfig.from_dict(options)


def load_recipe(profile: str = _INTERACTIVE, folder: Path | None = None) -> Recipe:
    """The recipe of a profile, by its name; that of a notebook opened by hand is the edition's.

    Raises
    ------
    ValueError
        There is no such profile, with those that there are; or its recipe is none. The message names the file.
    """
    content, path = read_profile(EDITION if profile == _INTERACTIVE else profile, folder)
    try:
        return Recipe.from_dict(content.get("recipe") if isinstance(content, Mapping) else content)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def read_profile(name: str, folder: Path | None = None) -> tuple[Any, Path]:
    """What ``<name>.yml`` holds, unchecked, and its path."""
    folder = folder or paths.PROFILES
    path = folder / f"{name}.yml"
    if not path.is_file():
        there = ", ".join(sorted(file.stem for file in folder.glob("*.yml"))) or "none"
        raise ValueError(f"no profile {name!r} in {folder}; there are: {there}")
    return read_yaml(path), path


def _check_names(where, values, known):
    if unknown := [name for name in values if name not in known]:
        raise ValueError(f"{where}: unknown {', '.join(map(str, unknown))}; there are: {', '.join(known)}")


def _own_steps(options, descriptor):
    """The options, with the number of steps that ``steps_of`` gives a descriptor."""
    options = dict(options)
    steps_of = options.pop("steps_of", None) or {}
    if not isinstance(steps_of, Mapping):
        raise ValueError(f"steps_of must be a mapping of descriptors to numbers of steps, not {steps_of!r}")
    for name, steps in steps_of.items():
        whole_number(f"steps_of.{get_descriptor(name).name}", steps, 1)
    return options | ({"steps": steps_of[descriptor]} if descriptor in steps_of else {})


def _options(name, change):
    """Changed options as a mapping."""
    try:
        found = json.loads(change) if isinstance(change, str) else change
    except ValueError:
        found = None
    if not isinstance(found, Mapping):
        raise ValueError(f'{name} must be a mapping of options, such as {{"steps": 500}}, not {change!r}')
    return found
