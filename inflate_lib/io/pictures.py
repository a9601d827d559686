"""From an inflated structure to what mechanicians look at: a picture, an animation, a ParaView series."""

import io
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps, ImageSequence, UnidentifiedImageError

from inflate_lib._checks import choice, positive_number
from inflate_lib._files import hand_out
from inflate_lib.mechanics import stress
from inflate_lib.mechanics.inflation import Inflation
from inflate_lib.mechanics.stress import QUANTITIES
from inflate_lib.structures.labels import FRAME

_ONE_PICTURE = ("MPO", "PSD")  # formats whose frames are views or layers of the same picture


#: Endings of pictures that can be written; capitals are as good.
PICTURES = (".png", ".svg", ".pdf", ".jpg", ".jpeg", ".tif", ".tiff")


def reached_steps(result):
    """Number of load steps that have an equilibrium; the first ones.

    Raises
    ------
    ValueError
        Where there is none, and so nothing to show.
    """
    n = int(np.isfinite(result.displacement).all(axis=(1, 2)).sum())
    if n == 0:
        raise ValueError(f"nothing to export: {result.reason}")
    return n


def write_picture(result: Inflation, path: str | Path, quantity: str = "von-mises") -> Path:
    """Picture of the undeformed and the deformed structure, coloured by a quantity.

    Parameters
    ----------
    result : Inflation
        At the last load step that has an equilibrium.
    path : path_like
        Its end says what it becomes, see `PICTURES`.
    quantity : {"von-mises", "stretch"}

    Returns
    -------
    Path

    Raises
    ------
    ValueError
        For an unknown quantity or suffix, and where no load step has an equilibrium.
    OSError
        Where the file cannot be written, or would replace one that is not as this library wrote it; nothing is left
        behind then.
    """
    import matplotlib.pyplot as plt

    from inflate_lib.plotting import in_style
    from inflate_lib.plotting.mechanics import plot_inflation

    steps = reached_steps(result)
    values, label = _coloured(result, quantity)
    path = with_ending(path, *PICTURES)
    with in_style():
        fig = plot_inflation(result, values[1:], label, steps - 1)
        try:
            drawn = io.BytesIO()  # where the disk is full, a PDF that is being written fails in a way of its own
            fig.savefig(drawn, format=path.suffix.lower()[1:])
            with hand_out(path) as place:
                place.write_bytes(drawn.getvalue())
        finally:
            plt.close(fig)
    return path


def write_animation(
    result: Inflation, path: str | Path, quantity: str = "von-mises", frames_per_second: int = 5
) -> Path:
    """Animated GIF of the load steps, from the undeformed structure to the last equilibrium; same arguments."""
    import matplotlib.pyplot as plt
    from matplotlib.animation import PillowWriter

    from inflate_lib.plotting import in_style
    from inflate_lib.plotting.mechanics import animate_inflation

    positive_number("frames_per_second", frames_per_second)
    steps = reached_steps(result)
    values, label = _coloured(result, quantity)
    path = with_ending(path, ".gif")
    with in_style():
        fig, animation = animate_inflation(result, values, label, steps)
        try:
            with hand_out(path) as place:
                animation.save(place, writer=PillowWriter(fps=frames_per_second), dpi=90)
        finally:
            plt.close(fig)
    return path


def _coloured(result, quantity):
    """Values (steps + 1, m) of a quantity, the undeformed state first, and its label."""
    function, label, at_rest = QUANTITIES[choice("colour", quantity, QUANTITIES)]
    values = getattr(stress, function)(result)
    return np.concatenate([np.full_like(values[:1], at_rest), values]), label


def with_ending(path, *endings):
    """`path` as a Path; a ValueError where it has none of the endings, in whatever case."""
    path = Path(path)
    if path.suffix.lower() not in endings:
        raise ValueError(f"{path}: the name must end with {' or '.join(endings)}")
    return path


def read_images(path: str | Path, resize: bool = False, invert: bool = False) -> tuple[np.ndarray, str]:
    """Images in a file, as (n, 28, 28) uint8 or float, and a note on what was done to them.

    Parameters
    ----------
    path : path_like
        A picture (PNG, …: white structure on black), several pages or an animation of them, or ``.npy`` with
        (28, 28) or (n, 28, 28) numbers.
    resize : bool
        Fit a picture of another size into 28 × 28: the longer side to 28 pixels, centred on black.
    invert : bool
        For a black structure on white.

    Raises
    ------
    ValueError
        Naming the file, where it cannot be read or has another size and `resize` is off.
    """
    path = Path(path)
    note = ""
    if path.suffix.lower() == ".npy":
        images = _read_array(path)
    else:
        pages, note = read_pages(path)
        if len({page.shape for page in pages}) > 1:
            raise ValueError(f"{path} holds {len(pages)} pictures of different sizes; save each in a file of its own")
        images = np.array(pages)
        height, width = images.shape[1:]
        if (height, width) != (FRAME, FRAME):
            if not resize:
                raise ValueError(f"{path} is {width} × {height} pixels; {FRAME} × {FRAME} is needed (--resize fits it)")
            note = f"resized from {width} × {height}" + f", {note}" * bool(note)
    if invert:  # before the frame is filled up with black
        images = _inverted(images)
    if images.shape[1:] != (FRAME, FRAME):
        images = np.array([_fitted(image) for image in images])
    return images, note


