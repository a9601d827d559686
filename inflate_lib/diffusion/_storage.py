"""Tensors and their description in one safetensors file: nothing is pickled, and a damaged file is never used."""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

FORMAT = "inflate_lib.diffusion 1"


def _digest(tensors: Mapping[str, Tensor], content: str) -> str:
    total = hashlib.sha256(content.encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        total.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        total.update(tensor.numpy().tobytes())
    return total.hexdigest()


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Give the name of the file to an error that leaves it out, as that of a full disk does."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def write(path: Path, kind: str, tensors: Mapping[str, Tensor], content: Mapping) -> None:
    """Write a file of this ``kind``; ``content`` is JSON in its header.

    The file is written beside its place, flushed to disk, and then moved there in one operation, so that a run killed
    at any moment leaves either the old file or the new one, whole.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(content)
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    header = {"format": FORMAT, "kind": kind, "content": text, "digest": _digest(tensors, text)}
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        with naming(path):
            with open(partial, "wb") as file:
                file.write(save(tensors, metadata=header))
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def sweep(path: Path) -> None:
    """Remove what runs that were killed in the middle of ``write`` left beside ``path``."""
    for partial in path.parent.glob(f"{path.name}.*.partial"):
        partial.unlink(missing_ok=True)


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
    if header.get("format") != FORMAT or header.get("kind") != kind:
        raise ValueError(f"{path} is not a {kind} file written by this library")
    content = header.get("content", "")
    if header.get("digest") != _digest(tensors, content):
        raise ValueError(f"{path} is corrupt: its content does not match its own checksum")
    return tensors, json.loads(content)


def fill(places: Mapping[str, Tensor], tensors: Mapping[str, Tensor], path: Path) -> None:
    """Copy tensors into ``places``, which must match by name and shape; ``path`` is what an error names."""
    if {name: v.shape for name, v in places.items()} != {name: v.shape for name, v in tensors.items()}:
        raise ValueError(f"{path} does not fit the network that its configuration describes")
    with torch.no_grad():
        for name, place in places.items():
            place.copy_(tensors[name])


def fingerprint(*arrays: np.ndarray) -> str:
    """SHA-256 of the arrays' types, shapes and bytes."""
    total = hashlib.sha256()
    for array in arrays:
        total.update(f"{array.dtype} {array.shape}".encode())
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()
