"""Warm starts against cold ones over sequences of frames.

python -m bench.accuracy.sequence FOLDER... [--json FILE]

A FOLDER holds sensor.toml and either frames 000.png, 001.png ... with truth.npz (`dots_nominal [D, 3]`, `dots_deformed [F, D,
3]`), or light_000.npz, light_001.npz ... as of data/random_sensors.py --light, or folders of that kind, s0000, s0001 ...
Every frame is reconstructed from rest, and from the one before. Printed: rms distance of both surfaces over the rms
displacement, over the sequence and in the worst frame; each one's error at the dots over their displacement; frames with a
status; processor time a frame.
"""

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write


def rms(field) -> float:
    return float(np.sqrt((np.asarray(field, dtype=float) ** 2).sum(-1).mean()))


def frames(folder: Path) -> tuple[list[np.ndarray | Path], np.ndarray, np.ndarray]:
    """The images, and the dots `[D, 3]` at rest and `[F, D, 3]` pressed."""
    strokes = [np.load(path) for path in sorted(folder.glob("light_*.npz"))]
    if strokes:
        return [s["image"] for s in strokes], strokes[0]["dots_nominal"], np.stack([s["dots_deformed"] for s in strokes])
    truth = np.load(folder / "truth.npz")
    return sorted(folder.glob("[0-9]*.png")), truth["dots_nominal"], truth["dots_deformed"]


def compared(folder: Path) -> dict:
    """Of one sequence."""
    reconstructor, (images, X, Y) = tm.Reconstructor.from_file(folder / "sensor.toml"), frames(folder)
    found, seconds, previous = {"cold": [], "warm": []}, {"cold": 0.0, "warm": 0.0}, None
    for image in images:
        image = reconstructor.read(image) if isinstance(image, Path) else image
        for name, start in (("cold", None), ("warm", previous)):
            began = time.process_time()
            result = reconstructor(image, previous=start)
            seconds[name] += time.process_time() - began
            found[name].append(result)
        previous = result
    rest = reconstructor.estimator.membrane.rest.numpy()
    surface = {name: np.stack([r.vertices[0].numpy() for r in results]) for name, results in found.items()}
    moved, gap = rms(surface["cold"] - rest), surface["warm"] - surface["cold"]
    row = dict(folder=folder.name, frames=len(gap), difference=rms(gap) / moved, worst_frame=max(map(rms, gap)) / moved)
    print(
        f"{folder.name}: warm from cold, over the displacement: {row['difference']:.4f}, worst frame {row['worst_frame']:.4f}; "
        "error over displacement, frames with a status, processor time a frame: ",
        end="",
    )
    for name, results in found.items():
        markers = np.stack([r.markers[0].numpy() for r in results])
        row[f"{name}_error"] = rms(markers - Y) / rms(Y - X) if markers.shape == Y.shape else float("nan")  # nan: texture
        row[f"{name}_unsettled"] = sum(int(r.status[0]) != 0 for r in results)
        row[f"{name}_milliseconds"] = 1000 * seconds[name] / len(results)
        print(
            "{} {:.3f}, {}, {:.0f} ms".format(name, *(row[f"{name}_{k}"] for k in ("error", "unsettled", "milliseconds"))),
            end="; ",
        )
    print()
    return row


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    with torch.no_grad():
        folders = [each for folder in args.folders for each in sorted(folder.glob("s[0-9]*/")) or [folder]]
        write(args.json, dict(rows=[compared(folder) for folder in folders]))


if __name__ == "__main__":
    main()