def read_pages(path: str | Path) -> tuple[list[np.ndarray], str]:
    """The pictures in a file, each (height, width) uint8 grey and upright, and a note on what was not read.

    These are the pages of a TIFF and the frames of an animation. A file of several views of one scene (MPO, as some
    cameras write it) or of layers (PSD) is one picture, its first view or what the layers make together. Turned is what
    the EXIF tag of the orientation says to turn.

    Raises
    ------
    ValueError
        Naming the file, where there is no picture in it.
    """
    try:
        # As a stream: of a path Pillow maps raw TIFFs into memory, those that lie on their side with the wrong rows.
        with open(path, "rb") as stream, Image.open(stream) as file:
            n_frames = getattr(file, "n_frames", 1)
            if file.format in _ONE_PICTURE:
                return [_grey(file)], f"the first of {n_frames} views" * (file.format == "MPO")
            return [_grey(frame) for frame in ImageSequence.Iterator(file)], ""
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist") from None
    except _NotGrey as error:
        raise ValueError(f"{path} {error}") from None
    except UnidentifiedImageError:
        raise ValueError(f"{path} cannot be read as a picture: it has no format that Pillow knows") from None
    except Exception as error:  # whatever a decoder of Pillow meets in a damaged file
        raise ValueError(f"{path} cannot be read as a picture: {in_one_line(error)}") from None


class _NotGrey(ValueError):
    """Why a picture has no grey values that are known to go from black to white."""


def _grey(picture):
    """One picture as (height, width) uint8, upright."""
    tags = getattr(picture, "tag_v2", {})  # of a TIFF: 258 is the number of bits, 262 is 1 where black is zero
    deep = picture.mode.startswith("I;16") and tags.get(258, 16) in (16, (16,)) and tags.get(262, 1) == 1
    if picture.mode.startswith(("I", "F")) and not deep:
        raise _NotGrey("has grey values whose range is not known; convert it to 8-bit grey")
    clear = picture.info.get("transparency")
    picture, transparent = ImageOps.exif_transpose(picture), False
    if deep:
        grey = np.asarray(picture)
        transparent = clear is not None and (grey == clear).any()
        grey = np.rint(grey / 257).astype(np.uint8)  # 65535 becomes 255; what is brighter than half remains so
    else:
        if picture.has_transparency_data:
            picture = picture.convert("RGBA")
            transparent = picture.getchannel("A").getextrema()[0] < 255
        grey = np.array(picture.convert("L"))
    if transparent:
        raise _NotGrey("is partly transparent; say what is behind it by saving it without alpha")
    return grey


def _read_array(path):
    """The array (n, 28, 28) in a .npy file."""
    try:
        images = np.load(path, allow_pickle=False)
        if not isinstance(images, np.ndarray):
            raise ValueError("it holds several arrays")
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"{path} cannot be read as a NumPy array: {in_one_line(error)}") from None
    images = images[None] if images.ndim == 2 else images
    if images.ndim != 3 or images.shape[1:] != (FRAME, FRAME) or not len(images):
        raise ValueError(f"{path} holds an array of shape {images.shape}, not ({FRAME}, {FRAME}) or a stack")
    return images


def _inverted(images):
    """Black for white; what is no image of known range is left as it is, to be refused as that."""
    if images.dtype == bool:
        return ~images
    if images.dtype == np.uint8:
        return 255 - images
    known = images.dtype.kind == "f" and images.min() >= 0 and images.max() <= 1
    return 1 - images if known else images


def _fitted(grey):
    """A grey image in 28 × 28: its longer side scaled to 28 pixels, centred on black."""
    height, width = grey.shape
    scale = FRAME / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    method = Image.Resampling.BOX if scale < 1 else Image.Resampling.BICUBIC
    small = np.asarray(Image.fromarray(grey).resize(size, method))
    fitted = np.zeros((FRAME, FRAME), dtype=np.uint8)
    top, left = (FRAME - small.shape[0]) // 2, (FRAME - small.shape[1]) // 2
    fitted[top : top + small.shape[0], left : left + small.shape[1]] = small
    return fitted


def in_one_line(error):
    """An error in one line."""
    return " ".join(str(error).split()) or type(error).__name__
