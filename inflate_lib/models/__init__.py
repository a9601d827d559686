"""Trained models of descriptors (paper sec. 4.1): trained, found in the cache, or committed; and how to ask them."""

from inflate_lib._lazy import attach

RETRAIN = "INFLATE_RETRAIN"  # set by --retrain: models are trained, though data/pretrained has weights that fit

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "train": ["train_models", "training_config"],
        "weights": ["Model", "committed_weights", "load_model", "trained_models"],
        "calibration": ["Calibration"],
    },
)
