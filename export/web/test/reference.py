"""Write the test inputs of the web page and the expected results: images, models, and their results in Python.

python export/web/test/reference.py SENSOR.toml MODEL.onnx EXAMPLE.png... --tracking MODEL.onnx --out DIR
"""

import argparse
import json
import shutil
import struct
from pathlib import Path

import cv2
import numpy as np
import onnx
import torch
from PIL import Image, PngImagePlugin
from torchmembrane_edge import Session

from torchmembrane import Reconstructor
from torchmembrane.files.images import read_image
from torchmembrane.results.npz import save_frame


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name in ("sensor", "model"):
        parser.add_argument(name, type=Path)
    parser.add_argument("examples", nargs="+", type=Path)
    parser.add_argument("--tracking", required=True, type=Path)
    parser.add_argument("--out", required=True, type=Path)
    arguments = parser.parse_args()
    shutil.rmtree(arguments.out, ignore_errors=True)
    arguments.out.mkdir(parents=True)
    images(arguments.examples[0], arguments.out)
    models(arguments.model, arguments.out)
    torch.set_num_threads(1)
    reconstructor = Reconstructor.from_file(arguments.sensor)
    for path in [*arguments.examples, arguments.out / "blank.png"]:
        with torch.no_grad():
            save_frame(arguments.out / f"{path.stem}.npz", reconstructor(reconstructor.read(path)).frame(0))
    frames = [np.asarray(Image.open(path)) for path in sorted(arguments.examples)]
    for place, found in enumerate(Session(arguments.tracking).track(frames)):
        np.savez(arguments.out / f"tracked_{place}.npz", **{name: values[0] for name, values in found.items()})


def images(example: Path, out: Path) -> None:
    """Write images that decoders may misinterpret, with the grey values of `read_image` as .f32, and unusable images."""
    grey = Image.open(example)
    linear = PngImagePlugin.PngInfo()
    linear.add(b"gAMA", struct.pack(">I", 100000))  # the values are light, not sRGB: a screen would show them brighter
    grey.save(out / "linear.png", pnginfo=linear)
    colour = np.random.default_rng(0).integers(0, 256, (grey.height, grey.width, 3), np.uint8)
    Image.fromarray(colour).save(out / "colour.png")
    upside_down = Image.Exif()
    upside_down[0x0112] = 3  # orientation: turned by 180 degrees
    grey.save(out / "upside_down.jpg", exif=upside_down)
    grey.save(out / "upside_down.png", exif=upside_down)
    for name in ("linear.png", "colour.png", "upside_down.jpg", "upside_down.png"):
        read_image(out / name).tofile(out / f"{name}.f32")
    grey.crop((0, 0, 320, 480)).save(out / "narrow.png")
    Image.new("L", grey.size, 128).save(out / "blank.png")
    Image.new("LA", grey.size, (128, 100)).save(out / "transparent.png")
    values = np.asarray(grey).astype(np.uint16)
    Image.fromarray(values * 257).save(out / "sixteen.png")
    Image.fromarray(np.rint(values / 255 * 4095).astype(np.uint16)).save(out / "twelve.png")
    cv2.imwrite(str(out / "colour_16.png"), np.stack([values * 257] * 3, -1))
    sequences(grey.convert("RGB"), out)
    (out / "text.png").write_text("no image")
    (out / "empty.png").write_bytes(b"")
    (out / "cut.png").write_bytes((out / "colour.png").read_bytes()[:5000])
    for name in ("huge.png", "huge.jpg"):
        Image.new("L", (20_000, 20_000)).save(out / name)


def sequences(picture: Image.Image, out: Path) -> None:
    """Write files of three pictures, and a file of one picture with a preview."""
    others = [Image.eval(picture, lambda value: 255 - value), picture]
    for name, kind in {"png": "PNG", "gif": "GIF", "webp": "WEBP", "jpg": "MPO"}.items():
        picture.save(out / f"sequence.{name}", kind, save_all=True, append_images=others)
    picture.save(out / "preview.jpg", "MPO", save_all=True, append_images=[picture.resize((160, 120))])


def models(path: Path, out: Path) -> None:
    """Write copies of the model: under another name, with damaged sensor metadata, and as no `torchmembrane export` writes
    it."""
    model = onnx.load(path)
    known = {entry.key: entry.value for entry in model.metadata_props}
    mesh = json.loads(known["mesh"])
    for name, changed in {
        "another": {"name": "another sensor"},
        "twelve": {"bits": "12"},
        "regions": {
            "name": "two views",
            "mesh": json.dumps(mesh | {"image_size": [320, 400], "image_part": [0, 0, *mesh["image_size"]]}),
        },
        "no_part": {"mesh": json.dumps(mesh | {"image_part": [0, 0, 640]})},
        "apart": {"mesh": json.dumps(mesh | {"view_names": "left right"})},
        "no_mesh": {"mesh": ""},
        "no_size": {"mesh": json.dumps({key: value for key, value in mesh.items() if key != "image_size"})},
        "no_vertices": {"mesh": json.dumps(mesh | {"rest_vertices": [[0, 0], [1]]})},
        "no_texts": {"status_texts": "[ok"},
    }.items():
        del model.metadata_props[:]
        onnx.helper.set_model_props(model, known | changed)
        onnx.save(model, out / f"{name}.onnx")
    entries = onnx.ModelProto()
    onnx.helper.set_model_props(entries, known)
    (out / "cut.onnx").write_bytes(entries.SerializeToString() + path.read_bytes()[:10_000])
    (out / "text.onnx").write_text("no model")
    (out / "empty.onnx").write_bytes(b"")
    del model.metadata_props[:]
    onnx.save(model, out / "foreign.onnx")


if __name__ == "__main__":
    main()
