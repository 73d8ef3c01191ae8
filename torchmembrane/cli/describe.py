"""Description of a sensor file in words."""

from collections.abc import Iterable
from datetime import date
from typing import Any

import numpy as np
import torch

from ..camera.mode import Mode
from ..camera.model import Camera
from ..forming.sheet_energy import SheetEnergy
from ..machine_code import using
from ..markers.placement import markers_in_view
from ..reconstruct import Reconstructor
from ..results.reconstruction import Frame
from ..results.status import Status
from ..sensor.camera_tables import shared_image
from ..sensor.factories import elastic_energy
from ..sensor.inflated import InflatedSurface
from ..sensor.parts import FRICTION
from ..sensor.sensor import Sensor
from ..sensor.units import hectopascal
from ..sensor.views import FEWEST_LINES

COARSE = f"  coarse for several views, whose forces want {FEWEST_LINES} lines or more: give a finer grid"
LISTED = 12
"""Largest number of missing markers that are listed individually."""
FILLINGS = {
    "liquid": "liquid: its volume is kept",
    "gas": "gas: absolute pressure x volume is kept",
    "open": "open: the pressure stays at rest, the volume is free",
}


def rest_frame(reconstructor: Reconstructor) -> Frame | None:
    """Return the frame of the sensor's own rest image, or None if there is none."""
    sensor = reconstructor.sensor
    image: Any = sensor.markers.rest_image
    if sensor.views:
        images = [view.rest_image for view in sensor.views]
        image = images if sensor.views_apart else shared_image(images, sensor.views)
    if image is None or (sensor.views and any(view.rest_image is None for view in sensor.views)):
        return None
    with torch.no_grad(), using(not reconstructor.estimator.must_compile):  # one frame is not worth the wait
        return reconstructor(image).frame(0)


def pressure_in_words(pressure: float, sensor: Sensor) -> str:
    """Return a pressure of a sensor's results with its unit, and in hPa, the unit of gauges and of `--pressure`.

    Example:
        >>> from torchmembrane.presets import preset
        >>> pressure_in_words(0.0005, preset("bubble"))
        '0.0005 N/mm² = 5 hPa'
    """
    if sensor.force_unit == "relative":
        return f"{pressure:.4g} (relative)"
    unit = sensor.length_unit
    return f"{pressure:.4g} N/{unit}² = {pressure / hectopascal(unit):.4g} hPa"


def described(sensor: Sensor, reconstructor: Reconstructor | None = None, frame: Frame | None = None) -> list[str]:
    """Return lines that describe a `Sensor`; its `Reconstructor` and rest frame add further lines."""
    lines = {
        "sensor": [f"{sensor.name!r}, fingerprint {sensor.fingerprint[:12]}, lengths in {sensor.length_unit}"],
        "camera": _views(sensor) or _camera(sensor.camera, sensor.length_unit),
        "membrane": _membrane(sensor),
        "material": _material(sensor, reconstructor),
        "cavity": _cavity(sensor),
        "markers": _markers(sensor, reconstructor, frame),
        "tool": _tool(sensor),
        "range": [_range(sensor)],
        "record": sensor.record.said(date.today()) or ["none: no serial, no calibration is noted in the file"],
    }
    return [f"{key if i == 0 else '':<10}{line}" for key, block in lines.items() for i, line in enumerate(block)]


def _range(sensor: Sensor) -> str:
    """Return the limits within which the sensor's results are valid, and their source."""
    own = sensor.range.for_fingerprint(sensor.fingerprint)
    size, unit = sensor.membrane.size, sensor.length_unit
    limits = f"up to {own.depth * size:.3g} {unit} deep, the surface turned by {own.turn:.3g} degrees"
    if own.sensor:
        return f"{limits}, {own.force:.3g} {sensor.force_unit}, as `check --accuracy` has shown"
    stale = "; that of `check --accuracy` is of another state of this file: make it anew" if sensor.range.sensor else ""
    return f"{limits}, as of all sensors; `check --accuracy` finds this one's{stale}"


def _camera(camera: Camera, unit: str) -> list[str]:
    width, height = camera.image_size
    per = "px" if camera.model == "pinhole" else "px/rad"
    bent = camera.distortion.tolist()
    distortion = f"distortion {_listed(bent)}" if any(bent) else "no distortion"
    mode = [] if camera.mode is None else [_mode(camera.mode)]
    lines = [
        f"{camera.model}, {width} x {height} px, focal {_listed(camera.focal.tolist())} {per}, "
        f"centre {_listed(camera.centre.tolist())} px, {distortion}",
        *mode,
        f"field of view {_opening(camera, 0):.0f} x {_opening(camera, 1):.0f} degrees",
    ]
    for port in camera.ports:
        lines.append(f"port at {port.distance:g} {unit}, {port.thickness:g} {unit} thick, index {port.index:g}")
    lines.append(f"medium of index {float(camera.medium_index):g} behind" if camera.ports else "no ports")
    return lines


