"""Images degraded in many ways: is the answer right, said to be doubtful, or wrong with status ok?

python -m bench.robustness.degraded_images DATA [--sensors 0,1,2] [--json FILE]

DATA from data/random_sensors.py. Every way is applied to one press of every sensor, the first that has status ok undamaged.
Wrong: the surface is off by over a quarter of the press. Printed: for every way the status and the surface's error, for each
sensor; then the shares.
"""

import argparse
import io
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy import ndimage

import torchmembrane as tm
from bench.accuracy.range import CLOSE, quantities
from bench.data.record import write

Spoil = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def warped(matrix: np.ndarray, shift: tuple[float, float] = (0, 0)) -> Spoil:
    """The image seen by a camera that moved: `p -> matrix (p - centre) + centre + shift`, rows first."""

    def spoil(image: np.ndarray, _: np.random.Generator) -> np.ndarray:
        centre, inverse = (np.array(image.shape) - 1) / 2, np.linalg.inv(matrix)
        offset = centre - inverse @ (centre + np.array(shift))
        return ndimage.affine_transform(image, inverse, offset, order=1, mode="nearest")

    return spoil


def rotated(degrees: float) -> Spoil:
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return warped(np.array([[c, s], [-s, c]]))


def zoomed(scale: float) -> Spoil:
    return warped(scale * np.eye(2))


def covered(where: Callable[[np.ndarray, np.ndarray], np.ndarray], grey: float | None) -> Spoil:
    """A part, by its share of the image's height and width, of one grey; None: the image's median."""

    def spoil(image: np.ndarray, _: np.random.Generator) -> np.ndarray:
        v, u = np.indices(image.shape) / np.array(image.shape)[:, None, None]
        return np.where(where(v, u), np.median(image) if grey is None else grey, image)

    return spoil


