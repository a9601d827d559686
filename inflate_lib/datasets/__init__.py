"""Many structures, inflated and described (paper sec. 3): made, stored, split, and paired for training."""

from typing import TYPE_CHECKING

from inflate_lib._lazy import attach

if TYPE_CHECKING:
    from inflate_lib.datasets.pairs import TrainingSet, held_out, training_rows
    from inflate_lib.datasets.simulate import simulate_dataset, simulated_sevens
    from inflate_lib.datasets.storage import load_dataset, save_dataset

__all__ = [
    "TrainingSet",
    "held_out",
    "load_dataset",
    "save_dataset",
    "simulate_dataset",
    "simulated_sevens",
    "training_rows",
]
__getattr__, __dir__ = attach(__name__, __file__)
