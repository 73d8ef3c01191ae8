"""Drift of the rest state noticed in a stream: false alarms, delays, and what a slow drift does before, on random sensors.

python -m bench.robustness.drift [--sensors 8] [--first 0] [--only noise,jump,start,slow,touch] [--json FILE]

Sensors of data/random_sensors.py with listed dots, at 30 to 40 dB. `noise`: images at rest, half of which are taken for rest in
turn, all others are a stream; frames in which a drift is certain. `jump`: the membrane swells, softens or sags, or the camera
moves, by 0.1 or 0.2 px (rms over the markers) from one frame to the next, after 10 frames at rest; frames until it is said.
`start`: the same before the first frame.
`slow`: it swells or sags by 0.001 px a frame; the drift when it is said, and whether a contact was found before. `touch`: light
touches, three strokes from the first touch on and back, 15 frames at rest between them; whether a drift is said.
"""

import argparse
import itertools
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage

import torchmembrane as tm
from bench.data.random_sensors import NOISE_LEVEL, light_frames, random_sensor
from bench.data.record import write
from torchmembrane.markers.drift import DriftWatch
from torchmembrane.mechanics.cavity import rest_balance
from torchmembrane.simulate.appearance import Appearance, noisy
from torchmembrane.simulate.equilibrium import EquilibriumProblem, Liquid, Open
from torchmembrane.simulate.simulator import Simulator

KINDS = ("swells", "softens", "sags", "camera")
SIZES = (0.1, 0.2)  # px
RATE, STEP, LARGEST = 0.001, 10, 0.15  # px a frame; frames that are rendered once; px
BEFORE, LONGEST, STREAM = 10, 120, 200  # frames
CHANGES = (0.01, 0.001, 0.0001)  # of volume or modulus, tried in turn


class Aged:
    """One sensor whose membrane or camera no longer is as in its rest image."""

    def __init__(self, number: int):
        sensor, noise = random_sensor(number), np.random.default_rng([0, number, 2]).uniform(*NOISE_LEVEL)
        self.simulator, self.reconstructor = Simulator(sensor, appearance=Appearance(noise=noise)), tm.Reconstructor(sensor)
        self.noise, self.rng = noise, np.random.default_rng([0, number, 9])
        self.rest = self.rendered(self.simulator.membrane.rest)

    def rendered(self, vertices: torch.Tensor) -> torch.Tensor:
        """The image without noise."""
        with torch.no_grad():
            return self.simulator.renderer(vertices)

    def taken(self, clean: torch.Tensor) -> np.ndarray:
        """Return the image with the sensor's noise, rounded to uint8, as a camera delivers it."""
        return (255 * noisy(clean, self.noise, self.rng)).round().byte().numpy()

    def displaced(self, kind: str) -> torch.Tensor:
        """How the membrane moves, `[V, 3]`, for 1 px rms of its markers, of a small change."""
        membrane, elasticity = self.simulator.membrane, self.simulator.elasticity
        p0, load = rest_balance(membrane, elasticity)
        pressure, rest = float(p0), membrane.rest
        across = (rest[:, 0] - rest[:, 0].mean()) / membrane.size
        for change in CHANGES:
            fluid, soft, more = Open(), elasticity, torch.zeros_like(load)
            if kind == "swells":
                fluid = Liquid((1 + change) * float(membrane.rest_volume))
            elif kind == "softens":
                soft = elasticity.for_membrane(membrane)
                soft.prestretch = (1 - change) * elasticity.prestretch
            else:  # the fluid's weight, across
                fluid = Liquid(float(membrane.rest_volume))
                more = 10 * change * pressure * across[:, None] * membrane.volume_gradient(rest)
            try:
                moved = EquilibriumProblem(membrane, soft, fluid, load + more).solve(rest, pressure).vertices - rest
            except tm.MembraneError:
                continue
            return moved / self.pixels(moved)
        raise tm.MembraneError(f"{self.simulator.sensor.name}: no equilibrium for a membrane that {kind}")

    def pixels(self, moved: torch.Tensor) -> float:
        """Rms motion of the markers that are seen, px."""
        at, rest = (np.asarray(self.simulator.renderer.dots(self.simulator.membrane.rest + u).pixels) for u in (moved, 0))
        return float(np.sqrt(np.square(at - rest).sum(1)[self.reconstructor.observer.seen_at_rest.numpy()].mean()))

    def drifted(self, kind: str, size: float) -> torch.Tensor:
        """The image without noise after a drift of `size` px."""
        if kind == "camera":
            shifted = ndimage.shift(self.rest.numpy(), (0.8 * size, 0.6 * size), order=3, mode="nearest")
            return torch.from_numpy(shifted.clip(0, 1))
        return self.rendered(self.simulator.membrane.rest + size * self.displaced(kind))


