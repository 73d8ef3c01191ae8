"""A camera of two that was knocked since its rest image: whether its own motion says so, and what the answer is off by.

python -m bench.accuracy.knocked [--sensors 10] [--presses 3] [--first 0] [--depth 0.02,0.3] [--json FILE]

The presses of `views.py`. The second camera alone turns by 1 degree about an axis at random across its own, or is shifted by
0.5 mm in a direction at random; the sensor's file and rest images are as before. `shift`: how far the knock moves the second
image's dots, px, rms. `found`: of that, what `camera_motion` of the second view moves them by, and what that of the first
does; `named`: presses in which the second view's is the larger, by more than `TOLD` px. `shape` and `force`: by how much the
answer differs from that without the knock, rms over the dots' rms displacement, and over the force.
"""

from dataclasses import replace

import numpy as np
import torch

import torchmembrane as tm
from bench.accuracy.views import LOCATION_NOISE, Pressed, followed, of_sensors, options, with_second_view
from bench.data.random_sensors import random_sensor
from bench.data.record import write
from torchmembrane.errors import MembraneError
from torchmembrane.pose import ViewPose
from torchmembrane.results.status import Status
from torchmembrane.sensor.units import millimetre
from torchmembrane.simulate.simulator import Simulator

DEGREES, SHIFT = 1.0, 0.5  # mm
TOLD = 0.5  # px
KNOCKS = ("turned", "shifted")


def knock(kind: str, unit: str, rng: np.random.Generator) -> ViewPose:
    """What a camera's frame is moved by, in its own frame."""
    if kind == "turned":
        angle = rng.uniform(0, 2 * np.pi)
        return ViewPose(DEGREES * np.array([np.cos(angle), np.sin(angle), 0.0]), np.zeros(3))
    direction = rng.normal(size=3)
    return ViewPose(np.eye(3), SHIFT * millimetre(unit) * direction / np.linalg.norm(direction))


def rms(vectors: np.ndarray) -> float:
    """Of vectors `[N, C]`."""
    return float(np.sqrt((vectors**2).sum(-1).mean()))


def moved_by(reconstructor: tm.Reconstructor, result: tm.Reconstruction, seen: torch.Tensor) -> list[float]:
    """How far each view's found motion moves its dots, px, rms."""
    camera, observer = reconstructor.camera, reconstructor.observer
    shift = observer.by_view(camera.shift_of(camera.motion_in_pixels(result.camera_motion), observer.rest_pixels[None]))[0]
    return [rms(of_view[sees].numpy()) for of_view, sees in zip(shift, seen > 0, strict=True)]


def knocked_press(sensor: tm.Sensor, reconstructor: tm.Reconstructor, truth: Pressed, rng: np.random.Generator) -> dict:
    """What comes of one press without a knock, and with each."""
    exact = truth.dots.pixels
    noise = torch.from_numpy(rng.normal(0, LOCATION_NOISE, exact.shape))
    seen = (truth.dots.visible & exact.isfinite().all(-1)).float()
    still, row = reconstructor.from_pixels(exact + noise, seen), {}
    displacement = rms(truth.dots.positions.numpy() - truth.rest)
    for kind in KNOCKS:
        view = sensor.views[1]
        pose = ViewPose.of_matrix(view.pose.matrix @ knock(kind, sensor.length_unit, rng).matrix)
        pixels = exact.clone()
        pixels[1] = view.camera.point_to_pixel(pose.inverse.points(truth.dots.positions))
        found = reconstructor.from_pixels(pixels + noise, seen)
        shift = rms((pixels - exact)[1][seen[1] > 0].numpy())
        first, second = moved_by(reconstructor, found, seen)
        row[kind] = dict(
            status=int(found.status[0]),
            still=int(still.status[0]),
            shift=shift,
            found=second / shift,
            other=first / shift,
            named=second > max(first, TOLD),
            shape=rms((found.markers - still.markers)[0].numpy()) / displacement,
            force=float((found.force - still.force)[0].norm() / still.force[0].norm()),
        )
    return row


def presses_of(number: int, count: int, depths: tuple[float, float]) -> list[dict]:
    """What comes of one sensor's presses."""
    sensor = random_sensor(number)
    if sensor.markers.positions is None:
        raise MembraneError(f"{sensor.name}: no listed dots")
    alone = replace(sensor, markers=replace(sensor.markers, rest_image=None))
    sensor, _ = with_second_view(alone, np.random.default_rng([number, 7]))
    reconstructor = tm.Reconstructor(sensor)
    truths = followed(Simulator(sensor), number, count, depths)
    rngs = (np.random.default_rng([number, 10, k]) for k in range(len(truths)))
    return [
        knocked_press(sensor, reconstructor, truth, rng) | {"sensor": number} for truth, rng in zip(truths, rngs, strict=True)
    ]


def bands(rows: list[dict]) -> list[dict]:
    """Medians and 90 % of what each knock does; presses without a surface are counted alone."""
    found = []
    for kind in KNOCKS:
        chosen = [row[kind] for row in rows if np.isfinite(row[kind]["shape"])]
        spans = {key: np.quantile([r[key] for r in chosen], (0.5, 0.9)).tolist() for key in ("shift", "shape", "force")}
        medians = {key: float(np.median([r[key] for r in chosen])) for key in ("found", "other")}
        counts = {key: sum(bool(r[key]) for r in chosen) for key in ("named",)}
        ok = {key: sum(r[key] == 0 for r in chosen) for key in ("status", "still")}
        ok["unexplained"] = sum(r["status"] == Status.UNEXPLAINED for r in chosen)
        found.append(dict(knock=kind, presses=len(rows), solved=len(chosen)) | spans | medians | counts | ok)
    return found


def print_table(rows: list[dict]) -> None:
    """The same as lines."""
    for band in bands(rows):
        spans = ", ".join(f"{key} {band[key][0]:.3g} / {band[key][1]:.3g}" for key in ("shift", "shape", "force"))
        print(
            f"{band['knock']}: {band['presses']} presses, {band['solved']} solved, ok {band['status']} (without the knock "
            f"{band['still']}), {band['unexplained']} unexplained, named {band['named']}, found {band['found']:.3f}, in the "
            f"first view {band['other']:.3f}; {spans}",
            flush=True,
        )


def main() -> None:
    args = options(__doc__, sensors=10, presses=3).parse_args()
    rows = of_sensors(args, presses_of)
    print_table(rows)
    if args.json:
        write(args.json, {"presses": rows})


if __name__ == "__main__":
    main()
