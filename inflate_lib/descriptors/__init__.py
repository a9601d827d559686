"""Descriptors of a deformed structure (paper sec. 3.1, Fig. 3), each defined in one place.

Beside the paper's five (height, width, bounding box, hull area, medial axis) there are three that the paper leaves to
future work (sec. 5): the outline, the peak von Mises stress and the largest principal stretch. Others are added by
:func:`inflate_lib.descriptors.register`.
"""

from inflate_lib.descriptors.distances import OUTLINE_DISTANCE, POINT_DISTANCE, RELATIVE
from inflate_lib.descriptors.registry import DESCRIPTORS, Descriptor, get_descriptor, register
from inflate_lib.descriptors.shape import Shape
from inflate_lib.descriptors.values import Descriptors, describe, descriptor_matrix

__all__ = [
    "DESCRIPTORS",
    "OUTLINE_DISTANCE",
    "POINT_DISTANCE",
    "RELATIVE",
    "Descriptor",
    "Descriptors",
    "Shape",
    "describe",
    "descriptor_matrix",
    "get_descriptor",
    "register",
]
