"""Students of trained models, for a tenth of the cost: guidance distilled, and tuned by a surrogate of the simulation.

The second is the *descriptor loss* that the paper leaves to future work (sec. 5).
"""

from dataclasses import replace
from pathlib import Path

import xarray as xr

from inflate_lib._cache import cached, step_version
from inflate_lib.alternatives.distillation import distil, tune
from inflate_lib.alternatives.surrogate import blends_of, drawings_of, train_surrogate
from inflate_lib.descriptors.registry import JOINT
from inflate_lib.diffusion import TrainedModel
from inflate_lib.models.recipe import Recipe
from inflate_lib.models.surrogate import Surrogate, critic
from inflate_lib.models.train import training_set
from inflate_lib.models.weights import SURROGATE, Model


def student_file(path: Path, recipe: Recipe, data) -> Path:
    """Distil guidance into a student of a trained model, and tune it, or find it in the cache.

    Parameters
    ----------
    path : path_like
        The teacher's file, in 16 bits, as it is handed out.
    recipe, data
        See :func:`inflate_lib.models.train.trained_model_file`; the recipe has a section ``student``.
    """
    teacher = TrainedModel.load(path)
    pairs = training_set(teacher.metadata["descriptor"], recipe, data)
    config = replace(teacher.config, **recipe.student)

    def make(target, scratch):
        distil(teacher, *pairs.pairs, config, scratch, f"distilling {pairs.descriptor}").save(target)

    key = pairs.about | {
        "training": config.recipe(),
        "teacher": teacher.fingerprint,
        "code": step_version("alternative"),
    }
    path = cached("model", key, make, ".safetensors")
    return tuned_file(path, teacher, recipe, data) if recipe.tuning else path


def tuned_file(path: Path, teacher: TrainedModel, recipe: Recipe, data) -> Path:
    """Tune a student by a surrogate of the simulation, or find it in the cache.

    Parameters
    ----------
    path : path_like
        The student's file.
    teacher : TrainedModel
    recipe, data
        See :func:`inflate_lib.models.train.trained_model_file`; the recipe has a section ``tuning``.
    """
    student = TrainedModel.load(path)
    pairs = training_set(student.metadata["descriptor"], recipe, data)
    options = recipe.tuned(pairs.descriptor)

    def make(target, scratch):
        surrogate = judge_of(data, recipe)
        loss, how = critic(surrogate, student, pairs.descriptor), (options["steps"], options["weight"])
        tune(student, teacher, loss, *pairs.pairs, *how, scratch, f"{pairs.descriptor}").save(target)

    key = pairs.about | {"student": student.fingerprint, "tuning": options, "code": step_version("alternative")}
    return cached("model", key, make, ".safetensors")


def judge_of(data, recipe: Recipe) -> Surrogate:
    """The surrogate that tunes the students of a recipe: it knows all parts of the joint descriptor, and blends."""
    options = recipe.tuned()
    return _surrogate(data, recipe, blends_of(data, options["blends"], recipe.seed), (12, 24, 48))


def steering_surrogate(data, recipe: Recipe, students: Path) -> Surrogate:
    """The surrogate that steers the students in a folder: it has seen what they draw when :func:`judge_of` steers them.

    Drawings that a surrogate has corrected are not as the structures that it learned from: it is most wrong where it
    leads them. What came of them is simulated and learned from in turn, as in dataset aggregation (Ross et al. 2011).
    """
    first, options = judge_of(data, recipe), recipe.tuned()
    if not options["drawings"]:
        return first
    way = recipe.ways()["steered"]
    files = [path for path in sorted(students.glob("*.safetensors")) if path.stem != SURROGATE]
    models = [Model(path.stem, TrainedModel.load(path), way).steered(first, way["steering"]) for path in files]
    drawings = drawings_of(models, data, options["drawings"], recipe.seed)
    blends = blends_of(data, options["blends"], recipe.seed)
    return _surrogate(data, recipe, xr.concat([blends[list(drawings)], drawings], "structure"), (16, 32, 64))


def _surrogate(data, recipe, further, widths):
    steps = recipe.tuned()["surrogate_steps"]
    return train_surrogate(data, steps, recipe.seed, answers=JOINT, further=further, channels=widths, batch_size=128)
