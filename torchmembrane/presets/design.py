"""Design of the presets: `python -m torchmembrane.presets.design` writes their files."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..camera.model import Camera
from ..files.digits import rounded
from ..files.images import to_grey
from ..mechanics.cavity import rest_balance
from ..sensor.factories import elastic_energy
from ..sensor.parts import Cavity, Markers, Material, Surface
from ..sensor.sensor import Sensor
from ..sensor.toml import default_grid
from ..sensor.units import METRE
from ..simulate.appearance import noisy
from ..simulate.render import Renderer
from . import NAMES

AIR = 1013.0  # hPa
MARGIN = 0.93  # share of the arc from pole to rim that has dots
NOISE_LEVEL = 40.0  # dB below white


def fingertip() -> Sensor:
    """Return a half ellipsoid of the size of a fingertip, filled with liquid, with a fisheye camera inside."""
    semi_axes = [10.0, 8.0, 12.0]
    return _sensor(
        "fingertip",
        Camera("fisheye", (640, 480), (180.0, 180.0), (321.5, 238.2), (-0.012, 0.002)),
        Surface("ellipsoid_cap", {"semi_axes": semi_axes, "base_z": 3.0}),
        Material("neo_hookean", prestretch=1.25, shear_modulus=0.3, thickness=0.4),
        *dome_dots(semi_axes, np.pi / 2, 3.0, spacing=2.1),
    )


def bubble() -> Sensor:
    """Return a wide air-filled bubble seen by a distant pinhole camera."""
    rim, height, base_z = 30.0, 18.0, 60.0
    radius = (rim**2 + height**2) / (2 * height)
    return _sensor(
        "bubble",
        Camera("pinhole", (640, 480), (440.0, 440.0), (317.8, 241.1), (-0.06, 0.02)),
        Surface("spherical_cap", {"rim_radius": rim, "height": height, "base_z": base_z}),
        Material("neo_hookean", prestretch=1.3, shear_modulus=0.3, thickness=0.3),
        *dome_dots((radius,) * 3, np.arctan2(rim, radius - height), base_z, spacing=4.4),
        gas=True,
    )


def half_cylinder() -> Sensor:
    """Return a long water-filled half cylinder seen through a Plexiglas window, as in the paper's Appendix A."""
    radius, length, half_angle, base_z, spacing = 10.0, 36.0, 80.0, 24.0, 2.4
    return _sensor(
        "half_cylinder",
        Camera("pinhole", (640, 480), (265.0, 265.0), (322.4, 237.0), ports=[(4.0, 3.0, 1.49)], medium_index=1.33),
        Surface("half_cylinder", {"radius": radius, "length": length, "half_angle": half_angle, "base_z": base_z}),
        Material("mooney_rivlin", prestretch=1.2, c2_ratio=0.1, shear_modulus=0.35, thickness=0.3),
        *cylinder_dots(radius, length, np.deg2rad(half_angle), base_z, spacing),
    )


def write(folder: Path) -> None:
    """Write the files of every preset: `NAME/sensor.toml`, `sensor_dots.csv`, `sensor_rest.png`."""
    from tqdm import tqdm

    for name in tqdm(NAMES, desc="presets", unit="sensor"):
        globals()[name]().to_file(folder / name)


def _sensor(
    name: str,
    camera: Camera,
    surface: Surface,
    material: Material,
    positions: np.ndarray,
    sizes: list[str],
    gas: bool = False,
) -> Sensor:
    """Return a sensor with a rendered rest image."""
    markers = Markers("dots", "dark", positions, sizes)
    membrane = surface.membrane(default_grid(markers))
    blank = Sensor(name, "mm", camera, membrane, material, Cavity("liquid"), markers, surface)
    if gas:
        blank = replace(blank, cavity=Cavity("gas", AIR + _overpressure(blank)))
    image = noisy(Renderer(blank)(membrane.rest), NOISE_LEVEL, np.random.default_rng(0))
    return replace(blank, markers=replace(markers, rest_image=to_grey((255 * image).round().byte().numpy())))


def _overpressure(sensor: Sensor) -> float:
    """Return the overpressure that balances the membrane's tension at rest, rounded to whole hPa."""
    rest_pressure, _ = rest_balance(sensor.membrane, elastic_energy(sensor, sensor.membrane))
    return float(round(float(rest_pressure) * METRE["mm"] ** 2 / 100))


def dome_dots(semi_axes: Sequence[float], opening: float, base_z: float, spacing: float) -> tuple[np.ndarray, list[str]]:
    """Return a square pattern of alternating dots, spaced along the surface from the pole: positions `[D, 3]` and sizes."""
    a, b, c = semi_axes
    i, j = _lattice(opening * max(a, b) / spacing)
    x, y = i * spacing / a, j * spacing / b
    angle = np.hypot(x, y)
    scale = np.sinc(angle / np.pi)
    points = np.stack([a * scale * x, b * scale * y, base_z + c * (np.cos(angle) - np.cos(opening))], -1)
    kept = angle < MARGIN * opening
    return rounded(points[kept]), _sizes((i + j)[kept])


def cylinder_dots(
    radius: float, length: float, half_angle: float, base_z: float, spacing: float
) -> tuple[np.ndarray, list[str]]:
    """Return a square pattern of alternating dots on the unrolled cylinder: positions `[D, 3]` and sizes."""
    i, j = _lattice(length / spacing)
    x, angle = i * spacing, j * spacing / radius
    points = np.stack([x, radius * np.sin(angle), base_z + radius * (np.cos(angle) - np.cos(half_angle))], -1)
    kept = (np.abs(x) < length / 2 - spacing / 2) & (np.abs(angle) < half_angle - spacing / radius / 2)
    return rounded(points[kept]), _sizes((i + j)[kept])


def _lattice(reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the integer steps `i, j` of a square lattice, up to `reach` from its centre in each direction."""
    steps = np.arange(-int(reach), int(reach) + 1)
    i, j = np.meshgrid(steps, steps, indexing="ij")
    return i.ravel(), j.ravel()


def _sizes(order: np.ndarray) -> list[str]:
    return np.where(order % 2 == 0, "large", "small").tolist()


if __name__ == "__main__":
    write(Path(__file__).parent)
