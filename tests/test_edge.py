"""The edge package needs no torch and refuses damaged files.

Its model is made by hand, of a few nodes; `tests/test_export.py` runs exported ones.
"""

import csv
import errno
import io
import json
import os
import struct
import sys
import tomllib
import types
import zlib
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper
from PIL import Image

from torchmembrane.files.provenance import SourceFile
from torchmembrane.onnx.export import sealed
from torchmembrane.pose import Pose
from torchmembrane.results.summary_row import NAMES

ROOT = Path(__file__).parents[1]
SIZE = WIDTH, HEIGHT = 8, 6
GREY = (np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) * 5).astype(np.uint8)
WIDE = GREY.astype(np.uint16) * 257
TRUE = GREY / 255
VERTICES = np.stack([*np.meshgrid(np.arange(3.0), np.arange(3.0)), np.ones((3, 3))], -1).reshape(9, 3)
TRIANGLES = [[k, k + 1, k + 4] for k in (0, 1, 3, 4)] + [[k, k + 4, k + 3] for k in (0, 1, 3, 4)]
MESH = {
    "rest_vertices": VERTICES.tolist(),
    "rest_normals": [[0.0, 0.0, 1.0]] * 9,
    "triangles": TRIANGLES,
    "fixed": [k != 4 for k in range(9)],
    "grid": [3, 3],
    "vertex_pixels": VERTICES[:, :2].tolist(),
    "rest_pixels": [[4.0, 3.0]],
    "image_size": list(SIZE),
    "length_unit": "mm",
    "force_unit": "N",
    "name": "by hand",
    "sensor": "a" * 64,
    "estimator": "force-balance",
    "energy": "neo_hookean",
    "element": "triangle",
    "format": "npz",
    "volume": "exact",
    "smoothing": 0.0,
    "camera_in_tool": [],
}
TEXTS = {"0": "ok", "4": "blank or saturated image: no contrast; no surface"}
KNOWN = {"format": "1", "name": "by hand", "length_unit": "mm", "force_unit": "N"}


def metadata(mesh=None, **changed):
    """What the model says; None leaves a key out."""
    known = KNOWN | {"status_texts": json.dumps(TEXTS), "mesh": json.dumps(MESH | (mesh or {}))} | changed
    return {key: value for key, value in known.items() if value is not None}


def without(key):
    return json.dumps({name: value for name, value in MESH.items() if name != key})


def model_of(known, tracking=False, size=SIZE, rows=None, status="status"):
    """Gives the image itself as `seen`, its mean as the vertices' heights, and status 4 where it is black.

    `rows`: a number of rows that it gives, whatever the batch; `status`: the name of that output.
    """
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean4"], axes=[1, 2, 3]),
        helper.make_node("Reshape", ["mean4", "ones3"], ["mean"]),
        helper.make_node("Mul", ["mean", "surface"], ["vertices"]),
        helper.make_node("Identity", ["vertices"], ["displacement"]),
        helper.make_node("Reshape", ["mean4", "one"], ["mean1"]),
        helper.make_node("Reshape", ["mean4", "column"], ["mean2"]),
        helper.make_node("Mul", ["mean2", "push"], ["force"]),
        helper.make_node("Concat", ["force", "force"], ["wrench"], axis=1),
        helper.make_node("Less", ["mean1", "black"], ["dark"]),
        helper.make_node("Cast", ["dark"], ["dark_number"], to=TensorProto.INT32),
        helper.make_node("Mul", ["dark_number", "four"], [status]),
        helper.make_node("Identity", ["image"], ["seen"]),
    ]
    constants = {
        "ones3": np.array([-1, 1, 1]),
        "one": np.array([-1]),
        "column": np.array([-1, 1]),
        "surface": np.ones((1, 9, 3), np.float32),
        "push": np.array([[0, 0, -1]], np.float32),
        "black": np.array([1e-6], np.float32),
        "four": np.array([4], np.int32),
    }
    shapes = {"vertices": [9, 3], "displacement": [9, 3], "force": [3], "wrench": [6], "seen": [1, *size[::-1]]}
    inputs = {"image": [1, *size[::-1]]}
    if tracking:
        nodes += [
            helper.make_node("IsNaN", ["previous_pixels"], ["unknown"]),
            helper.make_node("Where", ["unknown", "zero", "previous_pixels"], ["from"]),
            helper.make_node("Add", ["from", "step"], ["pixels"]),
        ]
        constants |= {"zero": np.zeros(1, np.float32), "step": np.ones(1, np.float32)}
        inputs["previous_pixels"], shapes["pixels"] = [1, 2], [1, 2]
    if rows:
        nodes[3] = helper.make_node("Identity", ["fixed"], ["displacement"])
        constants["fixed"] = np.zeros((rows, 9, 3), np.float32)
    described = lambda name, shape, kind=1: helper.make_tensor_value_info(name, kind, ["batch", *shape])  # noqa: E731
    graph = helper.make_graph(
        nodes,
        "by_hand",
        [described(name, shape) for name, shape in inputs.items()],
        [described(name, shape) for name, shape in shapes.items()] + [described(status, [], TensorProto.INT32)],
        [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, known)
    return model.SerializeToString()


@pytest.fixture(scope="module")
def edge():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "export")
        import torchmembrane_edge.cli

        yield torchmembrane_edge


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.onnx"
    path.write_bytes(model_of(metadata()))
    return path


@pytest.mark.parametrize("place", [0.01, 0.5, 0.8])
def test_a_model_file_with_a_flipped_bit_is_refused(edge, tmp_path, place):
    """Most of a file are weights: a wrong one would pass for a right one."""
    content = bytearray(sealed(model_of(metadata())))
    content[int(place * len(content))] ^= 64
    damaged = tmp_path / "model.onnx"
    damaged.write_bytes(content)
    with pytest.raises(edge.EdgeError, match=f"{damaged}: damaged, .* export it again"):
        edge.Session(damaged)


def test_a_model_that_another_program_has_written_anew_is_not_checked(edge, tmp_path):
    whole, changed = tmp_path / "whole.onnx", tmp_path / "changed.onnx"
    whole.write_bytes(sealed(model_of(metadata())))
    model = onnx.load(whole)
    assert model.doc_string.startswith("SHA-256: ")
    helper.set_model_props(model, metadata() | {"checked by": "us"})
    onnx.save(model, changed)
    assert edge.Session(changed).name == edge.Session(whole).name == "by hand"


