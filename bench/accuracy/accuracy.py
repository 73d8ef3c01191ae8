"""Marker and surface accuracy on rendered cases with truth.

python -m bench.data.cases CASES
python -m bench.accuracy.accuracy CASES [--only NAME ...] [--device cuda] [--json FILE]

CASES holds index.json, a list of cases with `sensor`, `images` (files), `truth` (npz with `uv_deformed [D, 2]`, `dots_nominal`
and `dots_deformed [D, 3]`, optionally `visible_deformed [D]`), `folder`, `case`; or it is a folder like examples/, with
sensor.toml, NAME.png and NAME_truth.npz. Printed, for each sensor and kind of image: median and 95th percentile of the marker
error in px over found visible markers, the share found, how many are more than 3 px off, and the surface's error over its
displacement (rms at the markers, median over cases) for several estimators, from the image and from exact markers; for force
balance also the relative errors of total force and pressure change, and the distance of the contact points from the true ones.
"""

import argparse
import json
import warnings
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write

ESTIMATORS = {
    "the paper": dict(estimator="paper", locator="soft"),
    "harmonic, triangles": dict(estimator="minimum-energy", model="harmonic"),
    "the sensor's material": dict(estimator="minimum-energy"),
    "force balance": dict(estimator="force-balance"),
}


def cases_in(folder: Path) -> list[dict]:
    if (folder / "index.json").exists():
        return json.loads((folder / "index.json").read_text())
    return [
        dict(case=path.stem[:-6], folder=".", sensor="sensor.toml", images=[path.stem[:-6] + ".png"], truth=path.name)
        for path in sorted(folder.glob("*_truth.npz"))
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--only", nargs="*", choices=ESTIMATORS, default=list(ESTIMATORS))
    parser.add_argument("--device", default="cpu", type=torch.device)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    cases = cases_in(args.cases)
    markers, surface = {}, {}
    for name in sorted({case["sensor"] for case in cases}):
        for label in args.only:
            reconstructor = tm.Reconstructor.from_file(args.cases / name, **ESTIMATORS[label]).to(args.device)
            for case in (c for c in cases if c["sensor"] == name):
                score(reconstructor, args.cases, case, label, markers, surface)
    table = []
    for (folder, kind), groups in sorted(markers.items()):
        error, visible = (np.concatenate(part) for part in zip(*groups, strict=True))
        found = np.isfinite(error)
        median, p95 = np.median(error[found]), np.percentile(error[found], 95)
        share, wrong = found.sum() / visible.sum(), int((error[found] > 3).sum())
        row = dict(sensor=folder, images=kind, median=median, p95=p95, found=share, wrong=wrong)
        table.append({k: v if isinstance(v, str) else float(v) for k, v in row.items()})
        print(f"{folder:18s} {kind:8s} median {median:.3f} px, 95 % {p95:.3f} px, found {share:.4f}, wrong {wrong}")
    for (label, kind), values in sorted(surface.items()):
        what = "" if ": " in label else "surface error / displacement "
        print(f"{label}, {kind}: {what}{np.nanmedian(values):.3f} in the median, {np.nanmax(values):.3f} at worst")
    write(args.json, dict(markers=table, surface={f"{a}, {b}": v for (a, b), v in surface.items()}))


def score(reconstructor: tm.Reconstructor, root: Path, case: dict, label: str, markers: dict, surface: dict) -> None:
    truth = np.load(root / case["truth"])
    X, Y = truth["dots_nominal"].astype(float), truth["dots_deformed"].astype(float)

    def relative(result: tm.Reconstruction) -> float:
        return float(np.sqrt(((result.markers[0].numpy() - Y) ** 2).sum() / ((Y - X) ** 2).sum()))

    def cpu(result: tm.Reconstruction) -> tm.Reconstruction:
        return tm.Reconstruction(*(values.cpu() for values in result))

    exact = torch.from_numpy(truth["uv_deformed"].astype(np.float32)).to(reconstructor.rest_pixels.device)
    with torch.no_grad():
        surface.setdefault((label, "exact markers"), []).append(relative(cpu(reconstructor.from_pixels(exact))))
        for image in case["images"]:
            kind = Path(image).stem.rpartition("_")[2] if "_" in case["images"][0] and len(case["images"]) > 1 else "images"
            result = cpu(reconstructor(reconstructor.read(root / image)))
            if reconstructor.finds_tractions:
                for name, value in contact_errors(result, truth).items():
                    surface.setdefault((f"{label}: {name}", kind), []).append(value)
            surface.setdefault((label, kind), []).append(relative(result))
            if label == "the sensor's material":
                visible = truth["visible_deformed"].astype(bool) if "visible_deformed" in truth else np.ones(len(X), bool)
                error = np.linalg.norm(result.pixels[0].numpy() - truth["uv_deformed"], axis=1)
                markers.setdefault((case["folder"], kind), []).append((error[visible], np.ones(visible.sum())))


def contact_errors(result: tm.Reconstruction, truth) -> dict[str, float]:
    """Relative error of the force vector and of the pressure change; distance of contacts, the larger of both ways."""
    force, change = truth["force"], float(truth["p"] - truth["p0"])
    points, places = result.contact_points[0].numpy(), truth["contact_centroid_each"]
    points = points[np.isfinite(points).all(1)]
    gap = np.linalg.norm(points[:, None] - places, axis=2) if len(points) else np.full((1, 1), np.nan)
    return dict(
        force=float(np.linalg.norm(result.force[0].numpy() - force) / np.linalg.norm(force)),
        pressure_change=abs(float(result.pressure_change[0]) / change - 1),
        contact=float(max(gap.min(0).mean(), gap.min(1).mean())),
    )


if __name__ == "__main__":
    main()
