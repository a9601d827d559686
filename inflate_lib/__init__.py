"""Inverse design of inflatable structures: images → structures → inflation → descriptors → diffusion.

The packages follow the paper, and imports run down this list alone (``make lint`` checks it)::

    structures    images, labels, flips and shifts           (Figs. 2, 4)
    mechanics     mesh, inflation, stress, contact           (sec. 3)
    descriptors   height, width, box, hull area, axis        (sec. 3.1, Fig. 3)
    datasets      simulate, store, split, pair               (secs. 3, 3.2)
    diffusion     schedule, U-Net, training, sampling        (secs. 2, 4.1)
    models        trained weights, and how to ask them       (sec. 4.1)
    experiments   targets → structures → what they reach     (secs. 2.3, 4)
    alternatives, plotting, io, inverse                      beyond the paper
    book, cli                                                how it is shown

The names below are imported on first use, so that ``import inflate_lib`` is instant, and ``import
inflate_lib.diffusion`` needs PyTorch, NumPy and safetensors only.
"""

from typing import TYPE_CHECKING

from inflate_lib._lazy import attach

__version__ = "0.1.0"

if TYPE_CHECKING:
    from inflate_lib.datasets.simulate import simulate_dataset, simulated_sevens
    from inflate_lib.descriptors import describe
    from inflate_lib.inverse.search import design
    from inflate_lib.mechanics.buildable import find_flaw
    from inflate_lib.mechanics.contact import self_contact
    from inflate_lib.mechanics.inflation import inflate
    from inflate_lib.mechanics.mesh import build_mesh
    from inflate_lib.models.weights import load_model
    from inflate_lib.structures.labels import label_image
    from inflate_lib.structures.sources import load_sevens

__all__ = [
    "build_mesh",
    "describe",
    "design",
    "find_flaw",
    "inflate",
    "label_image",
    "load_model",
    "load_sevens",
    "self_contact",
    "simulate_dataset",
    "simulated_sevens",
]
__getattr__, __dir__ = attach(__name__, __file__)
