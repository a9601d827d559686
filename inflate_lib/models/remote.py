"""Training on another machine, which needs PyTorch, NumPy and safetensors, and nothing else of what the book needs.

    inflate train --profile paper --pack pairs.safetensors               # here: data and recipe, a few MB
    python -m inflate_lib.models.remote pairs.safetensors --out weights  # there, beside a copy of inflate_lib

trains the models of the pack side by side, and goes on where it was if it was stopped. The weights are those of
``inflate train --out``: put them into ``data/pretrained/<profile>``, and the notebooks find them.

Where a GPU can be had for a quarter of an hour only, steps are replayed (:mod:`inflate_lib.diffusion.graphs`):

    python -m inflate_lib.models.remote pairs.safetensors --out weights --graph --minutes 8
    python -m inflate_lib.models.remote pairs.safetensors --out weights --draw targets.npz

The first line stops in time, writes weights whose header tells ``epochs_done``, and goes on where it is called again;
on another machine, which has no checkpoints, from such weights with ``--start FOLDER``. The second has the models draw
structures, with all steps of their recipe, into ``weights/drawings/targets.safetensors``. Beside the weights in
``data/pretrained/<profile>``, they are what an experiment takes where it would draw the same.
"""

import argparse
import math
import os
import subprocess
import sys
import time
import zipfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from inflate_lib.diffusion import TrainedModel, TrainingConfig, generate, storage, train
from inflate_lib.diffusion.graphs import CapturedRun
from inflate_lib.diffusion.loop import device_name
from inflate_lib.diffusion.randomness import seed_for
from inflate_lib.diffusion.training import choose_device, simple_loss
from inflate_lib.structures.augmentation import apply_variants, augment_descriptors

_Pairs = tuple[np.ndarray, np.ndarray]  # images, conditions


def train_and_test(pairs: _Pairs, unseen: _Pairs, config: TrainingConfig, about: Mapping, *options) -> TrainedModel:
    """Train a model, measure its loss on pairs that were held out, and write both into its metadata.

    ``options`` are the further arguments of :func:`inflate_lib.diffusion.train`.
    """
    return _tested(train(*pairs, config, *options), pairs, unseen, about)


def _tested(model: TrainedModel, pairs: _Pairs, unseen: _Pairs, about: Mapping) -> TrainedModel:
    if len(unseen[0]):
        model.metadata["held_out_loss"] = simple_loss(model, *unseen)
    model.metadata |= {**about, "pairs": len(pairs[0])}
    return model


def _unpack(path: Path, name: str, device: str = "auto", compile: bool = False):
    """What one model of a pack is trained on, the pairs that are held out, its configuration, and its metadata."""
    tensors, models = storage.read(path, "pack")
    if name not in models:
        raise ValueError(f"{path} has no model {name!r}; it has {', '.join(models)}")
    if f"{name}.mirrored" not in tensors:
        raise ValueError(f"{path} was written by an older version of this library: let inflate train --pack do it anew")
    arrays = {key: tensor.numpy() for key, tensor in tensors.items()}
    conditions = augment_descriptors(arrays[f"{name}.seen"], arrays[f"{name}.mirrored"], arrays["variants"])
    pairs = apply_variants(arrays["images"], arrays["variants"]), conditions
    unseen = arrays["unseen"], arrays[f"{name}.unseen"]
    config = replace(TrainingConfig.from_dict(models[name]["config"]), device=device, compile=compile)
    return pairs, unseen, config, models[name]["about"]


def _train_pack(path: Path, name: str, out: Path, device: str, compile: bool, threads: int) -> None:
    """Train one model of a pack; its weights in 16 bits, ``out/<name>.safetensors``.

    The checkpoints and the log are kept in ``out/checkpoints/<name>``.
    """
    folder = out / "checkpoints" / name
    model = train_and_test(*_unpack(path, name, device, compile), folder, f"training {name}", threads, folder)
    _save(model, out, name)


def _save(model: TrainedModel, out: Path, name: str) -> None:
    file = out / f"{name}.safetensors"
    model.save(file, half=True)
    print(file, flush=True)


def _train_captured(given: argparse.Namespace, names: Sequence[str]) -> None:
    """Train models of a pack side by side, each in a thread that replays its steps."""
    torch.backends.cudnn.benchmark = True
    until, runs = time.monotonic() + 60 * given.minutes, {}
    for name in names:
        pairs, unseen, config, about = _unpack(given.pack, name, given.device, given.compile)
        start = TrainedModel.load(given.start / f"{name}.safetensors") if given.start else None
        run = CapturedRun(*pairs, config, given.out / "checkpoints" / name, start)
        run.until = until
        run.capture()
        runs[name] = run, pairs, unseen, about

    def one(name):
        run, pairs, unseen, about = runs[name]
        run.run(f"training {name}", given.out / "checkpoints" / name)
        about["epochs_done"] = round(run.step / run.per_epoch, 2)
        _save(_tested(run.model(), pairs, unseen, about), given.out, name)

    with ThreadPoolExecutor(len(names)) as pool:
        done = {name: pool.submit(one, name) for name in names}
        try:
            wait(done.values())
        finally:  # after Ctrl-C each ends its step, and keeps it
            for run, *_ in runs.values():
                run.until = 0
    if failed := [f"{name}: {future.exception()}" for name, future in done.items() if future.exception()]:
        raise RuntimeError("not trained: " + "; ".join(failed))


