"""What a pressure gauge adds: the same frames with and without its reading.

python -m bench.accuracy.gauge DATA [--first 0] [--sensors 10000] [--only light,press] [--noise 0.001] [--told 0.001,0.01]
    [--json FILE]

DATA from data/random_sensors.py, but for open cavities and speckle. A reading is the true change of the pressure since rest
with normal noise, `--noise` of the reference traction (mostly the rest pressure). Printed, without a reading and with one told
to be good to each of `--told` (`ForceBalanceSettings.pressure_noise`): errors of force and surface (over the true ones) and of
the pressure change (over the reference), median / 90 %, by the true force over the stroke's largest (light), and of presses by
depth over the surface's size.
"""

import argparse
import json
import warnings
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write

BANDS = {"light": (0, 0.02, 0.05, 0.15, 0.5, 1.01), "press": (0, 0.05, 0.1, 0.3)}


def errors(result: tm.Reconstruction, truth: dict, reference: float) -> dict:
    """Of one frame, over the truth."""
    X, Y, F = (truth[key].astype(float) for key in ("dots_nominal", "dots_deformed", "force"))
    got = {name: value[0].numpy() for name, value in result._asdict().items()}
    return dict(
        force=float(np.linalg.norm(got["force"] - F) / np.linalg.norm(F)),
        surface=float(np.linalg.norm(got["markers"] - Y) / np.linalg.norm(Y - X)),
        pressure=float(abs(got["pressure_change"] - (truth["p"] - truth["p0"])) / reference),
        status=int(got["status"]),
    )


def rows_of(folder: Path, kinds: list[str], noise: float, told: list[float]) -> list[dict]:
    """Errors of every frame, without a reading and with one told to be good to each of `told`."""
    sensor = tm.Sensor.from_file(folder / "sensor.toml")
    if sensor.cavity.filling == "open" or sensor.markers.kind == "texture":
        return []
    readers = {0.0: tm.Reconstructor(sensor)}
    readers |= {good: tm.Reconstructor(sensor, settings=tm.ForceBalanceSettings(pressure_noise=good)) for good in told}
    files, rows = [path for kind in kinds for path in sorted(folder.glob(f"{kind}_*.npz"))], []
    forces = {path: float(np.linalg.norm(np.load(path)["force"])) for path in files}
    for number, path in enumerate(files):
        truth, kind = dict(np.load(path)), path.stem.partition("_")[0]
        depth = json.loads(str(truth["stroke"]))["depth"] / sensor.membrane.size
        share = forces[path] / max(force for other, force in forces.items() if other.stem.startswith("light"))
        for good, reader in readers.items():
            reference = reader.estimator.reference
            error = noise * reference * np.random.default_rng([int(folder.name[1:]), number]).normal()
            reading = float(reader.rest_pressure) + float(truth["p"] - truth["p0"]) + error
            with torch.no_grad():
                result = reader(truth["image"], pressure=reading if good else None)
            row = dict(sensor=folder.name, file=path.name, kind=kind, told=good, filling=sensor.cavity.filling)
            row |= dict(at=share if kind == "light" else depth, **errors(result, truth, reference))
            rows.append(row | dict(rise=float(truth["p"] - truth["p0"]) / reference))
    return rows


def report(rows: list[dict]) -> None:
    for kind in sorted({row["kind"] for row in rows}):
        for low, high in zip(BANDS[kind][:-1], BANDS[kind][1:], strict=True):
            for told in sorted({row["told"] for row in rows}):
                chosen = [r for r in rows if r["kind"] == kind and r["told"] == told and low < r["at"] <= high]
                if chosen:
                    parts = {
                        key: np.percentile(np.nan_to_num([r[key] for r in chosen], nan=9.0), (50, 90))
                        for key in ("force", "surface", "pressure")
                    }
                    said = ", ".join(f"{key} {m:.3f} / {most:.3f}" for key, (m, most) in parts.items())
                    print(f"{kind} {low:.2f} to {high:.2f}, gauge {told or 'none'}: {len(chosen)} frames, {said}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--sensors", type=int, default=10000)
    parser.add_argument("--only", default="light,press")
    parser.add_argument("--noise", type=float, default=0.001)
    parser.add_argument("--told", default="0.001,0.01")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows, told = [], [float(part) for part in args.told.split(",")]
    for folder in sorted(args.data.glob("s[0-9]*")):
        if args.first <= int(folder.name[1:]) < args.first + args.sensors and any(folder.glob("light_*.npz")):
            rows += rows_of(folder, args.only.split(","), args.noise, told)
            print(folder.name, flush=True)
    report(rows)
    write(args.json, dict(rows=rows, args={key: str(value) for key, value in vars(args).items()}))


if __name__ == "__main__":
    main()
