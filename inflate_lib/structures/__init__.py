"""From a grey image to a structure (paper sec. 3, Figs. 2 and 4): where images come from, labels, flips and shifts."""

from inflate_lib._lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "sources": ["load_sevens", "resolve_source", "Sevens"],
        "labels": ["label_image", "point_joints", "stages"],
        "augmentation": ["apply_variants", "augment", "augment_descriptors"],
    },
)
