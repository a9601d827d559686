"""Model cards: what the weights of a profile are, where they come from, and how far they can be trusted."""

from collections.abc import Mapping
from contextlib import nullcontext, suppress
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from inflate_lib._cache import digest
from inflate_lib.descriptors import DESCRIPTORS, PHYSICAL, get_descriptor, name_of
from inflate_lib.diffusion import TrainedModel
from inflate_lib.experiments.calibrate import calibrate
from inflate_lib.experiments.run import held_out_targets, run_experiment
from inflate_lib.experiments.tables import score, scores, with_interval
from inflate_lib.models.reach import SIZES, save_reach
from inflate_lib.models.recipe import Recipe
from inflate_lib.models.weights import Model

if TYPE_CHECKING:
    import xarray as xr

_SEED = 1  # of the choice of targets, and of the noise
#: What a joint model is calibrated for.
_COMBINATIONS = [name_of(parts) for k in (1, 2, 3) for parts in combinations(SIZES, k)] + ["axis", *PHYSICAL]

_CARD = """# Weights of the profile `{profile}`

Conditional diffusion models: one for each descriptor of an inflated structure and, where there is one, a *joint* model,
which takes any combination of them. They are float16 safetensors, for `inflate_lib.load_model`. This
page was written by `inflate card --profile {profile}`, which measures what it states.

## Data

{source}: {structures} structures that inflate, of which every tenth (those whose index ends in 9) was held out with
all its flips and shifts; {pairs} pairs of image and descriptor were trained on. Digest of the images: `{data}`. The
images are not in here.

## Recipe

{recipe}

## Training

{training}

Minutes are those of the clock for one model, on the device named. On a CPU as many models as there are cores train
side by side, with one thread each, so that two cores trained all of these in half the sum. The loss is the mean of
the last interval of training, the held-out loss the simple loss on the structures that were left out.

## Accuracy

For each model the descriptors of {n} held-out structures that lie in the range of its training data were asked for, one
structure was drawn for each and inflated, and what it achieved was compared with what was asked for; sampling:
{sampling}; {calibration}. In brackets: 95 % bootstrap intervals. Errors are those of valid structures: drawings of
one closed structure that converges at each load step.

{accuracy}

## Limits

- The models draw handwritten sevens of 28 × 28 pixels and know nothing else. Descriptors outside the range of the
  training data (in each file's header) are refused by experiments, designs and
  `model.draw`; `inflate_lib.diffusion.generate` warns.
- The descriptors are those of one material, one wall thickness and one pressure. Other conditions need other
  simulations and other weights.
- Single structures miss their target by the errors above: simulate what was drawn, and choose. Self-contact of the
  inflated walls is not modelled.
- Weights are used for a run only if the recipe and the images are the same to the last bit; otherwise models are
  trained anew.
"""

_MEASURES = {
    "R²": "R²",
    "median error / target": "median error (%)",
    "mean error / target": "mean error (%)",
    "within 5 %": "within 5 % (%)",
    "median point distance": "median point distance (px)",
    "valid": "valid (%)",
}


def _calibrate_weights(folder, data, recipe: Recipe, seed=_SEED):
    """Measure how the models in a folder answer, and write what :func:`.weights.load_model` needs beside them.

    Into the header of each file go the recipe's sampling and the calibrations for it, and ``reach.npz`` beside them
    holds what the structures reach. The weights stay as they are. A joint model is calibrated for every combination of
    height, width and area, and for the axis, stress and stretch alone, as far as it follows them.

    Parameters
    ----------
    folder : path_like
        With ``<descriptor>.safetensors`` files of one recipe, as ``inflate train --out`` leaves them.
    data : xarray.Dataset
        All simulated structures that the models were trained on.
    recipe : inflate_lib.models.recipe.Recipe
        Its sampling, and its number of structures for :func:`inflate_lib.experiments.calibrate.calibrate`; 0 for none.
    seed : int
        Of the choice of structures, and of the noise.

    Returns
    -------
    dict
        Name of each model → :class:`inflate_lib.models.Model`, calibrated.

    Raises
    ------
    ValueError
        There are no weights in the folder, or they were trained on other data, or a model of a single descriptor
        hardly follows it.
    """
    folder, models = Path(folder), {}
    for file in sorted(folder.glob("*.safetensors")):
        trained = TrainedModel.load(file)
        if trained.metadata.get("data") != digest(data["image"].values, data["converged"].values):
            raise ValueError(f"{file} was trained on other data: {trained.metadata.get('structures')} structures")
        model, found = Model(file.stem, trained, recipe.sampling), {}
        joint = get_descriptor(file.stem).any_part
        for asked in _COMBINATIONS if joint else (file.stem,):
            with suppress(ValueError) if joint else nullcontext():
                if recipe.n_calibration:
                    found[asked] = calibrate(model, data, recipe.n_calibration, seed, asked)
        how = {"n": recipe.n_calibration, "seed": seed}
        trained.metadata["sampling"] = dict(recipe.sampling)
        trained.metadata["calibration"] = {asked: fit.as_dict() | how for asked, fit in found.items()}
        trained.save(file, half=True)
        models[file.stem] = replace(model, calibrations=found)
    if not models:
        raise ValueError(f"{folder} holds no weights (*.safetensors); inflate train --out {folder} puts them there")
    save_reach(data, folder)
    return models


