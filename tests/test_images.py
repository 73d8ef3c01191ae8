"""Grey is 0.299 R + 0.587 G + 0.114 B for every file and array."""

import re
import tracemalloc

import numpy as np
import pytest
from image_files import jpeg, packed_12_bits, tiff
from PIL import Image

from torchmembrane.errors import MembraneError
from torchmembrane.files.images import (
    decode_image,
    image_size,
    read_image,
    read_pixels,
    stack_images,
    to_grey,
    write_as_taken,
    write_image,
)

RGB = np.random.default_rng(0).integers(0, 256, (7, 9, 3), dtype=np.uint8)
GREY_OF_RGB = (RGB.astype(np.float64) @ [0.299, 0.587, 0.114]) / 255


def saved(tmp_path, image, name="image.png", **options):
    image.save(tmp_path / name, **options)
    return read_image(tmp_path / name)


def test_colour_is_weighed_in_floating_point_on_every_path(tmp_path):
    image = Image.fromarray(RGB)
    alpha = image.copy()
    alpha.putalpha(Image.fromarray(RGB[..., 0]))
    for grey in (
        to_grey(RGB),
        to_grey(RGB / 255),
        saved(tmp_path, image),
        saved(tmp_path, alpha),
        saved(tmp_path, image, "i.tiff"),
    ):
        assert grey.dtype == np.float32 and grey.shape == (7, 9)
        assert np.abs(grey - GREY_OF_RGB).max() < 1e-7
    assert to_grey(np.full((1, 1, 3), 255, np.uint8)) == 1.0


def test_grey_of_every_depth_is_the_fraction_of_white(tmp_path):
    eight, sixteen = RGB[..., 0], RGB[..., 0].astype(np.uint16) * 255 + RGB[..., 1]
    assert np.array_equal(saved(tmp_path, Image.fromarray(eight)), (eight / 255).astype(np.float32))
    assert np.array_equal(saved(tmp_path, Image.fromarray(sixteen)), (sixteen / 65535).astype(np.float32))
    assert np.array_equal(to_grey(sixteen), (sixteen / 65535).astype(np.float32))
    assert np.array_equal(saved(tmp_path, Image.fromarray(eight > 100)), (eight > 100).astype(np.float32))
    assert np.array_equal(saved(tmp_path, Image.fromarray(eight).convert("LA")), (eight / 255).astype(np.float32))


def test_palette_is_looked_up_before_it_is_weighed(tmp_path):
    image = Image.fromarray(RGB).quantize(8)
    colours = np.asarray(image.convert("RGB"))
    assert np.abs(saved(tmp_path, image) - (colours @ [0.299, 0.587, 0.114]) / 255).max() < 1e-7


def test_exif_orientation_is_not_applied(tmp_path):
    image = Image.fromarray(RGB)
    exif = image.getexif()
    exif[0x0112] = 6  # turned by 90 degrees
    assert saved(tmp_path, image, "image.jpg", exif=exif).shape == (7, 9)


