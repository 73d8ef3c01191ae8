"""A gauge's reading pulls the solution to its pressure."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from kept import kept
from PIL import Image

import torchmembrane as tm
from torchmembrane.cli.main import main
from torchmembrane.estimators.force_balance.gauss_newton import State
from torchmembrane.estimators.force_balance.pressure_gauge import gauge_loss, pulled
from torchmembrane.machine_code import using
from torchmembrane.mechanics.cavity import FILLINGS
from torchmembrane.presets import preset
from torchmembrane.sensor.parts import Cavity
from torchmembrane.simulate import Simulator, Sphere, Stroke
from torchmembrane.simulate.appearance import Appearance
from torchmembrane.simulate.dataset import stroke_to

pytestmark = pytest.mark.usefixtures("quick_images")

WAY = np.array([0.1, 0.2, -1.0]) / np.linalg.norm([0.1, 0.2, -1.0])
NAN = float("nan")


def sensor_of(filling="liquid", grid=13):
    """The fingertip; its gas is soft: the membrane's own pressure is a third of it."""
    sensor = preset("fingertip")
    cavity = Cavity(filling, 900.0) if filling == "gas" else Cavity(filling)
    return replace(sensor, cavity=cavity, membrane=sensor.surface.membrane((grid, grid)))


@pytest.fixture(scope="module")
def strokes():
    """By the filling: exact pixels `[3, D, 2]` of three depths of a press on 20 x 20 vertices, and the pressure changes."""

    def simulated():
        arrays = {}
        for filling in FILLINGS:
            simulator = Simulator(sensor_of(filling), grid=(20, 20))
            stroke = Stroke(Sphere(3.0).touching(simulator.membrane, WAY), WAY, 1.8)
            states = list(simulator.presses(stroke, ("push",), 3))
            arrays[filling] = np.stack([simulator.renderer.dots(state.vertices).pixels for state in states])
            arrays[f"{filling} rise"] = np.array([float(state.pressure - state.rest_pressure) for state in states], np.float32)
        return arrays

    found = {name: torch.from_numpy(array) for name, array in kept("gauge_strokes", None, simulated).items()}
    return {filling: (found[filling], found[f"{filling} rise"]) for filling in FILLINGS}


def reconstructor_of(filling="liquid", noise=0.01, dtype=torch.float64, **settings):
    settings = tm.ForceBalanceSettings(pressure_noise=noise, **settings)
    return tm.Reconstructor(sensor_of(filling), settings=settings, dtype=dtype)


def same(one, other):
    for key, value in one._asdict().items():
        assert torch.equal(value.nan_to_num(), other._asdict()[key].nan_to_num()), key


@pytest.mark.parametrize("filling", ["liquid", "gas"])
def test_a_reading_of_next_to_no_noise_is_the_pressure_found(strokes, filling):
    """Also where it is off the pressure that the image alone shows."""
    exact, rise = strokes[filling]
    reconstructor = reconstructor_of(filling, 1e-6)
    with torch.no_grad():
        image_alone = reconstructor.from_pixels(exact)
        for share in (1.0, 1.1):
            reading = reconstructor.rest_pressure + share * rise
            result = reconstructor.from_pixels(exact, pressure=reading)
            torch.testing.assert_close(result.pressure, reading.to(result.pressure), rtol=1e-5, atol=0)
            assert (result.status == 0).all() and (result.volume_error.abs() < 1e-4).all()
    assert ((image_alone.pressure_change / rise - 1).abs() > 1e-3).all()