def spots(count: int, radius: float, grey: float) -> Spoil:
    """Discs of one grey at random places, radius over the image's height."""

    def spoil(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        v, u = np.indices(image.shape)
        image = image.copy()
        for centre in rng.uniform(0.15, 0.85, (count, 2)) * image.shape:
            image[np.hypot(v - centre[0], u - centre[1]) < radius * image.shape[0]] = grey
        return image

    return spoil


def moved(length: int, degrees: float) -> Spoil:
    """Motion blur over so many px."""

    def spoil(image: np.ndarray, _: np.random.Generator) -> np.ndarray:
        t = np.linspace(-0.5, 0.5, 2 * length + 1) * length
        steps = [(k * np.sin(np.deg2rad(degrees)), k * np.cos(np.deg2rad(degrees))) for k in t]
        return np.mean([ndimage.shift(image, step, order=1, mode="nearest") for step in steps], 0)

    return spoil


def interlaced(step: int) -> Spoil:
    """Every second row taken later, the image shifted by so many px."""

    def spoil(image: np.ndarray, _: np.random.Generator) -> np.ndarray:
        image = image.copy()
        image[1::2] = np.roll(image[1::2], step, 1)
        return image

    return spoil


def rolling(step: float) -> Spoil:
    """Rows read one after another while the camera moves sideways by so many px."""
    return warped(np.array([[1.0, 0.0], [step / 480, 1.0]]))


def ghost(share: float, step: int) -> Spoil:
    return lambda image, _: (1 - share) * image + share * np.roll(image, step, 1)


def compressed(quality: int) -> Spoil:
    def spoil(image: np.ndarray, _: np.random.Generator) -> np.ndarray:
        file = io.BytesIO()
        Image.fromarray((255 * image).round().astype(np.uint8)).save(file, "JPEG", quality=quality)
        return np.asarray(Image.open(file)) / 255

    return spoil


def noise(size: float) -> Spoil:
    return lambda image, rng: image + rng.normal(0, size, image.shape)


def salt(share: float) -> Spoil:
    return lambda image, rng: np.where(rng.random(image.shape) < share, rng.integers(0, 2, image.shape), image)


def shaded(strength: float) -> Spoil:
    """Light from one side."""
    return lambda image, _: image * np.linspace(1 - strength, 1, image.shape[1])


def banded(size: float, rows: int) -> Spoil:
    return lambda image, _: image * (1 + size * np.sin(2 * np.pi * np.arange(image.shape[0]) / rows)[:, None])


def vignette(shape: tuple[int, ...]) -> np.ndarray:
    v, u = np.indices(shape) / np.array(shape)[:, None, None] - 0.5
    return 1 - 1.6 * (u * u + v * v)


def blurred(size: float) -> Spoil:
    return lambda image, _: ndimage.gaussian_filter(image, size)


SPOILS: dict[str, Spoil] = {
    **{f"shifted by {k} px": warped(np.eye(2), (0, k)) for k in (0.5, 1, 2, 5, 10)},
    "shifted down by 3 px": warped(np.eye(2), (3, 0)),
    **{f"rotated by {k} degrees": rotated(k) for k in (0.3, 1, 3, 10)},
    **{f"zoomed by {k}": zoomed(k) for k in (0.9, 0.95, 0.98, 1.02, 1.05)},
    "sheared": warped(np.array([[1, 0.03], [0, 1.0]])),
    "mirrored": lambda image, _: image[:, ::-1],
    "upside down": lambda image, _: image[::-1],
    "rolling shutter, 4 px": rolling(4),
    **{f"interlaced by {k} px": interlaced(k) for k in (2, 6)},
    "left half black": covered(lambda v, u: u < 0.5, 0.0),
    "left half grey": covered(lambda v, u: u < 0.5, None),
    "a quarter black": covered(lambda v, u: (u < 0.5) & (v < 0.5), 0.0),
    "right third white": covered(lambda v, u: u > 0.67, 1.0),
    "upper third grey": covered(lambda v, u: v < 0.33, None),
    "middle black": covered(lambda v, u: np.hypot(u - 0.5, v - 0.5) < 0.15, 0.0),
    "middle grey": covered(lambda v, u: np.hypot(u - 0.5, v - 0.5) < 0.15, None),
    "a stick": covered(lambda v, u: np.abs(v - 0.3 - 0.4 * u) < 0.03, 0.1),
    "a hair": covered(lambda v, u: np.abs(v - 0.3 - 0.4 * u) < 0.004, 0.1),
    "20 dark spots": spots(20, 0.02, 0.05),
    "60 dark spots": spots(60, 0.012, 0.05),
    "20 glints": spots(20, 0.02, 1.0),
    **{f"blurred by {k} px": blurred(k) for k in (1, 2, 4, 8)},
    **{f"motion blur of {k} px": moved(k, angle) for k, angle in ((5, 0), (10, 60), (15, 0), (30, 30))},
    **{f"noise of {k}": noise(k) for k in (0.03, 0.1, 0.2)},
    **{f"salt and pepper, {k}": salt(k) for k in (0.01, 0.1)},
    **{f"JPEG of quality {k}": compressed(k) for k in (5, 30)},
    "16 grey levels": lambda image, _: np.round(image * 15) / 15,
    "4 grey levels": lambda image, _: np.round(image * 3) / 3,
    "half the light": lambda image, _: 0.5 * image,
    "a tenth of the light": lambda image, _: np.round(25.5 * image) / 255,
    "overexposed": lambda image, _: 1.8 * image,
    "gamma 2": lambda image, _: image**2,
    "light from the side": shaded(0.8),
    "flicker": banded(0.3, 60),
    "negative": lambda image, _: 1 - image,
    "a reflection": ghost(0.3, 20),
    "a double exposure": ghost(0.5, 8),
    "torn": lambda image, _: np.concatenate([image[: len(image) // 2], np.roll(image[len(image) // 2 :], 6, 1)]),
    "vignetting": lambda image, _: image * vignette(image.shape),
}


def first_ok(r: tm.Reconstructor, folder: Path) -> dict:
    """The truth of the first press of a folder whose undamaged image has status ok."""
    for path in sorted(folder.glob("press_*.npz")):
        truth = dict(np.load(path))
        with torch.no_grad():
            if int(r(truth["image"]).status[0]) == 0:
                return truth
    raise SystemExit(f"{folder}: no press has status ok")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--sensors", default="0,1,2")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = []
    for number in map(int, args.sensors.split(",")):
        folder = args.data / f"s{number:04d}"
        r = tm.Reconstructor.from_file(folder / "sensor.toml")
        truth = first_ok(r, folder)
        clean = truth["image"].astype(float) / 255
        for k, (name, spoil) in enumerate({"clean": lambda image, _: image, **SPOILS}.items()):
            image = spoil(clean, np.random.default_rng([number, k])).clip(0, 1)
            with torch.no_grad():
                result = r((255 * image).round().astype(np.uint8))
            row = quantities(result, truth)
            rows.append(dict(sensor=folder.name, way=name, **row))
    for name in ("clean", *SPOILS):
        each = [row for row in rows if row["way"] == name]
        print(f"{name:26s}", "   ".join(f"{row['status']}: {row['surface']:6.2f}" for row in each))
    spoiled = [row for row in rows if row["way"] != "clean"]
    for said, chosen in (("ok", [r for r in spoiled if r["status"] == 0]), ("said", [r for r in spoiled if r["status"]])):
        off = sum(not row["surface"] < CLOSE for row in chosen)
        print(f"status {said}: {len(chosen)} of {len(spoiled)}, of which off by over a quarter of the press: {off}")
    write(args.json, dict(rows=rows))


if __name__ == "__main__":
    main()
