"""The forward problem: a membrane pressed by rigid indenters, and its camera's images of it.

The simulator of a sensor shares no solver with the estimators and uses a finer grid than they do.

Example:
    >>> from torchmembrane import simulate
    >>> from torchmembrane.mechanics.hyperelastic import ElasticEnergy
    >>> from torchmembrane.surface.shapes import spherical_cap
    >>> dome = spherical_cap(12, 9, 3, (9, 9))
    >>> ball = simulate.Sphere(4.0).touching(dome, (0, 0, -1))
    >>> state = simulate.press(dome, ElasticEnergy(dome, prestretch=1.3), [[ball, ball.moved((0, 0, -1.0))]])
    >>> bool(state.force[2] < 0), state.pressure > state.rest_pressure
    (True, True)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .appearance import Appearance
    from .indenters import Box, Cylinder, Indenter, Plane, Sphere, Union, Wedge, facing
    from .mesh_indenter import MeshIndenter
    from .pattern import Dots, Painted, Speckle
    from .quasi_static import Press, press, presses
    from .render import Renderer
    from .simulator import SimulatedFrame, Simulator, Stroke

_MODULE_OF = {
    "Appearance": "appearance",
    "Box": "indenters",
    "Cylinder": "indenters",
    "Dots": "pattern",
    "Indenter": "indenters",
    "MeshIndenter": "mesh_indenter",
    "Painted": "pattern",
    "Plane": "indenters",
    "Press": "quasi_static",
    "Renderer": "render",
    "SimulatedFrame": "simulator",
    "Simulator": "simulator",
    "Speckle": "pattern",
    "Sphere": "indenters",
    "Stroke": "simulator",
    "Union": "indenters",
    "Wedge": "indenters",
    "facing": "indenters",
    "press": "quasi_static",
    "presses": "quasi_static",
}

__all__ = [
    "Appearance",
    "Box",
    "Cylinder",
    "Dots",
    "Indenter",
    "MeshIndenter",
    "Painted",
    "Plane",
    "Press",
    "Renderer",
    "SimulatedFrame",
    "Simulator",
    "Speckle",
    "Sphere",
    "Stroke",
    "Union",
    "Wedge",
    "facing",
    "press",
    "presses",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_MODULE_OF[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
