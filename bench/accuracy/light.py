"""Strokes from the first touch on: what is found at which share of the largest force.

python -m bench.accuracy.light FOLDER... [--json FILE]

A FOLDER holds sensor.toml, frames 000.png, 001.png ... and truth.npz (`dots_nominal [D, 3]`, `dots_deformed [F, D, 3]`, `force
[F, 3]`, `contact_centroid [F, 3]`, NaN where nothing touches). Each frame is solved alone. Printed, by the true force over the
folder's largest: frames, median / 90 % of the force's error over its size and of the surface's at the dots over their
displacement, and how often contacts are reported within the dots' spacing of the true one in the mean; then the frames at rest:
contacts, and the largest force found over the folder's largest.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.accuracy.bands import by_force
from bench.data.record import write


def rows_of(folder: Path) -> list[dict]:
    """Errors of every frame."""
    truth, r = dict(np.load(folder / "truth.npz")), tm.Reconstructor.from_file(folder / "sensor.toml")
    spacing, rows = r.sensor.membrane.size / len(r.rest_markers) ** 0.5, []
    X = truth["dots_nominal"].astype(float)
    for k, path in enumerate(sorted(folder.glob("[0-9]*.png"))):
        with torch.no_grad():
            got = r(r.read(path)).frame(0)
        Y, F, centre = (truth[key][k].astype(float) for key in ("dots_deformed", "force", "contact_centroid"))
        points = got["contact_points"][np.isfinite(got["contact_points"][:, 0])]
        place = float(np.linalg.norm(points - centre, axis=1).mean()) if len(points) else np.inf
        rows.append(
            dict(
                sensor=folder.name,
                frame=path.name,
                true_force=float(np.linalg.norm(F)),
                found_force=float(np.linalg.norm(got["force"])),
                force=float(np.linalg.norm(got["force"] - F) / max(np.linalg.norm(F), 1e-12)),
                surface=float(np.linalg.norm(got["markers"] - Y) / max(np.linalg.norm(Y - X), 1e-12)),
                found=place < spacing,
                contacts=len(points),
                status=int(got["status"]),
            )
        )
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = [row for folder in args.folders for row in rows_of(folder)]
    table = by_force(rows)
    top = {row["sensor"]: max(r["true_force"] for r in rows if r["sensor"] == row["sensor"]) for row in rows}
    rest = [row for row in rows if row["true_force"] == 0]
    if rest:
        most = max(row["found_force"] / top[row["sensor"]] for row in rest)
        print(f"at rest: {len(rest)} frames, {sum(row['contacts'] > 0 for row in rest)} with a contact, force up to {most:.4f}")
    write(args.json, dict(bands=table, rows=rows))


if __name__ == "__main__":
    main()