KINDS = {"colour": RGB, "8": RGB[..., 0], "16": RGB[..., 0].astype(np.uint16) * 257, "float": RGB[..., 0] / np.float32(255)}


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("values", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize("code", ["raw", "tiff_lzw"])
def test_tiff_orientation_is_not_applied(tmp_path, values, orientation, code):
    """Pillow turns no other file, but these."""
    path = tmp_path / "a.tif"
    Image.fromarray(values).save(path, tiffinfo={274: orientation}, compression=code)
    grey = GREY_OF_RGB if values.ndim == 3 else RGB[..., 0] / 255
    for found in (read_image(path, (9, 7)), *stack_images(path, (9, 7))):
        np.testing.assert_allclose(found, grey, atol=1e-6)
    assert image_size(path) == (9, 7)


@pytest.mark.parametrize(
    "grey, suffix",
    [(RGB[..., 0] / 255, ".png"), (RGB[..., 0] * 256.0 / 65535, ".png"), (GREY_OF_RGB, ".tiff")],
)
def test_what_is_written_is_read_back_bit_by_bit(tmp_path, grey, suffix):
    grey = grey.astype(np.float32)
    path = write_image(tmp_path / "a.rest", grey)
    assert path.name == "a.rest" + suffix
    assert np.array_equal(read_image(path), grey)


def whole_png(tmp_path):
    noise = np.random.default_rng(1).integers(0, 256, (64, 64), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "whole.png")
    return (tmp_path / "whole.png").read_bytes()


@pytest.mark.parametrize(
    "content, words",
    [
        (None, "no such image"),
        (lambda _: b"", "not readable as an image"),
        (lambda _: b"x,y,z,size\n1,2,3,small\n", "cannot identify image file"),
        (lambda png: png[: len(png) // 2], "truncated"),
        (lambda png: png[:40], "not readable as an image"),
        (lambda png: png[:60] + b"?" * 40 + png[100:], "not readable as an image"),
    ],
)
def test_a_damaged_file_is_named_with_the_cause(tmp_path, content, words):
    path = tmp_path / "broken.png"
    if content is not None:
        path.write_bytes(content(whole_png(tmp_path)))
    with pytest.raises(MembraneError) as caught:
        read_image(path)
    assert str(path) in str(caught.value) and words in str(caught.value)


@pytest.mark.parametrize(
    "array, words",
    [
        (np.zeros((4, 4, 4), np.uint8), "shape [4, 4, 4]"),
        (np.zeros((0, 4), np.uint8), "shape [0, 4]"),
        (np.zeros(4), "shape [4]"),
        (np.zeros((4, 4), np.int64), "type int64"),
        (np.full((4, 4), 1.5), "from 1.5 to 1.5"),
        (np.full((4, 4), -0.1), "from -0.1"),
        (np.full((4, 4), np.nan), "from nan"),
        (np.where(np.eye(4), np.inf, 0.0), "to inf"),
    ],
)
def test_arrays_that_are_no_image_are_refused(array, words):
    with pytest.raises(MembraneError) as caught:
        to_grey(array)
    assert words in str(caught.value) and "expected" in str(caught.value)


@pytest.fixture(scope="module")
def photograph():
    return Image.open("examples/press_on_axis.png").convert("L")


@pytest.mark.parametrize("mode, options", [("L", {}), ("RGB", dict(progressive=True)), ("RGB", dict(subsampling=0))])
def test_what_the_decoder_remarks_of_a_jpeg_is_an_error(tmp_path, photograph, mode, options):
    """Bytes lost amid the scan: Pillow fills in what is missing."""
    path = tmp_path / "a.jpg"
    photograph.convert(mode).save(path, quality=90, **options)
    whole = path.read_bytes()
    assert read_image(path).shape == (480, 640)
    at = len(whole) // 2
    path.write_bytes(whole[:at] + whole[at + 400 :])
    with pytest.raises(MembraneError, match="not readable as an image .corrupt JPEG data.; expected a whole PNG, JPEG or TIFF"):
        read_image(path)


def test_a_quantisation_step_of_zero_is_damage(tmp_path, photograph):
    """The standard has steps from 1 on; without the lowest frequency along a column, all dots are displaced alike."""
    photograph.save(tmp_path / "a.jpg")
    content = bytearray((tmp_path / "a.jpg").read_bytes())
    at = content.index(b"\xff\xdb") + 7
    assert content[at] > 0
    content[at] = 0
    (tmp_path / "a.jpg").write_bytes(content)
    with pytest.raises(MembraneError, match="a.jpg: not readable as an image .a quantisation table of the JPEG holds 0"):
        read_image(tmp_path / "a.jpg")


def test_every_format_is_read_and_its_first_half_is_not(tmp_path, photograph):
    written = {"a.png": {}, "a.jpg": {}, "a.bmp": {}, "a.tiff": {}, "a.webp": dict(lossless=True)}
    for name, options in {**written, "b.tiff": dict(compression="tiff_lzw")}.items():
        path = tmp_path / name
        photograph.save(path, **options)
        assert np.abs(read_image(path) - np.asarray(photograph) / 255).max() < (0.1 if name == "a.jpg" else 1e-6), name
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(MembraneError, match=f"{name}: not readable as an image"):
            read_image(path)


def test_checksums_of_a_png_are_compared_to_its_end(tmp_path, photograph):
    path = tmp_path / "a.png"
    photograph.save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-13] + bytes([whole[-13] ^ 1]) + whole[-12:])  # the last byte of the last block's checksum
    with pytest.raises(MembraneError, match="not readable as an image"):
        read_image(path)


def test_a_large_image_is_refused_by_its_header(tmp_path):
    """13000 x 13000 px would take 2 GB; these bytes end after the header."""
    path = tmp_path / "large.png"
    Image.new("1", (13000, 13000)).save(path)
    tracemalloc.start()
    for size, words in ((None, "13000 x 13000 px; expected at most 33554432 px in all"), ((640, 480), "13000 x 13000 px")):
        with pytest.raises(MembraneError, match=words):
            read_image(path, size)
    with pytest.raises(MembraneError, match="the image is 640 x 480 px, expected 64 x 48: use images of this sensor's camera"):
        read_image("examples/rest.png", (64, 48))
    assert tracemalloc.get_traced_memory()[1] < 2e7
    tracemalloc.stop()


@pytest.mark.parametrize("kind", ["EPS", "PDF", "GIF", "PPM", "ICO"])
def test_formats_that_no_camera_writes_are_not_opened(tmp_path, photograph, kind):
    photograph.save(tmp_path / "a.png", kind)
    with pytest.raises(MembraneError, match="cannot identify image file"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize("options", [{}, dict(lossless=True), dict(exif=b"Exif\0\0odd")], ids=str)
def test_a_webp_is_as_long_as_its_chunks_say(tmp_path, options):
    path = tmp_path / "a.webp"
    Image.fromarray(RGB).save(path, **options)
    whole = path.read_bytes()
    assert read_image(path).shape == (7, 9)
    spoiled = [whole + b"more", whole[:-1], whole[:4] + bytes([whole[4] ^ 2]) + whole[5:], whole[:30] + whole[20:]]
    for content in spoiled:
        path.write_bytes(content)
        with pytest.raises(MembraneError, match="not readable as an image"):
            read_image(path)


JPEGS = [
    ("L", {}),
    ("RGB", {}),
    ("RGB", dict(subsampling=0)),
    ("L", dict(progressive=True)),
    ("L", dict(restart_marker_blocks=7)),
    ("RGB", dict(restart_marker_blocks=40)),
    ("RGB", dict(restart_marker_rows=1)),
]
every_jpeg = pytest.mark.parametrize("mode, options", JPEGS, ids=str)


@every_jpeg
@pytest.mark.parametrize("padding", [bytes(1), bytes(8), bytes(16), bytes(700), b"\x55" * 9, b"\xff" * 9, bytes(range(5, 15))])
def test_padding_before_the_end_of_a_jpeg_is_no_damage(photograph, mode, options, padding):
    whole = jpeg(photograph.convert(mode), **options)
    padded = decode_image(whole[:-2] + padding + whole[-2:], "a.jpg")
    np.testing.assert_array_equal(padded, decode_image(whole, "b.jpg"))


@pytest.mark.parametrize("mode, options", JPEGS[4:], ids=str)
def test_padding_before_restart_markers_is_no_damage(photograph, mode, options):
    whole, rng = jpeg(photograph.convert(mode), **options), np.random.default_rng(0)
    padded = re.sub(rb"\xff[\xd0-\xd7]", lambda marker: bytes(int(rng.integers(0, 4))) + marker.group(), whole)
    padded = padded[:-2] + bytes(12) + padded[-2:]
    assert len(padded) > len(whole) + 30
    np.testing.assert_array_equal(decode_image(padded, "a.jpg"), decode_image(whole, "b.jpg"))


@every_jpeg
@pytest.mark.parametrize("end", [b"", b"\xff\xd9", bytes(5000) + b"\xff\xd9", b"\xff" * 5000 + b"\xff\xd9"], ids=len)
def test_a_jpeg_that_ends_early_is_refused_however_it_is_filled_up(photograph, mode, options, end):
    whole = jpeg(photograph.convert(mode), **options)
    for share in (0.4, 0.9):
        with pytest.raises(MembraneError, match="a.jpg: not readable as an image"):
            decode_image(whole[: int(share * len(whole))] + end, "a.jpg")


@pytest.mark.parametrize("mode, options", JPEGS[:2] + JPEGS[4:5], ids=str)
def test_data_that_are_left_over_are_no_padding(photograph, mode, options):
    """A part of the data is there twice: the decoder ends early, and what is left is much and not alike."""
    whole = jpeg(photograph.convert(mode), **options)
    at = len(whole) // 2
    with pytest.raises(MembraneError, match="corrupt JPEG data"):
        decode_image(whole[:at] + whole[at - 600 :], "a.jpg")


SIXTEEN = RGB[..., 0].astype(np.uint16) * 255 + RGB[..., 1]
DEEP = [
    ("white is zero", tiff([(65535 - SIXTEEN, {262: 0})]), SIXTEEN / 65535),
    ("white is zero, float", tiff([((1 - RGB[..., 0] / 255).astype(np.float32), {262: 0})]), RGB[..., 0] / 255),
    ("float", tiff([((RGB[..., 0] / 255).astype(np.float32), {})]), RGB[..., 0] / 255),
    ("whole, of 32 bits", tiff([(SIXTEEN.astype(np.int32), {339: 2})]), SIXTEEN / 65535),
    ("unsigned, of 32 bits", tiff([(SIXTEEN.astype(np.uint32), {})]), SIXTEEN / 65535),
    ("of 12 bits", tiff([(packed_12_bits(SIXTEEN[:, :8] // 16), {256: 8, 258: 12})]), (SIXTEEN[:, :8] // 16) / 4095),
]


@pytest.mark.parametrize("content, expected", [each[1:] for each in DEEP], ids=[each[0] for each in DEEP])
def test_a_tiff_is_read_as_its_tags_say(content, expected):
    assert np.abs(decode_image(content, "a.tif") - expected).max() < 1e-6


@pytest.mark.parametrize(
    "values, said",
    [
        (
            np.full((4, 4), 70000, np.int32),
            "values from 70000 to 70000; expected whole numbers from 0 to 65535, or float in 0..1",
        ),
        (np.full((4, 4), -1, np.int32), "values from -1 to -1"),
        (np.full((4, 4), 255, np.float32), "float values from 255.0 to 255.0; expected finite, in 0..1: divide by white"),
        (np.full((4, 4), np.nan, np.float32), "float values from nan"),
    ],
)
def test_a_tiff_of_other_values_is_refused_in_words(values, said):
    with pytest.raises(MembraneError, match=re.escape(said)):
        decode_image(tiff([(values, {339: 2 if values.dtype.kind == "i" else 3})]), "a.tif")


@pytest.mark.parametrize("bits", range(8, 17))
def test_values_of_a_camera_of_fewer_bits_are_fractions_of_its_white(tmp_path, bits):
    white = 2**bits - 1
    values = np.random.default_rng(bits).integers(0, white, (7, 9), endpoint=True, dtype=np.uint16)
    values[0, :2] = 0, white
    Image.fromarray(values).save(tmp_path / "a.png")
    for grey in (read_image(tmp_path / "a.png", bits=bits), to_grey(values, bits)):
        assert np.abs(grey - values / white).max() < 1e-7
    assert np.array_equal(to_grey(RGB, bits), to_grey(RGB))  # of 8 bits as before
    for write in (write_image, write_as_taken):
        grey = read_image(tmp_path / "a.png", bits=bits)
        assert np.array_equal(read_image(write(tmp_path / "b", grey, bits), bits=bits), grey)
    taken = write_as_taken(tmp_path / "c", values, bits)
    assert np.array_equal(read_pixels(taken), values)
    if bits < 16:
        values[3, 3] = white + 1
        Image.fromarray(values).save(tmp_path / "a.png")
        with pytest.raises(
            MembraneError, match=rf"a.png: values up to {white + 1}; expected at most {white}, as bits = {bits} in"
        ):
            read_image(tmp_path / "a.png", bits=bits)


def test_bits_of_a_file_itself_go_before_the_camera_s_and_colour_of_16_is_refused():
    content, expected = DEEP[-1][1:]
    assert np.abs(decode_image(content, "a.tif", bits=10) - expected).max() < 1e-6
    colour = tiff([(np.full((4, 12), 9, np.uint16), {256: 4, 262: 2, 277: 3})])
    decode_image(colour, "a.tif")
    with pytest.raises(
        MembraneError, match="a.tif: .*colour with 16 bits per channel, of which 8 are read, so bits = 12 does not apply"
    ):
        decode_image(colour, "a.tif", bits=12)


def test_a_write_that_fails_leaves_no_part_of_a_file(tmp_path, monkeypatch):
    def full(self, file, *_, **__):
        with open(file, "wb") as begun:
            begun.write(b"\x89PNG")
        raise OSError("no space left")

    monkeypatch.setattr(Image.Image, "save", full)
    with pytest.raises(OSError, match="no space"):
        write_as_taken(tmp_path / "a", RGB)
    assert not list(tmp_path.iterdir())
