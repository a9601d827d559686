"""What else could be done: chance, retrieval, an autoencoder, a surrogate, students, best of many, all digits."""

from typing import TYPE_CHECKING

from inflate_lib._lazy import attach

if TYPE_CHECKING:
    from inflate_lib.alternatives.ablation import training_variants
    from inflate_lib.alternatives.autoencoder import run_autoencoder, train_autoencoder
    from inflate_lib.alternatives.best_of import selection
    from inflate_lib.alternatives.blends import Family, blend
    from inflate_lib.alternatives.parts import open_parts, simulated_digits
    from inflate_lib.alternatives.retrieval import random_structures, retrieved_structures
    from inflate_lib.alternatives.surrogate import train_surrogate

__all__ = [
    "Family",
    "blend",
    "open_parts",
    "random_structures",
    "retrieved_structures",
    "run_autoencoder",
    "selection",
    "simulated_digits",
    "train_autoencoder",
    "train_surrogate",
    "training_variants",
]
__getattr__, __dir__ = attach(__name__, __file__)
