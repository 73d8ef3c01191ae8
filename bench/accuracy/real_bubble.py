"""A real air-filled bubble: its surface against a depth camera, and its forces against a robot and a pressure gauge.

python -m bench.accuracy.real_bubble FOLDER [--json FILE]

FOLDER holds a published recording of one poke, which is not distributed with the package. sensor.toml and the files that it
names describe the bubble, in mm. Photographs are rgb_NNN.jpg; depth_NNN.png are images of a depth camera, registered to them,
16 bits of 0.01 mm, 0 where nothing was measured. force/robot.csv has a row for every frame NNN of the recording, with the
columns frame, pressure_hPa_absolute and force_since_rest (N, since the mean over the frames of `QUIET`).

Surfaces are compared as changes of depth since rest on a lattice of 6 px, wherever the depth camera sees the membrane; errors
are clipped at 6 mm. Printed, for every estimator: the rms error in the frames with contact and in those before it, and that of
no displacement, which before contact is the depth camera's own noise; the largest errors of the deepest point while the poke
is held; the largest share without a surface; and how many frames are ok. Then, with numbers of the sensor file changed, in the
photograph in the middle of the held poke: the force over the robot's with the modulus that gives the gauge's rise, the rise
over the gauge's with the modulus that gives the robot's force, and the pressure of the air outside that each modulus implies.
Last, with the file as it is: the force over the robot's with the modulus that follows from a pressure of the air outside, and
the rms difference of force over the poke with the modulus that gives the robot's force.
"""

import argparse
import warnings
from collections.abc import Callable, Iterable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import uniform_filter

import torchmembrane as tm
from bench.accuracy.accuracy import ESTIMATORS
from bench.data.record import write
from torchmembrane.sensor.units import hectopascal

REST, BEFORE, QUIET, CONTACT, POKE = range(5), range(5, 56), range(40, 58), range(64, 109), range(60, 113)  # frames
V, U = np.mgrid[9:474:6, 9:636:6]
CHANGES: dict[str, dict[str, Any]] = {
    "nothing": {},
    "prestretch 1.02": dict(prestretch=1.02),
    "prestretch 1.1": dict(prestretch=1.1),
    "prestretch 1.2": dict(prestretch=1.2),
    "incompressible air, like a liquid": dict(filling="liquid"),
    "air 100 cm3": dict(volume=100e3),
    "air 250 cm3": dict(volume=250e3),
    "air 300 cm3": dict(volume=300e3),
    "Mooney-Rivlin, C2 / C1 = 0.3": dict(model="mooney_rivlin", c2_ratio=0.3),
    "prestretch 1.1 and air 300 cm3": dict(prestretch=1.1, volume=300e3),
    "prestretch 1.2 and air 300 cm3": dict(prestretch=1.2, volume=300e3),
    "prestretch 1.2 and air 500 cm3": dict(prestretch=1.2, volume=500e3),
}
OUTSIDE = 1013, 995, 988  # hPa
FARTHEST, LONGEST, CLOSE, MOST_SOLVES = np.log(30), np.log(3), 0.001, 8  # of the search, logarithms


class Readings(NamedTuple):
    """Forces of all frames, N; held photographs, the middle one, its force and rise of the pressure; pressure at rest, hPa."""

    forces: np.ndarray
    held: list[int]
    middle: int
    force: float
    rise: float
    absolute: float


class Outcome(NamedTuple):
    """Force found, N; rise of the pressure and overpressure at rest, hPa; status."""

    force: float
    rise: float
    over: float
    status: int


