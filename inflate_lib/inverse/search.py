"""Inverse design: targets and constraints in; several different structures, each verified by inflating it, out.

Candidates come in batches, from a model that draws them and from the training structures that are nearest to the
targets (:mod:`inflate_lib.inverse.candidates`). Every one is labelled, inflated and described like the training data;
what cannot be built or a constraint forbids is rejected and counted; near misses are refined pixel by pixel; what is
within the tolerance of all targets is kept, until there are enough to choose from or the time or the candidates are
used up. From those a diverse set is chosen.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
import pandas as pd
import xarray as xr
from joblib import Parallel, delayed

from inflate_lib import paths
from inflate_lib._checks import choice, flag, positive_number, whole_number, workers
from inflate_lib.alternatives.all_digits import nearest_digits
from inflate_lib.alternatives.digits_model import load_digits_model
from inflate_lib.alternatives.rubbers import load_rubber_model
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.datasets.simulate import simulated_before, simulated_sevens
from inflate_lib.descriptors import Descriptors, describe, get_descriptor
from inflate_lib.descriptors.registry import DESCRIPTORS, OWN, PHYSICAL, basic, registered
from inflate_lib.diffusion.storage import fingerprint
from inflate_lib.inverse.candidates import STARTS, Drawings, Neighbours, differences
from inflate_lib.inverse.constraints import Constraints, mirrored
from inflate_lib.inverse.refine import Rejection, attempt, stiff_part
from inflate_lib.inverse.refine import refine as refine_structure
from inflate_lib.inverse.smooth import Plan, smoothed
from inflate_lib.inverse.targets import Targets, as_targets, deviations
from inflate_lib.mechanics.inflation import Inflation
from inflate_lib.models.reach import check_reach
from inflate_lib.models.recipe import EDITION, load_recipe
from inflate_lib.models.surrogate import centred
from inflate_lib.models.weights import Model, load_model, trained_models

_PREFERENCES = ("low-stress", "high-stress")
_BATCH = 64  # candidates
_NEAR, _INSIDE = 3, 0.5  # misses of up to 3 times the tolerance are refined, until they are at half of it
_SURPLUS = 2  # so many times the designs asked for are found before the most different ones are chosen
_BEYOND = "No seven comes near these targets: candidates are of all ten digits."
_WEIGHTS = ("paper", "laptop", "ci")  # folders of data/pretrained, in the order in which they are looked into


class Stop(StrEnum):
    """Why a search ended."""

    ENOUGH = "There were enough to choose from."
    CANDIDATES = "As many candidates had been tried as were allowed."
    NONE_LEFT = "All training structures had been tried."
    DRAWN = "It was drawn by hand."
    TIME = "The time that was allowed was up."


@dataclass(frozen=True)
class Design:
    """One structure that was made to targets, inflated and measured.

    Attributes
    ----------
    label : (28, 28) float
    result : Inflation
        Of the label image; of a smooth design, of the shape with smooth borders that was made from it. Everything below
        but the novelty is of the same.
    shape : Descriptors
    deviations : dict
        Relative error of each target, see :func:`inflate_lib.inverse.targets.deviations`.
    within : bool
        All of them are within the tolerance.
    candidate : int
        Its number among all candidates.
    origin : dict
        How to make it again: the seed and the conditions of its batch and its row there, or the number of the training
        structure; and what was done to the drawing (halves mirrored; pixels flipped, one after another).
    novelty : float
        Share of its pixels in which it differs from the nearest training structure, 0 for a copy, see
        :func:`inflate_lib.inverse.candidates.differences`; NaN where these were not at hand, or it was not chosen.
    plan : Plan, optional
        The smooth borders; None for one of pixels.
    """

    label: np.ndarray
    result: Inflation
    shape: Descriptors
    deviations: dict
    within: bool
    candidate: int
    origin: dict
    novelty: float = np.nan
    plan: Plan | None = None

    @property
    def stiff(self) -> np.ndarray | None:
        """(28, 28) bool: where the wall is of the stiff rubber; None where all of it is of the soft one."""
        return None if self.plan else stiff_part(self.label, self.result)

    @property
    def error(self) -> float:
        """The largest of the relative errors."""
        return max(self.deviations.values())


@dataclass
class Designs:
    """What :func:`design` found, and an account of the search."""

    designs: list  # the chosen ones
    pool: list  # every candidate within the tolerance, the best first; :func:`choose` makes another choice from them
    targets: Targets
    constraints: Constraints
    tolerance: float
    asked: int
    prefer: str | None
    seed: int
    model: dict = field(default_factory=dict)  # descriptor, digests of its weights and judge, profile, source; or empty
    sampling: dict = field(default_factory=dict)
    tried: int = 0
    sources: Counter = field(default_factory=Counter)  # "model", "training" → candidates
    refined: int = 0  # misses that came within the tolerance by flipping pixels
    rejected: Counter = field(default_factory=Counter)  # Flaw or Rejection → drawings
    seconds: dict = field(default_factory=dict)  # generating, inflating, all
    stopped: Stop | None = None  # None while it goes on

    @property
    def within(self) -> int:
        """Number of candidates within the tolerance."""
        return len(self.pool)

    def table(self) -> pd.DataFrame:
        """A row per design: errors in percent, and the descriptors that are one number; the stress over μ as well."""
        numbers = {one.name: one.title for one in basic() if one.length == 1}
        rows = []
        for number, one in enumerate(self.designs, start=1):
            row = {"design": number, "within": one.within}
            row |= {f"error {name} (%)": 100 * value for name, value in one.deviations.items()}
            row |= {title: float(one.shape.vector(name)[0]) for name, title in numbers.items()}
            rows.append(
                row | {"peak σ/μ": one.shape.peak_stress / one.result.lame[1], "novelty (%)": 100 * one.novelty}
            )
        names = [f"error {name} (%)" for name in self.targets.asked]
        columns = ["design", "within", *names, *numbers.values(), "peak σ/μ", "novelty (%)"]
        return pd.DataFrame(rows, columns=columns)

    def summary(self) -> str:
        """The account in a few lines."""
        good = sum(one.within for one in self.designs)
        lines = [
            f"{good} of {self.asked} designs are within {self.tolerance:.2g} of every target, chosen from "
            f"{self.within} among {self.tried} candidates. {self.stopped}"
        ]
        if good < len(self.designs):
            lines.append(f"The other {len(self.designs) - good} are the nearest misses, and are marked so.")
        if self.model.get("digits"):
            lines.append(_BEYOND)
        if "stiffness_ratio" in self.model:
            lines.append(
                f"Walls are of two rubbers, one {self.model['stiffness_ratio']:g} times as stiff as the other."
            )
        if smooth := sum(one.plan is not None for one in self.designs):
            lines.append(f"{smooth} have smooth borders, and were inflated with them.")
        if self.refined:
            lines.append(f"{self.refined} of the {self.within} were near misses, refined pixel by pixel.")
        if len(self.sources) > 1:
            lines.append(f"{self.sources['training']} candidates were training structures, the others drawn.")
        if copies := sum(one.novelty == 0 for one in self.designs):
            lines.append(f"{copies} of the {len(self.designs)} designs are training structures as they are.")
        if self.rejected:
            lines.append("All of these can be built. Rejected were:")
            lines += [f"{n:6d}  {reason}" for reason, n in self.rejected.most_common()]
        if self.designs:
            middle = np.median([one.error for one in self.designs])
            lines.append(f"The median of the largest errors is {100 * middle:.2f} %.")
        times = ", ".join(f"{name} {value:.1f} s" for name, value in self.seconds.items())
        return "\n".join([*lines, times])


def design(
    targets: Targets | Mapping,
    n: int = 12,
    *,
    model: Model | None = None,
    profile: str | None = None,
    data: xr.Dataset | None = None,
    start_from: str = "both",
    constraints: Constraints | None = None,
    tolerance: float = 0.01,
    prefer: str | None = None,
    seed: int = 0,
    seconds: float = 90.0,
    max_candidates: int = 4096,
    refine: int = 60,
    smooth: bool = False,
    rubbers: bool = False,
    n_jobs: int = -1,
    say: Callable | None = print,
) -> Designs:
    """Find `n` different structures that inflate to the targets.

    Parameters
    ----------
    targets : Targets or Mapping
        Any of height, width, area, axis, outline, stress, stretch. See
        :func:`inflate_lib.inverse.targets.as_targets`.
    n : int
        Number of designs.
    model : Model, optional
        It draws with its own sampling. By default that of :func:`find_model`, or, where no seven comes near the targets
        but another digit does, that of all digits (:func:`inflate_lib.alternatives.digits_model.load_digits_model`).
    profile : str, optional
        Take the weights of this profile only.
    data : xarray.Dataset, optional
        Simulated structures: those that models are trained on are candidates, and all say what can be reached. By
        default those of the model's source that were simulated before; where there are none, the model goes on alone,
        and says so. For ``start_from="training"`` they are simulated.
    start_from : {"both", "model", "training"}
        Where candidates come from: half of each batch from the model and half from the training structures nearest to
        the targets, or all from one of them (:mod:`inflate_lib.inverse.candidates`).
    constraints : Constraints, optional
    tolerance : float
        Largest relative error of every target.
    prefer : {"low-stress", "high-stress"}, optional
        Choose among those within the tolerance by the peak of the von Mises stress; so many more are looked for.
    seed : int
        Of the noise. With `max_candidates` and without a limit of time the result depends on nothing else.
    seconds, max_candidates
        Limits of the search; the batch at hand is finished.
    refine : int
        Inflations that may be spent on bringing each near miss nearer, pixel by pixel, see
        :func:`inflate_lib.inverse.refine.refine`; 0 for none.
    smooth : bool
        Give the designs smooth borders that one would cut, and a wall of one thickness, and correct them until they
        inflate to the targets again (:func:`inflate_lib.inverse.smooth.smoothed`). One that cannot be had smooth, or
        not within the tolerance, gives way to another of the pool. Not for stress and stretch, peaks of the pixels.
    rubbers : bool
        Walls of two rubbers: candidates are drawn by the model of these alone
        (:func:`inflate_lib.alternatives.rubbers.load_rubber_model`), pixels with their map. Not for smooth borders, nor
        for symmetric structures.
    n_jobs : int
        Threads that inflate.
    say : callable, optional
        Takes lines of progress; None for none.

    Returns
    -------
    Designs
        Ordered by their largest error; with `prefer`, by stress. Where fewer than `n` are within the tolerance, the
        nearest misses fill up, marked by ``within = False``. All of them, and all in the pool, can be built
        (:mod:`inflate_lib.mechanics.buildable`). It may be empty, where no candidate can.

    Raises
    ------
    ValueError
        For targets that contradict each other or the constraints or are out of reach, and arguments out of range.
    ConnectionError
        With ``start_from="training"``, where MNIST cannot be had.
    """
    targets, constraints = as_targets(targets), constraints or Constraints()
    _check(n, tolerance, prefer, start_from, seed, seconds, max_candidates, refine, n_jobs)
    check_smooth(smooth, targets)
    constraints.check()
    _check_symmetric(targets, constraints, tolerance)
    if rubbers:
        _check_rubbers(model, data, start_from, constraints, smooth)
        model, start_from = load_rubber_model(profile or EDITION), "model"
        _check_reach(targets, model.reach)
    elif start_from == "training":
        model = None
    else:
        replaceable = model is profile is data is None
        model = (model or find_model(targets, profile)).made_for("steered")
        _check_model(model, targets)
        try:
            _check_reach(targets, model.reach if data is None else data)
        except ValueError:
            if not replaceable or (model := _model_beyond_sevens(targets)) is None:
                raise
            if start_from == "both" and (data := nearest_digits(targets.vectors, n_jobs=n_jobs)) is None:
                start_from = "model"
            if say:
                say(_BEYOND)
    structures = data if data is not None and "label" in data else None
    if start_from != "model" and structures is None:
        structures = _training_structures(model, say)
    if model is None:
        _check_reach(targets, structures)
    search = Search(found := Designs([], [], targets, constraints, tolerance, n, prefer, seed), refine, n_jobs)
    if start_from != "model" and structures is not None:
        search.start_from(Neighbours(structures, targets, constraints))
    if model is not None:
        search.start_from(Drawings(model, targets, seed))
        found.model, found.sampling = _about(model), dict(model.sampling)
    enough = n * _SURPLUS * (2 if prefer else 1)
    started, longest = time.monotonic(), 0.0
    while not found.stopped:
        begun = time.monotonic()
        more = search.go_on(min(_BATCH, max_candidates - found.tried))
        now = time.monotonic()
        longest = max(longest, now - begun)
        if say:
            nearest = f", the best misses by {100 * search.best[0].error:.2f} %" if search.best else ""
            say(f"{now - started:.0f} s: {found.within} within {tolerance:.2g} among {found.tried} candidates{nearest}")
        if found.within >= enough:
            found.stopped = Stop.ENOUGH
        elif found.tried >= max_candidates:
            found.stopped = Stop.CANDIDATES
        elif not more:
            found.stopped = Stop.NONE_LEFT
        elif now - started + longest > seconds:
            found.stopped = Stop.TIME
    found.designs = choose(search.best, n, prefer)
    if smooth:
        found.designs = with_smooth_borders(found, n_jobs)
    if structures is not None:
        library = structures["label"].values[training_rows(structures)]
        novelty = differences([one.label for one in found.designs], library).min(axis=1)
        found.designs = [replace(one, novelty=float(n)) for one, n in zip(found.designs, novelty, strict=True)]
    found.seconds["all"] = time.monotonic() - started
    return found


class Search:
    """The search itself, batch by batch: candidates of one or several sources are verified, judged and refined.

    Parameters
    ----------
    found : Designs
        What is looked for; candidates within the tolerance, counts and clocks are put there.
    refine, n_jobs
        As in :func:`design`.

    Attributes
    ----------
    best : list of Design
        All that are within the tolerance and the nearest misses, the best first.
    """

    def __init__(self, found: Designs, refine: int = 60, n_jobs: int = -1):
        self.found, self.refine, self.n_jobs = found, refine, n_jobs
        self.sources: list[Drawings | Neighbours] = []
        self.best: list[Design] = []
        self._seen: set[bytes] = set()

    def start_from(self, source: Drawings | Neighbours) -> None:
        """Take candidates from this source, too."""
        self.sources.append(source)

    def go_on(self, size: int) -> bool:
        """Try one batch, shared out among the sources; False where none of them had a candidate left."""
        found, new, left = self.found, [], size
        for number, source in enumerate(self.sources):
            begun = time.monotonic()
            images, origins = source.take(left // (len(self.sources) - number), found.tried)
            drawn = time.monotonic()
            verified = _verified(images, origins, found, self._seen, self.n_jobs)
            source.learn([one.shape for one in verified])
            new += _refined(verified, found, self._seen, self.refine, self.n_jobs)
            left -= len(images)
            found.tried += len(images)
            found.sources[source.name] += len(images)
            for name, value in {"generating": drawn - begun, "inflating": time.monotonic() - drawn}.items():
                found.seconds[name] = found.seconds.get(name, 0.0) + value
        self.best = sorted([*self.best, *new], key=lambda one: (one.error, one.candidate))
        found.pool = [one for one in self.best if one.within]
        self.best = self.best[: found.within + found.asked]  # of the misses only the nearest
        return left < size


def find_model(targets: Targets, profile: str | None = None) -> Model:
    """The model to design with.

    That is the model of a single size, or of the box, where it takes all that is asked for; else the joint model,
    which does, and which follows an axis best (``benchmarks/joint.py`` measures them on the same targets). Where its
    weights are not there, it is the single model that takes most of it: the rest hangs together with that, and choice
    and refinement see to what does not. Committed weights come first, the best ones of ``data/pretrained`` or those of
    `profile`; else the model of the profile (``ci`` by default) is found in the cache or trained.

    Raises
    ------
    ValueError
        Where a stress or a stretch is asked for, and no joint model is there.
    """
    asked = set(targets.asked)
    joint = [one.name for one in registered() if one.any_part and asked & set(one.parts)]
    singles = [one.name for one in models_in_order() if set(one.parts) <= asked]
    singles = [] if asked & {*PHYSICAL} else singles
    whole = [one.name for one in map(get_descriptor, singles) if set(one.parts) == asked and not one.is_line]
    fitting = list(dict.fromkeys(whole + joint + singles))
    for folder in (profile,) if profile else _WEIGHTS:
        for name in fitting:
            if (paths.PRETRAINED / folder / f"{name}.safetensors").is_file():
                return load_model(name, folder)
    if not singles:
        raise _no_joint_model(targets)
    single = singles[0]
    recipe = load_recipe(profile or _WEIGHTS[-1])
    data = simulated_sevens(recipe.source, recipe.n_structures)
    return trained_models([single], recipe, data)[single]


def _model_beyond_sevens(targets):
    """The model of all ten digits; None where none of them comes near the targets, or its weights are not there."""
    try:
        model = load_digits_model()
    except FileNotFoundError:
        return None
    try:
        check_reach(targets.vectors, model.reach)
    except ValueError:
        return None
    return model


def models_in_order():
    """Descriptors that have a model of their own, the most telling first."""
    own = [one for one in registered()[::-1] if one.name in DESCRIPTORS or one.name not in OWN]
    return sorted(own, key=lambda one: -one.length)


def choose(pool: list[Design], n: int, prefer: str | None = None) -> list[Design]:
    """`n` designs of a pool in the order of their error: as different as can be among those within the tolerance.

    With `prefer`, among the half of those with the lowest (highest) stress, in the order of stress.
    """
    whole_number("n", n, 1)
    within = [one for one in pool if one.within]
    if prefer:
        within.sort(key=lambda one: one.shape.peak_stress, reverse=prefer == "high-stress")
        within = within[: max(n, len(within) // 2)]
    chosen = [within[i] for i in _diverse([one.label for one in within], n)]
    if prefer:
        chosen.sort(key=lambda one: one.shape.peak_stress, reverse=prefer == "high-stress")
    else:
        chosen.sort(key=lambda one: one.error)
    return chosen + [one for one in pool if not one.within][: n - len(chosen)]


def _diverse(labels, n):
    """Row numbers of `n` label images that differ from one another (greedy max–min), the first image among them.

    How much they differ, :func:`inflate_lib.inverse.candidates.differences` says.
    """
    if not labels:
        return []
    labels = np.array(labels)
    nearest, chosen = np.full(len(labels), np.inf), [0]
    while len(chosen) < min(n, len(labels)):
        nearest = np.minimum(nearest, differences(labels[chosen[-1]], labels)[0])
        nearest[chosen] = -1
        chosen.append(int(nearest.argmax()))
    return chosen


def _verified(images, origins, found, seen, n_jobs):
    """The designs among the images of a batch; what is none is counted in ``found.rejected``."""
    drawings = [(row, "as drawn", image) for row, image in enumerate(images)]
    if found.constraints.symmetric:
        kinds = ("left half", "right half", "both halves")
        drawings = [(row, *half) for row, _, image in drawings for half in zip(kinds, mirrored(image), strict=False)]
    attempts = Parallel(n_jobs=n_jobs, backend="threading")(
        delayed(attempt)(image, found.constraints) for _, _, image in drawings
    )
    designs = []
    for (row, kind, _), (reason, label, result) in zip(drawings, attempts, strict=True):
        key = None if reason else _key(label, result)
        if reason or key in seen:
            found.rejected[reason or Rejection.REPEATED] += 1
            continue
        seen.add(key)
        designs.append(_measured(label, result, found, found.tried + row, origins[row] | {"drawing": kind}))
    return designs


def _measured(label, result, found, candidate, origin, plan=None):
    """A design from a structure and its inflation."""
    shape = describe(result)
    miss = deviations(found.targets, shape)
    within = max(miss.values()) <= found.tolerance
    return Design(label, result, shape, miss, within, candidate, origin, plan=plan)


def with_smooth_borders(found, n_jobs=-1):
    """The designs of a search with smooth borders; in the place of one that misses them, another of the pool."""
    chosen = {id(one) for one in found.designs}
    waiting = [*found.designs, *(one for one in found.pool if id(one) not in chosen)]
    hits, misses = [], []
    while waiting and len(hits) < found.asked:
        batch, waiting = waiting[: found.asked - len(hits)], waiting[found.asked - len(hits) :]
        done = Parallel(n_jobs=n_jobs, backend="threading")(
            delayed(smoothed)(one.label, found.targets, found.constraints, found.tolerance * _INSIDE) for one in batch
        )
        for one, smooth in zip(batch, done, strict=True):
            if smooth is None:
                found.rejected[Rejection.SMOOTH] += 1
                continue
            plan, result = smooth
            design = _measured(one.label, result, found, one.candidate, one.origin, plan)
            (hits if design.within else misses).append(design)
    if not found.prefer:
        hits = sorted(hits, key=lambda one: one.error)
    return [*hits, *sorted(misses, key=lambda one: one.error)][: found.asked]


def _refined(designs, found, seen, tries, n_jobs):
    """The same designs, near misses brought nearer by :func:`inflate_lib.inverse.refine.refine`."""
    near = [one for one in designs if found.tolerance < one.error <= _NEAR * found.tolerance] if tries else []
    goal = found.tolerance * _INSIDE
    done = Parallel(n_jobs=n_jobs, backend="threading")(
        delayed(refine_structure)(
            one.label, one.result, found.targets, found.constraints, goal, tries, [found.seed, one.candidate]
        )
        for one in near
    )
    better = {}
    for one, (label, result, flipped) in zip(near, done, strict=True):
        if not flipped or (key := _key(label, result)) in seen:
            continue
        seen.add(key)
        better[id(one)] = _measured(label, result, found, one.candidate, one.origin | {"flipped": flipped})
    found.refined += sum(one.within for one in better.values())
    return [better.get(id(one), one) for one in designs]


def _key(label, result):
    """What two structures have in common that are the same, wherever they stand."""
    stiff = stiff_part(label, result)
    return centred((label if stiff is None else np.where(stiff, 0.25, label))[None]).tobytes()


def _training_structures(model, say):
    """The structures that a model was trained on, None where they were not simulated before; without a model, made."""
    if not model:
        return simulated_sevens()
    structures = simulated_before(model.trained.metadata.get("source", "digits"))
    if structures is None and say:
        say("The model goes on alone: no simulated training structures are at hand (inflate dataset makes them).")
    return structures


def _about(model):
    trained = model.trained
    weights = [value.cpu().numpy() for _, value in sorted(trained.net.state_dict().items())]
    about = {"descriptor": model.name, "weights": fingerprint(*weights, trained.condition_min, trained.condition_max)}
    if model.sampling.get("steering"):
        about["surrogate"] = trained.judge.fingerprint
    told = ("profile", "source", "digits", "pairs", "stiffness_ratio")
    return about | {key: trained.metadata[key] for key in told if key in trained.metadata}


def _check(n, tolerance, prefer, start_from, seed, seconds, max_candidates, refine, n_jobs):
    whole = (("n", n, 1), ("seed", seed, 0), ("max_candidates", max_candidates, 1), ("refine", refine, 0))
    for name, value, least in whole:
        whole_number(name, value, least)
    positive_number("tolerance", tolerance)
    positive_number("seconds", seconds, finite=False)
    workers(n_jobs)
    if prefer is not None:
        choice("prefer", prefer, _PREFERENCES)
    choice("start_from", start_from, STARTS)


def _check_rubbers(model, data, start_from, constraints, smooth):
    """A ValueError where something is asked for that walls of two rubbers cannot be asked for."""
    given = {"model": model is not None, "data": data is not None, "smooth borders": smooth}
    given |= {"symmetric structures": constraints.symmetric, "training structures": start_from == "training"}
    if names := [name for name, there in given.items() if there]:
        raise ValueError(
            f"rubbers: candidates of two rubbers are drawn by their own model; leave out {', '.join(names)}"
        )


def check_smooth(smooth, targets):
    """A ValueError where something is asked for that smooth borders cannot be asked for."""
    if flag("smooth", smooth) and (peaks := [name for name in PHYSICAL if name in targets.asked]):
        raise ValueError(
            f"{' and '.join(peaks)} cannot be asked of smooth borders: the peaks that models know sit in corners of "
            "pixels (--no-smooth)"
        )


def _check_model(model, targets):
    """Whether a model can be told the targets."""
    name, parts = model.name, model.trained.config.parts
    told = get_descriptor(name)
    if not told.any_part and set(PHYSICAL) & set(targets.asked):
        raise _no_joint_model(targets)
    lengths = tuple(get_descriptor(part).length for part in told.parts)
    if told.any_part and parts != lengths:
        raise ValueError(
            f"the {name} model was trained for parts of lengths {parts}, and {', '.join(told.parts)} have "
            f"{lengths}: train it again (inflate train --descriptor {name})"
        )


def _check_reach(targets, data):
    """A ValueError where targets are out of reach, with what an outline was measured by."""
    try:
        check_reach(targets.vectors, data)
    except ValueError as error:
        raise ValueError(f"{error} {targets.measured}".strip()) from None


def _no_joint_model(targets):
    physical = " and ".join(name for name in PHYSICAL if name in targets.asked)
    return ValueError(
        f"{physical} can be asked of the joint model only, and its weights are not there: train it (inflate train "
        f"--descriptor joint --profile laptop --out data/pretrained/laptop), or leave {physical} out and choose among "
        "the designs for the other targets (--prefer low-stress or high-stress)"
    )


def _check_symmetric(targets, constraints, tolerance):
    """A structure that is its own mirror image has the descriptors of its mirror image: its axis is straight."""
    for name, target in targets.vectors.items() if constraints.symmetric else ():
        one = get_descriptor(name)
        nearest = (target + one.mirrored(target[None])[0]) / 2
        if (miss := one.error.share(nearest, target)) > tolerance:
            raise ValueError(
                f"a symmetric structure has the {name} of its mirror image, and the {name} asked for is "
                f"{miss:.3f} away from being so: leave out --symmetric, or ask for a symmetric {name}"
            )
