"""From a grey image to a structure (paper sec. 3, Figs. 2 and 4): images, labels, flips and shifts."""

from typing import TYPE_CHECKING

from inflate_lib._lazy import attach

if TYPE_CHECKING:
    from inflate_lib.structures.augmentation import apply_variants, augment, augment_descriptors
    from inflate_lib.structures.labels import is_open, label_image, point_joints, stages
    from inflate_lib.structures.sources import Digits, load_digits, load_sevens, resolve_source

__all__ = [
    "Digits",
    "apply_variants",
    "augment",
    "augment_descriptors",
    "is_open",
    "label_image",
    "load_digits",
    "load_sevens",
    "point_joints",
    "resolve_source",
    "stages",
]
__getattr__, __dir__ = attach(__name__, __file__)
