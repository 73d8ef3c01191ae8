"""What the page is tested with and against: images, models, and what Python makes of them.

python export/web/test/reference.py SENSOR.toml MODEL.onnx EXAMPLE.png... --tracking MODEL.onnx --out DIR
"""

import argparse
import shutil
import struct
from pathlib import Path

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
    """Images that decoders may take for something else, with the grey values of `read_image` as .f32; unusable ones."""
    grey = Image.open(example)
    linear = PngImagePlugin.PngInfo()
    linear.add(b"gAMA", struct.pack(">I", 100000))  # the values are light, not sRGB: a screen would show them brighter
    grey.save(out / "linear.png", pnginfo=linear)
    colour = np.random.default_rng(0).integers(0, 256, (grey.height, grey.width, 3), np.uint8)
    Image.fromarray(colour).save(out / "colour.png")
    upside_down = Image.Exif()
    upside_down[0x0112] = 3  # orientation: turned by 180 degrees
    grey.save(out / "upside_down.jpg", exif=upside_down)
    for name in ("linear.png", "colour.png", "upside_down.jpg"):
        read_image(out / name).tofile(out / f"{name}.f32")
    grey.crop((0, 0, 320, 480)).save(out / "narrow.png")
    Image.new("L", grey.size, 128).save(out / "blank.png")
    Image.new("LA", grey.size, (128, 100)).save(out / "transparent.png")


def models(path: Path, out: Path) -> None:
    """The model under another name, and one that no `torchmembrane export` wrote."""
    model = onnx.load(path)
    name = next(entry for entry in model.metadata_props if entry.key == "name")
    name.value = "another sensor"
    onnx.save(model, out / "another.onnx")
    del model.metadata_props[:]
    onnx.save(model, out / "foreign.onnx")


if __name__ == "__main__":
    main()
