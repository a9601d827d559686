"""Trained models of descriptors (paper sec. 4.1): trained, found in the cache, or committed; and how to ask them."""

from typing import TYPE_CHECKING

from inflate_lib._lazy import attach

RETRAIN = "INFLATE_RETRAIN"  # set by --retrain: models are trained, though data/pretrained has weights that fit

if TYPE_CHECKING:
    from inflate_lib.models.calibration import Calibration
    from inflate_lib.models.recipe import Recipe, load_recipe
    from inflate_lib.models.train import train_models
    from inflate_lib.models.weights import Model, committed_weights, load_model, trained_models

__all__ = [
    "Calibration",
    "Model",
    "Recipe",
    "committed_weights",
    "load_model",
    "load_recipe",
    "train_models",
    "trained_models",
]
__getattr__, __dir__ = attach(__name__, __file__)
