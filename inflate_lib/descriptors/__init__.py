"""Descriptors of a deformed structure (paper sec. 3.1, Fig. 3), each defined in one place.

Beside the paper's five (height, width, bounding box, hull area, medial axis) there are two physical ones, which the
paper leaves to future work (sec. 5): the peak von Mises stress and the largest principal stretch. Others are added by
:func:`inflate_lib.descriptors.register`.
"""

from inflate_lib.descriptors.errors import POINT_DISTANCE, RELATIVE
from inflate_lib.descriptors.registry import (
    DESCRIPTORS,
    JOINT,
    PARTS,
    PHYSICAL,
    Descriptor,
    added_version,
    basic,
    columns,
    get_descriptor,
    name_of,
    register,
    registered,
)
from inflate_lib.descriptors.shape import (
    AXIS_POINTS,
    Shape,
    axis_height,
    hull_sides,
    medial_axis,
    mirror_axis,
    place_axis,
)
from inflate_lib.descriptors.values import Descriptors, describe, descriptor_matrix, joint_conditions

__all__ = [
    "AXIS_POINTS",
    "DESCRIPTORS",
    "JOINT",
    "PARTS",
    "PHYSICAL",
    "POINT_DISTANCE",
    "RELATIVE",
    "Descriptor",
    "Descriptors",
    "Shape",
    "added_version",
    "axis_height",
    "basic",
    "columns",
    "describe",
    "descriptor_matrix",
    "get_descriptor",
    "hull_sides",
    "joint_conditions",
    "medial_axis",
    "mirror_axis",
    "name_of",
    "place_axis",
    "register",
    "registered",
]