def _draw(file: Path, out: Path, names: Sequence[str], device: str) -> None:
    """Draw a structure for each target in a npz file, with the weights in `out` and the sampling of their recipe.

    The name of an array (m, N) is that of its model. Its noise is that of an experiment with the recipe's seed, or, as
    in ``height.held_out``, that of :func:`inflate_lib.experiments.run_held_out`.
    """
    try:
        with np.load(file) as arrays:
            targets = {key: array for key, array in arrays.items() if key.partition(".")[0] in names}
    except (ValueError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        raise ValueError(f"{file} is no npz file of targets ({error})") from None
    if not targets:
        raise ValueError(f"{file} has no targets for {', '.join(names)}")
    drawing = out / "drawings" / f"{file.stem}.safetensors"
    storage.check_files([drawing], "drawing")
    tensors, record, place = {}, {}, choose_device(device)
    for key, told in targets.items():
        (name, _, purpose), told = key.partition("."), told if told.ndim > 1 else told.reshape(-1, 1)
        model, began = TrainedModel.load(out / f"{name}.safetensors"), time.monotonic()
        seed, sampling = model.config.seed, model.metadata["sampling"]
        seed = seed_for(seed_for(seed, purpose.replace("_", " ")) if purpose else seed, name)
        images = np.round(255 * generate(model, told, seed, device=str(place), **sampling)).astype(np.uint8)
        tensors |= {f"{key}.images": torch.from_numpy(images), f"{key}.told": torch.from_numpy(told)}
        record[key] = {"weights": model.fingerprint, "seed": seed, "sampling": sampling, "torch": torch.__version__}
        record[key] |= {"device": device_name(place), "seconds": round(time.monotonic() - began, 1)}
        print(f"{key}: {len(images)} structures in {record[key]['seconds']} s", flush=True)
    storage.write(drawing, "drawing", tensors, record)
    print(drawing, flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line: one model here, several in a process each, or in a thread each where steps are captured."""
    parser = argparse.ArgumentParser(prog="python -m inflate_lib.models.remote", description=__doc__.partition("\n")[0])
    parser.add_argument("pack", type=Path, help="what inflate train --pack wrote")
    parser.add_argument("--out", type=Path, default=Path("weights"), help="folder for weights and checkpoints")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these models; all by default")
    parser.add_argument("--device", default="auto", help="cpu, cuda or mps; found by itself otherwise")
    parser.add_argument("--compile", action="store_true", help="with torch.compile")
    parser.add_argument("--jobs", type=int, help="models side by side; as many as there are cores")
    parser.add_argument("--threads", type=int, help="CPU threads of each")
    parser.add_argument("--graph", action="store_true", help="all side by side on one GPU, each step a CUDA graph")
    parser.add_argument(
        "--minutes", type=float, default=math.inf, help="with --graph: stop then, and write what there is"
    )
    parser.add_argument("--start", type=Path, help="with --graph: folder of weights to go on from without checkpoints")
    parser.add_argument("--draw", type=Path, metavar="NPZ", help="draw for these targets; train only with --graph")
    given = parser.parse_args(arguments)
    if given.graph and (given.jobs or given.threads):
        parser.error("--jobs and --threads have no meaning with --graph")
    if not given.graph and (given.minutes < math.inf or given.start):
        parser.error("--minutes and --start need --graph")
    try:
        names = given.only or list(storage.read(given.pack, "pack")[1])
        storage.check_files((given.out / f"{name}.safetensors" for name in names), "model")
        if given.graph:
            _train_captured(given, names)
        if given.draw:
            _draw(given.draw, given.out, names, given.device)
        if given.graph or given.draw:
            return
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        alone = choose_device(given.device).type == "mps"
        jobs = max(1, given.jobs or min(len(names), 1 if alone else cores))
        threads = given.threads or max(1, cores // jobs)
        if len(names) == 1:
            _train_pack(given.pack, names[0], given.out, given.device, given.compile, threads)
            return
    except (ValueError, RuntimeError, OSError, FloatingPointError) as error:
        sys.exit(f"inflate: {error}")

    def one(name):
        command = [sys.executable, "-m", __spec__.name, given.pack, "--out", given.out, "--only", name]
        command += ["--device", given.device, "--threads", str(threads)] + ["--compile"] * given.compile
        return subprocess.run(command, check=False).returncode

    with ThreadPoolExecutor(jobs) as pool:
        failed = [name for name, code in zip(names, pool.map(one, names), strict=True) if code]
    if failed:
        sys.exit(f"inflate: not trained: {', '.join(failed)}; the same command goes on from their checkpoints")


if __name__ == "__main__":
    main()
