"""3-D shape of a deformable membrane from one image of its markings: geometry, elasticity, equilibrium.

    import torchmembrane as tm

    sensor = tm.Sensor.from_file("sensor.toml")   # or tm.preset("fingertip")
    reconstructor = tm.Reconstructor(sensor)      # an nn.Module
    result = reconstructor(frames)                # a tm.Reconstruction
    tracker = tm.Tracker(reconstructor)           # one stream: tracker(frame)
    results = tm.read_results("out/")             # what `torchmembrane reconstruct` wrote
    tm.export(reconstructor, "model.onnx")        # image to result without torch

Names are loaded when they are first used: the import alone needs neither torch nor any other package.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    __version__: str
    from . import calibrate, simulate
    from .camera.model import Camera
    from .camera.ports import Port
    from .errors import MembraneError
    from .estimators.base import Deviations, Equilibrium, Estimator, Observation, Problem, StandardDeviations
    from .estimators.contacts import Contacts
    from .estimators.force_balance.estimator import ForceBalance
    from .estimators.force_balance.settings import ForceBalanceSettings
    from .estimators.minimum_energy.estimator import MinimumEnergy, MinimumEnergySettings
    from .estimators.paper.estimator import PaperEstimator, PaperSettings
    from .estimators.registry import register_estimator
    from .mechanics.hyperelastic import ElasticEnergy
    from .onnx.export import export
    from .pose import Pose, ViewPose
    from .presets import preset
    from .reconstruct import Reconstructor
    from .results.read import read_results
    from .results.reconstruction import Reconstruction
    from .results.status import Status
    from .sensor.parts import Cavity, Markers, Material, Surface
    from .sensor.sensor import Sensor
    from .sensor.views import View
    from .surface.membrane import Membrane
    from .track import Tracker

_HOMES = {
    "Camera": "camera.model",
    "Cavity": "sensor.parts",
    "Contacts": "estimators.contacts",
    "Deviations": "estimators.base",
    "ElasticEnergy": "mechanics.hyperelastic",
    "Equilibrium": "estimators.base",
    "Estimator": "estimators.base",
    "ForceBalance": "estimators.force_balance.estimator",
    "ForceBalanceSettings": "estimators.force_balance.settings",
    "Markers": "sensor.parts",
    "Material": "sensor.parts",
    "Membrane": "surface.membrane",
    "MembraneError": "errors",
    "MinimumEnergy": "estimators.minimum_energy.estimator",
    "MinimumEnergySettings": "estimators.minimum_energy.estimator",
    "Observation": "estimators.base",
    "PaperEstimator": "estimators.paper.estimator",
    "PaperSettings": "estimators.paper.estimator",
    "Port": "camera.ports",
    "Pose": "pose",
    "Problem": "estimators.base",
    "Reconstruction": "results.reconstruction",
    "Reconstructor": "reconstruct",
    "Sensor": "sensor.sensor",
    "StandardDeviations": "estimators.base",
    "Status": "results.status",
    "Surface": "sensor.parts",
    "Tracker": "track",
    "View": "sensor.views",
    "ViewPose": "pose",
    "export": "onnx.export",
    "preset": "presets",
    "read_results": "results.read",
    "register_estimator": "estimators.registry",
}
_NAMESPACES = ("calibrate", "simulate")

__all__ = [
    "Camera",
    "Cavity",
    "Contacts",
    "Deviations",
    "ElasticEnergy",
    "Equilibrium",
    "Estimator",
    "ForceBalance",
    "ForceBalanceSettings",
    "Markers",
    "Material",
    "Membrane",
    "MembraneError",
    "MinimumEnergy",
    "MinimumEnergySettings",
    "Observation",
    "PaperEstimator",
    "PaperSettings",
    "Port",
    "Pose",
    "Problem",
    "Reconstruction",
    "Reconstructor",
    "Sensor",
    "StandardDeviations",
    "Status",
    "Surface",
    "Tracker",
    "View",
    "ViewPose",
    "__version__",
    "calibrate",
    "export",
    "preset",
    "read_results",
    "register_estimator",
    "simulate",
]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("torchmembrane")
    if name in _NAMESPACES:
        return import_module(f".{name}", __name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_HOMES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
