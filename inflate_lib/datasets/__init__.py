"""Many structures, inflated and described (paper sec. 3): made, stored, split, and paired for training."""

from inflate_lib._lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "simulate": ["simulate_dataset", "simulated_sevens"],
        "storage": ["load_dataset", "save_dataset"],
        "split": ["held_out", "training_rows"],
        "pairs": ["training_pairs"],
    },
)
