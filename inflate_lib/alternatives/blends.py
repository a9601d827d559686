"""New structures between others: blends of two, by the signed distances from their borders.

:func:`blend` makes a few at once; :class:`Family` is as large as one likes, and makes each when it is asked for.
"""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import distance_transform_edt, zoom

from inflate_lib._checks import whole_number
from inflate_lib.structures.augmentation import apply_variants, augment
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
        blends[number] = _blended(distances[draw.integers(len(distances), size=2)], draw)
    return blends


class Family(Sequence):
    """Digits, and after them `n` blends of two of them, each mirrored or not and shifted by up to three pixels.

    An item is an image, (28, 28) uint8. That of number ``len(images) + k`` depends on `seed` and k alone: it is made
    when it is asked for, so that a family of a million takes no more memory than its digits.

    Parameters
    ----------
    images : (m, 28, 28) uint8
    n : int
        How many blends.
    seed : int
    """

    def __init__(self, images: np.ndarray, n: int, seed: int = 0) -> None:
        self.images = images
        self.n, self.seed = whole_number("n", n, 0), whole_number("seed", seed, 0)
        if n and len(images) < 2:
            raise ValueError(f"blends are made of two digits, and there is {len(images)}: ask for more structures")

    def __len__(self) -> int:
        return len(self.images) + self.n

    def __getitem__(self, number):
        if number < len(self.images):
            return self.images[number]
        if number >= len(self):
            raise IndexError(f"number {number} of a family of {len(self)}")
        draw = np.random.default_rng([self.seed, 12, number - len(self.images)])
        pair = self.images[draw.integers(len(self.images), size=2)]
        image = _blended([_signed_distance(one / 255) for one in pair], draw)[None]
        try:
            variants = augment(image)
        except ValueError:  # two that have nothing in common: a data set says so
            return image[0]
        return apply_variants(image, variants[draw.integers(len(variants), size=1)])[0]


def _blended(distances, draw):
    """A blend of two digits given by their distances, with a share and a thickness that are drawn: (28, 28) uint8."""
    one, other = distances
    share = draw.uniform(0.2, 0.8)
    distance = share * one + (1 - share) * other + draw.normal(0, _THICKER)
    fine = (distance + 0.5).clip(0, 1).reshape(FRAME, _FINER, FRAME, _FINER)
    return np.round(255 * fine.mean(axis=(1, 3))).astype(np.uint8)


def _signed_distance(image):
    """Distance from the border of a digit (28, 28) in pixels, positive inside, on a finer grid."""
    inside = zoom(image, _FINER, order=1) > THRESHOLD
    return (distance_transform_edt(inside) - distance_transform_edt(~inside)) / _FINER
