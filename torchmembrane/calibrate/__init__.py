"""Calibration (section 5.2): lens, ports, rest surface, dots and material from images, and the inverse, a layout of dots.

Each step takes the sensor or camera from the step before, and returns it with the values found and their uncertainty. Modules
are imported when their names are first used.

Example:
    >>> from torchmembrane import calibrate
    >>> from torchmembrane import Sensor
    >>> pixels, sizes = calibrate.pixel_lattice(Sensor.from_file("examples/sensor.toml"), 60.0)
    >>> len(pixels)
    32
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..camera.targets import Checkerboard, DotBoard
    from .camera import CameraFit, Views, lens_from_views, ports_from_views
    from .depth import DepthFit, rest_from_depth, rest_from_depth_of_view
    from .detection import find_target
    from .fit import Fit
    from .known_modulus import KnownForces, KnownPressures
    from .layout import FabricationLayout, layout_for_pixels, pixel_lattice
    from .material import MaterialFit, material_from_images, material_from_pixels
    from .rest import RestFit, rest_from_image
    from .view_poses import RigFit, rest_from_view_images
    from .views import ViewsFit, rest_from_views
    from .weight import WeightFit, material_from_weight

_MODULES = {
    "..camera.targets": ("Checkerboard", "DotBoard"),
    ".camera": ("CameraFit", "Views", "lens_from_views", "ports_from_views"),
    ".depth": ("DepthFit", "rest_from_depth", "rest_from_depth_of_view"),
    ".detection": ("find_target",),
    ".fit": ("Fit",),
    ".known_modulus": ("KnownForces", "KnownPressures"),
    ".layout": ("FabricationLayout", "layout_for_pixels", "pixel_lattice"),
    ".material": ("MaterialFit", "material_from_images", "material_from_pixels"),
    ".rest": ("RestFit", "rest_from_image"),
    ".view_poses": ("RigFit", "rest_from_view_images"),
    ".views": ("ViewsFit", "rest_from_views"),
    ".weight": ("WeightFit", "material_from_weight"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "CameraFit",
    "Checkerboard",
    "DepthFit",
    "DotBoard",
    "FabricationLayout",
    "Fit",
    "KnownForces",
    "KnownPressures",
    "MaterialFit",
    "RestFit",
    "RigFit",
    "Views",
    "ViewsFit",
    "WeightFit",
    "find_target",
    "layout_for_pixels",
    "lens_from_views",
    "material_from_images",
    "material_from_pixels",
    "material_from_weight",
    "pixel_lattice",
    "ports_from_views",
    "rest_from_depth",
    "rest_from_depth_of_view",
    "rest_from_image",
    "rest_from_view_images",
    "rest_from_views",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name], __name__), name)


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