def readings(folder: Path, frames: Iterable[int]) -> Readings:
    """Read robot.csv; the poke is held where the force is within 5 % of the median of the forces over 0.9 of the largest."""
    table = np.genfromtxt(folder / "force" / "robot.csv", delimiter=",", names=True)
    forces, pressures = table["force_since_rest"], table["pressure_hPa_absolute"]
    plateau, rest = np.median(forces[forces > 0.9 * forces.max()]), float(pressures[QUIET].mean())
    held = [frame for frame in frames if abs(forces[frame] / plateau - 1) < 0.05]
    middle = held[len(held) // 2]
    return Readings(forces, held, middle, float(forces[middle]), float(pressures[middle]) - rest, rest)


def lattice(*paths: Path) -> np.ndarray:
    """Return the median depth of several images in 5 x 5 px around the lattice's points; NaN where less than 9 are known."""
    depth = np.median([np.asarray(Image.open(path), dtype=float) / 100 for path in paths], axis=0)
    around = np.stack([depth[V + a, U + b] for a in range(-2, 3) for b in range(-2, 3)])
    around[around <= 0] = np.nan
    return np.where(np.isfinite(around).sum(0) > 8, np.nanmedian(around, 0), np.nan)


def depth_map(points: torch.Tensor, camera: tm.Camera) -> np.ndarray:
    """Return the depth of a surface at the lattice's points; NaN outside the surface, and everywhere if it has NaN."""
    if not points.isfinite().all():
        return np.full(U.shape, np.nan)
    return np.asarray(LinearNDInterpolator(camera.point_to_pixel(points.double()).numpy(), points[:, 2].double().numpy())(U, V))


def frame_errors(got: np.ndarray, true: np.ndarray, seen: np.ndarray) -> dict[str, float]:
    """Return the errors of a frame's change of depth where the camera sees the membrane; no surface counts as no change."""
    found = np.nan_to_num(got)
    ours, camera = (uniform_filter(np.where(seen, np.nan_to_num(change), 0.0), 3) for change in (found, true))
    k, t = ours.argmin(), camera.argmin()
    return dict(
        rms=float(np.sqrt((np.clip(found - true, -6, 6)[seen] ** 2).mean())),
        none=float(np.sqrt((true[seen] ** 2).mean())),
        uncovered=float((~np.isfinite(got) & seen).sum() / seen.sum()),
        camera_depth=float(-camera.flat[t]),
        deepest=float(ours.flat[k] / camera.flat[t] - 1),
        away=float(np.hypot(U.flat[k] - U.flat[t], V.flat[k] - V.flat[t])),
    )


def surface(folder: Path, paths: dict[int, Path], label: str, held: list[int]) -> dict[str, Any]:
    """Return the errors of an estimator's surfaces in every frame, and their summary."""
    reconstructor, rows = tm.Reconstructor.from_file(folder / "sensor.toml", **ESTIMATORS[label]), []
    sensor, camera = reconstructor.sensor, reconstructor.sensor.camera
    inner = depth_map(torch.from_numpy(sensor.surface.values["vertices"][1:-1, 1:-1].reshape(-1, 3)), camera)
    rest = lattice(*(folder / f"depth_{frame:03d}.png" for frame in REST))
    membrane = np.isfinite(inner) & np.isfinite(rest) & (np.abs(inner - rest) < 3)
    ours_at_rest = depth_map(sensor.membrane.rest, camera)
    for frame, path in paths.items():
        true = lattice(folder / f"depth_{frame:03d}.png") - rest
        result = reconstructor(reconstructor.read(path))
        errors = frame_errors(
            depth_map(result.vertices[0], camera) - ours_at_rest, true, membrane & np.isfinite(true) & (np.abs(true) < 12)
        )
        rows.append(dict(frame=frame, status=int(result.status[0]), **errors))
    contact = [row for row in rows if row["frame"] in CONTACT and row["camera_depth"] > 1]
    before, still = ([row for row in rows if row["frame"] in frames] for frames in (BEFORE, held))
    found = dict(estimator=label, frames=len(rows), ok=sum(row["status"] == 0 for row in rows), contact=len(contact))
    parts = dict(contact=contact, before=before)
    found |= {f"{k}_{name}": np.mean([row[k] for row in part]) for name, part in parts.items() for k in ("rms", "none")}
    found |= dict(deepest=max((row["deepest"] for row in still), key=abs), away=max(row["away"] for row in still))
    return found | dict(uncovered=max(row["uncovered"] for row in contact + before), rows=rows)


def outcomes(sensor: tm.Sensor, paths: list[Path], modulus: float, changes: dict[str, Any]) -> list[Outcome]:
    """Reconstruct photographs with some numbers of the sensor file changed and this modulus, N/mm."""
    of_material = {field.name for field in fields(tm.Material)} & set(changes)
    material = replace(sensor.material, shear_modulus=modulus, thickness=1.0, **{key: changes[key] for key in of_material})
    cavity = replace(sensor.cavity, **{key: value for key, value in changes.items() if key not in of_material})
    reconstructor = tm.Reconstructor(replace(sensor, material=material, cavity=cavity))
    found = reconstructor(reconstructor.read(*paths))
    rises, over = (pressure.double() / hectopascal("mm") for pressure in (found.pressure_change, reconstructor.rest_pressure))
    columns = found.force.norm(dim=1), rises, over.expand(len(paths)), found.status
    return [Outcome(*values) for values in zip(*(column.tolist() for column in columns), strict=True)]


def fitted(solve: Callable[[float], Outcome], key: str, target: float, seen: dict[float, Outcome]) -> float | None:
    """Search the logarithm of the modulus at which a value is right, by secants through the two best outcomes seen so far."""

    def miss(at: float) -> float:
        return np.log(max(getattr(seen[at], key), 1e-9) / target)

    for _ in range(MOST_SOLVES):
        best, *others = sorted(seen, key=lambda at: abs(miss(at)))
        if abs(miss(best)) < CLOSE:
            return best
        slope = (miss(best) - miss(others[0])) / (best - others[0]) if others else 1.0
        step = best - min(max(miss(best) / max(slope, 0.1), -LONGEST), LONGEST)
        if abs(step) > FARTHEST:
            return None
        seen[step] = solve(step)
    return None


def changed(sensor: tm.Sensor, path: Path, robot: Readings, start: float, name: str) -> dict[str, Any]:
    """Return the row of a change: what is found with the modulus of the gauge's rise, and with that of the robot's force."""

    def solve(at: float) -> Outcome:
        return outcomes(sensor, [path], start * np.exp(at), CHANGES[name])[0]

    seen = {0.0: solve(0.0)}
    row, said = dict[str, Any](changed=name), []
    for key, other in (("rise", "force"), ("force", "rise")):
        found, at = None, fitted(solve, key, getattr(robot, key), seen)
        if at is not None:
            ratio, outside = getattr(seen[at], other) / getattr(robot, other), robot.absolute - seen[at].over
            found = dict(ratio=ratio, outside=outside, modulus=start * np.exp(at), **seen[at]._asdict())
        row[f"by_{key}"] = found
        said.append(f"{found['ratio']:.2f} ({found['outside']:.0f} hPa)" if found else "-")
    print(f"| {name} | {' | '.join(said)} | {len(seen)} solves", flush=True)
    return row


def unchanged(sensor: tm.Sensor, paths: dict[int, Path], robot: Readings, modulus: float, over: float) -> dict[str, Any]:
    """Return the force over the robot's by the pressure of the air outside, and the forces of the poke with this modulus."""
    path, poke, overs = paths[robot.middle], [frame for frame in paths if frame in POKE], robot.absolute - np.array(OUTSIDE)
    ratios = [outcomes(sensor, [path], modulus * value / over, {})[0].force / robot.force for value in overs]
    found = [one.force for one in outcomes(sensor, [paths[frame] for frame in poke], modulus, {})]
    rms = float(np.sqrt(((np.array(found) - robot.forces[poke]) ** 2).mean()))
    print(f"outside {OUTSIDE} hPa: {[round(ratio, 2) for ratio in ratios]}; poke, {len(poke)} photographs: rms {rms:.2f} N")
    return dict(outside=dict(zip(OUTSIDE, ratios, strict=True)), poke=dict(frames=poke, forces=found, rms=rms))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", type=Path)
    args, surfaces = parser.parse_args(), []
    warnings.simplefilter("ignore")
    torch.set_grad_enabled(False)
    paths = {int(path.stem[4:]): path for path in sorted(args.folder.glob("rgb_*.jpg"))}
    sensor, robot = tm.Sensor.from_file(args.folder / "sensor.toml"), readings(args.folder, paths)
    for label in ESTIMATORS:
        surfaces.append(surface(args.folder, paths, label, robot.held))
        print(", ".join(f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in surfaces[-1].items() if k != "rows"))
    print(f"held: {robot.held}; in {robot.middle} robot {robot.force:.2f} N, gauge {robot.rise:.2f} hPa", flush=True)
    start = robot.force / outcomes(sensor, [paths[robot.middle]], 1.0, dict(filling="liquid"))[0].force
    table = [changed(sensor, paths[robot.middle], robot, start, name) for name in CHANGES]
    right = table[0]["by_force"]
    more = unchanged(sensor, paths, robot, right["modulus"], right["over"]) if right else {}
    write(args.json, dict(surface=surfaces, held=robot._asdict() | dict(forces=robot.forces.tolist()), force=table, **more))


if __name__ == "__main__":
    main()
