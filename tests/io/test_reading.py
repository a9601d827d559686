"""Pictures in: the same structure however a file keeps it, and every picture of a file, or a reason."""

import numpy as np
import pytest
from PIL import Image

from inflate_lib import label_image
from inflate_lib.inverse.drawings import read_outline
from inflate_lib.io.pictures import read_images
from inflate_lib.structures.labels import stages
from inflate_lib.structures.sources import load_sevens

SEVENS = load_sevens("digits").images[:3]
#: How a camera that was held in each of the eight ways stores an upright picture: the inverse of what the tag asks for.
STORED = {
    1: lambda image: image,
    2: np.fliplr,
    3: lambda image: np.rot90(image, 2),
    4: np.flipud,
    5: np.transpose,
    6: np.rot90,
    7: lambda image: np.rot90(image, 2).T,
    8: lambda image: np.rot90(image, -1),
}
FORMATS = {"png": {}, "jpg": {"quality": 100}, "tif": {}, "webp": {"lossless": True}}


def stored(path, image, orientation, **options):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(np.ascontiguousarray(STORED[orientation](image))).save(path, exif=exif, **options)
    return path


@pytest.mark.parametrize("orientation", STORED)
@pytest.mark.parametrize("suffix", FORMATS)
def test_eight_orientations_are_one_structure_and_one_outline(tmp_path, suffix, orientation):
    (image,), note = read_images(stored(tmp_path / f"a.{suffix}", SEVENS[0], orientation, **FORMATS[suffix]))
    assert np.array_equal(label_image(image), label_image(SEVENS[0])) and not note
    drawing = np.zeros((40, 60), np.uint8)
    drawing[5:30, 10:20] = drawing[25:35, 10:55] = 255
    outlines = [
        read_outline(stored(tmp_path / f"{n}.{suffix}", drawing, n, **FORMATS[suffix]), unit=30)
        for n in (1, orientation)
    ]
    assert np.array_equal(*outlines)


@pytest.mark.parametrize("suffix", ["tif", "gif", "png", "webp"])
def test_a_stack_is_read_whole_and_no_outline(tmp_path, suffix):
    first, *others = (Image.fromarray(image).convert("RGB") for image in SEVENS)
    options = {"lossless": True} if suffix == "webp" else {}
    first.save(tmp_path / f"a.{suffix}", save_all=True, append_images=others, **options)
    images, note = read_images(tmp_path / f"a.{suffix}")
    assert np.abs(images.astype(int) - SEVENS).max() <= 1 and not note
    with pytest.raises(ValueError, match=rf"a\.{suffix} holds 3 pictures; one outline is needed"):
        read_outline(tmp_path / f"a.{suffix}", unit=28)


def test_a_stack_of_two_sizes_is_refused_and_one_of_another_size_is_fitted(tmp_path):
    large = [Image.fromarray(np.kron(image, np.ones((2, 2), np.uint8))) for image in SEVENS]
    large[0].save(tmp_path / "a.tif", save_all=True, append_images=large[1:])
    images, note = read_images(tmp_path / "a.tif", resize=True)
    assert np.array_equal(images, SEVENS) and note == "resized from 56 × 56"
    large[0].save(tmp_path / "b.tif", save_all=True, append_images=[Image.fromarray(SEVENS[0])])
    with pytest.raises(ValueError, match=r"b\.tif holds 2 pictures of different sizes"):
        read_images(tmp_path / "b.tif", resize=True)


def test_the_second_view_of_a_camera_is_noted(tmp_path):
    first, *others = (Image.fromarray(image).convert("RGB") for image in SEVENS[:2])
    first.save(tmp_path / "a.jpg", format="MPO", save_all=True, append_images=others, quality=100)
    images, note = read_images(tmp_path / "a.jpg")
    assert np.abs(images.astype(int) - SEVENS[:1]).max() <= 12 and note == "the first of 2 views"


