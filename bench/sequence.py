"""Warm starts against cold ones over a sequence of frames with truth.

python bench/sequence.py FOLDER [--json FILE]

FOLDER holds sensor.toml, frames 000.png, 001.png ... and truth.npz (`dots_nominal [D, 3]`, `dots_deformed [F, D, 3]`). Every
frame is solved from rest, and from the one before. Printed: rms distance of both surfaces over the rms displacement, over the
whole sequence and in the worst frame; each one's error at the dots over their displacement; processor time a frame.
"""

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
import torch
from record import write

import torchmembrane as tm


def rms(field) -> float:
    return float(np.sqrt((np.asarray(field, dtype=float) ** 2).sum(-1).mean()))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    reconstructor, truth = tm.Reconstructor.from_file(args.folder / "sensor.toml"), np.load(args.folder / "truth.npz")
    observer = reconstructor.observer
    found, seconds, previous = {"cold": [], "warm": []}, {"cold": 0.0, "warm": 0.0}, None
    with torch.no_grad():
        for path in sorted(args.folder.glob("[0-9]*.png")):
            displacement, confidence, *_ = observer(reconstructor.read(path))
            pixels = displacement + observer.measured_rest
            for name, start in (("cold", None), ("warm", previous)):
                began = time.process_time()
                result = reconstructor.from_pixels(pixels, confidence, observer.measured_rest, start)
                seconds[name] += time.process_time() - began
                found[name].append(result)
            previous = result
    rest = reconstructor.estimator.membrane.rest.numpy()
    surface = {name: np.stack([r.vertices[0].numpy() for r in results]) for name, results in found.items()}
    moved, gap = rms(surface["cold"] - rest), surface["warm"] - surface["cold"]
    X, Y = truth["dots_nominal"], truth["dots_deformed"]
    row = dict(difference=rms(gap) / moved, worst_frame=max(map(rms, gap)) / moved)
    print("warm from cold, over the displacement: {difference:.4f}, worst frame {worst_frame:.4f}".format(**row))
    for name, results in found.items():
        row[f"{name}_error"] = rms(np.stack([r.markers[0].numpy() for r in results]) - Y) / rms(Y - X)
        row[f"{name}_unsettled"] = sum(int(r.status[0]) != 0 for r in results)
        row[f"{name}_milliseconds"] = 1000 * seconds[name] / len(results)
        print(
            f"{name}: error over displacement {row[f'{name}_error']:.3f}, {row[f'{name}_unsettled']} of {len(results)} frames "
            f"not settled, {row[f'{name}_milliseconds']:.0f} ms of processor time a frame"
        )
    write(args.json, dict(frames=len(gap), **row))


if __name__ == "__main__":
    main()