@pytest.fixture
def call(edge, capsys):
    """The command's exit code, what it prints, and what it says of errors, without the line that it loads."""

    def call(*arguments):
        try:
            code = edge.cli.main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code
        out, err = capsys.readouterr()
        return code, out, "".join(line for line in err.splitlines(True) if "loading" not in line)

    return call


@pytest.fixture
def images(tmp_path):
    """Writes an image file; returns its path."""
    folder = tmp_path / "images"
    folder.mkdir()

    def write(name, content, **options):
        path = folder / name
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            (content if isinstance(content, Image.Image) else Image.fromarray(content)).save(path, **options)
        return path

    return write


def seen(out, name):
    with np.load(out / f"{name}.npz") as file:
        return file["seen"][0]


def saved(content, format, **options):
    """An image file's content."""
    file = io.BytesIO()
    (content if isinstance(content, Image.Image) else Image.fromarray(content)).save(file, format, **options)
    return file.getvalue()


def tiff(values, photometric=1, bits=16, kind=1, planes=1):
    """A TIFF as no program here writes it: an uncompressed picture with these tags."""
    data = np.asarray(values).tobytes()
    entries = {256: WIDTH, 257: HEIGHT, 258: bits, 259: 1, 262: photometric, 273: 8, 277: planes, 278: HEIGHT, 279: len(data)}
    entries |= {284: 2 if planes > 1 else 1, 339: kind}
    body = data + b"\0" * (len(data) % 2)
    at, more = 8 + len(body), b""
    rows = []
    for tag, value in sorted(entries.items()):
        several = planes if tag in (258, 339) else planes if planes > 1 and tag in (273, 279) else 1
        if several > 2:
            each = {273: [8 + k * len(data) // planes for k in range(planes)], 279: [len(data) // planes] * planes}
            place = at + 2 + 12 * len(entries) + 4 + len(more)
            more += struct.pack(f"<{several}L", *each.get(tag, [value] * several))
            rows.append(struct.pack("<HHLL", tag, 4, several, place))
        else:
            rows.append(struct.pack("<HHLL", tag, 4, 1, value))
    return b"II*\0" + struct.pack("<L", at) + body + struct.pack("<H", len(rows)) + b"".join(rows) + b"\0" * 4 + more


def png_of_16_bits(colour, *planes):
    """A PNG of several 16-bit channels, which Pillow does not write."""

    def chunk(kind, data):
        return struct.pack(">L", len(data)) + kind + data + struct.pack(">L", zlib.crc32(kind + data))

    rows = b"".join(b"\0" + np.stack(row, -1).astype(">u2").tobytes() for row in zip(*planes, strict=True))
    header = struct.pack(">LLBBBBB", WIDTH, HEIGHT, 16, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def declared(png, width, height):
    """A PNG whose header says another size than its data have."""
    header = b"IHDR" + struct.pack(">LL", width, height) + png[24:29]
    return png[:12] + header + struct.pack(">L", zlib.crc32(header)) + png[33:]


def padded(jpeg):
    """A JPEG with bytes that mean nothing before its first table, as some cameras fill buffers."""
    at = jpeg.index(b"\xff\xdb")
    return jpeg[:at] + b"\0\0\0\0" + jpeg[at:]


def packed_12_bits():
    bits = [f"{value:012b}" for value in np.rint(TRUE * 4095).astype(int).ravel()]
    return np.frombuffer(int("".join(bits), 2).to_bytes(len(bits) * 12 // 8, "big"), np.uint8)


def sequence(format, **options):
    pictures = [Image.fromarray(np.stack([each] * 3, -1)) for each in (GREY, 255 - GREY, GREY)]
    return saved(pictures[0], format, save_all=True, append_images=pictures[1:], **options)


RGB = np.stack([GREY] * 3, -1)
READ = {
    "grey.png": saved(GREY, "PNG"),
    "grey_16.png": saved(WIDE, "PNG"),
    "grey.bmp": saved(GREY, "BMP"),
    "grey.jpg": saved(GREY, "JPEG", quality=100),
    "padded.jpg": padded(saved(GREY, "JPEG", quality=100)),
    "padded_by_ff.jpg": saved(GREY, "JPEG", quality=100).replace(b"\xff\xdb", b"\xff\xff\xff\xdb", 1),
    "longer.jpg": saved(GREY, "JPEG", quality=100) + b"\0" * 100,
    "grey.webp": saved(RGB, "WEBP", lossless=True),
    "grey.gif": saved(GREY, "GIF"),
    "grey.pgm": saved(GREY, "PPM"),
    "grey_12.pgm": b"P5 8 6 4095\n" + np.rint(TRUE * 4095).astype(">u2").tobytes(),
    "rgb.png": saved(RGB, "PNG"),
    "rgba.png": saved(Image.fromarray(RGB).convert("RGBA"), "PNG"),
    "clear.png": saved(Image.merge("LA", [Image.fromarray(GREY), Image.new("L", SIZE, 0)]), "PNG"),
    "palette.png": saved(Image.fromarray(GREY).convert("P"), "PNG"),
    "cmyk.tif": saved(Image.fromarray(RGB).convert("CMYK"), "TIFF"),
    "rgb_16.png": png_of_16_bits(2, WIDE, WIDE, WIDE),
    "grey_16.tif": saved(WIDE, "TIFF"),
    "mode_i.tif": saved(WIDE.astype(np.int32), "TIFF"),
    "float.tif": saved(TRUE.astype(np.float32), "TIFF"),
    "white_is_0.tif": tiff(255 - GREY, photometric=0, bits=8),
    "white_is_0_16.tif": tiff(65535 - WIDE, photometric=0),
    "packed_12.tif": tiff(packed_12_bits(), bits=12),
    **{f"turned_{k}.tif": saved(WIDE if k % 2 else GREY, "TIFF", tiffinfo={274: k}) for k in range(2, 9)},
}


@pytest.mark.parametrize("name", READ)
def test_an_image_is_seen_as_it_is(name, model, call, images, tmp_path):
    code, out, err = call(model, images(name, READ[name]), "--out", tmp_path / "r")
    assert (code, err) == (0, "") and "1 reconstructed, 0 failed" in out
    np.testing.assert_allclose(seen(tmp_path / "r", Path(name).stem), TRUE, atol=2e-4)


def test_an_image_of_one_bit_is_seen_as_it_is(model, call, images, tmp_path):
    code, _, _ = call(model, images("a.png", GREY > 100), "--out", tmp_path / "r")
    assert code == 0
    np.testing.assert_array_equal(seen(tmp_path / "r", "a"), GREY > 100)


@pytest.mark.parametrize("mode", ["I", "I;16", "I;16B", "I;16L"])
def test_grey_of_16_bits_is_seen_as_it_is_in_every_mode_that_pillow_gives_it(mode, edge):
    """Before 10.3 a PNG's is "I", whose conversion to 8 bits clips at 255."""
    values = WIDE.astype({"I": np.int32, "I;16B": ">u2"}.get(mode, "<u2"))
    opened = Image.frombytes(mode, SIZE, values.tobytes())
    opened.tile = []
    np.testing.assert_allclose(edge.images._grey_of_more_bits(opened, {}, None)[0], TRUE, atol=1e-6)


REFUSED = {
    "text.png": (b"no image", "not readable as an image (cannot identify image file); expected a whole PNG, JPEG or TIFF"),
    "empty.png": (b"", "cannot identify image file"),
    "cut.png": (saved(GREY, "PNG")[:-30], "not readable as an image ("),
    "cut.jpg": (saved(GREY, "JPEG")[:-30], "not readable as an image ("),
    "cut.bmp": (saved(GREY, "BMP")[:-20], "not readable as an image ("),
    "cut.webp": (saved(RGB, "WEBP", lossless=True)[:-20], "not readable as an image ("),
    "flipped.png": (saved(GREY, "PNG").replace(b"IDAT", b"IDAT\x55", 1)[:-1], "not readable as an image ("),
    "small.png": (saved(GREY[:, :4], "PNG"), "the image is 4 x 6 px, expected 8 x 6: use images of this sensor's camera"),
    "turned.png": (saved(GREY.T, "PNG"), "the image is 6 x 8 px, expected 8 x 6"),
    "huge.png": (declared(saved(GREY, "PNG"), 20000, 20000), "the image is 20000 x 20000 px, expected 8 x 6"),
    "float_255.tif": (saved(GREY.astype(np.float32), "TIFF"), "float values from 0.0 to 235.0; expected finite, in 0..1"),
    "nan.tif": (saved(np.full((6, 8), np.nan, np.float32), "TIFF"), "float values from nan to nan"),
    "large_32.tif": (
        saved(WIDE.astype(np.int32) * 2, "TIFF"),
        "values from 0 to 120790; expected whole numbers from 0 to 65535: save the image with 8 or 16 bits",
    ),
    "signed_16.tif": (tiff(WIDE // 2, kind=2), "its values are signed integers"),
    "list.jpg": (sequence("MPO").replace(b"MPF\0", b"MPF\0??", 1), "not readable as an image ("),
    "planes_16.tif": (tiff([WIDE] * 3, photometric=2, planes=3), "colour or alpha with more than 8 bits"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_image_that_cannot_be_seen_as_it_is_is_refused_and_the_rest_goes_on(name, model, call, images, tmp_path):
    content, reason = REFUSED[name]
    paths = images(name, content), images("good.png", GREY)
    code, out, err = call(model, *paths, "--out", tmp_path / "r", "--batch", 2)
    assert code == 1 and "frames: 1 reconstructed, 1 failed" in out
    assert err.startswith(f"{paths[0]}: ") and reason in err and len(err.splitlines()) == 1
    np.testing.assert_allclose(seen(tmp_path / "r", "good"), TRUE, atol=1e-6)


SEQUENCES = {
    "a.tif": sequence("TIFF"),
    "a.png": sequence("PNG"),
    "a.webp": sequence("WEBP", lossless=True),
    "a.gif": sequence("GIF"),
    "a.jpg": sequence("MPO", quality=100),
}


@pytest.mark.parametrize("name", SEQUENCES)
def test_every_picture_of_a_file_is_a_frame(name, model, call, images, tmp_path):
    code, out, err = call(model, images(name, SEQUENCES[name]), "--out", tmp_path / "r")
    assert (code, err) == (0, "") and "3 reconstructed, 0 failed" in out
    for number, expected in enumerate((TRUE, 1 - TRUE, TRUE)):
        np.testing.assert_allclose(seen(tmp_path / "r", f"a_{number:06d}"), expected, atol=0.01)


@pytest.mark.parametrize("name", ["a.tif", "a.gif", "a.jpg"])
def test_of_a_sequence_that_is_cut_whole_pictures_are_kept_and_the_end_is_told(name, model, call, images, tmp_path):
    content = SEQUENCES[name]
    code, out, err = call(model, images(name, content[: len(content) * 5 // 6]), "--out", tmp_path / "r")
    assert code == 1 and ("ends early" in err or "not readable as an image" in err), err
    assert ", 1 failed" in out and "0 reconstructed" not in out
    np.testing.assert_allclose(seen(tmp_path / "r", "a_000000"), TRUE, atol=0.01)


def test_a_picture_of_another_size_is_told_and_the_others_are_kept(model, call, images, tmp_path):
    pictures = [Image.fromarray(each) for each in (GREY, GREY[:3], GREY)]
    path = images("a.tif", pictures[0], save_all=True, append_images=pictures[1:])
    code, out, err = call(model, path, "--out", tmp_path / "r")
    assert code == 1 and "2 reconstructed, 1 failed" in out
    assert err == f"{path}, a_000001: the image is 8 x 3 px, expected 8 x 6: use images of this sensor's camera\n"


def test_a_reduced_copy_of_a_picture_is_no_frame(model, call, images, tmp_path):
    pictures = [Image.fromarray(each) for each in (GREY, GREY[::2, ::2].copy())]
    pictures[1].encoderinfo = {"tiffinfo": {254: 1}}
    path = images("a.tif", pictures[0], save_all=True, append_images=pictures[1:])
    assert call(model, path, "--out", tmp_path / "r")[::2] == (0, "")
    np.testing.assert_allclose(seen(tmp_path / "r", "a"), TRUE, atol=1e-6)


def test_a_preview_in_a_jpeg_is_no_frame(model, call, images, tmp_path):
    pictures = [Image.fromarray(each) for each in (RGB, RGB[:3, :4].copy())]
    path = images("a.jpg", saved(pictures[0], "MPO", save_all=True, append_images=pictures[1:], quality=100))
    assert call(model, path, "--out", tmp_path / "r")[::2] == (0, "")
    np.testing.assert_allclose(seen(tmp_path / "r", "a"), TRUE, atol=0.01)


def test_pictures_of_a_tiff_that_only_imagej_finds_are_told(model, call, images, tmp_path):
    path = images("a.tif", Image.fromarray(GREY), tiffinfo={270: "ImageJ=1.54f\nimages=40\nframes=40\n"})
    code, _, err = call(model, path, "--out", tmp_path / "r")
    assert code == 1 and "holds 40 images by its ImageJ description, but 1 pages; expected one page per image" in err


def test_files_that_systems_leave_are_passed_over(model, call, images, tmp_path):
    for name in ("._a.png", ".a.png", "Thumbs.db", "a.png"):
        images(name, saved(GREY, "PNG") if name == "a.png" else b"of the system")
    for given in ([tmp_path / "images"], [tmp_path / "images" / "._a.png", tmp_path / "images" / "a.png"]):
        code, out, err = call(model, *given, "--out", tmp_path / "r")
        assert (code, err) == (0, "") and "1 reconstructed" in out


def test_names_that_two_frames_would_have_are_refused(model, call, images, tmp_path):
    stack, single = images("a.tif", SEQUENCES["a.tif"]), images("b.png", GREY)
    for other, said in (("b.bmp", "two images of the name 'b'"), ("a_000001.png", "a picture of "), ("mesh.png", "mesh.npz")):
        code, _, err = call(model, stack, single, images(other, GREY), "--out", tmp_path / "r")
        assert code == 2 and said in err and not (tmp_path / "r").exists()
    code, out, _ = call(
        model, stack, images("a_000003.png", GREY), images("b_000000.png", GREY), single, "--out", tmp_path / "r"
    )
    assert code == 0 and "6 reconstructed" in out


def test_folders_and_patterns_stand_for_their_images(model, call, images, tmp_path):
    for name in ("f10.png", "f9.png", "notes.txt"):
        images(name, b"text" if name.endswith("txt") else GREY)
    for given in (tmp_path / "images", tmp_path / "images" / "f*.png"):
        code, out, _ = call(model, given, "--out", tmp_path / given.name.replace("*", "_"))
        assert code == 0 and "2 reconstructed" in out
    (tmp_path / "none").mkdir()
    assert call(model, tmp_path / "none", "--out", tmp_path / "r")[2].count("the folder holds no files") == 1
    assert "no such file, no pattern that matches one" in call(model, tmp_path / "no.png", "--out", tmp_path / "r")[2]


def test_a_name_too_long_or_without_meaning_is_told_or_written_out(model, call, images, tmp_path):
    long = images("a" * 250 + ".png", GREY)
    broken = images(os.fsdecode(b"caf\xe9.png"), b"")
    code, out, err = call(model, long, broken, images(os.fsdecode(b"th\xe9.png"), GREY), "--out", tmp_path / "r")
    assert code == 1 and r"caf\xe9.png: not readable" in err and (tmp_path / "r" / r"th\xe9.npz").exists()
    assert (tmp_path / "r" / f"{'a' * 250}.npz").exists() and "2 reconstructed, 1 failed" in out


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_values_of_a_camera_of_fewer_bits_are_shares_of_its_white(bits, tmp_path, call, images):
    model = tmp_path / "model.onnx"
    model.write_bytes(model_of(metadata(bits=str(bits))))
    white = 2**bits - 1
    good = images("good.png", np.rint(TRUE * white).astype(np.uint16)), images("eight.png", GREY)
    bad = images("over.png", np.full((6, 8), white + 1, np.uint16)), images("rgb.png", READ["rgb_16.png"])
    code, out, err = call(model, *good, *bad, "--out", tmp_path / "r")
    assert code == 1 and "2 reconstructed, 2 failed" in out
    for name in ("good", "eight"):
        np.testing.assert_allclose(seen(tmp_path / "r", name), TRUE, atol=0.51 / white)
    assert f"values up to {white + 1}; expected at most {white} for the {bits} bits that the model states" in err
    assert "rgb.png: colour or alpha with more than 8 bits" in err


def test_the_arrays_of_a_camera_of_12_bits_are_divided_too(edge, tmp_path):
    model = tmp_path / "model.onnx"
    model.write_bytes(model_of(metadata(bits="12")))
    session = edge.Session(model)
    values = np.rint(TRUE * 4095).astype(np.uint16)
    np.testing.assert_allclose(session.run(values)["seen"][0, 0], TRUE, atol=2e-4)
    with pytest.raises(edge.EdgeError, match="values up to 4096; expected at most 4095"):
        session.run(values + 4096 - values.max())


FILES = {
    "missing": (None, "no such file; expected a model from `torchmembrane export`, check the path"),
    "a folder": ("folder", "a folder; expected a model from `torchmembrane export`"),
    "empty": (b"", "not readable as a model"),
    "text": (b"format = 1\nname = 'sensor'\n", "not readable as a model"),
    "cut": (model_of(metadata())[:-400], "not readable as a model"),
    "damaged": (model_of(metadata()).replace(b"ReduceMean", b"ReduceMeat"), "not readable as a model"),
    "an image": (saved(GREY, "PNG"), "not readable as a model"),
    "another format": (model_of(metadata(format="2")), "format '2'; expected '1'"),
    "of another program": (model_of({}), "format None; expected '1'"),
    "no name": (model_of(metadata(name=None)), "name is missing"),
    "no unit": (model_of(metadata(length_unit=None)), "length_unit is missing"),
    "empty unit": (model_of(metadata(force_unit="")), "force_unit is missing"),
    "two units": (model_of(metadata(length_unit="m")), "length_unit is 'm', of the mesh 'mm'"),
    "no texts": (model_of(metadata(status_texts=None)), "status_texts is missing"),
    "texts no JSON": (model_of(metadata(status_texts="{0: ok")), "metadata are not readable"),
    "texts a list": (model_of(metadata(status_texts='["ok"]')), "status_texts is a list"),
    "texts of words": (model_of(metadata(status_texts='{"zero": "ok"}')), "status_texts are not texts by their codes"),
    "texts of numbers": (model_of(metadata(status_texts='{"0": 1}')), "status_texts are not texts by their codes"),
    "no mesh": (model_of(metadata(mesh=None) | {"mesh": ""}), "mesh is missing"),
    "mesh a number": (model_of(metadata() | {"mesh": "7"}), "mesh is a int"),
    "mesh nested": (model_of(metadata() | {"mesh": "[" * 100_000}), "metadata are not readable"),
    "mesh without size": (model_of(metadata() | {"mesh": without("image_size")}), "mesh lacks image_size"),
    "mesh without sensor": (model_of(metadata() | {"mesh": without("sensor")}), "mesh lacks sensor"),
    "mesh without vertices": (model_of(metadata() | {"mesh": without("rest_vertices")}), "mesh lacks rest_vertices"),
    "sensor a number": (model_of(metadata({"sensor": 1})), "mesh: sensor is not text"),
    "size of one": (model_of(metadata({"image_size": [8]})), "image_size is int64 [1], not [2]"),
    "size a number": (model_of(metadata({"image_size": 8})), "image_size is int64 [], not [2]"),
    "size a text": (model_of(metadata({"image_size": "8 x 6"})), "image_size is <U5 [], not [2]"),
    "size fractional": (model_of(metadata({"image_size": [8.5, 6]})), "image_size is float64 [2], not [2]"),
    "size negative": (model_of(metadata({"image_size": [-8, -6]})), "image_size [-8, -6]"),
    "size huge": (model_of(metadata({"image_size": [10**30, 6]})), "image_size is object [2], not [2]"),
    "size of another": (model_of(metadata({"image_size": [6, 8]})), "not [batch, 1, 8, 6] as its mesh says"),
    "vertices ragged": (model_of(metadata({"rest_vertices": [[0, 0], [1]]})), "metadata are not readable"),
    "vertices null": (model_of(metadata({"rest_vertices": [[None] * 3] * 9})), "rest_vertices is object"),
    "vertices few": (model_of(metadata({"rest_vertices": VERTICES[:4].tolist()})), "rest_normals is float64 [9, 3]"),
    "triangles beyond": (model_of(metadata({"triangles": [[0, 1, 9]]})), "triangles refer to vertices that do not exist"),
    "triangles negative": (model_of(metadata({"triangles": [[0, 1, -1]]})), "triangles refer to vertices that do not exist"),
    "fixed of numbers": (model_of(metadata({"fixed": [0.5] * 9})), "fixed is float64 [9]"),
    "grid of another": (model_of(metadata({"grid": [3, 4]})), "grid [3, 4]"),
    "tool cut": (model_of(metadata({"camera_in_tool": [[1, 0, 0, 0]]})), "camera_in_tool [[1.0, 0.0, 0.0, 0.0]]"),
    "bits a word": (model_of(metadata(bits="twelve")), "metadata are not readable"),
    "bits many": (model_of(metadata(bits="32")), "bits is 32, not 8 to 16"),
    "other inputs": (model_of(metadata(), size=(4, 4)), "its image is ['batch', 1, 4, 4], not [batch, 1, 6, 8]"),
}


@pytest.mark.parametrize("kind", FILES)
def test_a_file_that_is_no_model_is_refused_in_words(kind, call, images, tmp_path):
    content, reason = FILES[kind]
    path = tmp_path / "model.onnx"
    if content == "folder":
        path.mkdir()
    elif content is not None:
        path.write_bytes(content)
    code, _, err = call(path, images("a.png", GREY), "--out", tmp_path / "r")
    assert code == 2 and err.startswith(f"torchmembrane-edge: error: {path}: ") and reason in err, err
    assert "torchmembrane export" in err and len(err.splitlines()) == 1 and not (tmp_path / "r").exists()


def test_a_model_without_a_status_is_refused(call, images, tmp_path):
    model = tmp_path / "model.onnx"
    model.write_bytes(model_of(metadata(), status="stasis"))
    code, _, err = call(model, images("a.png", GREY), "--out", tmp_path / "r")
    assert code == 2 and "the model of 'by hand' gives no status; expected a model from `torchmembrane export`" in err


@pytest.mark.parametrize("seed", range(12))
def test_a_damaged_model_is_refused_or_runs_and_never_ends_in_a_traceback(seed, call, images, tmp_path):
    generator, content = np.random.default_rng(seed), bytearray(model_of(metadata()))
    for place in generator.integers(0, len(content), 8):
        content[place] ^= 1 << generator.integers(8)
    path = tmp_path / "model.onnx"
    path.write_bytes(content)
    code, _, err = call(path, images("a.png", GREY), "--out", tmp_path / "r")
    assert code in (0, 1) or err.startswith("torchmembrane-edge: error: ")


def test_a_status_without_a_text_is_given_by_its_code(call, images, tmp_path):
    model = tmp_path / "model.onnx"
    model.write_bytes(model_of(metadata(status_texts='{"0": "ok"}')))
    path = images("a.png", 0 * GREY)
    assert call(model, path, "--out", tmp_path / "r")[::2] == (1, f"{path}: status 4\n")


def test_loading_is_told_with_its_time_before_it_begins(model, edge, images, tmp_path, monkeypatch, capsys):
    path = images("a.png", GREY)
    told = []

    class Loaded(edge.Session):
        def __init__(self, *arguments):
            told.append(capsys.readouterr().err)
            super().__init__(*arguments)

    monkeypatch.setattr(edge.cli, "Session", Loaded)
    assert edge.cli.main([str(model), str(path), "--out", str(tmp_path / "r")]) == 0
    assert told == [f"torchmembrane-edge: loading {model}, 0.0 MB; on one core this takes some 1 s\n"]


OUTS = {
    "a file": (lambda out: out.write_text("x"), "is a file; expected a new folder"),
    "results without mesh": (lambda out: np.savez(out / "a.npz", x=1), "holds .npz files or frames/ but no mesh.npz"),
    "damaged mesh": (lambda out: (out / "mesh.npz").write_bytes(b"PK\3\4 damaged"), "not a mesh.npz of torchmembrane"),
    "empty mesh": (lambda out: (out / "mesh.npz").write_bytes(b""), "not a mesh.npz of torchmembrane"),
    "foreign mesh": (lambda out: np.savez(out / "mesh.npz", points=np.zeros((3, 3))), "it has no name"),
    "pickled mesh": (
        lambda out: np.savez(out / "mesh.npz", name="x", sensor=np.array([{}], object)),
        "not a mesh.npz of torchmembrane",
    ),
    "sensor a number": (lambda out: np.savez(out / "mesh.npz", name="x", sensor=7), "it has no sensor"),
    "a folder mesh": (lambda out: (out / "mesh.npz").mkdir(), "not a mesh.npz of torchmembrane"),
    "another sensor": (
        lambda out: np.savez(out / "mesh.npz", name="other\n", sensor="b" * 64),
        r"holds results of another sensor, 'other\n' (bbbbbbbbbbbb, here aaaaaaaaaaaa); choose another folder",
    ),
    "another estimator": (
        lambda out: np.savez(out / "mesh.npz", name="by hand", sensor="a" * 64, estimator="paper"),
        "was made with estimator paper, the model has force-balance; choose another folder",
    ),
    "parquet": (
        lambda out: np.savez(out / "mesh.npz", name="by hand", sensor="a" * 64, estimator="force-balance", format="parquet"),
        "was made with format parquet, the model has npz",
    ),
}


@pytest.mark.parametrize("kind", OUTS)
def test_a_folder_that_is_not_of_these_results_is_refused_and_left_as_it_is(kind, model, call, images, tmp_path):
    make, reason = OUTS[kind]
    out = tmp_path / "r"
    if kind != "a file":
        out.mkdir()
    make(out)
    before = sorted((path, path.is_file() and path.read_bytes()) for path in tmp_path.rglob("*"))
    path = images("a.png", GREY)
    code, _, err = call(model, path, "--out", out)
    assert code == 2 and reason in err and str(out) in err and len(err.splitlines()) == 1, err
    assert [each for each in before if each[0] != path] == [
        (each, each.is_file() and each.read_bytes()) for each in sorted(tmp_path.rglob("*")) if each != path
    ]


def test_results_of_the_same_model_are_added_to(model, call, images, tmp_path):
    for name in ("a.png", "b.png"):
        assert call(model, images(name, GREY), "--out", tmp_path / "r")[0] == 0
    tables = ["summary.csv", "summary_columns.csv"]
    assert sorted(path.name for path in (tmp_path / "r").iterdir()) == ["a.npz", "b.npz", "mesh.npz", *tables]


def test_a_result_of_an_image_that_cannot_be_read_any_more_is_removed(model, call, images, tmp_path):
    paths = [images(name, GREY) for name in ("a.png", "b.png")]
    assert call(model, *paths, "--out", tmp_path / "r")[0] == 0
    paths[1].write_bytes(paths[1].read_bytes()[:50])
    assert call(model, *paths, "--out", tmp_path / "r")[0] == 1
    assert sorted(path.name for path in (tmp_path / "r").glob("*.npz")) == ["a.npz", "mesh.npz"]


@pytest.mark.parametrize("count, left", [(2, ["a_000000", "a_000001"]), (1, ["a"])])
def test_results_of_pictures_that_a_file_no_longer_contains_are_removed(count, left, model, call, images, tmp_path):
    assert call(model, images("a.tif", SEQUENCES["a.tif"]), "--out", tmp_path / "r")[0] == 0
    assert call(model, images("a_000007.png", GREY), "--out", tmp_path / "r")[0] == 0  # of another file: kept
    pictures = [Image.fromarray(GREY)] * count
    code, _, err = call(model, images("a.tif", pictures[0], save_all=True, append_images=pictures[1:]), "--out", tmp_path / "r")
    names = [*left, "a_000007"]
    assert code == 0 and "a_000002 removed, as the file does not contain this picture any more" in err
    assert sorted(path.stem for path in (tmp_path / "r").glob("a*.npz")) == sorted(names)
    with open(tmp_path / "r" / "summary.csv", newline="") as file:
        assert [row["name"] for row in csv.DictReader(file)] == names


def test_a_full_disk_is_told_with_the_file_and_leaves_no_half_one(model, call, images, tmp_path, monkeypatch):
    write, left = Path.write_bytes, [3000]

    def written(path, content):
        left[0] -= len(content)
        if left[0] < 0:
            write(path, bytes(content)[:100])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, content)

    paths = [images(f"{k}.png", GREY) for k in range(5)]
    left[0] = 12_000
    monkeypatch.setattr(Path, "write_bytes", written)
    code, _, err = call(model, *paths, "--out", tmp_path / "r")
    assert code == 2 and "npz: cannot be written (No space left on device); expected a folder with space" in err
    names = {path.name for path in (tmp_path / "r").iterdir()}
    assert "mesh.npz" in names and "0.npz" in names and "4.npz" not in names and not any("partial" in name for name in names)


@pytest.mark.parametrize("out", ["/proc/results", "/dev/null/results"])
def test_a_folder_that_cannot_be_made_is_told(out, model, call, images):
    code, _, err = call(model, images("a.png", GREY), "--out", out)
    assert code == 2 and err.startswith(f"torchmembrane-edge: error: --out {out}: cannot be made ("), err


OPTIONS = {
    "--batch 0": "argument --batch: '0'; expected a whole number from 1 to 256",
    "--batch -1": "argument --batch: '-1'; expected a whole number",
    "--batch 1000000000000": "argument --batch: '1000000000000'; expected a whole number",
    "--batch 2.5": "argument --batch: '2.5'; expected a whole number",
    "--threads 0": "argument --threads: '0'; expected a whole number from 1 to 256",
    "--threads 100000": "argument --threads: '100000'; expected",
    "--frames 3": "--frames 3 without --camera",
    "--frames 0": "argument --frames: '0'; expected",
    "--camera -1": "argument --camera: '-1'; expected",
    "--camera 0": "--camera with images or --out",
    "--tracking": "unrecognized arguments: --tracking",
    "--pressure gauge.csv": "unrecognized arguments: --pressure",
    "--providers NoneExecutionProvider": "providers ['NoneExecutionProvider']; expected a list of some of the providers",
}


@pytest.mark.parametrize("options", OPTIONS)
def test_options_that_cannot_be_are_refused(options, model, call, images, tmp_path):
    code, out, err = call(model, images("a.png", GREY), "--out", tmp_path / "r", *options.split())
    assert (code, out) == (2, "") and OPTIONS[options] in err and not (tmp_path / "r").exists(), err


def test_without_images_or_folder_the_command_says_what_it_needs(model, call, images, tmp_path):
    for arguments in ((), (images("a.png", GREY),), ("--out", tmp_path / "r")):
        code, _, err = call(model, *arguments)
        assert code == 2 and "expected IMAGES and --out DIR, or --camera NUMBER" in err


def rows_of(folder):
    with open(folder / "summary.csv", newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def test_the_table_of_a_folder_is_torchmembrane_s(model, call, images, tmp_path):
    one, dark = images("press_20260927T113829.png", GREY), images("=dark.png", 0 * GREY)
    broken = images("broken.png", b"no image")
    code, out, err = call(model, one, dark, broken, "--out", tmp_path / "r")
    assert code == 1 and (tmp_path / "r" / "summary_columns.csv").read_text().startswith("name,unit,meaning")
    rows = rows_of(tmp_path / "r")
    assert list(rows) == ["'=dark", "broken", one.stem] and tuple(rows["broken"]) == NAMES
    assert [row["status"] for row in rows.values()] == ["4", "-1", "0"]
    row, mean = rows[one.stem], GREY.mean() / 255
    assert row["status_text"] == "ok" and rows["broken"]["status_text"].startswith("unreadable: ")
    assert [float(row[f"force_{axis}"]) for axis in "xyz"] == pytest.approx([0, 0, -mean], rel=1e-4)
    assert [float(row[key]) for key in ("deepest", "time")] == pytest.approx([mean, 1790509109], rel=1e-4)
    assert row["content_hash"] == SourceFile.from_files(one).content_hash and row["contact_1_x"] == ""
    with np.load(tmp_path / "r" / f"{one.stem}.npz") as stored:
        assert str(stored["path"]) == row["file"] == str(one) and stored["time"] == 1790509109
    again = images("again.png", GREY)
    call(model, again, "--out", tmp_path / "r")
    later = rows_of(tmp_path / "r")
    assert list(later) == ["'=dark", "again", "broken", one.stem] and later[one.stem] == row


def test_each_frame_s_line_says_status_and_force(model, call, images, tmp_path):
    code, out, err = call(model, images("press.png", GREY), images("dark.png", 0 * GREY), "--out", tmp_path / "r")
    first, last = out.splitlines()
    assert first.startswith("press: ok, moved by at most ") and f"force {GREY.mean() / 255:.3g} N (0, 0, -" in first
    assert last.startswith("frames: 1 reconstructed, 1 failed") and "blank or saturated" in err


def test_a_batch_s_time_is_shared_by_its_images_and_rows_are_in_the_order_of_their_numbers(
    model, call, images, tmp_path, monkeypatch
):
    """Of three images in six seconds each takes two; the tenth comes after the second, however a table is begun."""
    from torchmembrane_edge import cli

    clock = iter((0.0, 6.0, 10.0, 11.0))
    monkeypatch.setattr(cli, "time", types.SimpleNamespace(perf_counter=lambda: next(clock)))
    made = [images(f"press_{number}.png", GREY) for number in (2, 10, 11)]
    _, out, _ = call(model, *made, "--out", tmp_path / "r", "--batch", 3)
    assert [line.rpartition(", ")[2] for line in out.splitlines()[:3]] == ["2000 ms"] * 3
    call(model, images("press_9.png", GREY), "--out", tmp_path / "r")
    rows = rows_of(tmp_path / "r")
    assert list(rows) == ["press_2", "press_9", "press_10", "press_11"]
    assert [float(row["seconds"]) for row in rows.values()] == [2.0, 1.0, 2.0, 2.0]


def test_contacts_are_told_with_place_and_force(edge):
    session = types.SimpleNamespace(
        length_unit="mm", force_unit="N", status_text=lambda code: "ok", mesh={"rest_normals": np.ones((1, 3))}
    )
    points = np.full((4, 3), np.nan)
    points[:2] = [[1, 2, 3], [4, 5, 6]]
    moved = np.array([[-2.0, 3.0, 6.0]])
    frame = {"status": 0, "displacement": moved, "vertices": np.ones((1, 3)), "force": np.array([0.0, 3.0, 4.0])}
    frame |= {"contact_points": points, "contact_force": 2 * points, "contact_area": points[:, 0]}
    said = edge.cli.line(session, frame)
    assert said.endswith(
        "by at most 7 mm, force 5 N (0, 3, 4), contact at (1, 2, 3) mm of 7.48 N, contact at (4, 5, 6) mm of 17.5 N"
    )


@pytest.mark.parametrize("made, warned", [("99.0.0", True), ("0.0.9", False), (None, False), ("nonsense", False)])
def test_a_model_of_a_later_version_is_told(made, warned, call, images, tmp_path):
    model = tmp_path / "later.onnx"
    model.write_bytes(model_of(metadata(version=made)))
    code, _, err = call(model, images("press.png", GREY), "--out", tmp_path / "r")
    assert code == 0 and ("made by torchmembrane 99.0.0; expected one of this torchmembrane-edge's version" in err) == warned


def test_both_packages_have_one_version(edge):
    projects = [tomllib.loads((folder / "pyproject.toml").read_text())["project"] for folder in (ROOT, ROOT / "export")]
    assert [project["version"] for project in projects] == [edge.__version__] * 2


def with_camera(monkeypatch, *frames):
    """OpenCV whose camera gives these frames, then none."""
    waiting = iter(frames)

    class Capture:
        def __init__(self, number): ...

        def set(self, *_): ...

        def release(self): ...

        def read(self):
            frame = next(waiting, None)
            return frame is not None, frame

    cv2 = types.SimpleNamespace(
        VideoCapture=Capture, CAP_PROP_FRAME_WIDTH=3, CAP_PROP_FRAME_HEIGHT=4, CAP_PROP_ORIENTATION_AUTO=49
    )
    cv2.__spec__ = types.SimpleNamespace(name="cv2")
    monkeypatch.setitem(sys.modules, "cv2", cv2)


def test_frames_of_a_camera_are_computed_in_every_layout(model, call, monkeypatch):
    with_camera(monkeypatch, GREY, RGB, GREY[..., None], np.dstack([RGB, GREY]), WIDE, 0 * GREY)
    code, out, err = call(model, "--camera", 0, "--frames", 6)
    lines = out.splitlines()
    assert (code, err, len(lines)) == (0, "", 6) and "blank or saturated" in lines[5]
    assert len({line.split(": ")[1].rpartition(",")[0] for line in lines[:5]}) == 1


@pytest.mark.parametrize("frame", [None, GREY[:, :4], GREY.astype(np.int32)])
def test_a_camera_that_gives_no_such_images_is_told(frame, model, call, monkeypatch):
    with_camera(monkeypatch, *([] if frame is None else [frame]))
    code, _, err = call(model, "--camera", 5)
    expected = "camera 5 gives no image; expected one of 8 x 6 px" if frame is None else "expected"
    assert code == 2 and expected in err and len(err.splitlines()) == 1


ARRAYS = {
    "grey": (GREY, 1),
    "a batch": (np.stack([GREY, GREY]), 2),
    "colour": (RGB, 1),
    "a batch of colour": (np.stack([RGB, RGB]), 2),
    "channel first": (GREY[None, None], 1),
    "colours first": (np.moveaxis(RGB, -1, 0)[None], 1),
    "channel last": (GREY[None, :, :, None], 1),
    "one channel last": (GREY[..., None], 1),
    "16 bits": (WIDE, 1),
    "16 bits, bytes swapped": (WIDE.astype(">u2"), 1),
    "float": (TRUE, 1),
    "a list of floats": (TRUE.tolist(), 1),
}


@pytest.mark.parametrize("kind", ARRAYS)
def test_arrays_of_every_layout_are_the_same_image(kind, edge, model):
    array, count = ARRAYS[kind]
    results = edge.Session(model).run(array)
    assert results["status"].tolist() == [0] * count
    np.testing.assert_allclose(results["seen"][:, 0], np.stack([TRUE] * count), atol=1e-6)


NO_IMAGES = {
    "none": (None, r"images \[\]; expected \[H, W\]"),
    "a number": (3, r"images \[\]; expected"),
    "an empty list": ([], r"images \[0\]; expected"),
    "a text": ("press.png", r"images \[\]; expected"),
    "rows of different lengths": ([[1, 2], [3]], "images are not an array"),
    "a tensor that requires gradients": (torch.zeros(6, 8, requires_grad=True), "images are not an array"),
    "whole numbers": (GREY.astype(int), "images of type int64; expected uint8, uint16 or float in 0..1"),
    "truths": (GREY > 3, "images of type bool"),
    "objects": (GREY.astype(object), "images of type object"),
    "complex numbers": (TRUE + 0j, "images of type complex128"),
    "another size": (GREY[:4], "the image is 8 x 4 px, expected 8 x 6"),
    "turned": (GREY.T, "the image is 6 x 8 px, expected 8 x 6"),
    "with alpha": (np.dstack([RGB, GREY]), "give grey or colour, without alpha"),
    "five dimensions": (GREY[None, None, None], "expected"),
}


@pytest.mark.parametrize("kind", NO_IMAGES)
def test_what_is_no_image_is_refused(kind, edge, model):
    array, reason = NO_IMAGES[kind]
    with pytest.raises(edge.EdgeError, match=reason):
        edge.Session(model).run(array)


def test_no_images_give_no_rows(edge, model):
    results, one = (edge.Session(model).run(np.zeros((count, HEIGHT, WIDTH), np.uint8)) for count in (0, 1))
    assert {key: (value.shape[1:], value.dtype, len(value)) for key, value in results.items()} == {
        key: (value.shape[1:], value.dtype, 0) for key, value in one.items()
    }


def test_a_model_that_gives_other_than_a_row_for_each_image_is_refused(edge, tmp_path):
    model = tmp_path / "model.onnx"
    model.write_bytes(model_of(metadata(), rows=3))
    with pytest.raises(edge.EdgeError, match="does not return one row per image|cannot run the model on 2 images"):
        edge.Session(model).run(np.stack([GREY, GREY]))


def test_results_that_a_frame_cannot_start_from_are_refused(edge, tmp_path):
    model = tmp_path / "model.onnx"
    model.write_bytes(model_of(metadata(), tracking=True))
    session = edge.Session(model)
    first = session.run(GREY)
    assert session.run(GREY, first)["pixels"].tolist() == [[[2.0, 2.0]]]
    for wrong in ({}, [], {"pixels": np.zeros((2, 1, 2), np.float32)}, {"pixels": None}, {"pixels": [["a", "b"]]}):
        with pytest.raises(edge.EdgeError, match="expected"):
            session.run(GREY, wrong)
    with pytest.raises(edge.EdgeError, match="2 images with previous results pixels"):
        session.run(np.stack([GREY, GREY]), first)
    assert [len(found["status"]) for found in session.track([GREY, GREY.tolist() and GREY])] == [1, 1]
    with pytest.raises(edge.EdgeError, match="images are of type NoneType; expected an iterable of a video's images"):
        next(session.track(None))
    model.write_bytes(model_of(metadata()))
    with pytest.raises(edge.EdgeError, match="does not track"):
        next(edge.Session(model).track([GREY]))


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"threads": 0}, "threads 0; expected a whole number"),
        ({"threads": "2"}, "threads '2'; expected"),
        ({"providers": "CPUExecutionProvider"}, "expected a list of some"),
        ({"providers": [1]}, "expected a list of some"),
    ],
)
def test_a_session_s_options_are_checked(options, reason, edge, model):
    with pytest.raises(edge.EdgeError, match=reason):
        edge.Session(model, **options)


@pytest.mark.parametrize("path", [None, 3, b"model.onnx", ["model.onnx"]])
def test_what_is_no_path_is_refused(path, edge):
    with pytest.raises(edge.EdgeError, match="expected the path of a model"):
        edge.Session(path)


def test_a_wrench_without_tool_or_of_other_results_is_refused(edge, model, tmp_path):
    with pytest.raises(edge.EdgeError, match="has no tool"):
        edge.Session(model).wrench_in_tool({})
    path = tmp_path / "tool.onnx"
    path.write_bytes(model_of(metadata({"camera_in_tool": np.eye(4)[:3].tolist()})))
    session = edge.Session(path)
    results = session.run(GREY)
    np.testing.assert_allclose(session.wrench_in_tool(results), results["wrench"])
    for wrong in ({}, None, {"wrench": np.zeros(6)}, {"wrench": "x"}):
        with pytest.raises(edge.EdgeError, match="expected results of `run`"):
            session.wrench_in_tool(wrong)


def test_a_wrench_is_carried_to_the_tool_as_torchmembrane_s_pose_does_it(edge, tmp_path):
    pose = Pose(np.array([20.0, -50.0, 70.0]), np.array([3.0, -1.0, 12.0]))
    path, wrench = tmp_path / "tool.onnx", np.random.default_rng(0).normal(size=(5, 6)).astype(np.float32)
    path.write_bytes(model_of(metadata({"camera_in_tool": np.column_stack([pose.rotation, pose.translation]).tolist()})))
    np.testing.assert_allclose(edge.Session(path).wrench_in_tool({"wrench": wrench}), pose.wrench(wrench), atol=1e-4)
