"""What `check` says of rest surfaces that are wrong by a known share of their size.

python -m bench.accuracy.rest_shapes [--sensors 120] [--json FILE]

Sheets on rectangles, ellipses and rounded triangles, prestretch 1.02 to 1.3, blown up to 0.1 to 0.25 of their size (seed 0).
Each is given as a grid: as it is, and with one of eight smooth waves added whose rms is 1, 2 or 5 % of the size. Of each group:
the forces left over, the distance from the nearest sheet and what that holds over what the file's does, as median (5 %, 95 %),
and how many `check` doubts, for what is left over, or because the nearest sheet lies apart.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write
from torchmembrane.accuracy.rest_shape import rest_shape
from torchmembrane.cli.rest_words import rest_in_words
from torchmembrane.forming.formed import FormedSurface, SheetMaterial, formed_surface
from torchmembrane.forming.outline import ellipse, rectangle
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface

WRONG = (0.0, 0.01, 0.02, 0.05)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", type=int, default=120)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rng, rows = np.random.default_rng(0), {wrong: [] for wrong in WRONG}
    for k in range(args.sensors):
        formed, stretch = sheet(k % 3, rng)
        for wrong in WRONG if k % 4 == 0 else WRONG[1 + k % 3 :][:1]:
            sensor = with_wave(formed, stretch, wrong, rng)
            found = rest_shape(sensor)
            doubted = any(
                "expected below" in line or "depths and forces by this file are wrong" in line for line in rest_in_words(sensor)
            )
            near = found.nearest
            values = (np.nan,) * 2 if near is None else (near.distance / sensor.membrane.size, near.pressure / found.pressure)
            rows[wrong].append([found.left_over, *values, doubted])
    groups = []
    for wrong, values in rows.items():
        table = np.array(values, float)
        spans = {
            name: np.nanquantile(column, (0.5, 0.05, 0.95)).tolist()
            for name, column in zip(("left over", "distance / size", "pressure ratio"), table.T, strict=False)
        }
        groups.append(dict(wrong=wrong, sensors=len(table), spans=spans, doubted=float(table[:, 3].mean())))
        words = ["{} {:.3f} ({:.3f}, {:.3f})".format(name, *span) for name, span in spans.items()]
        print(f"off by {wrong:.0%}: {len(table)} sensors; {'; '.join(words)}; doubted {table[:, 3].mean():.0%}", flush=True)
    write(args.json, dict(groups=groups))


def sheet(kind: int, rng: np.random.Generator) -> tuple[FormedSurface, float]:
    """A sheet on a random rim, and its prestretch."""
    a, b = 40 * rng.uniform(0.8, 1.25, 2)
    rim = flat_rim(kind, a, b)
    stretch, height = float(rng.uniform(1.02, 1.3)), float(rng.uniform(0.1, 0.25) * (a * b) ** 0.5)
    return formed_surface(np.insert(rim, 2, 60.0, axis=1), SheetMaterial("neo_hookean", stretch), height=height), stretch


def flat_rim(kind: int, a: float, b: float) -> np.ndarray:
    """Points once around a rectangle, an ellipse or a rounded triangle, `[K, 2]`."""
    if kind < 2:
        return rectangle((a, b), 0.15 * min(a, b)) if kind == 0 else ellipse((a, b))
    angle = 2 * np.pi * np.arange(360) / 360
    radius = 0.5 * min(a, b) * (1 + 0.1 * np.cos(3 * angle))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)


def with_wave(formed: FormedSurface, stretch: float, wrong: float, rng: np.random.Generator) -> tm.Sensor:
    """The sheet's surface with a wave of so much rms, as a share of its size, along z; the prestretch is that at rest."""
    n = len(formed.vertices)
    u, v = np.meshgrid(*(np.linspace(0, np.pi, n),) * 2, indexing="ij")
    i, j = [(1, 1), (1, 2), (2, 1), (2, 2), (1, 3), (3, 1), (2, 3), (3, 2)][rng.integers(8)]
    wave = np.sin(i * u) * np.sin(j * v)
    X, true = formed.vertices.copy(), tm.Membrane(formed.vertices)
    X[..., 2] += wrong * true.size * wave / np.sqrt((wave**2).mean()) * rng.choice([-1, 1])
    surface = Surface("grid", {"vertices": X, "fixed": ~np.isnan(formed.cells.places)})
    stretched = stretch * float(true.rest_area.sum() / tm.Membrane(formed.sheet).rest_area.sum()) ** 0.5
    membrane, camera = surface.membrane((n, n)), tm.Camera("pinhole", (640, 480), (400, 400), (320, 240))
    markers = Markers("dots", positions=membrane.rest.numpy()[n + 5 :: 29][:30])
    return tm.Sensor("s", "mm", camera, membrane, Material("neo_hookean", stretched), Cavity("liquid"), markers, surface)


if __name__ == "__main__":
    main()
