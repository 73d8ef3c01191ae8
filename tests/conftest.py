"""Fixtures that several test files share."""

import gc
import pickle
from dataclasses import replace
from functools import partialmethod, wraps
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torchmembrane import processes
from torchmembrane.calibrate import explained, presses
from torchmembrane.camera.model import Camera
from torchmembrane.estimators.force_balance.settings import ForceBalanceSettings
from torchmembrane.jobs import workers
from torchmembrane.markers import placement
from torchmembrane.markers.dots import pattern
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.render import Renderer
from torchmembrane.simulate.simulator import Simulator

EXAMPLES = Path(__file__).parents[1] / "examples"
torch.set_num_threads(1)
gc.set_threshold(100_000, 50, 100)  # tracing makes millions of objects that stay
LONG = ["test_export", "test_export_sensors", "test_drift", "test_compile", "test_learning_stack", "test_jobs", "test_learning",
        "test_fuzz", "test_material", "test_deviations", "test_calibrate", "test_tutorial", "test_gauge_modulus",
        "test_export_choices", "test_open_estimators", "test_weight", "test_units"]  # fmt: skip


def pytest_collection_modifyitems(items):
    """The longest files first, so that no process has one left to do when the others are through."""
    place = {name: k for k, name in enumerate(LONG)}
    items.sort(key=lambda item: place.get(item.path.stem, len(LONG)))


@pytest.fixture(scope="module")
def quick_images():
    """Images of the simulator are of 2 x 2 samples a pixel, not of 4 x 4; the outlines of dots are as exact."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Renderer, "__init__", partialmethod(Renderer.__init__, samples=2))
        yield


@pytest.fixture
def few_steps():
    """Settings for torch.compile and torch.export, which unroll all steps: every branch of the solve, each of few steps."""
    return ForceBalanceSettings(steps=(2, 2, 2))


@pytest.fixture
def quick_processes(monkeypatch):
    """Worker processes are forked from one that has imported torch; new ones, as users get them, take five seconds each."""
    context = get_context("forkserver")
    context.set_forkserver_preload(["torchmembrane.reconstruct"])
    for module in (processes, workers):
        monkeypatch.setattr(module, "get_context", lambda _: context)
    return context


def once(function):
    """The function, whose answer to the same arguments is computed once and copied from then on."""
    found = {}

    @wraps(function)
    def copied(*given):
        key = sha256(pickle.dumps(given)).digest()
        if key not in found:
            found[key] = pickle.dumps(function(*given))
        return pickle.loads(found[key])

    return copied


@pytest.fixture(scope="session", autouse=True)
def _dots_found_once():
    """What is found in a rest image, half a second of each `Reconstructor`, is kept for the next one."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(pattern, "find_blobs", once(pattern.find_blobs))
        patched.setattr(placement, "measure_dots", once(placement.measure_dots))
        yield


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


@pytest.fixture(scope="module")
def sensor():
    """That of the example, on a grid of 9 x 9."""
    full = Sensor.from_file(EXAMPLES / "sensor.toml")
    return replace(full, membrane=full.surface.membrane((9, 9)))


@pytest.fixture(scope="module")
def reconstructor(sensor):
    """Of that sensor."""
    return Reconstructor(sensor)


@pytest.fixture(scope="session")
def small_sensor(tmp_path_factory):
    """A small cap with 49 dots, an image of 160 x 120 px, and three frames of a press."""
    surface = Surface("spherical_cap", {"rim_radius": 8.0, "height": 4.0, "base_z": 14.0})
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-5, 5, 7)] * 2))
    dots = np.stack([x, y, 8 + np.sqrt(100 - x**2 - y**2)], -1)
    camera, markers = Camera("pinhole", (160, 120), (100, 100), (79, 60)), Markers("dots", "dark", dots)
    material = Material("neo_hookean", 1.3, shear_modulus=0.3, thickness=0.4)
    sensor = Sensor("cap", "mm", camera, surface.membrane((9, 9)), material, Cavity("liquid"), markers, surface)
    path = tmp_path_factory.mktemp("small_sensor")
    sensor.to_file(path / "sensor.toml")
    simulator, rng = Simulator(sensor), np.random.default_rng(0)
    stroke = stroke_to(simulator, Sphere(3.0), np.array([0.0, 1.0, 18.0]), np.array([-0.3, 0.0, -0.95]), 1.2)
    for k, press in enumerate(simulator.presses(stroke, ["push"], frames=3)):
        Image.fromarray(simulator.frame(press, stroke, rng).image).save(path / f"press{k}.png")
    return path


@pytest.fixture(scope="session")
def small_images(small_sensor):
    """Those three frames."""
    return [small_sensor / f"press{k}.png" for k in range(3)]


@pytest.fixture(params=["coarse", pytest.param("default", marks=pytest.mark.full)])
def calibration_grids(request, monkeypatch):
    """Those of `calibrate material`: coarser ones and fewer prestretches; with the mark `full` its own."""
    if request.param == "coarse":
        monkeypatch.setattr(explained, "GRID", (9, 9))
        monkeypatch.setattr(presses, "PRESSURE_GRID", (17, 17))
        for module in (explained, presses):
            monkeypatch.setattr(module, "STRETCHES", np.geomspace(1.05, 1.7, 6))
        monkeypatch.setattr(presses, "BETWEEN", 3)
    return request.param
