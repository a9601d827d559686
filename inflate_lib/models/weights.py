"""Trained weights: committed, or in the cache."""

import os
from collections.abc import Sequence

import numpy as np

from inflate_lib import paths
from inflate_lib._cache import RETRAIN
from inflate_lib.datasets.pairs import _about, _mean
from inflate_lib.diffusion import TrainedModel
from inflate_lib.models.train import train_models, training_config
from inflate_lib.structures import augmentation


def committed_weights(descriptor, training, data, n_augmented=augmentation.PAPER_SAMPLES, seed=0):
    """Find weights in ``data/pretrained`` that were trained as asked, on these very data.

    The images must be the same to the last bit; the descriptors, whose last digits depend on the processor, must agree
    in their mean to six digits. Parameters are those of :func:`trained_model_file`.

    Returns
    -------
    path : Path or None
        The safetensors file.
    why_not : str
        What differs where the recipe is the same and yet the weights are not taken.

    Raises
    ------
    ValueError
        A file there is damaged, or not one of this library.
    """
    recipe = training_config(descriptor, training, seed).recipe()
    about, mean, why_not = _about(descriptor, data, n_augmented), _mean(descriptor, data), ""
    for path in sorted(paths.PRETRAINED.glob(f"*/{descriptor}.safetensors")):
        model = TrainedModel.load(path)
        if model.config.recipe() != recipe:
            continue
        differs = [name for name, value in about.items() if model.metadata.get(name) != value]
        if not differs and np.allclose(model.metadata["mean"], mean, rtol=1e-6, atol=1e-9):
            return path, ""
        why_not = f"{_name(path)} is of another {', '.join(differs) or 'simulation'}"
    return None, why_not


def trained_models(names: Sequence[str], training, data, n_augmented=augmentation.PAPER_SAMPLES, seed=0):
    """The models of several descriptors: committed weights where there are any, else trained, or found in the cache.

    A line of text says which. With the environment variable ``INFLATE_RETRAIN`` (``inflate reproduce --retrain``)
    committed weights are not considered. Parameters are those of :func:`trained_model_file`.

    Returns
    -------
    dict
        Name of the descriptor → :class:`inflate_lib.diffusion.TrainedModel`.
    """
    found = {}
    for name in names if RETRAIN not in os.environ else ():
        path, why_not = committed_weights(name, training, data, n_augmented, seed)
        if path is not None:
            found[name] = path
        elif why_not:
            print(why_not)
    for folder in sorted({path.parent for path in found.values()}):
        print(f"weights from {_name(folder)}: {', '.join(name for name in found if found[name].parent == folder)}")
    if missing := [name for name in names if name not in found]:
        print(f"trained for this run: {', '.join(missing)}")
        found |= train_models(missing, training, data, n_augmented, seed)
    return {name: TrainedModel.load(found[name]) for name in names}


def _name(path):
    """A path as a reader of the book should see it."""
    return path.relative_to(paths.ROOT) if path.is_relative_to(paths.ROOT) else path
