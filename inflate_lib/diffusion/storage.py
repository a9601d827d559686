"""Tensors and their description in one safetensors file: nothing is pickled, and a damaged file is never used."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from inflate_lib._files import check_outputs, draft, read_by

_FORMAT = "inflate_lib.diffusion 1"


def _digest(tensors: Mapping[str, Tensor], content: str) -> str:
    total = hashlib.sha256(content.encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        total.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        total.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())  # NumPy knows no bfloat16
    return total.hexdigest()


def write(path: Path, kind: str, tensors: Mapping[str, Tensor], content: Mapping) -> None:
    """Write a file of this ``kind``; ``content`` is JSON in its header.

    A run killed at any moment leaves either the old file or the new one, whole.
    """
    text = json.dumps(content)
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    header = {"format": _FORMAT, "kind": kind, "content": text, "digest": _digest(tensors, text)}
    with draft(path, durable=True) as place:
        place.write_bytes(save(tensors, metadata=header))


def read(path: Path, kind: str) -> tuple[dict[str, Tensor], dict]:
    """Read what ``write`` wrote: the tensors and the content.

    Raises
    ------
    FileNotFoundError
        There is no such file.
    ValueError
        The file is not one of ours, of another kind, truncated or altered. The message names it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no {kind} file at {path}")
    data = path.read_bytes()  # at once: another process may be putting a newer file in its place
    try:
        tensors = load(data)
    except SafetensorError as error:
        raise ValueError(f"{path} is truncated or not a safetensors file ({error})") from error
    # A safetensors file begins with the length of its header (8 bytes) and the header, which is JSON.
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")]).get("__metadata__", {})
    if header.get("format") != _FORMAT or header.get("kind") != kind:
        raise ValueError(f"{path} is not a {kind} file written by this library")
    content = header.get("content", "")
    if header.get("digest") != _digest(tensors, content):
        raise ValueError(f"{path} is corrupt, or somebody saved it again: its content does not match its own checksum")
    return tensors, json.loads(content)


def check_files(paths: Iterable[Path], kind: str) -> None:
    """Refuse, before the work, files that cannot be written, or that would replace one which is not of this ``kind``.

    Raises
    ------
    OSError
        See ``inflate_lib._files.check_outputs``.
    """
    check_outputs(paths, ours=read_by(lambda path: read(path, kind)))


def fill(places: Mapping[str, Tensor], tensors: Mapping[str, Tensor], path: Path) -> None:
    """Copy tensors into ``places``, which must match by name and shape; ``path`` is what an error names."""
    if {name: v.shape for name, v in places.items()} != {name: v.shape for name, v in tensors.items()}:
        differs = _difference(places, tensors)
        raise ValueError(f"{path} does not fit the network that its configuration describes: {differs}")
    with torch.no_grad():
        for name, place in places.items():
            place.copy_(tensors[name])


def _difference(places, tensors):
    """Where tensors depart from their places, for people."""
    missing, foreign = sorted(places.keys() - tensors.keys()), sorted(tensors.keys() - places.keys())
    sizes = [name for name in places.keys() & tensors.keys() if places[name].shape != tensors[name].shape]
    kinds = {"missing": missing, "not of it": foreign, "of another size": sorted(sizes)}
    return "; ".join(f"{names[0]}{' and others' * (len(names) > 1)} {kind}" for kind, names in kinds.items() if names)


def fingerprint(*arrays: np.ndarray) -> str:
    """SHA-256 of the arrays' types, shapes and bytes."""
    total = hashlib.sha256()
    for array in arrays:
        total.update(f"{array.dtype} {array.shape}".encode())
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()