def test_the_gauge_pulls_as_the_forces_resist(strokes):
    """At the solution the pressure's row has no residual: what the weighted forces ask of the pressure, the gauge holds."""
    exact, rise = strokes["liquid"]
    reconstructor = reconstructor_of(noise=0.01, steps=(64, 40, 100), settled_step_tol=1e-8)
    estimator = reconstructor.estimator
    flow = reconstructor.observer.judge(*reconstructor.observer.from_pixels(exact, None, None))
    observation = reconstructor.observation(*flow[:3])
    reading = reconstructor.rest_pressure + 1.2 * rise
    pulls = []
    for gauged in (observation, estimator.gauged(observation, reading)):
        with torch.no_grad():
            found = estimator(gauged)
            measured = estimator.equations.bearings.measured(gauged)
            scales = (
                torch.full_like(found.pressure, scale) for scale in (estimator.settings.tau[1], estimator.settings.outlier)
            )
            corner = estimator.equations.linearised(
                found.vertices - estimator.membrane.rest, found.pressure, found.moved, measured, *scales
            )[3]
        pulls.append(corner[0])
    sigma = 0.01 * estimator.reference
    expected = (found.pressure - reading) / sigma**2
    assert (pulls[0].abs() < 1e-3 * expected.abs()).all()
    torch.testing.assert_close(pulls[1], expected, rtol=1e-3, atol=0)


def test_gradient_and_diagonal_are_the_derivatives_of_the_loss():
    rise, none = torch.tensor([0.3, 0.2], dtype=torch.float64).requires_grad_(), torch.zeros(2, dtype=torch.float64)
    gauge = torch.tensor([[0.25, 7.0], [0.0, 0.0]], dtype=torch.float64)
    (slope,) = torch.autograd.grad(gauge_loss(gauge, rise).sum(), rise, create_graph=True)
    (second,) = torch.autograd.grad(slope.sum(), rise)
    load, diagonal = pulled((none, none), gauge, rise)
    torch.testing.assert_close(load, -slope)
    torch.testing.assert_close(diagonal, second)
    assert slope[0] > 0 == slope[1]


def test_the_objective_holds_half_the_squared_reading_over_its_noise(strokes):
    exact, rise = strokes["liquid"]
    reconstructor = reconstructor_of(noise=0.02)
    estimator = reconstructor.estimator
    flow = reconstructor.observer.judge(*reconstructor.observer.from_pixels(exact, None, None))
    observation = reconstructor.observation(*flow[:3])
    reading = reconstructor.rest_pressure + torch.tensor([1.3 * rise[0], NAN, rise[2]])
    with torch.no_grad():
        found = estimator(observation)
        state, bearings = (
            State(found.vertices - estimator.membrane.rest, found.pressure, found.moved),
            estimator.equations.bearings,
        )
        with_it, without = (bearings.measured(each) for each in (estimator.gauged(observation, reading), observation))
        angles = bearings.angles(state.u, with_it, state.moved)[0]
        misfits = [estimator.gauss_newton.misfit(angles, state.pressure, each) for each in (with_it, without)]
        more = misfits[0] - misfits[1]
    expected = ((found.pressure - reading) / (0.02 * estimator.reference)).square() / 2
    torch.testing.assert_close(more, expected.nan_to_num())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_reading_changes_nothing(strokes, dtype):
    exact, _ = strokes["liquid"]
    reconstructor = reconstructor_of(dtype=dtype)
    with torch.no_grad():
        plain = reconstructor.from_pixels(exact)
        same(plain, reconstructor.from_pixels(exact, pressure=torch.full((3,), NAN)))
        same(plain, reconstructor.from_pixels(exact, pressure=NAN))
        deviations = reconstructor.standard_deviations(plain), reconstructor.standard_deviations(plain, NAN)
    for one, other in zip(*deviations, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-7)


def test_each_frame_of_a_batch_has_its_own_reading(strokes):
    exact, rise = strokes["gas"]
    reconstructor = reconstructor_of("gas", 0.003)
    reading = reconstructor.rest_pressure + rise * torch.tensor([1.2, NAN, 0.9])
    with torch.no_grad():
        batch = reconstructor.from_pixels(exact, pressure=reading)
        single = [reconstructor.from_pixels(exact[k], pressure=reading[k]) for k in range(3)]
        plain = reconstructor.from_pixels(exact)
    for k in range(3):
        for key in ("vertices", "pressure", "force"):
            torch.testing.assert_close(getattr(batch, key)[k], getattr(single[k], key)[0], rtol=1e-6, atol=1e-8)
    assert torch.equal(batch.vertices[1], plain.vertices[1]) and not torch.equal(batch.vertices[0], plain.vertices[0])