def _views(sensor: Sensor) -> list[str]:
    """Return, for a sensor of several views, lines on each view's camera, position and visible part of the rest surface."""
    lines = []
    for number, view in enumerate(sensor.views):
        rotation, mirror = view.pose.rotation, "by a mirror, " * (view.pose.determinant < 0)
        at, ahead = _listed(view.pose.translation), _listed(rotation[:, 2].round(9) + 0.0)
        region = "" if view.region is None else ", the region {} of {} x {} px".format(list(view.region), *sensor.image_size)
        place = f"{mirror}from {at} {sensor.length_unit} along {ahead}, {view.side}{region}"
        seen = markers_in_view(sensor.in_view(number))
        lines += [f"view {view.name!r} {place}: sees {seen.sum()} of {len(seen)} markers"]
        lines += [f"  {line}" for line in _camera(view.camera, sensor.length_unit)]
    return lines


def _mode(mode: Mode) -> str:
    left, top, width, height = mode.crop
    blocks = "not binned" if mode.binning == (1, 1) else "binned {} x {}".format(*mode.binning)
    whole = "calibrated at {} x {} px".format(*mode.image_size)
    return f"{whole}; its images are the {width} x {height} px from column {left} and row {top} on, {blocks}"


def _opening(camera: Camera, axis: int) -> float:
    """Return the angle of view through the image centre along a row (axis 0) or column (axis 1), degrees."""
    pixels = camera.centre.repeat(401, 1)
    pixels[:, axis] = torch.linspace(-0.5, camera.image_size[axis] - 0.5, 401, dtype=pixels.dtype, device=pixels.device)
    direction = camera.pixel_to_ray(pixels).direction.numpy()
    return float(np.ptp(np.degrees(np.arctan2(direction[:, axis], direction[:, 2]))[np.isfinite(direction[:, 2])]))


def _membrane(sensor: Sensor) -> list[str]:
    membrane, unit = sensor.membrane, sensor.length_unit
    X = membrane.rest.numpy()
    sides = ", ".join(f"{a} {low:.4g} to {high:.4g}" for a, low, high in zip("xyz", X.min(0), X.max(0), strict=True))
    return [
        f"{sensor.surface.shape}, {sides} {unit}",
        *_sheet(sensor),
        f"area {float(membrane.rest_area.sum()):.4g} {unit}², volume over the rim {membrane.cavity_volume:.4g} {unit}³",
        f"grid {membrane.grid[0]} x {membrane.grid[1]}: {len(X)} vertices, {int(membrane.fixed.sum())} of them fixed",
        *[COARSE] * (bool(sensor.views) and min(membrane.grid) < FEWEST_LINES),
    ]


def _sheet(sensor: Sensor) -> list[str]:
    """Return lines on the equilibrium of an inflated surface."""
    surface, energy = sensor.surface, elastic_energy(sensor, sensor.membrane)
    if not isinstance(surface, InflatedSurface) or not isinstance(energy, SheetEnergy):
        return []
    formed, stretches, unit = surface.formed, energy.rest_stretches, sensor.length_unit
    at, material = formed.outline.camera_frame(np.append(formed.cells.worst, 0.0))[:2], sensor.material
    return [
        f"a sheet inflated to {formed.height:.4g} {unit} over its rim's plane; its stretches at rest are "
        f"{float(stretches.min()):.4g} to {float(stretches.max()):.4g}, without pressure {material.prestretch:g} everywhere",
        f"worst cell of its grid: an angle of {formed.cells.angle:.0f} degrees, near x, y = {_listed(at)}",
    ]


def _material(sensor: Sensor, reconstructor: Reconstructor | None) -> list[str]:
    material, unit = sensor.material, sensor.length_unit
    known = {
        "C2 / C1": (material.c2_ratio, ""),
        "shear modulus": (material.shear_modulus, f" N/{unit}²"),
        "thickness": (material.thickness, f" {unit}"),
    }
    words = [f"{key} {value:g}{per}" for key, (value, per) in known.items() if value is not None]
    lines = [", ".join([material.model, f"prestretch {material.prestretch:g}", *words])]
    default = ", the default: friction in [material] changes it" * (material.friction == FRICTION)
    lines.append(f"friction {material.friction:g} with what touches it{default}")
    relative = sensor.force_unit == "relative"
    if relative:
        lines.append("without shear_modulus and thickness forces are relative, in units of their product")
    if reconstructor is not None:
        tension, pressure = float(elastic_energy(sensor, sensor.membrane).tension), float(reconstructor.rest_pressure)
        held = f"{tension:.4g} {'(relative)' if relative else f'N/{unit}'}"
        mean = "mean " * isinstance(sensor.surface, InflatedSurface)
        lines.append(f"at rest: {mean}tension {held}, pressure difference {pressure_in_words(pressure, sensor)}")
    return lines


