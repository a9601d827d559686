"""Model cards: what the weights of a profile are, where they come from, and how far they can be trusted."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import torch
import xarray as xr

from inflate_lib._checks import whole_number
from inflate_lib._files import check_outputs, hand_out
from inflate_lib.datasets.pairs import training_rows
from inflate_lib.descriptors import DESCRIPTORS, get_descriptor
from inflate_lib.descriptors.registry import PARTS
from inflate_lib.diffusion import storage
from inflate_lib.diffusion.randomness import seed_for
from inflate_lib.experiments.calibrate import calibrate_weights
from inflate_lib.experiments.run import held_out_seed, run_held_out
from inflate_lib.experiments.tables import score, scores, with_interval
from inflate_lib.models.recipe import Recipe

_CARD = """# Weights of the profile `{profile}`

Conditional diffusion models: one for each descriptor of an inflated structure and, where there is one, a *joint* model,
which takes any combination of them. They are float16 safetensors, for `inflate_lib.load_model`. This
page was written by `inflate card --profile {profile}`, which measures what it states.

## Data

{source}: {structures} structures that inflate, of which every tenth (those whose index ends in 9) was held out with
all its flips and shifts; {pairs} pairs of image and descriptor were trained on: {originals} originals and {variants}
flips and shifts of them. Digest of the images: `{data}`. The
images are not in here.

## Recipe

{recipe}

## Training

{training}

Minutes are those of the clock for one model, on the device named. On a CPU as many models as there are cores train
side by side, with one thread each, so that two cores trained all of these in half the sum. The loss is the mean of
the last interval of training, the held-out loss the simple loss on the structures that were left out. Losses of
different models are not comparable, since the descriptors that they are given differ; accuracy is measured below.
The two losses of one model are averages of different kinds, which the book's chapter on training compares.

## Accuracy

For each model the descriptors of {n} held-out structures that lie in the range of its training data were asked for, one
structure was drawn for each and inflated, and what it achieved was compared with what was asked for; sampling:
{sampling}; {calibration}. Ways of sampling for other purposes differ in what is named: {others}. Where there is a
folder `students`, these draw with networks into which guidance was distilled, evaluated once a step{tuned}.

In brackets: 95 % bootstrap intervals over targets and noise. They do not show how much another training would change
the numbers: each model was trained once, from one seed.

A drawing is *valid* if it gives one closed structure, fits the frame and has an equilibrium at every load step; a valid
structure is *buildable* if its wall has no joint of one node and crosses no wall at any load step. Both are shares of
all drawings; of the real structures of the data {buildable} are buildable. Errors are those of valid structures.

A joint model is calibrated for any of height, width and area together, and for each other descriptor alone, as far
as it follows them. For other combinations, such as a stress beside a height, it is given the targets themselves.

{accuracy}

## Limits