def test_frames_that_take_different_numbers_of_steps_keep_their_readings(strokes):
    """By tensor operations, of which a frame that has settled takes no more: its own reading is what each then has."""
    exact, rise = strokes["liquid"]
    reconstructor = reconstructor_of(noise=1e-6)
    reading = reconstructor.rest_pressure + rise.double() * torch.tensor([1.0, 0.8, 1.1])
    flow = reconstructor.observer.judge(*reconstructor.observer.from_pixels(exact, None, None))
    with torch.no_grad(), using(False):
        found = reconstructor.estimator(reconstructor.estimator.gauged(reconstructor.observation(*flow[:3]), reading))
    torch.testing.assert_close(found.pressure, reading, rtol=1e-6, atol=0)


def test_gradients_in_the_reading_agree_with_finite_differences(strokes):
    exact, rise = strokes["liquid"]
    reconstructor = reconstructor_of(noise=0.01, steps=(64, 400, 16), settled_step_tol=1e-11)

    def answers(reading):
        result = reconstructor.from_pixels(exact[2], pressure=reading)
        return torch.cat([result.pressure, result.force[0]])

    reading = (reconstructor.rest_pressure + 1.05 * rise[2]).detach().requires_grad_()
    gradients = torch.stack([torch.autograd.grad(a, reading, retain_graph=True)[0] for a in answers(reading)])
    step = 1e-6 * reading.detach()
    with torch.no_grad():
        expected = (answers(reading + step) - answers(reading - step)) / (2 * step)
    torch.testing.assert_close(gradients, expected, rtol=1e-4, atol=1e-6)
    assert gradients[0] > 0.05


@pytest.mark.parametrize("noise, shallowest", [(0.001, 0), (0.003, 1)])
def test_the_noise_of_the_gauge_is_in_the_standard_deviations(strokes, noise, shallowest):
    """Markers that are sure: what is left is how the answer follows the reading, times the reading's noise.

    A larger noise changes what the shallowest of the three presses pushes, which is beyond the first order.
    """
    exact, rise = (values[shallowest:] for values in strokes["liquid"])
    reconstructor = reconstructor_of(noise=noise, steps=(64, 400, 16), settled_step_tol=1e-9)
    reading = reconstructor.rest_pressure + rise
    sigma = noise * reconstructor.estimator.reference
    with torch.no_grad():
        result = reconstructor.from_pixels(exact, pressure=reading)
        more, less = (reconstructor.from_pixels(exact, pressure=reading + s * 0.1 * sigma) for s in (1, -1))
        reconstructor.observer.rest_covariance *= 1e-8
        alone = reconstructor.standard_deviations(result, reading)
    for got, high, low in ((alone.pressure, more.pressure, less.pressure), (alone.force, more.force, less.force)):
        expected = (high - low).abs() / 0.2
        assert ((got - expected).abs() < 0.25 * expected.norm(dim=-1, keepdim=expected.ndim > 1)).all(), (got, expected)


def test_precisions_agree(strokes):
    exact, rise = strokes["gas"]
    results = []
    for dtype in (torch.float32, torch.float64):
        reconstructor = reconstructor_of("gas", 0.003, dtype)
        with torch.no_grad():
            results.append(reconstructor.from_pixels(exact, pressure=reconstructor.rest_pressure + 1.05 * rise))
    single, double = results
    torch.testing.assert_close(single.pressure.double(), double.pressure, rtol=1e-3, atol=0)
    assert (single.force - double.force).norm() < 5e-3 * double.force.norm()