def write_card(folder: Path, data: "xr.Dataset", recipe: Recipe, n: int | None = None, seed: int = _SEED) -> Path:
    """Measure the models in a folder on held-out targets, and write the card, ``README.md``, beside them.

    They are calibrated first, see :func:`_calibrate_weights`, whose parameters these are. The measured numbers also go
    into the header of each file, as ``metadata["metrics"]``. A joint model is asked for one descriptor after the other,
    and its metrics are those of each.

    Parameters
    ----------
    folder, data, recipe, seed
        See there; the seed is also that of the choice of targets.
    n : int, optional
        Number of held-out targets; all of them by default.

    Returns
    -------
    Path
        The card.
    """
    folder, training, accuracy = Path(folder), {}, {}
    for name, model in _calibrate_weights(folder, data, recipe, seed).items():
        metrics, trained, joint = {}, model.trained, get_descriptor(name).any_part
        for asked in (*DESCRIPTORS, *PHYSICAL) if joint else (name,):
            targets, _ = held_out_targets(data, asked, model, n, seed)
            table = scores(run_experiment(model, targets, 1, seed, asked), asked, data)
            rows = table.set_index("measure")[["value", "low", "high"]]
            known = [measure for measure in _MEASURES if measure in rows.index]
            title = f"{name}: {asked}" if joint else name
            accuracy[title] = {_MEASURES[measure]: with_interval(*rows.loc[measure]) for measure in known}
            metrics[asked] = {measure: score(table, measure) for measure in known}
        about = trained.metadata
        training[name] = {
            "parameters": f"{trained.net.n_parameters:,}",
            "steps": f"{trained.config.training_steps(about['pairs']):,}",
            "minutes": f"{about['seconds'] / 60:.1f}",
            "device": about["device"],
            "loss": f"{trained.history['loss'][-1]:.4f}",
            "held-out loss": f"{about.get('held_out_loss', float('nan')):.4f}",
        }
        about["metrics"] = metrics if joint else metrics[name]
        trained.save(folder / f"{name}.safetensors", half=True)
    options = (
        pd.Series(trained.config.recipe())
        .drop(["parts", "steps", "epochs"])
        .map(str)
        .rename("value")
        .rename_axis("option")
    )
    how = f"targets calibrated on {recipe.n_calibration} training structures (`inflate_lib.models.calibration`)"
    card = folder / "README.md"
    text = _CARD.format(
        profile=about.get("profile", folder.name),
        source={"mnist": "The sevens of the MNIST training files"}.get(about["source"], about["source"]),
        structures=f"{about['structures']:,}",
        pairs=f"{about['pairs']:,}",
        data=about["data"],
        recipe=options.to_frame().to_markdown(),
        training=_markdown(training),
        accuracy=_markdown(accuracy),
        n="all" if n is None else n,
        sampling=", ".join(f"{key} {value}" for key, value in recipe.sampling.items()),
        calibration=how if recipe.n_calibration else "the model was told the target itself",
    )
    card.write_text(text, encoding="utf-8")
    return card


def _markdown(rows: Mapping) -> str:
    return pd.DataFrame(rows).T.fillna("–").rename_axis("model").to_markdown()
