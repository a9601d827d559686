"""More training pairs without more simulations (Fig. 4): mirror images and shifts that change no descriptor's worth.

A *variant* is a row ``(structure, flip, shift_x, shift_y)`` of integers: take image number ``structure``, mirror it
left to right if ``flip`` is 1, then move it ``shift_x`` pixels to the right and ``shift_y`` pixels down (negative: left
and up). A variant is allowed where the whole structure, wall included, stays inside the frame. Whatever the shift, the
label image is moved back to the bottom edge, so the simulated structure is the same up to its horizontal position.
"""

import numpy as np

from inflate_lib._checks import whole_number
from inflate_lib.structures.labels import FRAME, THICKNESS, as_grey, main_component

MAX_SHIFT = 3
PAPER_SAMPLES = 71_616


def augment(images: np.ndarray, n_samples: int | None = None, seed: int = 0, max_shift: int = MAX_SHIFT) -> np.ndarray:
    """Choose variants of grey images or label images: every original first, then others drawn at random.

    Parameters
    ----------
    images : array (n, 28, 28)
        uint8, or float in [0, 1].
    n_samples : int, optional
        How many variants in all (the paper: 71,616); ``None`` means every allowed one.
    seed : int
        For the draw, which is uniform over the allowed variants, without repetition.
    max_shift : int
        Largest shift in pixels, in each direction.

    Returns
    -------
    int array (m, 4) with the columns structure, flip, shift_x, shift_y. The first n rows are the originals, in order,
    even where an original's wall would leave the frame (`label_image` moves it back inside).

    Raises
    ------
    ValueError
        Where ``n_samples`` is smaller than the number of images or larger than the number of allowed variants, or an
        image holds no structure.
    """
    whole_number("max_shift", max_shift, 0, FRAME)
    whole_number("seed", seed, 0)
    whole_number("n_samples", n_samples, 1, optional=True)
    variants = _allowed_variants(_structure_boxes(images), max_shift)
    n_images = len(images)
    originals, others = variants[:n_images], variants[n_images:]
    if n_samples is None:
        return variants
    if not n_images <= n_samples <= len(variants):
        raise ValueError(
            f"n_samples is {n_samples}; these {n_images} structures allow {n_images} (the originals alone) to "
            f"{len(variants)} (every flip and shift of up to {max_shift} pixels)"
        )
    drawn = np.random.default_rng(seed).choice(len(others), n_samples - n_images, replace=False)
    return np.concatenate([originals, others[np.sort(drawn)]])


def _allowed_variants(boxes, max_shift=MAX_SHIFT):
    """Every variant that keeps a box inside the frame, (m, 4); the originals first, then in order of structure.

    ``boxes`` is (n, 4): first row, last row, first column, last column of each structure, in pixels.
    """
    top, bottom, left, right = np.asarray(boxes).T[:, :, None, None, None]
    shifts = np.arange(-max_shift, max_shift + 1)
    flip, shift_x, shift_y = np.meshgrid([0, 1], shifts, shifts, indexing="ij")
    left, right = np.where(flip, FRAME - 1 - right, left), np.where(flip, FRAME - 1 - left, right)
    inside_x = (left + shift_x >= 0) & (right + shift_x < FRAME)
    inside_y = (top + shift_y >= 0) & (bottom + shift_y < FRAME)
    is_original = (flip == 0) & (shift_x == 0) & (shift_y == 0)
    structure, *where = np.nonzero(inside_x & inside_y & ~is_original)
    others = np.column_stack([structure, *(values[tuple(where)] for values in (flip, shift_x, shift_y))])
    originals = np.zeros((len(boxes), 4), int)
    originals[:, 0] = np.arange(len(boxes))
    return np.concatenate([originals, others])


def _structure_boxes(images, wall=THICKNESS):
    """Where each structure (digit and wall) lies before it is moved: first and last row and column, int (n, 4).

    The wall may reach beyond the frame: a first row of -1 or a last one of 28 says so.
    """
    boxes = np.empty((len(images), 4), int)
    for number, image in enumerate(images):
        try:
            digit = main_component(as_grey(image))
        except ValueError as error:
            raise ValueError(f"image number {number}: {error}") from error
        rows, columns = np.flatnonzero(digit.any(axis=1)), np.flatnonzero(digit.any(axis=0))
        boxes[number] = rows[0] - wall, rows[-1] + wall, columns[0] - wall, columns[-1] + wall
    return boxes


def apply_variants(images: np.ndarray, variants: np.ndarray, repeat_edge: bool = False) -> np.ndarray:
    """The images that the variants stand for, (m, 28, 28), in the type of ``images`` (n, 28, 28).

    Pixels that come from beyond the frame are 0, or with `repeat_edge` those of its edge.
    """
    images, variants = np.asarray(images), np.asarray(variants)
    structure, flip, shift_x, shift_y = variants.T
    pixels = np.arange(FRAME)
    row = pixels - shift_y[:, None]  # which row of the original lands here
    column = pixels - shift_x[:, None]
    row_inside, column_inside = (0 <= row) & (row < FRAME), (0 <= column) & (column < FRAME)
    column = np.where(flip[:, None] == 1, FRAME - 1 - column, column)
    row, column = row.clip(0, FRAME - 1), column.clip(0, FRAME - 1)
    moved = images[structure[:, None, None], row[:, :, None], column[:, None, :]]
    if not repeat_edge:
        moved[~(row_inside[:, :, None] & column_inside[:, None, :])] = 0
    return moved


def augment_descriptors(matrix: np.ndarray, mirrored: np.ndarray, variants: np.ndarray) -> np.ndarray:
    """Descriptors of the variants, (m, N): those of the original, whatever its shift, or of its mirror image.

    Parameters
    ----------
    matrix, mirrored : (n, N) array_like
        Of the originals, and of their mirror images (:meth:`inflate_lib.descriptors.Descriptor.mirrored`).
    variants : (m, 4) int
    """
    structure, flip = np.asarray(variants)[:, :2].T
    return np.where(flip[:, None] == 1, np.asarray(mirrored)[structure], np.asarray(matrix)[structure])
