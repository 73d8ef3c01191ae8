"""How often intervals of one standard deviation hold the truth, and how wide they are.

python -m bench.accuracy.intervals DATA... [--first 0] [--sensors 10000] [--grid N] [--json FILE]

DATA from data/random_sensors.py, its light strokes and presses. Of frames with status ok, by the true force over the sensor's
largest, and apart where a contact reaches the rim: how many intervals of `force_deviation` (each component) and
`depth_deviation` hold the truth (68 % would of normal errors), the deviations' median over the rms error, both over the force
or depth itself, the rank correlation of deviations and errors, in brackets that of errors that are normal with just these
deviations, and by how much of themselves depths are found too shallow, in the median.
"""

import argparse
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.stats import spearmanr

import torchmembrane as tm
from bench.accuracy.bands import BANDS
from bench.data.record import write

FEWEST = 5
DRAWS = 200


def row_of(r: tm.Reconstructor, path: Path) -> dict:
    """Errors and deviations of one frame."""
    truth = dict(np.load(path))
    with torch.no_grad():
        got = r(truth["image"]).frame(0)
    n = round(len(truth["vertices_nominal"]) ** 0.5)
    normals = r.sensor.surface.membrane((n, n)).rest_normals.numpy()
    rest = r.sensor.membrane
    found = -(got["displacement"] * rest.rest_normals.numpy()).sum(-1).min(initial=0, where=~rest.fixed.numpy())
    deepest = -((truth["vertices_deformed"] - truth["vertices_nominal"]) * normals).sum(-1).min()
    F = truth["force"].astype(float)
    return dict(
        sensor=str(path.parent),
        file=path.stem,
        status=int(got["status"]),
        force=float(np.linalg.norm(F)),
        depth=float(deepest),
        force_error=(got["force"] - F).tolist(),
        depth_error=[float(found - deepest)],
        force_deviation=got["force_deviation"].tolist(),
        depth_deviation=[float(got["depth_deviation"])],
        at_rim=bool((got["contact_at_rim"] == 1).any()),
    )


def line(name: str, rows: list[dict], of: str) -> dict[str, float]:
    """How often the deviations of force or depth hold, how wide they are, and how they rank; printed."""
    error, deviation = (np.array([row[f"{of}_{what}"] for row in rows]) for what in ("error", "deviation"))
    held = (abs(error) < deviation).mean()
    size = np.array([row[of] for row in rows])
    signed = error[:, 0]
    error, deviation = (np.linalg.norm(a, axis=1) for a in (error, deviation))
    wide = np.median(deviation / size) / np.sqrt(np.mean((error / size) ** 2))
    drawn = np.abs(np.random.default_rng(0).normal(size=(DRAWS, len(rows)))) * deviation
    normal = np.mean([spearmanr(each, deviation).statistic for each in drawn])
    ranks, shallow = float(spearmanr(error, deviation).statistic), float(np.median(-signed / size))
    print(
        f"{name:28s} {len(rows):4d}: held {held:.2f}, wide {wide:.2f}, ranks {ranks:.2f} ({normal:.2f})"
        + (f", too shallow by {shallow:.2f}" if of == "depth" else "")
    )
    return dict(held=float(held), width=float(wide), ranks=ranks, shallow=shallow)


def report(rows: list[dict]) -> list[dict]:
    """Printed, and for all frames and every band what `line` gives of force and depth."""
    largest: dict[str, float] = {}
    for row in rows:
        largest[row["sensor"]] = max(largest.get(row["sensor"], 0.0), row["force"])
    told = [row for row in rows if row["status"] == 0 and row["force"] > 0 and row["depth"] > 0]
    bands = [dict(low=None, high=None, frames=len(told), **{of: line(of, told, of) for of in ("force", "depth")})]
    for low, high in zip(BANDS[:-1], BANDS[1:], strict=True):
        within = [row for row in told if low < row["force"] / largest[row["sensor"]] <= high]
        band = dict(low=low, high=high, frames=len(within))
        for of in ("force", "depth"):
            for name, chosen in (
                ("", within),
                (", at the rim", [row for row in within if row["at_rim"]]),
                (", clear", [row for row in within if not row["at_rim"]]),
            ):
                if len(chosen) >= FEWEST:
                    found = line(f"{of}, {low} to {high}{name}", chosen, of)
                    band |= {} if name else {of: found}
        bands += [band] if "depth" in band else []
    return bands


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="+")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--sensors", type=int, default=10000)
    parser.add_argument("--grid", type=int)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = []
    for folder in sorted(folder for data in args.data for folder in data.glob("s[0-9]*")):
        if not args.first <= int(folder.name[1:]) < args.first + args.sensors:
            continue
        files = [path for kind in ("press", "light") for path in sorted(folder.glob(f"{kind}_*.npz"))]
        try:
            sensor = tm.Sensor.from_file(folder / "sensor.toml")
            if args.grid:
                sensor = replace(sensor, membrane=sensor.surface.membrane((args.grid, args.grid)))
            r = tm.Reconstructor(sensor)
        except tm.MembraneError as error:
            print(f"{folder}: {error}")
            continue
        rows += [row_of(r, path) for path in files]
    bands = report(rows)
    write(args.json, dict(bands=bands, rows=rows))


if __name__ == "__main__":
    main()