@pytest.mark.parametrize("mode", ["RGBA", "LA", "PA", "CMYK"])
def test_an_opaque_picture_is_read_whatever_its_channels(tmp_path, mode):
    suffix = "tif" if mode in ("CMYK", "PA") else "png"
    picture = Image.fromarray(SEVENS[0]).convert("P" if mode == "PA" else "RGB").convert(mode)
    picture.save(tmp_path / f"a.{suffix}")
    assert np.array_equal(read_images(tmp_path / f"a.{suffix}")[0][0], SEVENS[0])


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_sixteen_bits_are_read_and_scaled_by_their_range(tmp_path, suffix):
    grey = np.random.default_rng(0).integers(0, 65536, (28, 28)).astype(np.uint16)
    grey[0, :4] = 0, 32767, 32768, 65535
    Image.fromarray(grey).save(file := tmp_path / f"a.{suffix}")
    ((found,), _) = read_images(file)
    assert np.abs(found / 255 - grey / 65535).max() <= 0.5 / 255 + 1e-12
    assert ((found / 255 > 0.5) == (grey / 65535 > 0.5)).all()


def test_a_range_that_is_not_known_is_refused(tmp_path):
    Image.fromarray(np.zeros((28, 28), np.int32)).save(tmp_path / "32.tif")
    Image.fromarray(np.zeros((28, 28), np.float32)).save(tmp_path / "float.tif")
    Image.fromarray(np.zeros((28, 28), np.uint16)).save(tmp_path / "white.tif", tiffinfo={262: 0})  # white is zero
    Image.fromarray(np.zeros((28, 28), np.uint16)).save(tmp_path / "clear.png", transparency=0)
    for name in ("32.tif", "float.tif", "white.tif", "clear.png"):
        with pytest.raises(ValueError, match="partly transparent" if name == "clear.png" else "range is not known"):
            read_images(tmp_path / name)


def test_what_is_behind_a_hole_is_not_guessed(tmp_path):
    picture = Image.fromarray(SEVENS[0])
    picture.convert("P").save(tmp_path / "palette.png", transparency=0)
    picture.putalpha(Image.fromarray(np.where(SEVENS[0] > 9, 255, 254).astype(np.uint8)))
    picture.save(tmp_path / "alpha.png")
    for name in ("palette", "alpha"):
        with pytest.raises(ValueError, match=rf"{name}\.png is partly transparent"):
            read_images(tmp_path / f"{name}.png")


@pytest.mark.parametrize("dtype", [bool, np.uint8, float, np.float32])
def test_black_on_white_is_inverted_in_every_type(tmp_path, dtype):
    bright = SEVENS[0] > 127
    np.save(tmp_path / "a.npy", (~bright * (255 if dtype is np.uint8 else 1)).astype(dtype))
    (read,), _ = read_images(tmp_path / "a.npy", invert=True)
    assert read.dtype == dtype and np.array_equal(label_image(read), label_image(bright))


@pytest.mark.parametrize("invert", [False, True])
@pytest.mark.parametrize(
    ("image", "message"),
    [
        (SEVENS[0].astype(float), "values from 0 to 255; they must lie in"),
        (SEVENS[0].astype(int), "type int64"),
        (SEVENS[0] / 255 * 1j, "type complex128"),
        (SEVENS[0].astype(str), "type <U"),
        (np.full((28, 28), np.nan), "NaN"),
        (np.zeros((28, 28), dtype=[("grey", "u1")]), "type"),
    ],
)
def test_what_is_no_image_is_called_what_it_is(tmp_path, image, message, invert):
    np.save(tmp_path / "a.npy", image)
    (read,), _ = read_images(tmp_path / "a.npy", invert=invert)
    with pytest.raises(ValueError, match=message):
        label_image(read)


def test_several_arrays_are_refused(tmp_path):
    with (tmp_path / "a.npy").open("wb") as file:
        np.savez(file, one=SEVENS[0], two=SEVENS[1])
    with pytest.raises(ValueError, match=r"a\.npy cannot be read as a NumPy array: it holds several arrays"):
        read_images(tmp_path / "a.npy")


def test_a_masked_array_is_refused():
    with pytest.raises(ValueError, match="image is a masked array"):
        label_image(np.ma.masked_less(SEVENS[0], 9))


def test_what_is_left_out_of_a_drawing_is_said():
    drawing = np.zeros((28, 28), bool)
    drawing[5:20, 5:15] = True
    assert stages(drawing).note == ""
    drawing[8:10, 8:10] = drawing[15, 9] = False
    drawing[3, 25] = drawing[10:12, 20] = True
    assert stages(drawing).note == "2 smaller pieces of 3 pixels dropped, 2 holes of 5 pixels filled"
    drawing[9, 8:10] = drawing[10:12, 20] = False
    assert stages(drawing).note == "1 smaller piece of 1 pixel dropped, 2 holes of 5 pixels filled"
