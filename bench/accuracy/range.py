"""How far the estimator's answers hold: random sensors, pressed at random, through images.

python -m bench.accuracy.range DATA... [--first 0] [--sensors 10000] [--only press,light,rest] [--json FILE]

DATA from data/random_sensors.py. A press is right where the markers' surface is within a quarter of their displacement and the
force within a quarter of the true one, or said to be a lower bound, by `contact_at_rim`. Printed: shares right and wrong with
status ok, and the rest by status, of presses whose contact is no narrower than the dots' spacing, by filling, prestretch, dots,
view and depth, and of the narrower ones; how many that are right have a status; how often `contact_at_rim` is said of contacts
clear of the rim; errors of moment (length unit), patch force, slip ratio and curvature, median / 90 %; then what light strokes
give, by the share of their largest force; then images at rest.
"""

import argparse
import json
import warnings
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.accuracy.bands import by_force
from bench.data.record import write

CLOSE = 0.25


def quantities(result: tm.Reconstruction, truth: dict) -> dict:
    """Errors of one frame, over the truth."""
    X, Y, F = (truth[key].astype(float) for key in ("dots_nominal", "dots_deformed", "force"))
    got = {name: value[0].numpy() for name, value in result._asdict().items()}
    row = dict(status=int(got["status"]), residual=float(got["residual"]))
    if len(X) == len(got["markers"]) and len(X):
        row["surface"] = float(np.linalg.norm(got["markers"] - Y) / np.linalg.norm(Y - X))
    else:  # texture: on the surface itself
        row["surface"] = surface_error(got["displacement"], truth)
    size = max(float(np.linalg.norm(F)), 1e-12)
    row |= dict(force=float(np.linalg.norm(got["force"] - F) / size), true_force=size)
    row["found_force"] = float(np.linalg.norm(got["force"]))
    points = got["contact_points"][np.isfinite(got["contact_points"][:, 0])]
    centre = truth["contact_centroid_each"][0]
    row |= dict(points=len(points), at_rim=bool((got["contact_at_rim"] == 1).any()), coverage=float(got["coverage"]))
    row["place"] = float(np.linalg.norm(points - centre, axis=1).mean()) if len(points) else np.inf
    return row


def patch_quantities(result: tm.Reconstruction, truth: dict, membrane: tm.Membrane) -> dict:
    """Errors of the moment over the force (length unit) and, of one contact, of force, slip ratio and a sphere's curvature."""
    x, traction = (torch.from_numpy(truth[key]).double() for key in ("vertices_deformed", "traction"))
    load, normals = traction * membrane.vertex_area(x)[:, None], membrane.normals(x)
    inward = -(load * normals).sum(-1)
    force, shear = load.sum(0), (load + inward[:, None] * normals).sum(0)
    moment = torch.linalg.cross(x, load).sum(0)
    row = dict(moment=float((result.wrench[0, 3:] - moment).norm() / force.norm()))
    if torch.isfinite(result.contact_points[0, :, 0]).sum() == 1:
        row["patch_force"] = float((result.contact_force[0, 0] - force).norm() / force.norm())
        row["slip"] = float((result.contact_slip[0, 0] - shear.norm() / inward.sum()).abs())
        stroke = json.loads(str(truth["stroke"]))
        if stroke["indenter"] == "sphere":
            row["curvature"] = float((result.contact_curvature[0, 0] * stroke["radius"] - 1).mean().abs())
    return row


def surface_error(displacement: np.ndarray, truth: dict) -> float:
    """Of a surface's vertices, at those of the true one, both on even grids over the same surface."""
    X, Y = truth["vertices_nominal"], truth["vertices_deformed"]
    fine, coarse = (round(len(a) ** 0.5) for a in (X, displacement))
    found = torch.from_numpy(displacement).reshape(1, coarse, coarse, 3).movedim(-1, 1)
    found = torch.nn.functional.interpolate(found, (fine, fine), mode="bicubic", align_corners=True)
    return float(np.linalg.norm(found[0].movedim(0, -1).reshape(-1, 3).numpy() - (Y - X)) / np.linalg.norm(Y - X))


def contact_width(truth: dict, spacing: float) -> float:
    """Width of the true contact over the dots' spacing."""
    touched = truth["contact_mask"].astype(bool)
    X = truth["vertices_nominal"]
    n = round(len(X) ** 0.5)
    grid = X.reshape(n, n, 3)
    area = np.linalg.norm(np.cross(np.gradient(grid, axis=0), np.gradient(grid, axis=1)), axis=-1).ravel()
    return float(np.sqrt(area[touched].sum()) / spacing)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="+")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--sensors", type=int, default=10000)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--only", default="press")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows, refused = [], []
    for folder in (folder for data in args.data for folder in sorted(data.glob("s[0-9]*"))):
        if not args.first <= int(folder.name[1:]) < args.first + args.sensors:
            continue
        files = sorted(path for kind in args.only.split(",") for path in folder.glob(f"{kind}_*.npz"))
        if not files:
            continue
        try:
            r = tm.Reconstructor.from_file(folder / "sensor.toml")
        except tm.MembraneError as error:
            refused.append(f"{folder.name}: {error}")
            print(refused[-1])
            continue
        rows += [row for path in files for row in reconstructed(r, path)]
    report(rows)
    write(args.json, dict(rows=rows, refused=refused))


