"""Two real sensors with pins, from published recordings: a TacTip, and a hollow finger whose skin is seen through mirrors.

python -m bench.accuracy.real_pins FOLDER [--json FILE]

The recordings are published by others and are not distributed with the package. FOLDER holds two of them:

tactip/  init_0.png, the photograph at rest, and frame_*.png, those of presses: 256 x 256 px, 127 white pins on black.
vts4/    a sensor file of the left mirror's view, sensor.toml, with the files that it names; photographs images/001.png, 002.png
         ...; and stereo_truth.npz, the stereo positions of its D listed pins in these F photographs: left_px [F, D, 2], pixels
         in the left mirror, and xyz_mm [F, D, 3], in that mirror's frame. Nothing touches the finger in the first three.

Of the TacTip, `torchmembrane init` makes the sensor file (INIT). The lens, the radius and the height of the pins are guesses.
Printed for each height are the number of pins found at rest and in the presses, the statuses, and the median depth of the
deepest point. Of the finger, the pins found are compared with the stereo positions, in frames alone and tracked. A frame is at
rest if the rms motion of its pins is below STILL times the stereo's noise, which is that of the first three frames. Printed are
the statuses of frames at rest and of the others, and for the others the error of the pins' displacement over their motion, both
rms; then the number of status ok among the others if the file says another material or filling. Finally, frames whose pins move
by more than MOVED are reconstructed from the stereo's pixels, without a `height` and with a rest surface HEIGHT outside the
tips of the pins: the median error, how many have status ok, and how many of these an error over WRONG.
"""

import argparse
import shutil
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.accuracy.window_commands import command
from bench.data.record import write
from torchmembrane.surface.levers import inward_levers
from torchmembrane.surface.membrane import Membrane

INIT = "--shape dome --radius 20 --rest init_0.png --rim 127,128,120 --lens fisheye --view 120 --polarity light"
PINS = 127  # of the TacTip
HEIGHTS = (0.0, 2.0, 4.0)  # of its pins, mm
AT_REST = 3  # frames of the finger, the first ones
STILL = 5.0  # times the stereo's noise
MOVED = 0.15  # mm, rms
NEAR = 1.0  # px
HEIGHT = 3.0  # of the finger's pins, mm
WRONG = 0.25  # of the motion


def rms(vectors: np.ndarray) -> np.ndarray:
    """Return the rms length of vectors `[..., D, 3]`."""
    return np.sqrt((vectors**2).sum(-1).mean(-1))


def counted(statuses: Iterable[int]) -> dict[str, int]:
    """Return how many frames have each status."""
    return {str(status): count for status, count in sorted(Counter(statuses).items())}


def in_words(statuses: dict[str, int]) -> str:
    """Return such counts as words."""
    return ", ".join(f"{count} of status {status}" for status, count in statuses.items()) or "none"


def tactip(folder: Path) -> dict:
    """Make the TacTip's sensor file and reconstruct its presses with each height of the pins."""
    with tempfile.TemporaryDirectory() as temporary:
        shutil.copy(folder / "init_0.png", temporary)
        command(Path(temporary), f"init tactip.toml {INIT}")
        sensor = tm.Sensor.from_file(Path(temporary) / "tactip.toml")
    paths, heights = [folder / "init_0.png", *sorted(folder.glob("frame_*.png"))], []
    for height in HEIGHTS:
        r = tm.Reconstructor(replace(sensor, markers=replace(sensor.markers, height=height)))
        normals, off = r.estimator.membrane.rest_normals, (r.observer.measured_rest - r.rest_pixels).norm(dim=-1)
        with torch.no_grad():
            at_rest, *found = (r(r.read(path)) for path in paths)
        depths = [float(-(frame.displacement[0] * normals).sum(-1).min()) for frame in found]
        statuses, pins = counted(int(frame.status[0]) for frame in found), [found_in(frame) for frame in found]
        rest = dict(found=found_in(at_rest), rms_px=float(off.square().mean().sqrt()), most_px=float(off.max()))
        count = dict(photographs=len(pins), all_found=pins.count(PINS), fewer=sorted(n for n in pins if n < PINS))
        depth = dict(depth=float(np.nanmedian(depths)), depths=depths)
        heights.append(dict(height=height, rest=rest, **count, statuses=statuses, **depth))
        print(f"TacTip, pins of {height:g} mm: at rest {rest['found']} of {PINS} found,", end=" ")
        print("{rms_px:.3f} px rms (at most {most_px:.3f}) off the model".format(**rest))
        print("  presses: all pins found in {all_found} of {photographs}; pins in the others: {fewer}".format(**count))
        print(f"  {in_words(statuses)}; median depth {depth['depth']:.2f} mm", flush=True)
    return dict(pins=PINS, heights=heights)