- The models draw handwritten sevens of 28 × 28 pixels and know nothing else. Descriptors outside the range of the
  training data (in each file's header) are refused by experiments, designs and
  `model.draw`; `inflate_lib.diffusion.generate` warns.
- The descriptors are those of one material, one wall thickness and one pressure. Other conditions need other
  simulations and other weights.
- Single structures miss their target by the errors above, and not all can be built: simulate what was drawn, and
  choose, as `inflate design` does. Contact of walls is not modelled, only seen (`inflate_lib.mechanics.find_flaw`).
- Weights are used for a run only if the recipe and the images are the same to the last bit; otherwise models are
  trained anew.
"""

_TUNED = (
    ", and\nwhich were tuned on what they draw, judged by a surrogate of the simulation. "
    "It lies beside them: in the way called\n*steered* it corrects each drawing while it is made"
)
_MEASURES = {
    "R²": "R²",
    "median error / target": "median error (%)",
    "mean error / target": "mean error (%)",
    "within 5 %": "within 5 % (%)",
    "median point distance": "median distance (px)",
    "median outline distance": "median distance (px)",
    "valid": "valid (%)",
    "buildable": "buildable (%)",
}


def write_card(folder: Path, data: xr.Dataset, recipe: Recipe, n: int | None = None) -> Path:
    """Measure the models in a folder on held-out targets, and write the card, ``README.md``, beside them.

    They are calibrated first, see :func:`.calibrate_weights`, whose parameters these are. The measured numbers also go
    into the header of each file, as ``metadata["metrics"]``. A joint model is asked for one descriptor after the other,
    and its metrics are those of each.

    Parameters
    ----------
    folder, data, recipe
        See there.
    n : int, optional
        Number of held-out targets; all of them by default, see :func:`inflate_lib.experiments.run.run_held_out`.

    Returns
    -------
    Path
        The card.
    """
    whole_number("n", n, 1, optional=True)
    folder, training, accuracy = Path(folder), {}, {}
    card = folder / "README.md"
    check_outputs([card], ours=_is_card)
    models = calibrate_weights(folder, data, recipe)
    if n is None:
        _keep_drawings(folder, models, data, recipe)
    for name, model in models.items():
        metrics, trained, joint = {}, model.trained, get_descriptor(name).any_part
        for asked in dict.fromkeys((*DESCRIPTORS, *PARTS)) if joint else (name,):
            for purpose, one in {"faithful": model, **model.others}.items():
                drawn = run_held_out(one, data, recipe.seed, asked, n=n)
                table = scores(drawn, asked, data, seed=recipe.seed)
                rows = table.set_index("measure")[["value", "low", "high"]]
                known = [measure for measure in _MEASURES if measure in rows.index]
                title = (f"{name}: {asked}" if joint else name) + f", {purpose}" * (purpose != "faithful")
                accuracy[title] = {_MEASURES[measure]: with_interval(*rows.loc[measure]) for measure in known}
                if purpose == "faithful":
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
    text = _CARD.format(
        profile=about.get("profile", folder.name),
        source={"mnist": "The sevens of the MNIST training files"}.get(about["source"], about["source"]),
        structures=f"{about['structures']:,}",
        pairs=f"{about['pairs']:,}",
        originals=f"{(originals := len(training_rows(data))):,}",
        variants=f"{about['pairs'] - originals:,}",
        data=about["data"],
        recipe=options.to_frame().to_markdown(),
        training=_markdown(training),
        accuracy=_markdown(accuracy),
        buildable=f"{100 * float(data['buildable'].mean()):.1f} %",
        n="all" if n is None else n,
        sampling=_in_words(recipe.sampling),
        others="; ".join(f"*{purpose}*: {_in_words(changes)}" for purpose, changes in recipe.samplers.items())
        or "none",
        tuned=_TUNED if recipe.tuning else "",
        calibration=how if recipe.n_calibration else "the model was told the target itself",
    )
    with hand_out(card, _is_card) as place:
        place.write_text(text, encoding="utf-8")
    return card


def _keep_drawings(folder, models, data, recipe):
    """Store what the models of one descriptor draw for all held-out targets, so that chapters need not draw it again.

    :func:`.run.run_experiment` takes it where it would draw the same, as it takes what was drawn on a GPU.
    """
    tensors, record = {}, {}
    for name, model in models.items():
        if get_descriptor(name).any_part:
            continue
        drawn = run_held_out(model, data, recipe.seed)
        images = np.round(255 * drawn["image"].values).astype(np.uint8)
        told = model.told(name, drawn["target"].values)
        tensors |= {f"{name}.images": torch.from_numpy(images), f"{name}.told": torch.from_numpy(told)}
        seed = seed_for(held_out_seed(recipe.seed), name)
        record[name] = {"weights": model.trained.fingerprint, "seed": seed, "sampling": dict(model.sampling)}
    if tensors:
        file = folder / "drawings" / "held_out.safetensors"
        storage.check_files([file], "drawing")
        storage.write(file, "drawing", tensors, record)


def _is_card(file):
    """Whether a file is a card, by its first words; it has no record where it comes with a clone."""
    return file.read_bytes().startswith(_CARD.split("`")[0].encode())


def _in_words(options):
    return ", ".join(f"{key} {value}" for key, value in options.items())


def _markdown(rows: Mapping) -> str:
    return pd.DataFrame(rows).T.fillna("–").rename_axis("model").to_markdown()
