"""Images of digits: MNIST files good and bad, no network, and the embedded digits."""

import errno
import gzip
import hashlib
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from sklearn import datasets

from inflate_lib import paths
from inflate_lib._cache import CacheError
from inflate_lib.structures import sources
from inflate_lib.structures.sources import _FILES, _TEST_FILES, at_hand, load_digits, load_sevens, resolve_source

IMAGES, LABELS = _FILES


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """An empty cache: what is read is kept there."""
    monkeypatch.setattr(paths, "CACHE", tmp_path / "cache")
    return tmp_path / "cache" / "mnist"


@pytest.fixture
def small_mnist(tmp_path, monkeypatch):
    """A folder of ten-image IDX files that stand in for MNIST, with their checksums in place of the real ones."""
    pixels = np.random.default_rng(0).integers(0, 256, (10, 28, 28), dtype=np.uint8)
    digits = np.array([7, 0, 7, 1, 2, 7, 3, 4, 7, 9], np.uint8)
    contents = {
        IMAGES: np.array([2051, 10, 28, 28], ">i4").tobytes() + pixels.tobytes(),
        LABELS: np.array([2049, 10], ">i4").tobytes() + digits.tobytes(),
    }
    for name, content in contents.items():
        monkeypatch.setitem(sources._SHA256, name, hashlib.sha256(content).hexdigest())
        (tmp_path / f"{name}.gz").write_bytes(gzip.compress(content))
    monkeypatch.setenv("INFLATE_MNIST_DIR", str(tmp_path))
    return tmp_path, pixels[digits == 7]


@pytest.fixture
def no_folder(monkeypatch):
    """No folder named, and a network of which nothing is known yet."""
    monkeypatch.delenv("INFLATE_MNIST_DIR", raising=False)
    monkeypatch.setattr(sources, "_network_failure", None)


def test_what_is_at_hand_needs_no_download(small_mnist, monkeypatch):
    assert at_hand("digits") and at_hand("mnist")
    load_sevens("mnist")
    monkeypatch.delenv("INFLATE_MNIST_DIR")
    assert at_hand("mnist")  # a copy is in the cache
    (paths.CACHE / "mnist" / LABELS).unlink()
    assert not at_hand("mnist") and at_hand("digits")


def test_sevens_are_picked_in_order(small_mnist):
    _, expected = small_mnist
    assert resolve_source() == "mnist"
    sevens = load_sevens()
    assert np.array_equal(sevens.images, expected)
    assert (sevens.source, sevens.description, len(sevens)) == ("mnist", "MNIST training sevens", 4)
    assert np.array_equal(load_sevens(limit=2).images, expected[:2])


@pytest.mark.parametrize(
    ("wanted", "labels", "description"),
    [
        ("all", [7, 0, 7, 1, 2, 7, 3, 4, 7, 9], "MNIST training digits"),
        ((7,), [7, 7, 7, 7], "MNIST training sevens"),
        ([9, 0, 3], [0, 3, 9], "MNIST training digits 0, 3, 9"),
        (range(3), [0, 1, 2], "MNIST training digits 0, 1, 2"),
        (1, [1], "MNIST training digits 1"),
    ],
)
def test_digits_are_picked_in_order_with_their_labels(small_mnist, wanted, labels, description):
    digits = load_digits(wanted)
    assert digits.labels.tolist() == labels and digits.description == description
    assert np.array_equal(digits.images[digits.labels == 7], small_mnist[1][: labels.count(7)])
    assert load_digits(wanted, limit=1).labels.tolist() == labels[:1]


def test_test_digits_come_from_files_of_their_own(small_mnist, monkeypatch):
    folder, _ = small_mnist
    with pytest.raises(FileNotFoundError, match=_TEST_FILES[0]):
        load_digits("all", test=True)
    pixels, labels = np.full((3, 28, 28), 9, np.uint8), np.array([4, 7, 4], np.uint8)
    contents = np.zeros(16, np.uint8).tobytes() + pixels.tobytes(), np.zeros(8, np.uint8).tobytes() + labels.tobytes()
    for name, content in zip(_TEST_FILES, contents, strict=True):
        (folder / name).write_bytes(content)
        with pytest.raises(ValueError, match=f"{name} is not MNIST's"):
            load_digits("all", test=True)
        monkeypatch.setitem(sources._SHA256, name, hashlib.sha256(content).hexdigest())
    digits = load_digits([4], test=True)
    assert digits.labels.tolist() == [4, 4] and digits.description == "MNIST test digits 4"
    assert (digits.images == 9).all()
    with pytest.raises(ValueError, match="only MNIST has test digits"):
        load_digits("all", "digits", test=True)


def test_all_embedded_digits_have_their_sevens_as_they_were():
    digits, sevens = load_digits("all", "digits"), load_sevens("digits")
    assert len(digits) == 1797 and np.array_equal(digits.images[digits.labels == 7], sevens.images)
    assert (sevens.labels == 7).all()


