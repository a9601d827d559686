"""Choices behind the simulation that can be made otherwise, and the data set under each of them (calibration study)."""

from dataclasses import dataclass

import numpy as np
from joblib import Parallel, delayed

from inflate_lib.alternatives.stabilised import ALL_ELEMENTS, inflate_with
from inflate_lib.descriptors import describe
from inflate_lib.mechanics.inflation import ELEMENTS
from inflate_lib.structures.labels import THRESHOLD, label_image

_THRESHOLDS = (THRESHOLD, 0.4, 0.6)


@dataclass(frozen=True)
class _Setting:
    """What a simulation may be made with instead of the default."""

    threshold: float = THRESHOLD
    pad: bool = True
    element: str = "mean-dilatation"
    refine: int = 1


#: The calibration study: the default first, then every element, threshold and padding, and finer meshes.
SETTINGS = (
    *(_Setting(level, pad, element) for element in ALL_ELEMENTS for level in _THRESHOLDS for pad in (True, False)),
    *(_Setting(threshold, True, element, 2) for element in ELEMENTS for threshold in _THRESHOLDS),
    *(_Setting(pad=False, element=element, refine=2) for element in ELEMENTS),
    _Setting(element="stabilised", refine=2),
    *(_Setting(element=element, refine=4) for element in ELEMENTS),
)


def simulate_setting(images, setting, n_jobs=1):
    """Height, width and hull area at full pressure, (n, 3), of images simulated with a `_Setting`.

    One load step, since the end does not depend on their number. NaN where an image gives no structure (an unpadded
    cavity may be open, see :func:`inflate_lib.structures.is_open`) or no equilibrium was found.
    """
    return np.array(Parallel(n_jobs=n_jobs, batch_size=16)(delayed(_sizes)(image, setting) for image in images))


def _sizes(image, setting):
    try:
        label = label_image(image, threshold=setting.threshold, pad=setting.pad)
        result = inflate_with(label, setting.element, n_steps=1, refine=setting.refine)
    except ValueError:
        return [np.nan] * 3
    if not result.converged:
        return [np.nan] * 3
    shape = describe(result)
    return [shape.height, shape.width, shape.hull_area]
