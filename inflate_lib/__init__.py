"""Inverse design of inflatable structures: images → structures → inflation → descriptors → diffusion.

The public names below are imported on first use (PEP 562), so that ``import inflate_lib`` is instant and
``import inflate_lib.diffusion`` needs PyTorch, NumPy and safetensors only.
"""

from importlib import import_module

__version__ = "0.1.0"

_PUBLIC = {
    "label_image": "structures",
    "load_sevens": "sources",
    "build_mesh": "mesh",
    "inflate": "inflation",
    "describe": "descriptors",
    "self_contact": "contact",
    "simulate_dataset": "datasets",
    "simulated_sevens": "datasets",
    "design": "inverse_design",
}

__all__ = sorted(_PUBLIC)


def __getattr__(name):
    if name in _PUBLIC:
        return getattr(import_module(f"inflate_lib.{_PUBLIC[name]}"), name)
    raise AttributeError(f"module 'inflate_lib' has no attribute {name!r}")


def __dir__():
    return sorted([*globals(), *_PUBLIC])
