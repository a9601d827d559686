"""Where the images of digits come from: MNIST, or the small embedded set of scikit-learn.

MNIST is looked for in the folder that ``INFLATE_MNIST_DIR`` names, and what is read there is kept in the cache; without
such a folder it is looked for in the cache, and downloaded into it once from a public mirror. Every time the SHA-256 of
the decompressed bytes must be the published one, or the file is not used. Where no mirror can be reached,
``source="auto"`` falls back to the 1797 digits (179 sevens) that ship with scikit-learn, aloud; a folder that cannot be
read or a cache that cannot be written is an error, never a reason for other data.
"""

import gzip
import hashlib
import io
import os
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from inflate_lib import paths
from inflate_lib._cache import writing
from inflate_lib._checks import choice, whole_number
from inflate_lib._files import draft
from inflate_lib.structures.labels import FRAME

SOURCES = ("auto", "mnist", "digits")
CHOSEN = "INFLATE_SOURCE"  # set by --source: what "auto" is to mean
_SHA256 = {  # of the decompressed files
    "train-images-idx3-ubyte": "ba891046e6505d7aadcbbe25680a0738ad16aec93bde7f9b65e87a2fc25776db",
    "train-labels-idx1-ubyte": "65a50cbbf4e906d70832878ad85ccda5333a97f0f4c3dd2ef09a8a9eef7101c5",
    "t10k-images-idx3-ubyte": "0fa7898d509279e482958e8ce81c8e77db3f2f8254e26661ceb7762c4d494ce7",
    "t10k-labels-idx1-ubyte": "ff7bcfd416de33731a308c3f266cc351222c34898ecbeaf847f06e48f7ec33f2",
}
_FILES = tuple(_SHA256)[:2]  # images, labels: the training digits
_TEST_FILES = tuple(_SHA256)[2:]
_MIRRORS = (
    "https://ossci-datasets.s3.amazonaws.com/mnist/",
    "https://storage.googleapis.com/cvdf-datasets/mnist/",
)
_TIMEOUT = (4, 10)  # seconds to connect, seconds without a byte

_network_failure = None  # remembered, so that one process waits for a dead network only once


@dataclass(frozen=True)
class Digits:
    """Grey images, ``images`` (n, 28, 28) uint8, which digit each one is, ``labels`` (n,), and where they come from."""

    images: np.ndarray
    labels: np.ndarray
    source: str
    description: str

    def __len__(self):
        return len(self.images)


def resolve_source(source: str = "auto") -> str:
    """The source that ``source`` stands for: ``"mnist"`` or ``"digits"``.

    ``"auto"`` is what the environment variable ``INFLATE_SOURCE`` names; without it MNIST where it can be had, else the
    embedded digits, and then it says so on standard output. Once ``INFLATE_MNIST_DIR`` is set it must hold the files: a
    missing or wrong one is an error, never a silent fallback.
    """
    if source == "auto":
        source = os.environ.get(CHOSEN) or source
    choice("source", source, SOURCES)
    if source != "auto":
        return source
    try:
        for name in _FILES:
            _locate(name)
    except ConnectionError as error:
        print(f"{error}\nUsing the embedded scikit-learn digits instead of MNIST.")
        return "digits"
    return "mnist"


def load_sevens(source: str = "auto", limit: int | None = None) -> Digits:
    """Load the sevens of MNIST or of the embedded digits: ``load_digits((7,), source, limit)``."""
    return load_digits((7,), source, limit)


def load_digits(
    digits: str | Sequence[int] = "all", source: str = "auto", limit: int | None = None, test: bool = False
) -> Digits:
    """Load digits of MNIST, or the embedded ones.

    Parameters
    ----------
    digits : "all", or numbers from 0 to 9
        Which ones; they come in the order of the files.
    source : {"auto", "mnist", "digits"}
        See :func:`resolve_source`.
    limit : int, optional
        Keep the first ``limit``. More than there are means all of them, with a line that says so.
    test : bool
        MNIST's 10,000 test digits in place of its 60,000 training digits.

    Raises
    ------
    FileNotFoundError
        ``INFLATE_MNIST_DIR`` names no folder, or one that lacks a file.
    ValueError
        A file is corrupt, truncated or not MNIST's; or an argument is out of range.
    CacheError
        The cache, where the files are kept, cannot be written.
    ConnectionError
        ``source="mnist"``, no folder is named and no mirror delivers.
    """
    whole_number("limit", limit, 1, optional=True)
    wanted = set(range(10) if isinstance(digits, str) and digits == "all" else np.ravel(digits).tolist())
    if not wanted or not wanted <= set(range(10)):
        raise ValueError(f"digits must be 'all' or numbers from 0 to 9, not {digits!r}")
    source = resolve_source(source)
    if test and source != "mnist":
        raise ValueError("only MNIST has test digits: choose the source mnist, or the training digits")
    images, labels = _mnist(_TEST_FILES if test else _FILES) if source == "mnist" else _embedded()
    name = "sevens" if wanted == {7} else "digits"
    if wanted != {7} and len(wanted) < 10:
        name += " " + ", ".join(map(str, sorted(wanted)))
    description = f"MNIST {'test' if test else 'training'} {name}" if source == "mnist" else "scikit-learn digits"
    rows = np.flatnonzero(np.isin(labels, list(wanted)))
    if limit is not None and limit > len(rows):
        print(f"{limit} {name} were asked for; {description} are {len(rows)}, so all of them are used.")
    images, labels = images[rows[:limit]], labels[rows[:limit]]
    return Digits(images if source == "mnist" else np.stack([*map(_like_mnist, images)]), labels, source, description)


