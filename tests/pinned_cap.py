"""A cap with pins, which the tests of heights have in common."""

import numpy as np

from torchmembrane.camera.model import Camera
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.sensor import Sensor

CAMERA = Camera("pinhole", (320, 240), (200, 200), (159.5, 119.5))
SURFACE = Surface("spherical_cap", {"rim_radius": 8.0, "height": 4.0, "base_z": 14.0})
HEIGHT = 1.5


def cap(height, grid=(13, 13)):
    """A cap with 49 dots."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-4.8, 4.8, 7)] * 2))
    dots = np.stack([x, y, 8 + np.sqrt(100 - x**2 - y**2)], -1)
    material = Material("neo_hookean", 1.3, shear_modulus=0.3, thickness=0.4)
    markers = Markers("dots", "dark", dots, height=height)
    return Sensor("cap", "mm", CAMERA, SURFACE.membrane(grid), material, Cavity("liquid"), markers, SURFACE)