def is_said(tracker: tm.Tracker, image: np.ndarray) -> tuple[bool, bool]:
    """Whether a drift is said of this frame, and whether a contact is found."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        result = tracker(image)
    return any("aged" in str(one.message) for one in said), bool(result.contact_points.isfinite().any())


def noise_row(aged: Aged) -> dict:
    """Of streams at rest, each from another rest image: frames in which a drift is certain, and the largest certainty."""
    r, flows = aged.reconstructor, []
    with torch.no_grad():
        for _ in range(STREAM):
            flows.append(r.observer(r.grey(aged.taken(aged.rest))))
    covariances = [flow.covariance[0] - r.observer.rest_covariance for flow in flows]
    rests = [(torch.zeros_like(r.rest_pixels), r.observer.rest_covariance)]
    rests += [(flow.displacement[0], of) for flow, of in list(zip(flows, covariances, strict=True))[: STREAM // 2]]
    frames, alarms, certainty = 0, [], -np.inf
    for k, (rest, covariance) in enumerate(rests):
        watch = DriftWatch(r.rest_pixels, covariance, r.observer.seen_at_rest, r.image_size)
        for n, flow in enumerate(flows):
            if n == k - 1:  # it is the rest image
                continue
            watch.add(flow.displacement[0] - rest, flow.confidence[0])
            found = watch.drift()
            frames, certainty = frames + 1, max(certainty, found.certainty if watch.frames >= BEFORE else -np.inf)
            alarms += [k] if found.is_certain else []
    return dict(frames=frames, alarms=len(alarms), streams_with_alarms=len(set(alarms)), certainty=certainty)


def jump_rows(aged: Aged, before: int) -> Iterator[dict]:
    for kind in KINDS:
        for size in SIZES:
            tracker, clean = tm.Tracker(aged.reconstructor), aged.drifted(kind, size)
            early = [is_said(tracker, aged.taken(aged.rest))[0] for _ in range(before)]
            said, contacts = None, 0
            for frame in range(1, LONGEST + 1):
                now, contact = is_said(tracker, aged.taken(clean))
                contacts += contact
                if now or (before and contacts == frame == BEFORE):  # or nothing but contacts is found
                    said = frame if now else None
                    break
            yield dict(kind=kind, size=size, said=said, contacts=contacts, drift=tracker.drift, early=any(early))


def slow_rows(aged: Aged) -> Iterator[dict]:
    for kind in ("swells", "sags"):
        tracker, contacts, moved = tm.Tracker(aged.reconstructor), 0, aged.displaced(kind)
        for frame in range(round(LARGEST / RATE)):
            size = RATE * (frame - frame % STEP)
            if frame % STEP == 0:
                clean = aged.rendered(aged.simulator.membrane.rest + size * moved)
            said, contact = is_said(tracker, aged.taken(clean))
            contacts += contact
            if said:
                break
        yield dict(kind=kind, said=frame if said else None, true=size, drift=tracker.drift, contacts_before=contacts)


def touch_row(aged: Aged) -> dict:
    stroke = [frame.image for frame in light_frames(aged.simulator, aged.rng, 8)]
    tracker, said, contacts = tm.Tracker(aged.reconstructor), False, 0
    for _ in range(3):
        at_rest = [aged.taken(aged.rest) for _ in range(15)]
        for image in (*at_rest, *stroke, *stroke[::-1]):
            now, contact = is_said(tracker, image)
            said, contacts = said or now, contacts + contact
    return dict(said=said, contacts=contacts, drift=tracker.drift)


def summarise(rows: list[dict]) -> None:
    """Over all sensors."""
    of = {part: [row for row in rows if row["part"] == part] for part in ("noise", "jump", "start", "slow", "touch")}
    if of["noise"]:
        frames, alarms = (sum(row[key] for row in of["noise"]) for key in ("frames", "alarms"))
        print(f"noise: {alarms} of {frames} frames, certainty at most {max(row['certainty'] for row in of['noise']):.1f}")
    for part, size in itertools.product(("jump", "start"), SIZES):
        some = [row for row in of[part] if row["size"] == size]
        if delays := [row["said"] for row in some if row["said"]]:
            said = f"said in {len(delays)} of {len(some)}"
            print(f"{part}, {size} px: {said}, after {np.median(delays)} frames, at most {max(delays)}")
    if of["slow"]:
        true = [row["true"] for row in of["slow"] if row["said"]]
        before = [row["contacts_before"] for row in of["slow"]]
        said = f"said in {len(true)} of {len(before)}"
        print(f"slow: {said}, at {np.median(true):.3f} px, at most {max(true):.3f}; contacts before {before}")
    if of["touch"]:
        print(f"touch: a drift is said in {sum(row['said'] for row in of['touch'])} of {len(of['touch'])}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", type=int, default=8)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", default="noise,jump,start,slow,touch")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    rows, number, taken = [], args.first - 1, 0
    parts = {
        "noise": lambda a: [noise_row(a)],
        "jump": lambda a: jump_rows(a, BEFORE),
        "start": lambda a: jump_rows(a, 0),
        "slow": slow_rows,
        "touch": lambda a: [touch_row(a)],
    }
    while taken < args.sensors:
        number += 1
        if random_sensor(number).markers.kind != "dots":
            continue
        aged, taken = Aged(number), taken + 1
        for part in args.only.split(","):
            try:
                for row in parts[part](aged):
                    rows.append(dict(sensor=number, part=part, **row))
                    words = (f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in rows[-1].items())
                    print(" ".join(words), flush=True)
            except tm.MembraneError as error:
                print(f"sensor {number} {part}: {error}", flush=True)
    summarise(rows)
    write(args.json, dict(rows=rows))


if __name__ == "__main__":
    main()