def at_hand(source: str) -> bool:
    """Whether the training images of a source are here, so that nothing would have to be downloaded."""
    return source == "digits" or bool(os.environ.get("INFLATE_MNIST_DIR")) or all(map(_is_kept, _FILES))


def _mnist(files):
    """All images and labels of a pair of files."""
    images, labels = map(_read, files)
    pixels = np.frombuffer(images, np.uint8, offset=16)
    return pixels.reshape(-1, FRAME, FRAME), np.frombuffer(labels, np.uint8, offset=8)


def _locate(name):
    """Path of one MNIST file: in the user's folder if one is named, else in the cache, downloaded if need be."""
    named = os.environ.get("INFLATE_MNIST_DIR")
    if not named:
        return _download(name)
    folder = Path(named).expanduser()
    if not folder.is_dir():  # a relative name is meant from the checkout, too: notebooks run in folders of their own
        folder = paths.ROOT / folder
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        raise FileNotFoundError(
            f"INFLATE_MNIST_DIR is {named}, which {what}. Let it name the folder with MNIST's files, or unset it to "
            "download them."
        )
    for candidate in (Path(folder, name), Path(folder, name + ".gz")):
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(
        f"INFLATE_MNIST_DIR is {named}, but there is no {name} or {name}.gz in it. Put MNIST's four files there, or "
        "unset INFLATE_MNIST_DIR to download them."
    )


def _read(name):
    """The decompressed bytes of an MNIST file, kept in the cache from now on; or a ValueError that names the file."""
    path = _locate(name)
    try:
        content = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ValueError(f"{path} is corrupt or truncated ({error}). Delete it and fetch it again.") from error
    found = hashlib.sha256(content).hexdigest()
    if found != _SHA256[name]:
        raise ValueError(
            f"{path} is not MNIST's {name}, or it is damaged: the SHA-256 of its {len(content)} decompressed bytes is "
            f"{found}, not {_SHA256[name]}. Replace it."
        )
    if not _is_kept(name):
        with writing(), draft(_kept(name)) as place:
            place.write_bytes(content)
    return content


def _kept(name):
    """Where the cache has a file."""
    return paths.CACHE / "mnist" / name


def _is_kept(name):
    """Whether the cache has the very bytes."""
    path = _kept(name)
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest() == _SHA256[name]


def _download(name):
    """Path of one file in the cache, fetched where it is not there. The cache is opened first, and may not fail."""
    global _network_failure
    if _is_kept(name):
        return _kept(name)
    with writing(), draft(_kept(name)) as place:
        if _network_failure:
            raise ConnectionError(_network_failure)
        failures = []
        for mirror in _MIRRORS:
            try:
                content = _fetch(f"{mirror}{name}.gz", _SHA256[name])
            # an unreachable mirror, or one that answers with something else
            except (OSError, EOFError, zlib.error, ValueError) as error:
                failures.append(f"{mirror}: {type(error).__name__}")
            else:
                place.write_bytes(content)
                return _kept(name)
        _network_failure = (
            f"MNIST's {name} could not be downloaded ({'; '.join(failures)}). Set INFLATE_MNIST_DIR to a folder that "
            "holds MNIST's files."
        )
        raise ConnectionError(_network_failure)


def _fetch(url, sha256):
    """The decompressed bytes behind an address, in memory: whatever fails here is the network's."""
    with warnings.catch_warnings():  # of tqdm, which pooch would use and which misses widgets in a notebook
        warnings.simplefilter("ignore")
        import pooch
    zipped = io.BytesIO()
    pooch.get_logger().setLevel("WARNING")
    pooch.HTTPDownloader(timeout=_TIMEOUT)(url, zipped, None)
    content = gzip.decompress(zipped.getvalue())
    if hashlib.sha256(content).hexdigest() != sha256:
        raise ValueError(f"{url} has other bytes than it should")
    return content


def _embedded():
    """All images of scikit-learn, 8×8 in [0, 1], and their labels."""
    from sklearn.datasets import load_digits

    digits = load_digits()
    return digits.images / 16, digits.target.astype(np.uint8)


def _like_mnist(image):
    """An 8×8 image in [0, 1] the way MNIST was made: 20×20 box, aspect kept, centre of mass in the middle of 28×28."""
    from skimage.transform import resize

    rows, columns = np.nonzero(image)
    crop = image[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    shape = np.rint(np.array(crop.shape) * 20 / max(crop.shape)).astype(int)
    digit = np.clip(resize(crop, shape, order=3, mode="constant"), 0, 1)
    centre = np.array([np.sum(axis * digit) for axis in np.indices(shape)]) / digit.sum()
    top, left = np.clip(np.rint((FRAME - 1) / 2 - centre).astype(int), 0, FRAME - shape)
    frame = np.zeros((FRAME, FRAME), np.uint8)
    frame[top : top + shape[0], left : left + shape[1]] = np.rint(255 * digit)
    return frame