def _cavity(sensor: Sensor) -> list[str]:
    cavity, words = sensor.cavity, [FILLINGS[sensor.cavity.filling]]
    if cavity.filling == "gas":
        volume = cavity.volume or sensor.membrane.cavity_volume
        words.append(f"{cavity.pressure:g} hPa, {volume:.4g} {sensor.length_unit}³")
        if sensor.force_unit == "relative":
            words.append("acts as a liquid, as forces are relative")
    return ["; ".join(words)]


def _markers(sensor: Sensor, reconstructor: Reconstructor | None, frame: Frame | None) -> list[str]:
    markers = sensor.markers
    lines, heights = [f"{markers.kind}, {markers.polarity}"], np.atleast_1d(markers.height)
    if markers.stand_off:
        lines.append(f"they stand off the inner side by {_extent(heights)} {sensor.length_unit}")
    if markers.positions is not None:
        listed, large = len(markers.positions), sum(size == "large" for size in markers.sizes or ())
        lines[0] += f", {listed} listed: {large} large, {listed - large} small"
        seen = markers_in_view(sensor)
        lines += [f"{seen.sum()} of {listed} in the camera's view"] * (not seen.all() and not sensor.views)
    if reconstructor is not None and markers.positions is None:
        lines[0] += f", {len(reconstructor.rest_pixels)} placed on the rest surface from the rest image"
    if frame is None or reconstructor is None:
        return [*lines, "no rest image" if markers.rest_image is None else "not looked for in the rest image"]
    found = frame["confidence"] > 0
    if sensor.views:
        return [*lines, *_of_views(sensor, reconstructor, frame)]
    lines.append(f"{found.sum()} of {found.size} found in the rest image")
    missing = np.flatnonzero(~found)
    model = reconstructor.rest_pixels.cpu().numpy()
    lines += [f"  not found: marker {d} (from 0), expected at pixel {_listed(model[d])}" for d in missing[:LISTED]]
    lines += [f"  and {len(missing) - LISTED} more"] * (len(missing) > LISTED)
    status = Status(int(frame["status"]))
    reconstructed = [f"the rest image reconstructed: {status.text}"]
    if markers.positions is None:  # each lies on its ray, whatever the surface's shape
        placed = "they were placed from it: that it agrees does not tell whether the rest surface is right"
        return [*lines, placed, *reconstructed * (status != Status.OK)]
    off = np.linalg.norm(reconstructor.observer.measured_rest.cpu().numpy() - model, axis=1)[found]
    if len(off):
        rms = np.sqrt((off**2).mean())
        lines.append(f"they lie {rms:.2f} px (rms; at most {off.max():.2f} px) from where the model has them")
    return [*lines, *reconstructed]


def _extent(values: np.ndarray) -> str:
    """Return the smallest and the largest value, or the single value if all are equal."""
    low, high = values.min(), values.max()
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _of_views(sensor: Sensor, reconstructor: Reconstructor, frame: Frame) -> list[str]:
    """Return lines on the markers found in each view's rest image, and their distance from the model's markers."""
    observer, lines = reconstructor.observer, []
    measured = observer.by_view(observer.measured_rest[None])[0]
    off = torch.linalg.vector_norm(measured - reconstructor.rest_pixels, dim=-1).cpu().numpy()
    for number, view in enumerate(sensor.views):
        found = frame["confidence"][number] > 0
        rms = np.sqrt((off[number, found] ** 2).mean()) if found.any() else np.nan
        lines.append(
            f"view {view.name!r}: {found.sum()} found in its rest image, {rms:.2f} px (rms) from where the model has them"
        )
    return [*lines, f"the rest images reconstructed: {Status(int(frame['status'])).text}"]


def _tool(sensor: Sensor) -> list[str]:
    if sensor.tool is None:
        return []
    right, _, ahead = (sensor.tool.rotation.T.round(9) + 0.0).tolist()  # no -0
    at = f"the camera is at {_listed(sensor.tool.translation)} {sensor.length_unit} in the tool's frame"
    return [f"{at}, looks along {_listed(ahead)}, its image's right is along {_listed(right)}"]


def _listed(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.5g}" for value in values)