def test_unzipped_files_do_as_well(small_mnist):
    folder, expected = small_mnist
    for zipped in folder.glob("*.gz"):
        zipped.with_suffix("").write_bytes(gzip.decompress(zipped.read_bytes()))
        zipped.unlink()
    assert np.array_equal(load_sevens().images, expected)


def test_a_folder_is_named_once_and_remembered(small_mnist, monkeypatch):
    folder, expected = small_mnist
    load_sevens("mnist")
    monkeypatch.delenv("INFLATE_MNIST_DIR")
    for file in folder.glob("*.gz"):
        file.unlink()
    asked = serve(monkeypatch, lambda url: pytest.fail("the network was asked"))
    assert resolve_source("auto") == "mnist"
    assert np.array_equal(load_sevens("auto").images, expected)
    assert not asked


def test_what_was_remembered_and_damaged_is_replaced(small_mnist, cache):
    _, expected = small_mnist
    load_sevens()
    flip_a_bit(cache / IMAGES)
    load_sevens()
    assert np.array_equal(np.frombuffer((cache / IMAGES).read_bytes()[16:], np.uint8)[:784], expected[0].ravel())
    assert sorted(path.name for path in cache.iterdir()) == sorted(_FILES)


def test_nothing_damaged_is_remembered(small_mnist, cache):
    folder, _ = small_mnist
    change_a_pixel(folder / f"{IMAGES}.gz")
    with pytest.raises(ValueError, match="is not MNIST's"):
        load_sevens()
    assert not (cache / IMAGES).exists()


def a_file_in_its_place(cache, monkeypatch):
    cache.parent.write_text("a file where the folder should be")


def failing(number):
    """A disk on which no file of the cache can be opened for writing: full, read-only, of somebody else."""

    def damage(cache, monkeypatch):
        def write_bytes(self, content):
            raise OSError(number, os.strerror(number), None if number == errno.ENOSPC else str(self))

        monkeypatch.setattr(Path, "write_bytes", write_bytes)

    return damage


@pytest.mark.parametrize("download", [False, True])
@pytest.mark.parametrize(
    "damage",
    [a_file_in_its_place, *map(failing, (errno.ENOSPC, errno.EROFS, errno.EACCES))],
    ids=["file in the way", "ENOSPC", "EROFS", "EACCES"],
)
def test_a_cache_that_cannot_be_written_is_never_a_reason_for_other_data(
    small_mnist, cache, damage, download, monkeypatch
):
    folder, _ = small_mnist
    if download:
        monkeypatch.delenv("INFLATE_MNIST_DIR")
        monkeypatch.setattr(sources, "_network_failure", None)
        serve(monkeypatch, lambda url: (folder / Path(url).name).read_bytes())
    damage(cache, monkeypatch)
    with pytest.raises((CacheError, OSError), match=re.escape(str(cache.parent))) as raised:
        load_sevens("auto")
    assert not isinstance(raised.value, ConnectionError)


def test_a_cache_in_the_way_is_named_where_there_is_no_network_either(no_folder, cache, monkeypatch):
    def fail(url):
        raise ConnectionError("no network")

    serve(monkeypatch, fail)
    cache.parent.write_text("a file where the folder should be")
    with pytest.raises(CacheError, match="INFLATE_CACHE"):
        load_sevens("auto")


def truncate(path):
    path.write_bytes(path.read_bytes()[:-20])


