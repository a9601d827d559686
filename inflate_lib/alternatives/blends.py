"""New structures between others: blends of two, by the signed distances from their borders."""

import numpy as np
from scipy.ndimage import distance_transform_edt, zoom

from inflate_lib._checks import whole_number
from inflate_lib.structures.labels import FRAME, THRESHOLD

_FINER = 4  # pixels of the distances that are blended, per pixel of the image
_THICKER = 0.15  # pixels by which a blend grows or shrinks besides: standard deviation


def blend(images: np.ndarray, n: int, seed: int = 0) -> np.ndarray:
    """New structures between two others: the signed distances from their borders are averaged, with a random weight.

    They have to be simulated like any other; :mod:`inflate_lib.alternatives.surrogate` learns from them.

    Parameters
    ----------
    images : array (m, 28, 28)
        uint8, or float in [0, 1]. The two that are blended are drawn from them at random.
    n : int
        How many blends.
    seed : int
        Of the draw.

    Returns
    -------
    uint8 array (n, 28, 28); the border is one pixel wide, as in a drawn digit.
    """
    whole_number("n", n, 1)
    whole_number("seed", seed, 0)
    images = np.asarray(images)
    bright = images / 255 if images.dtype == np.uint8 else images
    distances = np.array([_signed_distance(image) for image in bright], np.float32)
    draw, blends = np.random.default_rng([seed, 11]), np.empty((n, FRAME, FRAME), np.uint8)
    for number in range(n):
        one, other = distances[draw.integers(len(distances), size=2)]
        share = draw.uniform(0.2, 0.8)
        distance = share * one + (1 - share) * other + draw.normal(0, _THICKER)
        fine = (distance + 0.5).clip(0, 1).reshape(FRAME, _FINER, FRAME, _FINER)
        blends[number] = np.round(255 * fine.mean(axis=(1, 3)))
    return blends


def _signed_distance(image):
    """Distance from the border of a digit (28, 28) in pixels, positive inside, on a finer grid."""
    inside = zoom(image, _FINER, order=1) > THRESHOLD
    return (distance_transform_edt(inside) - distance_transform_edt(~inside)) / _FINER