def found_in(result: tm.Reconstruction) -> int:
    """Return the number of pins that are found in a result of one frame."""
    return int((result.confidence[0] > 0).sum())


class Finger:
    """The recording of the finger.

    Attributes:
        sensor: the sensor of its file.
        paths: its photographs.
        pixels: stereo positions of the pins in the left mirror, `[F, D, 2]` px.
        motion: stereo displacements of the pins from rest, `[F, D, 3]` mm.
        size: rms motion of the pins, `[F]` mm.
        noise: rms error of a stereo position, mm.
    """

    def __init__(self, folder: Path) -> None:
        self.sensor = tm.Sensor.from_file(folder / "sensor.toml")
        self.paths = sorted((folder / "images").glob("[0-9]*.png"))
        with np.load(folder / "stereo_truth.npz") as truth:
            self.pixels, places = truth["left_px"].astype(float), truth["xyz_mm"].astype(float)
        if not len(self.paths) == len(places) == len(self.pixels):
            raise SystemExit(f"{folder}: {len(self.paths)} photographs, stereo of {len(places)}; expected as many")
        self.motion = places - places[:AT_REST].mean(0)
        self.size = rms(self.motion)
        self.noise = float(np.sqrt((self.size[:AT_REST] ** 2).sum() / (AT_REST - 1)))

    def moving(self) -> np.ndarray:
        """Return whether the pins of each frame move by more than the stereo's noise, `[F]`."""
        return self.size > STILL * self.noise

    def errors(self, displacement: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Return the rms errors of the pins' displacement `[B, D, 3]` in frames of these indices `[B]`, over their motion."""
        return rms(displacement - self.motion[frames]) / self.size[frames]


def followed(finger: Finger, name: str, found: list[dict], rest: np.ndarray) -> dict:
    """Compare the results of all frames, alone or tracked, with the stereo; print and return a summary."""
    off = np.linalg.norm(np.array([frame["pixels"] for frame in found]) - finger.pixels, axis=-1)
    statuses, moving = np.array([int(frame["status"]) for frame in found]), finger.moving()
    errors = finger.errors(np.array([frame["markers"] for frame in found])[moving] - rest, np.flatnonzero(moving))
    row = dict(
        pins=off.shape[1],
        fewest_found=int(np.isfinite(off).sum(1).min()),
        fewest_near=int((off < NEAR).sum(1).min()),
        farthest_px=float(np.nanmax(off)),
        astray=np.flatnonzero((off >= NEAR).any(0)).tolist(),
        statuses_at_rest=counted(statuses[~moving].tolist()),
        statuses_moving=counted(statuses[moving].tolist()),
        error=np.nanquantile(errors, (0, 0.5, 1)).tolist(),
    )
    print(f"  {name}: at least {row['fewest_found']} of {row['pins']} pins found and {row['fewest_near']} within {NEAR:g} px;")
    print(f"    the others are {len(row['astray'])} pins, up to {row['farthest_px']:.2f} px off")
    print(f"    at rest {in_words(row['statuses_at_rest'])}; moving {in_words(row['statuses_moving'])}")
    print("    error over motion: least {:.2f}, median {:.2f}, most {:.2f}".format(*row["error"]))
    return row


def photographed(finger: Finger) -> dict:
    """Reconstruct the photographs of the finger alone and tracked, and by files with another material or filling."""
    moving = finger.moving()
    r = tm.Reconstructor(finger.sensor)
    tracker, rest = tm.Tracker(r), r.rest_markers.numpy()
    with torch.no_grad():
        found = {name: [by(r.read(p)).frame(0) for p in finger.paths] for name, by in (("alone", r), ("tracked", tracker))}
    largest, smallest = float(finger.size[~moving].max()), float(finger.size[moving].min())
    print(f"finger: {(~moving).sum()} frames at rest, motion up to {largest:.3f} mm rms,", end=" ")
    print(f"{moving.sum()} others, from {smallest:.3f} mm")
    print(f"  noise of the stereo {finger.noise:.4f} mm rms")
    rows, ok = {name: followed(finger, name, frames, rest) for name, frames in found.items()}, {}
    for name, sensor in other_files(finger.sensor).items():
        r = tm.Reconstructor(sensor)
        with torch.no_grad():
            ok[name] = sum(int(r(r.read(finger.paths[k])).status[0]) == 0 for k in np.flatnonzero(moving))
    print(f"  status ok among the moving: {', '.join(f'{name} {n}' for name, n in ok.items())}", flush=True)
    count = dict(frames=len(moving), at_rest=int((~moving).sum()), moving=int(moving.sum()))
    motion = dict(noise_mm=finger.noise, largest_at_rest_mm=largest, smallest_moving_mm=smallest)
    return dict(**count, **motion, **rows, ok_by_file=ok)


def other_files(s: tm.Sensor) -> dict[str, tm.Sensor]:
    """Return the finger's sensor with other materials and fillings."""
    cavities = {"liquid": tm.Cavity("liquid"), "gas": tm.Cavity("gas", 1013.0)}
    files = {f"prestretch {value}": replace(s, material=replace(s.material, prestretch=value)) for value in (1.02, 1.3)}
    files |= {name: replace(s, cavity=cavity) for name, cavity in cavities.items()}
    return files | {"harmonic": replace(s, material=replace(s.material, model="harmonic"))}


def lever_files(s: tm.Sensor) -> dict[str, tm.Sensor]:
    """Return the finger's sensor as its file describes it, and with pins on levers."""
    m, tips = s.membrane, s.markers.positions
    feet = tips - inward_levers(m, m.closest_points(tips), np.full(len(tips), HEIGHT))
    outside = Membrane((m.rest + HEIGHT * m.rest_normals).reshape(*m.grid, 3), m.fixed.reshape(m.grid))
    pins = replace(s, membrane=outside, markers=replace(s.markers, positions=feet, height=HEIGHT))
    liquid = replace(pins, cavity=replace(pins.cavity, filling="liquid"))
    stretched = replace(liquid, material=replace(liquid.material, prestretch=1.3))
    return {"no height": s, "height": pins, "height, liquid": liquid, "height, liquid, prestretch 1.3": stretched}


def levers(finger: Finger) -> dict:
    """Reconstruct the frames in which pins move most from the stereo's pixels, by each file."""
    frames, tips, rows = np.flatnonzero(finger.size > MOVED), torch.as_tensor(finger.sensor.markers.positions), []
    pixels, rest_pixels = (torch.from_numpy(p).float() for p in (finger.pixels[frames], finger.pixels[:AT_REST].mean(0)))
    print(f"from the stereo's pixels, {len(frames)} frames:")
    for name, sensor in lever_files(finger.sensor).items():
        r = tm.Reconstructor(sensor)
        with torch.no_grad():
            found = r.from_pixels(pixels, rest_pixels=rest_pixels)
        errors = finger.errors((found.markers - tips).numpy(), frames)
        ok = found.status.numpy() == 0
        count = dict(ok=int(ok.sum()), wrong=int((ok & (errors > WRONG)).sum()))
        rows.append(dict(file=name, error=float(np.nanmedian(errors)), **count, errors=errors.tolist()))
        print(f"  {name:31}error {rows[-1]['error']:.2f}, {count['ok']:2} ok, {count['wrong']} of these wrong", flush=True)
    return dict(frames=len(frames), files=rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    touched, finger = tactip(args.folder / "tactip"), Finger(args.folder / "vts4")
    write(args.json, dict(tactip=touched, finger=photographed(finger), levers=levers(finger)))


if __name__ == "__main__":
    main()