def reconstructed(r: tm.Reconstructor, path: Path) -> list[dict]:
    """What one file's frame gives."""
    truth = dict(np.load(path))
    with torch.no_grad():
        result = r(truth["image"])
    kind, _, number = path.stem.partition("_")
    sensor = r.sensor
    about = dict(
        sensor=path.parent.name,
        kind=kind,
        number=int(number),
        shape=sensor.surface.shape,
        filling=sensor.cavity.filling,
        prestretch=sensor.material.prestretch,
        markers=sensor.markers.kind,
        dots=len(r.rest_markers),
        lens=sensor.camera.model + (" port" if len(sensor.camera.ports) else ""),
    )
    if kind == "rest":
        points = int(torch.isfinite(result.contact_points[0, :, 0]).sum())
        return [about | dict(status=int(result.status[0]), points=points, found_force=float(result.force[0].norm()))]
    size = sensor.membrane.size
    width, height = sensor.camera.image_size
    seen = ((r.rest_pixels >= 0) & (r.rest_pixels < torch.tensor([width, height]))).all(-1).double().mean()
    stroke = json.loads(str(truth["stroke"]))
    spacing = size / len(r.rest_markers) ** 0.5
    about |= dict(depth=stroke["depth"] / size, body=stroke["indenter"], friction=stroke["friction"], seen=float(seen))
    X, touched = truth["vertices_nominal"], truth["contact_mask"].astype(bool)
    rim = r.sensor.membrane.rest.numpy()[r.sensor.membrane.fixed.numpy()]
    clear = np.linalg.norm(X[touched][:, None] - rim, axis=-1).min() / size if touched.any() else np.nan
    about |= dict(width=contact_width(truth, spacing), spacing=spacing, size=size, clear=float(clear))
    row = about | quantities(result, truth)
    n = round(len(X) ** 0.5)
    return [row | patch_quantities(result, truth, sensor.surface.membrane((n, n))) if n * n == len(X) else row]


def is_right(row: dict) -> bool:
    """Whether the answer is, whatever its status."""
    return row["surface"] < CLOSE and (row["force"] < CLOSE or row["at_rim"])


def verdict(row: dict) -> str:
    """ "right", "wrong" (with status ok), or the status."""
    if row["status"] == 0:
        return "right" if is_right(row) else "wrong"
    return f"status {row['status']}"


def line(name: str, rows: list[dict]) -> None:
    verdicts = [verdict(row) for row in rows]
    shares = {v: verdicts.count(v) / len(rows) for v in sorted(set(verdicts))}
    surface, force = (np.nanmedian([row[key] for row in rows]) for key in ("surface", "force"))
    print(
        f"{name:28s} {len(rows):4d}: "
        + ", ".join(f"{v} {share:.3f}" for v, share in shares.items())
        + f"; surface {surface:.3f}, force {force:.3f}"
    )


def report(rows: list[dict]) -> None:
    presses = [row for row in rows if row["kind"] == "press"]
    wide = [row for row in presses if row["width"] >= 1]
    if wide:
        line("all", wide)
        right = [row for row in wide if is_right(row)]
        print(f"with a status though right: {sum(row['status'] != 0 for row in right)} of {len(right)}")
        for key in ("filling", "shape", "markers", "lens", "body"):
            for value in sorted({row[key] for row in wide}):
                line(f"{key} {value}", [row for row in wide if row[key] == value])
        for key, edges in (
            ("prestretch", (1, 1.02, 1.1, 1.3, 2)),
            ("dots", (0, 80, 150, 1000)),
            ("seen", (0, 0.999, 2)),
            ("depth", (0, 0.05, 0.1, 0.2, 0.4)),
            ("clear", (0, 0.05, 0.1, 0.2, 1)),
        ):
            for low, high in zip(edges[:-1], edges[1:], strict=True):
                chosen = [row for row in wide if low <= row[key] < high]
                if chosen:
                    line(f"{key} {low} to {high}", chosen)
        off_rim = [row["at_rim"] for row in wide if row["clear"] > max(0.1, row["spacing"] / row["size"])]
        print(f"contact_at_rim of {len(off_rim)} contacts 0.1 of the size and a spacing clear of it: {np.mean(off_rim):.3f}")
        settled = [row for row in wide if row["status"] == 0 and row["clear"] > 0.1]
        for key in ("moment", "patch_force", "slip", "curvature"):
            values = np.array([row[key] for row in settled if key in row])
            told = values[np.isfinite(values)]
            if len(told):
                middle, most = np.percentile(told, (50, 90))
                print(f"{key}, clear of the rim: {middle:.3f} / {most:.3f} of {len(told)}, {len(values) - len(told)} not told")
    narrow = [row for row in presses if row["width"] < 1]
    if narrow:
        line("narrower than the spacing", narrow)
    by_force([row | dict(found=row["place"] < row["spacing"]) for row in rows if row["kind"] == "light"])
    rest = [row for row in rows if row["kind"] == "rest"]
    if rest:
        print(f"at rest: {len(rest)} frames, {sum(row['points'] > 0 for row in rest)} with a contact")


if __name__ == "__main__":
    main()
