"""A model to ask for structures, and where its weights are: committed, or in the cache."""

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from inflate_lib import paths
from inflate_lib._checks import choice, numbers, whole_number
from inflate_lib.datasets.simulate import simulated_sevens
from inflate_lib.descriptors import POINT_DISTANCE, get_descriptor
from inflate_lib.descriptors.registry import JOINT, columns, name_of
from inflate_lib.diffusion import TrainedModel, generate
from inflate_lib.diffusion.randomness import seed_for
from inflate_lib.models import RETRAIN, reach
from inflate_lib.models.calibration import Calibration
from inflate_lib.models.recipe import PURPOSES, Recipe
from inflate_lib.models.surrogate import Judge, Surrogate
from inflate_lib.models.train import train_models, training_set

STUDENTS = "students"  # folder beside the weights, with those into which guidance was distilled
SURROGATE = "surrogate"  # the file in that folder with the network that tuned them and steers them


@dataclass(frozen=True)
class Model:
    """A trained model with what belongs to it: ask it for structures with :meth:`draw`.

    Attributes
    ----------
    name : str
        The descriptor that it was trained for.
    trained : inflate_lib.diffusion.TrainedModel
    sampling : Mapping
        Options of :func:`inflate_lib.diffusion.generate`: sampler, steps, eta, guidance.
    calibrations : Mapping
        Descriptor asked for → :class:`Calibration`, good for this sampling alone. What has none is told as it is.
    others : Mapping
        Purpose → the model for it, see :meth:`made_for`.
    reach : xarray.Dataset, optional
        Descriptors of the simulated structures, beyond which nothing is drawn (:mod:`inflate_lib.models.reach`).
    """

    name: str
    trained: TrainedModel
    sampling: Mapping = field(default_factory=dict)
    calibrations: Mapping[str, Calibration] = field(default_factory=dict)
    reach: Any = None
    others: Mapping[str, "Model"] = field(default_factory=dict)

    @property
    def takes(self) -> tuple[str, ...]:
        """The descriptors that it can be told, all of them together; "joint" takes any of its own."""
        return get_descriptor(self.name).parts

    def draw(self, targets: Mapping[str, Any], n: int = 1, seed: int = 0) -> np.ndarray:
        """Structures that are drawn to inflate to the targets; how near they come, a simulation tells.

        Parameters
        ----------
        targets : Mapping
            Descriptor → value, in lengths and areas of the unit square: ``{"height": 1.05, "area": 0.8}``; "box" is
            (height, width), "axis" (30, 2), "outline" (32,). Or an array of m values, an axis (m, 30, 2). The joint
            model takes any combination; calibrated are those of height, width and area, and each other part alone.
            Others are told as they are.
        n : int
            Structures for each target.
        seed : int
            Structure i depends on the seed, on i and on its own target alone; a target of another descriptor has other
            noise.

        Returns
        -------
        array, shape (m · n, 28, 28), float32 in [0, 1]
            The n structures of the first target, then those of the second, …

        Raises
        ------
        ValueError
            The model does not take such targets; they are no finite numbers of the right shape; or out of reach, with
            the range that can be reached.
        """
        whole_number("n", n, 1)
        whole_number("seed", seed, 0)
        wanted = self._vectors(targets)
        m = len(next(iter(wanted.values())))
        for row in range(m if self.reach is not None else 0):
            try:
                reach.check_reach({name: values[row] for name, values in wanted.items()}, self.reach)
            except ValueError as error:
                raise ValueError(f"target {row}: {error}" if m > 1 else str(error)) from None
        name = name_of(wanted)
        told = self.told(name, np.column_stack(list(wanted.values())))
        with warnings.catch_warnings():  # what a calibrated model is told may lie outside
            warnings.filterwarnings("ignore", "[0-9]+ of [0-9]+ conditions lie outside")
            return generate(self.trained, np.repeat(told, n, axis=0), seed=seed_for(seed, name), **self.sampling)

    def told(self, descriptor: str, targets: np.ndarray) -> np.ndarray:
        """What the network is told, (m, ·), to get targets (m, N) of a descriptor."""
        calibration = self.calibrations.get(descriptor)
        told = targets if calibration is None else calibration.told(targets)
        return get_descriptor(self.name).conditions(descriptor, told) if self.trained.config.parts else told

    def sampled(self, **changes: Any) -> "Model":
        """The same model with other options of sampling, for which it is not calibrated."""
        return replace(self, sampling={**self.sampling, **changes}, calibrations={}, others={})

    def steered(self, surrogate: Surrogate, strength: float = 1.0) -> "Model":
        """The same model, corrected by a surrogate of the simulation while it draws; for that it is not calibrated."""
        judge = Judge(surrogate, self.trained, self.name)
        return replace(self.sampled(steering=strength), trained=replace(self.trained, judge=judge))

    def made_for(self, purpose: str) -> "Model":
        """The model that draws for a purpose, with its sampling and calibrations; this one where there is no other.

        Parameters
        ----------
        purpose : {"faithful", "varied", "quick", "steered"}
            As the experiments of the paper are made, which is how every model comes; with more steps, which draw more
            various structures; with few; or, for designs, corrected by a surrogate of the simulation, which comes
            nearest to the target (where none is stored, as for "quick"). Where there is a student
            (:mod:`inflate_lib.alternatives.distillation`), it answers for all but the first.

        Raises
        ------
        ValueError
            There is no such purpose.
        """
        choice("purpose", purpose, PURPOSES)
        if purpose == "steered" and purpose not in self.others:
            purpose = "quick"
        return self.others.get(purpose, self)

    def _vectors(self, targets):
        """Targets as vectors (m, N), by their names, in the order in which the model takes them."""
        if not isinstance(targets, Mapping) or not targets:
            raise ValueError(f"targets must be a mapping such as {{'{self.takes[0]}': 1.05}}, not {targets!r}")
        any_part = get_descriptor(self.name).any_part
        takes = f"the {self.name} model takes {', '.join(self.takes)}" + ", any of them" * any_part
        found = {}
        for name, value in targets.items():
            parts = _parts(name)
            if not parts or not set(parts) <= set(self.takes):
                raise ValueError(f"{takes}, not {name!r}")
            values = _as_vectors(name, value)
            for part in parts:
                if part in found:
                    raise ValueError(f"{part} is asked for twice")
                found[part] = values[:, columns(part, parts)]
        if not any_part and (missing := [part for part in self.takes if part not in found]):
            raise ValueError(f"{takes}: {', '.join(missing)} is not given")
        if len(many := {len(values) for values in found.values()} - {1}) > 1:
            raise ValueError(f"targets must be as many of each descriptor, not {' and '.join(map(str, sorted(many)))}")
        m = max(map(len, found.values()))
        return {part: np.repeat(found[part], m // len(found[part]), axis=0) for part in self.takes if part in found}


def _parts(name):
    """The parts of a descriptor; none of what is no descriptor."""
    try:
        return get_descriptor(name).parts
    except ValueError:
        return ()


def _as_vectors(name, value):
    """One or several values of a descriptor as vectors (m, N)."""
    descriptor = get_descriptor(name)
    n, one = descriptor.length, tuple(descriptor.sizes.values())
    if not one:
        shapes = "a number or an array (m,)"
    elif descriptor.is_basic:
        shape = ", ".join(map(str, one))
        shapes = f"an array ({shape}) or (m, {shape})"
    else:
        shapes = f"({', '.join(descriptor.parts)}) or an array (m, {n})"
    problem = f"{name} must be {shapes}, not "
    values = numbers(name, value, shapes, finite=False)
    if values.size == 0 or values.shape not in (one, (len(np.atleast_1d(values)), *one)):
        raise ValueError(f"{problem}one of shape {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite, not {values[~np.isfinite(values)][0]}")
    values = values.reshape(-1, n)
    if descriptor.error is POINT_DISTANCE and (values[:, :2].any() or not np.all(np.diff(values[:, 1::2]) > 0)):
        raise ValueError(f"{name} must begin at the origin, and its points must rise")
    return values


def load_model(name: str = JOINT, profile: str = "laptop") -> Model:
    """The committed weights of a model, with the sampler, the calibrations and the reach that belong to them.

    Parameters
    ----------
    name : {"height", "width", "box", "area", "axis", "joint"}
        The joint model takes any combination of targets; the others are those of the paper's experiments.
    profile : str
        A folder of ``data/pretrained``.

    Raises
    ------
    ValueError
        There are no such weights, with those that there are; or they are damaged.
    """
    folder = paths.PRETRAINED / str(profile)
    there = {path.stem: path for path in sorted(folder.glob("*.safetensors"))}
    if not there:
        profiles = ", ".join(sorted(path.name for path in paths.PRETRAINED.glob("*/"))) or "none"
        raise ValueError(f"no weights of the profile {profile!r}; there are: {profiles}")
    if name not in list(there):
        raise ValueError(f"no model {name!r} of the profile {profile!r}; there are: {', '.join(there)}")
    trained = TrainedModel.load(there[name])
    if (folder / reach.FILE).is_file():
        table = reach.load_reach(folder)
    else:  # nobody measured these weights yet
        table = reach.reach_of(simulated_sevens(trained.metadata.get("source", "auto")))
    if "calibration" not in trained.metadata:
        warnings.warn(f"{there[name]} is not calibrated: `inflate card --profile {profile}` does it", stacklevel=2)
    asked = _asked_for(there[name], trained)
    made = {purpose: _model(name, one, about, table) for purpose, (one, about) in asked.items()}
    return replace(made.pop("faithful"), others=made)


def committed_weights(descriptor: str, recipe: Recipe, data: xr.Dataset) -> tuple[Path | None, str]:
    """Find weights in ``data/pretrained`` that were trained as a recipe says, on these very data.

    The images must be the same to the last bit; the descriptors, whose last digits depend on the processor, must agree
    in their mean to six digits. Parameters are those of :func:`inflate_lib.models.train.trained_model_file`.

    Returns
    -------
    path : Path or None
        The safetensors file.
    why_not : str
        What differs where the recipe is the same and yet the weights are not taken.

    Raises
    ------
    ValueError
        A file there is damaged, or not one of this library.
    """
    wanted, pairs, why_not = recipe.config(descriptor).recipe(), training_set(descriptor, recipe, data), ""
    for path in sorted(paths.PRETRAINED.glob(f"*/{descriptor}.safetensors")):
        model = TrainedModel.load(path)
        if model.config.recipe() != wanted:
            continue
        differs = [name for name, value in pairs.about.items() if model.metadata.get(name) != value]
        if not differs and np.allclose(model.metadata["mean"], pairs.mean, rtol=1e-6, atol=1e-9):
            return path, ""
        why_not = f"{_name(path)} is of another {', '.join(differs) or 'simulation'}"
    return None, why_not


def trained_models(names: Sequence[str], recipe: Recipe, data: xr.Dataset) -> dict[str, Model]:
    """The models of several descriptors: committed weights where there are any, else trained, or found in the cache.

    A line of text says which. With the environment variable ``INFLATE_RETRAIN`` (``inflate reproduce --retrain``)
    committed weights are not considered. Parameters are those of :func:`inflate_lib.models.train.train_models`.

    Returns
    -------
    dict
        Name of the descriptor → :class:`Model`, which draws as the recipe says. It is calibrated where its file holds
        what the recipe asks for; the others are by :func:`inflate_lib.experiments.calibrate.calibrate_all`.
    """
    found = {}
    for name in names if RETRAIN not in os.environ else ():
        path, why_not = committed_weights(name, recipe, data)
        if path is not None:
            found[name] = path
        elif why_not:
            print(why_not)
    for folder in sorted({path.parent for path in found.values()}):
        print(f"weights from {_name(folder)}: {', '.join(name for name in found if found[name].parent == folder)}")
    if missing := [name for name in names if name not in found]:
        print(f"trained for this run: {', '.join(missing)}")
        found |= {name: path for name, path in train_models(missing, recipe, data).items() if path is not None}
    table = reach.reach_of(data)
    models = {}
    for name in names:
        asked, made = _asked_for(found[name], TrainedModel.load(found[name])), {}
        for purpose, way in {"faithful": dict(recipe.sampling), **recipe.ways()}.items():
            one, about = asked.get(purpose, (asked.get("quick", asked["faithful"])[0], {}))
            if way.get("steering") and one.judge is None:
                continue
            made[purpose] = _model(name, one, {"sampling": way, "calibration": _stored(about, way, recipe)}, table)
        models[name] = replace(made.pop("faithful"), others=made)
    return models


def _model(name, trained, about, table):
    """A model with the sampling and the calibrations that a header tells."""
    calibrations = {asked: Calibration.from_dict(values) for asked, values in about.get("calibration", {}).items()}
    return Model(name, trained, about.get("sampling", {}), calibrations, table)


def _asked_for(path, teacher):
    """Purpose → who answers, and its sampling and calibrations, as the header of its weights tells them.

    That is the model in a file, or for what it knows its student, if there is one, and it is of this very teacher.
    """
    found = {purpose: (teacher, about) for purpose, about in teacher.metadata.get("samplers", {}).items()}
    found["faithful"] = teacher, teacher.metadata
    file = path.parent / STUDENTS / path.name
    if file.is_file() and (student := with_judge(file)).metadata.get("teacher") == teacher.fingerprint:
        known = {"quick": student.metadata, **student.metadata.get("samplers", {})}
        found |= {purpose: (student, about) for purpose, about in known.items()}
    return found


def with_judge(file: Path) -> TrainedModel:
    """The model in a file, with the judge that steers it where a surrogate lies beside it."""
    trained = TrainedModel.load(file)
    if (surrogate := file.with_stem(SURROGATE)).is_file():
        trained.judge = Judge(Surrogate.load(surrogate), trained, file.stem)
    return trained


def _stored(about, sampling, recipe):
    """The calibrations in a header, without those of another sampling, n or seed than a recipe's."""
    wanted, fits = {"n": recipe.n_calibration, "seed": recipe.seed}, about.get("sampling") == dict(sampling)
    stored = about.get("calibration", {}) if fits else {}
    return {asked: one for asked, one in stored.items() if wanted.items() <= one.items()}


def _name(path):
    """A path as a reader of the book should see it."""
    return path.relative_to(paths.ROOT) if path.is_relative_to(paths.ROOT) else path