def flip_a_bit(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def change_a_pixel(path):
    content = bytearray(gzip.decompress(path.read_bytes()))
    content[-1] ^= 1
    path.write_bytes(gzip.compress(content))


def not_gzip(path):
    path.write_bytes(b"<html>404</html>")


def make_empty(path):
    path.write_bytes(b"")


@pytest.mark.parametrize("source", ["auto", "mnist"])
@pytest.mark.parametrize("name", _FILES)
@pytest.mark.parametrize("damage", [truncate, flip_a_bit, change_a_pixel, not_gzip, make_empty])
def test_damaged_files_are_named_and_not_used(small_mnist, damage, name, source):
    folder, _ = small_mnist
    damage(folder / f"{name}.gz")
    with pytest.raises(ValueError, match=f"{name}.gz is (corrupt|not MNIST)"):
        load_sevens(source)


def test_swapped_files_are_refused(small_mnist):
    folder, _ = small_mnist
    shutil.copy(folder / f"{LABELS}.gz", folder / f"{IMAGES}.gz")
    with pytest.raises(ValueError, match=IMAGES):
        load_sevens()


@pytest.mark.parametrize("call", [resolve_source, load_sevens])
def test_missing_file_is_an_error_and_no_fallback(small_mnist, call):
    folder, _ = small_mnist
    (folder / f"{LABELS}.gz").unlink()
    with pytest.raises(FileNotFoundError, match=f"INFLATE_MNIST_DIR.*{LABELS}"):
        call("auto")


def test_relative_folder_is_found_from_the_checkout_as_well(small_mnist, monkeypatch):
    folder, expected = small_mnist
    monkeypatch.setattr(paths, "ROOT", folder.parent)
    monkeypatch.setenv("INFLATE_MNIST_DIR", folder.name)
    assert np.array_equal(load_sevens("mnist").images, expected)


@pytest.mark.parametrize("source", ["auto", "mnist"])
def test_missing_folder_is_named(source, tmp_path, monkeypatch):
    monkeypatch.setenv("INFLATE_MNIST_DIR", "/nowhere/mnist")
    with pytest.raises(FileNotFoundError, match="/nowhere/mnist, which does not exist"):
        load_sevens(source)
    (tmp_path / "mnist.zip").write_text("")
    monkeypatch.setenv("INFLATE_MNIST_DIR", str(tmp_path / "mnist.zip"))
    with pytest.raises(FileNotFoundError, match=r"mnist.zip, which is a file"):
        load_sevens(source)


def serve(monkeypatch, answer):
    """Replace the network: ``answer(url)`` gives bytes or raises. Returns the list of addresses asked for."""
    asked = []

    class Downloader:
        def __init__(self, **options):
            assert max(options["timeout"]) <= 10

        def __call__(self, url, output_file, pooch_instance):
            asked.append(url)
            output_file.write(answer(url))

    monkeypatch.setattr("pooch.HTTPDownloader", Downloader)
    return asked


def test_no_network_means_digits_aloud_and_is_remembered(no_folder, monkeypatch, capsys):
    def fail(url):
        raise ConnectionError("no network")

    asked = serve(monkeypatch, fail)
    sevens = load_sevens("auto")
    assert (sevens.source, len(sevens)) == ("digits", 179)
    assert "embedded scikit-learn digits instead of MNIST" in capsys.readouterr().out
    assert len(asked) == 2  # each mirror once
    assert resolve_source() == "digits"
    with pytest.raises(ConnectionError, match="INFLATE_MNIST_DIR"):
        load_sevens("mnist")
    assert len(asked) == 2


def test_second_mirror_serves_when_the_first_one_lies(small_mnist, no_folder, monkeypatch):
    folder, expected = small_mnist

    def answer(url):
        if url.startswith(sources._MIRRORS[0]):
            return gzip.compress(b"something else") if "images" in url else b"<html>log in first</html>"
        return (folder / Path(url).name).read_bytes()

    asked = serve(monkeypatch, answer)
    assert np.array_equal(load_sevens("mnist").images, expected)
    assert len(asked) == 4
    assert np.array_equal(load_sevens("auto").images, expected)
    assert len(asked) == 4  # now from the cache
    assert sorted(path.name for path in (paths.CACHE / "mnist").iterdir()) == sorted(_FILES)


def test_damaged_cache_is_downloaded_again(small_mnist, no_folder, monkeypatch):
    folder, expected = small_mnist
    asked = serve(monkeypatch, lambda url: (folder / Path(url).name).read_bytes())
    load_sevens("mnist")
    (paths.CACHE / "mnist" / IMAGES).write_bytes(b"damaged")
    assert np.array_equal(load_sevens("mnist").images, expected)
    assert len(asked) == 3


def test_embedded_digits_look_like_mnist():
    sevens = load_sevens("digits")
    assert sevens.images.shape == (179, 28, 28) and sevens.images.dtype == np.uint8
    assert sevens.description == "scikit-learn digits"
    digits = datasets.load_digits()
    for image, small in zip(sevens.images, digits.images[digits.target == 7], strict=True):
        rows, columns = np.nonzero(image)
        assert max(np.ptp(rows), np.ptp(columns)) + 1 <= 20
        centre = np.array([np.sum(axis * image) for axis in np.indices((28, 28))]) / image.sum()
        assert np.all(np.abs(centre - 13.5) <= 0.51)
        height, width = (np.ptp(np.nonzero(small.any(axis=axis))[0]) + 1 for axis in (1, 0))
        assert width / height == pytest.approx((np.ptp(columns) + 1) / (np.ptp(rows) + 1), abs=0.16)


def test_asking_for_more_than_there_are_gives_all_and_says_so(capsys):
    assert len(load_sevens("digits", limit=1000)) == 179
    assert "1000 sevens were asked for" in capsys.readouterr().out
    assert len(load_sevens("digits", limit=179)) == 179
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("digits", [(), "", "sevens", "037", 10, -1, (3, 12), ("3",), None, 1.5])
def test_what_is_no_digit_is_refused(digits):
    with pytest.raises(ValueError, match="digits must be 'all' or numbers from 0 to 9, not"):
        load_digits(digits, "digits")


@pytest.mark.parametrize("arguments", [{"limit": 0}, {"limit": -3}, {"limit": 2.5}, {"source": "emnist"}])
def test_arguments_out_of_range_are_refused(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        load_sevens(**{"source": "digits", **arguments})


@pytest.mark.mnist
def test_mnist_has_6265_training_sevens():
    if resolve_source() != "mnist":
        pytest.skip("MNIST cannot be had: its files are not checked")
    sevens = load_sevens("mnist")
    assert sevens.images.shape == (6265, 28, 28) and sevens.images.dtype == np.uint8
    digits = load_digits("all", "mnist")
    assert len(digits) == 60_000 and np.array_equal(digits.images[digits.labels == 7], sevens.images)
