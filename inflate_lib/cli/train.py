"""``inflate train``: train the models of a profile."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from inflate_lib import paths
from inflate_lib.cli.app import ProfileName, app


@app.command()
def train(
    descriptor: Annotated[str, typer.Option(help="height, width, box, area, axis, joint, or all but joint.")] = "all",
    profile: ProfileName = "ci",
    device: Annotated[str | None, typer.Option(help="cpu, cuda or mps; found by itself otherwise.")] = None,
    compile: Annotated[bool, typer.Option("--compile", help="With torch.compile.")] = False,
    steps: Annotated[int | None, typer.Option(min=2, help="A dry run of so many steps: what would it cost?")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the weights in 16 bits: name.safetensors.")] = None,
    log: Annotated[Path | None, typer.Option(help="Folder for CSV and TensorBoard logs.")] = None,
    pack: Annotated[Path | None, typer.Option(help="Train nothing: write data and recipe, to train elsewhere.")] = None,
) -> None:
    """Train the models of a profile, or find them trained in the cache. A killed training goes on where it was.

    Several GPUs or machines: torchrun --nproc-per-node 2 -m -- inflate_lib train … (-- keeps torchrun from --log)

    A machine that has little but PyTorch: --pack pairs.safetensors, and there python -m inflate_lib.models.remote …
    """
    paths.need_checkout("inflate train")
    from inflate_lib.alternatives.students import steering_surrogate, student_file
    from inflate_lib.datasets.simulate import simulated_sevens
    from inflate_lib.descriptors import DESCRIPTORS, get_descriptor
    from inflate_lib.diffusion import ranks, storage
    from inflate_lib.diffusion.training import choose_device
    from inflate_lib.experiments.calibrate import calibrate_weights
    from inflate_lib.models import train
    from inflate_lib.models.reach import check_reach_file, save_reach
    from inflate_lib.models.recipe import load_recipe
    from inflate_lib.models.weights import STUDENTS, SURROGATE

    if pack is not None and (steps, out, log) != (None, None, None):
        raise ValueError("--pack trains nothing: leave out --steps, --out and --log")
    if steps is not None and (out, log) != (None, None):
        raise ValueError("--steps is a dry run, which keeps nothing: leave out --out and --log")
    if pack is not None:
        storage.check_files([pack], "pack")
    names = list(DESCRIPTORS) if descriptor == "all" else [get_descriptor(descriptor).name]
    if out is not None:
        storage.check_files(
            (place / f"{name}.safetensors" for place in (out, out / STUDENTS) for name in names), "model"
        )
        check_reach_file(out)
    recipe = load_recipe(profile)
    changes = {"device": device, "compile": compile or None}
    recipe = recipe.changed(training={name: value for name, value in changes.items() if value is not None})
    chosen = recipe.training.get("device", "auto")
    try:
        choose_device(chosen)
    except ValueError as error:
        where = f"profile {profile}, recipe.training" if device is None else "--device"
        raise ValueError(f"{where}: {error}") from None
    ranks.start(chosen)
    data = simulated_sevens(recipe.source, recipe.n_structures)
    basis = names, recipe, data
    if pack is not None:
        train.pack(pack, *basis, profile)
        text = f"{', '.join(names)}: {pack}, {pack.stat().st_size / 1e6:.1f} MB"
    elif steps:
        cost = train.training_cost(*basis, steps)
        at_a_time = cost["side by side"][0]
        text = f"{cost.to_string(index=False, float_format='{:.4g}'.format)}\nthe whole training: about "
        text += f"{cost['hours'].sum() / at_a_time:.3g} h, {at_a_time} at a time"
    else:
        log = log or paths.CACHE / "logs" / profile
        files = train.train_models(*basis, log)
        told = {"profile": profile, "sampling": dict(recipe.sampling)}
        text = "\n".join(_export(Path(file), name, told, out) for name, file in files.items() if file)
        if out is not None and ranks.rank() == 0:
            save_reach(data, out)
            for name in names:
                if recipe.student:
                    student = student_file(out / f"{name}.safetensors", recipe, data)
                    text += "\n" + _export(student, name, told, out / STUDENTS)
            if recipe.tuning:
                surrogate = steering_surrogate(data, recipe, out / STUDENTS)
                surrogate.save(out / STUDENTS / f"{SURROGATE}.safetensors")
            for name in names:
                try:
                    calibrate_weights(out, data, recipe, [name])
                except ValueError as error:  # it can be used all the same, told the target itself
                    text += f"\n{name} is not calibrated: {error}"
    if ranks.rank() == 0:
        print(text)
    ranks.finish()


def _export(file: Path, name: str, told: Mapping, out: Path | None) -> str:
    """Copy a trained model in 16 bits to `out`, with what it is told about itself; a line about it."""
    from inflate_lib.diffusion import TrainedModel

    model = TrainedModel.load(file)
    if out is not None:
        model.metadata |= told
        file = out / f"{name}.safetensors"
        model.save(file, half=True)
    about, loss = model.metadata, model.history["loss"][-1]
    unseen = f", held out {about['held_out_loss']:.4f}" if "held_out_loss" in about else ""
    return f"{name}: {about['seconds'] / 60:.1f} min on {about['device']}, loss {loss:.4f}{unseen}: {file}"
