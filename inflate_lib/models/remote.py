"""Training on another machine, which needs PyTorch, NumPy and safetensors, and nothing else of what the book needs.

    inflate train --profile paper --pack pairs.safetensors               # here: data and recipe, a few MB
    python -m inflate_lib.models.remote pairs.safetensors --out weights  # there, beside a copy of inflate_lib

trains the models of the pack side by side, and goes on where it was if it was stopped. The weights are those of
``inflate train --out``: put them into ``data/pretrained/<profile>``, and the notebooks find them.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from inflate_lib.diffusion import TrainedModel, TrainingConfig, storage, train
from inflate_lib.diffusion.training import choose_device, simple_loss
from inflate_lib.structures.augmentation import apply_variants, augment_descriptors

_Pairs = tuple[np.ndarray, np.ndarray]  # images, conditions


def train_and_test(pairs: _Pairs, unseen: _Pairs, config: TrainingConfig, about: Mapping, *options) -> TrainedModel:
    """Train a model, measure its loss on pairs that were held out, and write both into its metadata.

    ``options`` are the further arguments of :func:`inflate_lib.diffusion.train`.
    """
    model = train(*pairs, config, *options)
    if len(unseen[0]):
        model.metadata["held_out_loss"] = simple_loss(model, *unseen)
    model.metadata |= {**about, "pairs": len(pairs[0])}
    return model


def write_pack(
    path: Path, images: np.ndarray, variants: np.ndarray, unseen: np.ndarray, models: Mapping[str, Mapping]
) -> None:
    """Write data and recipes into one file.

    Parameters
    ----------
    path : path
        A safetensors file.
    images : array, shape (n, 28, 28)
        Structures to train on, without their flips and shifts.
    variants : int array, shape (m, 4)
        See :func:`inflate_lib.structures.augmentation.augment`.
    unseen : array, shape (k, 28, 28)
        Structures that are held out.
    models : Mapping
        Name of a descriptor → ``config`` (TrainingConfig), ``about`` (metadata, JSON), and ``seen`` and
        ``mirrored`` (n, N), the descriptors of the structures and of their mirror images, and ``unseen`` (k, N).
    """
    arrays = {"images": images, "variants": variants.astype(np.int32), "unseen": unseen}
    content = {}
    for name, model in models.items():
        arrays |= {f"{name}.{part}": model[part] for part in ("seen", "mirrored", "unseen")}
        content[name] = {"config": model["config"].as_dict(), "about": model["about"]}
    tensors = {name: torch.from_numpy(np.array(array, order="C")) for name, array in arrays.items()}  # copies
    storage.check_files([path], "pack")
    storage.write(path, "pack", tensors, content)


def _train_pack(path: Path, name: str, out: Path, device: str = "auto", compile: bool = False, threads=None) -> Path:
    """Train one model of a pack; its weights in 16 bits, ``out/<name>.safetensors``.

    The checkpoints and the log are kept in ``out/checkpoints/<name>``.
    """
    tensors, models = storage.read(path, "pack")
    if name not in models:
        raise ValueError(f"{path} has no model {name!r}; it has {', '.join(models)}")
    arrays = {key: tensor.numpy() for key, tensor in tensors.items()}
    conditions = augment_descriptors(arrays[f"{name}.seen"], arrays[f"{name}.mirrored"], arrays["variants"])
    pairs = apply_variants(arrays["images"], arrays["variants"]), conditions
    unseen = arrays["unseen"], arrays[f"{name}.unseen"]
    config = replace(TrainingConfig.from_dict(models[name]["config"]), device=device, compile=compile)
    folder = Path(out) / "checkpoints" / name
    about = models[name]["about"]
    model = train_and_test(pairs, unseen, config, about, folder, f"training {name}", threads, folder)
    file = Path(out) / f"{name}.safetensors"
    model.save(file, half=True)
    return file


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line: one model here, several in a process each."""
    parser = argparse.ArgumentParser(prog="python -m inflate_lib.models.remote", description=__doc__.partition("\n")[0])
    parser.add_argument("pack", type=Path, help="what inflate train --pack wrote")
    parser.add_argument("--out", type=Path, default=Path("weights"), help="folder for weights and checkpoints")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these models; all by default")
    parser.add_argument("--device", default="auto", help="cpu, cuda or mps; found by itself otherwise")
    parser.add_argument("--compile", action="store_true", help="with torch.compile")
    parser.add_argument("--jobs", type=int, help="models side by side; as many as there are cores")
    parser.add_argument("--threads", type=int, help="CPU threads of each")
    given = parser.parse_args(arguments)
    try:
        names = given.only or list(storage.read(given.pack, "pack")[1])
        storage.check_files((given.out / f"{name}.safetensors" for name in names), "model")
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        alone = choose_device(given.device).type == "mps"
        jobs = max(1, given.jobs or min(len(names), 1 if alone else cores))
        threads = given.threads or max(1, cores // jobs)
        if len(names) == 1:
            print(_train_pack(given.pack, names[0], given.out, given.device, given.compile, threads), flush=True)
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
