"""What else could be done: chance, retrieval, an autoencoder, a surrogate, steering, the best of many, other recipes."""

from inflate_lib._lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "retrieval": ["random_structures", "retrieved_structures"],
        "autoencoder": ["run_autoencoder", "train_autoencoder"],
        "surrogate": ["train_surrogate"],
        "steering": ["steer"],
        "best_of": ["selection"],
        "ablation": ["sampling_ablation", "training_variants"],
    },
)
