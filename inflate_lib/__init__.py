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

The names below are imported on first use, so that ``import inflate_lib`` is instant and ``import inflate_lib.diffusion``
needs PyTorch, NumPy and safetensors only.
"""

from inflate_lib._lazy import attach

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "structures.sources": ["load_sevens"],
        "structures.labels": ["label_image"],
        "mechanics.mesh": ["build_mesh"],
        "mechanics.inflation": ["inflate"],
        "mechanics.contact": ["self_contact"],
        "descriptors": ["describe"],
        "datasets.simulate": ["simulate_dataset", "simulated_sevens"],
        "models.weights": ["load_model"],
        "inverse.search": ["design"],
    },
)
