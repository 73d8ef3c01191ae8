"""Damage of TIFF files that decoders do not notice."""

import struct
import zlib
from io import BytesIO
from itertools import islice

import numpy as np
import pytest
from PIL import Image

from torchmembrane.errors import MembraneError
from torchmembrane.files import tiff as tiff_module
from torchmembrane.files.images import decode_image, read_image, stack_images

PICTURE = np.random.default_rng(5).integers(0, 256, (40, 48), np.uint8)
DEEP = PICTURE.astype(np.uint16) * 250
CODES = ["raw", "tiff_deflate", "tiff_adobe_deflate", "tiff_lzw", "packbits"]


def tiff(values=PICTURE, **options):
    file = BytesIO()
    Image.fromarray(values).save(file, "TIFF", **options)
    return file.getvalue()


def motorola(values, code=1, data=None):
    """A big-endian file, its directory and a text behind the data, as cameras' programs write them."""
    data = values.tobytes() if data is None else data
    text = b"a description of more than four bytes\0"
    at = 8 + len(data)
    fields = [
        (256, 3, 1, values.shape[1] << 16),
        (257, 3, 1, values.shape[0] << 16),
        (258, 3, 1, 8 << 16),
        (259, 3, 1, code << 16),
    ]
    fields += [(262, 3, 1, 1 << 16), (270, 2, len(text), at + 2 + 12 * 10 + 4), (273, 4, 1, 8), (277, 3, 1, 1 << 16)]
    fields += [(278, 3, 1, values.shape[0] << 16), (279, 4, 1, len(data))]
    directory = struct.pack(">H", len(fields)) + b"".join(struct.pack(">HHLL", *field) for field in fields) + bytes(4)
    return b"MM\0*" + struct.pack(">L", at) + data + directory + text


def strips(content):
    with Image.open(BytesIO(content)) as image:
        return list(zip(image.tag_v2[273], image.tag_v2[279], strict=True))


@pytest.mark.parametrize("values", [PICTURE, DEEP, np.stack([PICTURE] * 3, -1)], ids=["grey", "deep", "colour"])
@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("big", [False, True])
def test_whole_files_are_read(values, code, big):
    content = tiff(values, compression=code, big_tiff=big)
    assert decode_image(content, "a.tif").shape == PICTURE.shape


@pytest.mark.parametrize("code", [8, 32946])
@pytest.mark.parametrize("further", [1, 500])
def test_damaged_data_that_fill_a_strip_are_refused(tmp_path, code, further):
    """Where damaged data give too many pixels the decoder stops at the last one, before the checksum."""
    data = bytearray(zlib.compress(PICTURE.tobytes() + bytes(further)))
    data[-1] ^= 1
    content = motorola(PICTURE, code, bytes(data))
    with Image.open(BytesIO(content)) as image:
        np.testing.assert_array_equal(np.asarray(image), PICTURE)
    with pytest.raises(
        MembraneError, match=r"a.tif: not readable as an image \(damaged data of a TIFF: .*incorrect data check"
    ):
        decode_image(content, "a.tif")
    (tmp_path / "a.tif").write_bytes(content)
    (found,) = stack_images(tmp_path / "a.tif", (48, 40))
    assert isinstance(found, MembraneError) and "incorrect data check" in str(found)


@pytest.mark.parametrize("code, name", [(5, "tiff_lzw"), (32773, "packbits")])
@pytest.mark.parametrize("rows, is_whole", [(40, True), (41, False), (48, False)])
def test_data_that_unpack_to_more_than_a_strip_are_refused(code, name, rows, is_whole):
    """A flipped bit makes a run longer: all that follows is pushed aside, and the decoder stops when the strip is full."""
    runs = np.repeat(PICTURE, 4, 1)[:, :48]
    longer = tiff(np.concatenate([runs, runs])[:rows], compression=name, tiffinfo={278: rows})
    ((place, length),) = strips(longer)
    content = motorola(runs, code, longer[place : place + length])
    with Image.open(BytesIO(content)) as image:
        np.testing.assert_array_equal(np.asarray(image), runs)
    if is_whole:
        np.testing.assert_array_equal(np.rint(255 * decode_image(content, "a.tif")), runs)
        return
    with pytest.raises(
        MembraneError, match="damaged data of a TIFF: the decompressed data have another size than the file declares"
    ):
        decode_image(content, "a.tif")


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("values", [PICTURE, DEEP], ids=["grey", "deep"])
def test_bytes_pushed_into_uncompressed_pixels_are_refused(values, big):
    content = tiff(values, big_tiff=big)
    ((place, length),) = strips(content)
    at = place + length // 3
    for pushed in (content[at : at + 1], content[at : at + 25], bytes(range(200))):
        damaged = content[:at] + pushed + content[at:]
        with Image.open(BytesIO(damaged)) as image:
            assert (np.asarray(image) != values).any()
        if len(set(damaged[len(content) :])) > 1:
            with pytest.raises(MembraneError, match=f"{len(pushed)} bytes behind the data of an uncompressed TIFF"):
                decode_image(damaged, "a.tif")


@pytest.mark.parametrize("padding", [b"", b"\0", bytes(500), b"\xff" * 7])
def test_padding_at_the_end_is_no_damage(tmp_path, padding):
    (tmp_path / "a.tif").write_bytes(tiff() + padding)
    np.testing.assert_array_equal(np.rint(255 * read_image(tmp_path / "a.tif")), PICTURE)


def test_a_directory_that_leads_to_itself_is_looked_at_once(monkeypatch):
    content = bytearray(motorola(PICTURE))
    at = int.from_bytes(content[4:8], "big")
    end = at + 2 + 12 * int.from_bytes(content[at : at + 2], "big")
    content[end : end + 4] = content[4:8]
    entries = list(islice(tiff_module._entries(BytesIO(content)), 1000))
    assert len(entries) == 11
    np.testing.assert_array_equal(np.rint(255 * decode_image(bytes(content), "a.tif")), PICTURE)


def test_directory_and_values_behind_the_data_belong_to_the_file():
    content = motorola(PICTURE)
    np.testing.assert_array_equal(np.rint(255 * decode_image(content, "a.tif")), PICTURE)
    with pytest.raises(MembraneError, match="5 bytes behind the data of an uncompressed TIFF"):
        decode_image(content + b"extra", "a.tif")