def test_where_a_gauge_tells_nothing_is_said(strokes):
    exact, rise = strokes["open"]
    with pytest.raises(tm.MembraneError, match="cavity is open"):
        reconstructor_of("open").from_pixels(exact, pressure=0.03)
    with pytest.raises(tm.MembraneError, match="minimum-energy"):
        tm.Reconstructor(sensor_of(), "minimum-energy").from_pixels(exact, pressure=0.03)
    liquid = reconstructor_of()
    for wrong in (torch.zeros(2), torch.zeros(3, 1)):
        with pytest.raises(tm.MembraneError, match=r"expected \[3\]"):
            liquid.from_pixels(exact, pressure=wrong)
    with pytest.raises(tm.MembraneError, match="inf"):
        liquid.from_pixels(exact, pressure=float("inf"))
    with pytest.raises(tm.MembraneError, match="pressure_noise"):
        tm.ForceBalanceSettings(pressure_noise=0.0)


@pytest.mark.parametrize("presses", [1, pytest.param(3, marks=pytest.mark.full)])
def test_a_reading_takes_the_grids_error_out_of_the_force(presses):
    """Presses through rendered images, readings good to 0.1 % of the rest pressure, told to be good to 1 %; of these the deep
    one of a narrow ball, the first, is what 17 lines resolve least."""
    sensor = sensor_of(grid=17)
    simulator = Simulator(sensor, grid=(31, 31), appearance=Appearance(noise=35.0))
    reader = tm.Reconstructor(replace(sensor, markers=replace(sensor.markers, rest_image=simulator.rest_image())))
    size, aim = simulator.membrane.size, simulator.membrane.rest[simulator.membrane.fixed].mean(0).numpy()
    errors, rng, rest = [], np.random.default_rng(0), float(reader.rest_pressure)
    drawn = ((0.14, (0, 0, -1), 0.16), (0.3, (-0.7, 0.3, -0.5), 0.06), (0.2, (-0.5, 0.3, -0.8), 0.1))
    for radius, way, depth in drawn[:presses]:
        stroke = stroke_to(simulator, Sphere(radius * size), aim, np.array(way, float), depth * size)
        state = next(simulator.presses(stroke, ("push",)))
        image, truth = simulator.image(state.vertices, rng), state.force.numpy()
        reading = rest + float(state.pressure - state.rest_pressure) + 1e-3 * rest * rng.normal()
        with torch.no_grad():
            found = [reader(image, pressure=pressure).force[0].numpy() for pressure in (None, reading)]
        errors.append([np.linalg.norm(force - truth) / np.linalg.norm(truth) for force in found])
    (alone, gauged), (narrow, narrow_gauged) = np.mean(errors, 0), errors[0]
    assert narrow_gauged < 0.6 * narrow and gauged < alone and gauged < 0.016


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A sensor of 13 x 13 vertices on disk, images of two presses, and their pressure changes in hPa."""
    path, sensor = tmp_path_factory.mktemp("recording"), sensor_of()
    simulator = Simulator(sensor, grid=(20, 20), appearance=Appearance(noise=40.0))
    sensor = replace(sensor, markers=replace(sensor.markers, rest_image=simulator.rest_image()))
    sensor.to_file(path / "sensor.toml")
    stroke = Stroke(Sphere(3.0).touching(simulator.membrane, WAY), WAY, 1.6)
    rises = []
    for k, state in enumerate(simulator.presses(stroke, ("push",), 2)):
        Image.fromarray(simulator.image(state.vertices, np.random.default_rng(k))).save(path / f"p{k}.png")
        rises.append(1e4 * float(state.pressure - state.rest_pressure))
    return path, rises


def reconstruct(path, out, *options):
    return main(
        ["reconstruct", str(path / "sensor.toml"), str(path / "p0.png"), str(path / "p1.png"), "--out", str(out), *options]
    )


def test_the_command_takes_readings_of_frames(recording, tmp_path, capsys):
    path, rises = recording
    reader = tm.Reconstructor.from_file(path / "sensor.toml", settings=tm.ForceBalanceSettings(pressure_noise=0.001))
    rest = float(reader.rest_pressure)
    tables = {
        "change": f"name,pressure_change\np1.png,{1.2 * rises[1]:.6f}\n",
        "across": f"name,pressure\np0,\np1,{1e4 * rest + 1.2 * rises[1]:.6f}\n",
    }
    with torch.no_grad():
        plain = reader(reader.read(path / "p0.png", path / "p1.png"))
        told = reader(reader.read(path / "p1.png"), pressure=rest + 1.2e-4 * rises[1])
    for name, text in tables.items():
        (tmp_path / f"{name}.csv").write_text(text)
        options = ["--pressure", str(tmp_path / f"{name}.csv"), "--pressure-noise", "0.001"]
        assert reconstruct(path, tmp_path / name, *options) == 0
        results = tm.read_results(tmp_path / name)
        assert results["p0"]["force"] == pytest.approx(plain.force[0].numpy(), rel=1e-4, abs=1e-5)
        assert results["p1"]["force"] == pytest.approx(told.force[0].numpy(), rel=1e-3)
        assert abs(float(told.pressure[0] - plain.pressure[1])) > 0.5 * 1e-4 * 0.2 * rises[1]
    assert reconstruct(path, tmp_path / "change", *options) == 2
    assert "across.csv" in (said := capsys.readouterr().err) and f"--pressure {tmp_path / 'change.csv'}" in said
    assert reconstruct(path, tmp_path / "change") == 2 and "not measured" in capsys.readouterr().err
    options[1], options[3] = str(tmp_path / "change.csv"), "0.01"
    assert reconstruct(path, tmp_path / "change", *options) == 2 and "--pressure-noise 0.001" in capsys.readouterr().err
    options[3] = "0.001"
    assert reconstruct(path, tmp_path / "change", *options) == 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name,hPa\np0,3\n", "header is 'name,hPa'"),
        ("name,pressure\np7,3\n", "'p7' is none of the frames"),
        (
            "name,pressure\np0,three\n",
            "line 2: pressure = 'three'; expected a number such as 12 or 1.5, with a point and not a comma",
        ),
        ("name,pressure\np0,3\np0.png,3\n", "twice"),
        ("name,pressure\np0,3,4\n", "3 values"),
        ("name,pressure\np0,inf\n", "line 2: pressure = inf; expected a finite number"),
        ("name,pressure\np0,nan\n", "no readings"),
    ],
)
def test_a_wrong_table_is_refused_in_words(recording, tmp_path, capsys, text, said):
    path, _ = recording
    (tmp_path / "gauge.csv").write_text(text)
    assert reconstruct(path, tmp_path / "out", "--pressure", str(tmp_path / "gauge.csv")) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_hectopascals_need_a_modulus_and_force_balance(recording, tmp_path, capsys):
    path, _ = recording
    (tmp_path / "gauge.csv").write_text("name,pressure\np0,3\n")
    options = ["--pressure", str(tmp_path / "gauge.csv")]
    assert reconstruct(path, tmp_path / "out", *options, "--estimator", "minimum-energy") == 2
    assert "force-balance" in capsys.readouterr().err
    assert reconstruct(path, tmp_path / "out", "--pressure-noise", "0.1", "--estimator", "minimum-energy") == 2
    assert "--estimator force-balance" in capsys.readouterr().err
    sensor = tm.Sensor.from_file(path / "sensor.toml")
    relative = replace(sensor, material=replace(sensor.material, shear_modulus=None))
    relative.to_file(tmp_path / "sensor.toml")
    for name in ("p0.png", "p1.png"):
        (tmp_path / name).write_bytes((path / name).read_bytes())
    assert reconstruct(tmp_path, tmp_path / "out", *options) == 2
    assert "calibrate material --pressure" in capsys.readouterr().err


def test_a_tracker_takes_a_reading_with_each_frame(recording):
    path, rises = recording
    reader = tm.Reconstructor.from_file(path / "sensor.toml", settings=tm.ForceBalanceSettings(pressure_noise=1e-5))
    tracker, rest = tm.Tracker(reader), float(reader.rest_pressure)
    for k, rise in enumerate(rises):
        result = tracker(reader.read(path / f"p{k}.png"), rest + 1e-4 * rise)
        assert float(result.pressure_change[0]) == pytest.approx(1e-4 * rise, rel=2e-3)
