"""An estimator of one's own works everywhere without a change."""

import re
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
import onnxruntime
import pytest
import torch

import torchmembrane as tm
from torchmembrane import control_flow
from torchmembrane.cli.main import main
from torchmembrane.estimators import registry
from torchmembrane.estimators.contacts import ContactPatches
from torchmembrane.onnx.export import Tracer
from torchmembrane.onnx.graph import described
from torchmembrane.results.store import Mesh

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "own_estimator.md").read_text()
MODULE, USE = re.findall(r"```python\n(.*?)```", PAGE, re.S)
COMMANDS = [shlex.split(line)[1:] for line in re.search(r"```sh\n(.*?)```", PAGE, re.S)[1].splitlines()]
MEMBERS = {"from_problem", "prepare", "forward", "is_converged"}


@pytest.fixture(autouse=True)
def _as_before(monkeypatch):
    """Names, the page's module and the path of imports are as they were after each test."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    with patch.dict(registry.ESTIMATORS):
        yield
    sys.modules.pop("linear_map", None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One with the page's module and the examples."""
    path = tmp_path_factory.mktemp("own")
    (path / "linear_map.py").write_text(MODULE)
    (path / "examples").symlink_to(ROOT / "examples")
    return path


@pytest.fixture
def linear_map(folder, monkeypatch):
    """The page's module, imported."""
    monkeypatch.syspath_prepend(str(folder))
    import linear_map

    return linear_map


@pytest.fixture
def cap(small_sensor):
    return tm.Sensor.from_file(small_sensor / "sensor.toml")


@dataclass(frozen=True)
class Nothing:
    pass


class Still(tm.Estimator):
    """The rest surface, whatever is seen."""

    Settings = Nothing

    @classmethod
    def from_problem(cls, problem, settings=None):
        return cls(problem.membrane, problem.cavity_law(), settings)

    def prepare(self, camera, pixels, confidence, covariance):
        return tm.Observation(*camera.pixel_to_ray(pixels), confidence)

    def forward(self, observation):
        frames = len(observation.confidence)
        x, pressure = self.membrane.rest.repeat(frames, 1, 1), self.rest_pressure.expand(frames)
        return tm.Equilibrium.without_tractions(x, pressure, self.membrane.volume(x), 0 * pressure)

    def is_converged(self, found):
        return found.relative_step == 0


def test_the_page_s_python_and_commands_run_and_find_the_same(folder, monkeypatch, capsys):
    """Of the exported model here the estimator's part, below the whole."""
    monkeypatch.chdir(folder)
    exported = []

    def export_part(reconstructor, path, **options):
        exported.append((reconstructor, traced(reconstructor)))
        path.touch()

    monkeypatch.setattr("torchmembrane.onnx.export.export", export_part)
    for call in COMMANDS:
        assert main(call) == 0, call
    assert str(folder) in sys.path
    names: dict = {}
    exec(compile(USE, "own_estimator.md", "exec"), names)
    reconstructor, result = names["reconstructor"], names["result"]
    assert result.status.tolist() == [0, 0] and reconstructor.estimator_name == "linear-map"
    assert (result.residual < 0.05).all() and result.displacement.norm(dim=-1).amax(-1).min() > 0.01
    stored = tm.read_results("out/linear")
    mesh = Mesh.load(Path("out/linear/mesh.npz"))
    assert (mesh.estimator, mesh.smoothing, mesh.element) == ("linear_map:LinearMap", 0.01, "triangle")
    with torch.no_grad():
        alone = tm.Reconstructor(reconstructor.sensor, "linear_map:LinearMap")(reconstructor.read("examples/press_on_axis.png"))
    for key, value in alone.frame(0).items():
        np.testing.assert_array_equal(stored["press_on_axis"][key], value, err_msg=key)
    ((made, (parts, vertices)),) = exported
    assert parts == ["LinearMap.forward"] and torch.equal(made.estimator.spread, reconstructor.estimator.spread)
    np.testing.assert_allclose(vertices["found"], vertices["expected"], rtol=0, atol=1e-5)


@pytest.mark.full
def test_the_page_s_exported_model_gives_what_torch_gives(folder, monkeypatch):
    monkeypatch.chdir(folder)
    Path("out").mkdir(exist_ok=True)
    (call,) = (call for call in COMMANDS if call[0] == "export")
    assert main(call) == 0
    names: dict = {}
    exec(compile(USE, "own_estimator.md", "exec"), names)
    reconstructor = names["reconstructor"]
    grey = reconstructor.grey(reconstructor.read("examples/press_on_axis.png", "examples/flat_plate.png"))
    with torch.no_grad():
        expected = reconstructor.reconstruct_grey(grey)
    session = onnxruntime.InferenceSession("out/linear.onnx", providers=["CPUExecutionProvider"])
    found = dict(zip([out.name for out in session.get_outputs()], session.run(None, {"image": grey.numpy()}), strict=True))
    for key in ("vertices", "contact", "contact_points", "wrench", "pressure", "status"):
        np.testing.assert_allclose(found[key], getattr(expected, key).numpy(), rtol=0, atol=2e-5, err_msg=key)


@pytest.mark.usefixtures("quick_processes")
def test_the_command_finds_it_in_the_current_directory_also_in_worker_processes(
    folder, small_sensor, small_images, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(folder)
    assert str(folder) not in sys.path and "" not in sys.path and "linear_map" not in sys.modules
    call = ["reconstruct", small_sensor / "sensor.toml", *small_images, "--out", tmp_path / "out", "--workers", "2"]
    assert main([*map(str, call), "--batch", "1", "--estimator", "linear_map:LinearMap"]) == 0
    assert "3 reconstructed, 0 failed" in capsys.readouterr().out
    assert len(tm.read_results(tmp_path / "out").names) == 3


def test_the_class_its_path_and_its_name_are_the_same_estimator(linear_map, cap, small_images):
    by_class = tm.Reconstructor(cap, linear_map.LinearMap)
    assert by_class.estimator_name == "linear_map:LinearMap"
    with torch.no_grad():
        expected = by_class(by_class.read(*small_images))
    tm.register_estimator("linear-map", linear_map.LinearMap)
    for given in ("linear-map", "linear_map:LinearMap", linear_map.LinearMap):
        made = tm.Reconstructor(cap, given)
        assert made.estimator_name == made.estimator.name == "linear-map"
        with torch.no_grad():
            for found, value in zip(made(made.read(*small_images)), expected, strict=True):
                torch.testing.assert_close(found, value, rtol=0, atol=0, equal_nan=True)


def test_a_batch_gives_what_its_frames_give_and_double_agrees(linear_map, cap, small_images):
    single, double = (tm.Reconstructor(cap, linear_map.LinearMap, dtype=kind) for kind in (torch.float32, torch.float64))
    with torch.no_grad():
        together = single(images := single.read(*small_images))
        for k in range(3):
            alone = single(images[k : k + 1])
            torch.testing.assert_close(alone.vertices[0], together.vertices[k], rtol=0, atol=1e-5)
        precise = double.from_pixels(together.pixels.double(), together.confidence.double())
    assert precise.vertices.dtype == torch.float64
    torch.testing.assert_close(precise.vertices.float(), together.vertices, rtol=0, atol=1e-4)
    assert together.displacement.norm(dim=-1).amax(-1)[-1] > 0.1


def test_gradients_are_finite_differences(linear_map, cap):
    made = tm.Reconstructor(cap, linear_map.LinearMap, dtype=torch.float64)
    rest = made.rest_pixels
    direction = torch.rand(rest.shape, dtype=rest.dtype) - 0.5
    pixels = (rest + 0.3 * direction)[None].requires_grad_()
    made.from_pixels(pixels).vertices.square().sum().backward()
    ahead, behind = (made.from_pixels(pixels.detach() + s * direction).vertices.square().sum() for s in (1e-4, -1e-4))
    torch.testing.assert_close((pixels.grad * direction).sum(), (ahead - behind) / 2e-4, rtol=1e-5, atol=0)


def test_what_a_class_does_not_say_has_a_default(cap):
    made = tm.Reconstructor(cap, Still)
    result = made.from_pixels(made.rest_pixels + 1.0)
    assert result.status.tolist() == [0] and not made.finds_tractions and made.locator_name == "fit"
    assert result.displacement.abs().max() == 0 and result.contact.max() == 0 and result.contact_points.isnan().all()
    assert result.force_deviation.isnan().all() and result.depth_deviation.isnan().all()
    known = {"element": "triangle", "volume": "exact", "flow_kind": "smooth", "smoothing_weight": 0.0}
    assert {name: getattr(made.estimator, name) for name in known} == known
    name = f"{__name__}:Still"
    for refused in (lambda: made.from_pixels(made.rest_pixels, pressure=0.1), made.estimator.check_gauge):
        with pytest.raises(
            tm.MembraneError,
            match=rf"estimator {name} has no use for a measured pressure; expected estimator = 'force-balance'",
        ):
            refused()
    with pytest.raises(
        tm.MembraneError, match=rf"estimator {name} has no standard deviations; expected estimator = 'force-balance'"
    ):
        made.standard_deviations(result)


def test_a_class_says_what_reconstructor_asks(cap):
    class Picky(Still):
        default_locator, needs_every_vertex, solves_in_double = "soft", False, True

        def is_converged(self, found):
            return super().is_converged(found) & (found.vertices.dtype == torch.float32)

    made = tm.Reconstructor(cap, Picky)
    result = made.from_pixels(made.rest_pixels)
    assert made.locator_name == "soft" and made.estimator.membrane.rest.dtype == torch.float64
    assert result.vertices.dtype == torch.float32 and result.status.tolist() == [tm.Status.NOT_CONVERGED]


def test_contacts_are_where_the_surface_lies_inside_the_rest_surface(cap):
    """A dent of depth 0.5: one contact there, whose force is that of the traction on it, where one is known."""
    membrane = cap.membrane
    patches, centre = ContactPatches(membrane), len(membrane.rest) // 2
    share = torch.exp(-(membrane.rest - membrane.rest[centre]).square().sum(-1) / 4) * ~membrane.fixed
    x = (membrane.rest - 0.5 * share[:, None] * membrane.rest_normals)[None]
    normals = membrane.normals(x)
    unknown, known = patches.bulges(x, normals), patches.bulges(x, normals, -0.2 * normals)
    assert unknown.points[0, 1:].isnan().all() and unknown.force.isnan().all() and unknown.slip.isnan().all()
    torch.testing.assert_close(unknown.points[0, 0], x[0, centre], rtol=0, atol=0.2)
    assert unknown.indicator[0, centre] == 1 and unknown.indicator[0, 0] == 0
    inside = unknown.indicator[0, :, None] * membrane.rest_area[:, None]
    torch.testing.assert_close(known.force[0, 0], (-0.2 * normals[0] * inside).sum(0))
    outwards = patches.bulges((2 * membrane.rest - x[0])[None], membrane.rest_normals[None])
    assert outwards.indicator.max() == 0 and outwards.points.isnan().all()


def test_the_state_keeps_parameters_and_leaves_out_what_is_rebuilt(linear_map, cap):
    class Learned(linear_map.LinearMap):
        def __init__(self, problem, settings):
            super().__init__(problem, settings)
            self.scale = torch.nn.Parameter(torch.ones(()))

        def forward(self, observation):
            found = super().forward(observation)
            return found._replace(vertices=self.membrane.rest + self.scale * (found.vertices - self.membrane.rest))

    one, other = tm.Reconstructor(cap, Learned), tm.Reconstructor(cap, Learned)
    with torch.no_grad():
        one.estimator.scale.fill_(0.5)
    state = one.state_dict()
    assert "estimator.scale" in state and not [name for name in state if "spread" in name]
    other.load_state_dict(state)
    pixels = one.rest_pixels + torch.rand(one.rest_pixels.shape)
    torch.testing.assert_close(other.from_pixels(pixels).vertices, one.from_pixels(pixels).vertices)
    half, whole = one.from_pixels(pixels).displacement, tm.Reconstructor(cap, linear_map.LinearMap).from_pixels(pixels)
    torch.testing.assert_close(2 * half, whole.displacement, rtol=1e-4, atol=1e-5)


def traced(made: tm.Reconstructor) -> tuple[list[str], dict]:
    """The parts of a model that an estimator becomes, and what the model gives beside what torch gives of two frames' rays."""
    rays = made.camera.pixel_to_ray(made.rest_pixels + torch.rand(2, *made.rest_pixels.shape))
    given = {"directions": rays.direction, "confidence": torch.ones(rays.direction.shape[:2])}
    parts: list[str] = []
    tracer = Tracer(lambda share, step: parts.append(step))
    known = {name: tracer.given(name, value) for name, value in given.items()}
    found = made.estimator(tm.Observation(known["directions"], **known))
    tracer.assembly.named(found.vertices.name, "vertices")
    inputs = [described(name, 1, ["batch", *value.shape[1:]]) for name, value in given.items()]
    model = tracer.assembly.model(inputs, [described("vertices", 1, ["batch", *found.vertices.example.shape[1:]])], {})
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    with torch.no_grad():
        expected = made.estimator(tm.Observation(given["directions"], **given)).vertices
    return parts, {"found": session.run(None, {k: v.numpy() for k, v in given.items()})[0], "expected": expected.numpy()}


def test_an_own_forward_is_one_part_of_a_model_and_agrees_with_torch(linear_map, cap):
    parts, vertices = traced(tm.Reconstructor(cap, linear_map.LinearMap))
    assert parts == ["LinearMap.forward"] and all(kind.in_parts for kind in (tm.ForceBalance, tm.MinimumEnergy))
    assert np.ptp(vertices["expected"], axis=0).max() > 0.01  # the frames differ
    np.testing.assert_allclose(vertices["found"], vertices["expected"], rtol=0, atol=1e-5)


def test_a_forward_in_parts_is_its_traced_methods(linear_map, cap):
    class Halved(linear_map.LinearMap):
        in_parts = True

        def forward(self, observation):
            return self.half(self.half(self.whole(observation)))

        @control_flow.traced
        def whole(self, observation):
            return linear_map.LinearMap.forward(self, observation)

        @control_flow.traced
        def half(self, found):
            return found._replace(vertices=(found.vertices + self.membrane.rest) / 2)

    parts, vertices = traced(tm.Reconstructor(cap, Halved))
    assert [part.rpartition(".")[2] for part in parts] == ["whole", "half"]  # traced once, used twice
    np.testing.assert_allclose(vertices["found"], vertices["expected"], rtol=0, atol=1e-5)


def test_what_onnx_cannot_hold_is_said(cap):
    class Asking(Still):
        def forward(self, observation):
            found = super().forward(observation)
            return found if bool((observation.confidence > 2).any()) else found._replace(moved=found.moved + 0)

    with pytest.raises(tm.MembraneError, match=r"export: \S*Asking\.forward cannot be written as ONNX: \S"):
        traced(tm.Reconstructor(cap, Asking))


def test_a_name_is_one_class_s():
    tm.register_estimator("still", Still)
    tm.register_estimator("still", Still)

    class Other(Still):
        pass

    for name in ("still", "paper"):
        with pytest.raises(tm.MembraneError, match=f"'{name}' is {registry.ESTIMATORS[name].__qualname__}'s; expected another"):
            tm.register_estimator(name, Other)
    with pytest.raises(
        tm.MembraneError, match="expected letters, digits, hyphens and underscores, without a digit at the beginning"
    ):
        tm.register_estimator("linear_map:LinearMap", Other)


def without(*members: str) -> type:
    """`Still` without some of its members."""
    return type("Lacking", (tm.Estimator,), {name: value for name, value in vars(Still).items() if name not in members})


@pytest.mark.parametrize("member", sorted({"Settings", *MEMBERS}))
def test_the_member_that_a_class_lacks_is_named(cap, member):
    for give in (lambda kind: tm.register_estimator("lacking", kind), lambda kind: tm.Reconstructor(cap, kind)):
        with pytest.raises(tm.MembraneError, match=rf"lacks {member}; see torchmembrane\.Estimator"):
            give(without(member))


def test_all_that_a_class_lacks_is_named(cap):
    class Plain(torch.nn.Module):
        pass

    @dataclass
    class Loose:
        pass

    everything = "Settings, from_problem, prepare, forward, is_converged"
    for kind, said in (
        (Plain, f"lacks the base class torchmembrane.Estimator, {everything}; see"),
        (tm.Estimator, f"lacks {everything}; see"),
        (type("Loosely", (Still,), {"Settings": Loose}), r"lacks @dataclass\(frozen=True\) at Settings; see"),
        (Still.forward, "estimator is a function; expected text or a subclass of Estimator"),
    ):
        with pytest.raises(tm.MembraneError, match=said):
            tm.Reconstructor(cap, kind)
    with pytest.raises(tm.MembraneError, match="settings are PaperSettings; expected Nothing for "):
        tm.Reconstructor(cap, Still, settings=tm.PaperSettings())


@pytest.mark.parametrize(
    "given, said",
    [
        ("papre", "expected one of force-balance, minimum-energy, paper or MODULE:CLASS; did you mean 'paper'"),
        ("no_such_module:Sheet", "the module 'no_such_module' cannot be imported"),
        (":Sheet", "the module '' cannot be imported"),
        ("linear_map:Sheet", "no 'Sheet' in "),
        ("linear_map:", "no '' in "),
        ("linear_map:torch", "is not a class; expected a subclass"),
        ("linear_map:LinearMapSettings", "lacks the base class torchmembrane.Estimator, Settings, from_problem"),
    ],
)
def test_the_command_says_what_is_wrong_with_an_estimator(folder, monkeypatch, capsys, given, said):
    monkeypatch.chdir(folder)
    call = ["reconstruct", "examples/sensor.toml", "examples/rest.png", "--out", "none", "--estimator", given]
    assert main(call) == 2 and not (folder / "none").exists()
    errors = capsys.readouterr().err
    assert said in errors and len(errors.splitlines()) == 1


def test_an_option_without_a_field_in_the_settings_is_refused(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    call = ["export", "examples/sensor.toml", "-o", "none.onnx", "--estimator", "linear_map:LinearMap", "--flow", "smooth"]
    assert main(call) == 2
    assert "--flow smooth: linear_map:LinearMap has no such choice" in capsys.readouterr().err


def installed(path: Path, package: str, entries: str) -> None:
    """What an installed package with these entry points leaves in a folder of the path."""
    info = path / f"{package}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[torchmembrane.estimators]\n{entries}")


def test_an_installed_package_gives_estimators_their_names(folder, linear_map, cap, tmp_path, monkeypatch):
    (entry,) = re.findall(r"```toml\n\[project.entry-points.\"torchmembrane.estimators\"\]\n(.*?)```", PAGE, re.S)
    installed(tmp_path, "maps", entry.replace('"', "") + "broken = linear_map:Sheet\npaper = linear_map:LinearMap\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert isinstance(tm.Reconstructor(cap, "linear-map").estimator, linear_map.LinearMap)
    assert isinstance(tm.Reconstructor(cap, "paper").estimator, tm.PaperEstimator)
    for name, said in (("broken", "no 'Sheet' in "), ("lineer-map", r"paper, linear-map, broken or .*mean 'linear-map'")):
        with pytest.raises(tm.MembraneError, match=said):
            tm.Reconstructor(cap, name)
    installed(tmp_path / "more", "others", "twice = a:A\n")
    installed(tmp_path / "most", "others2", "twice = b:B\n")
    for path in ("more", "most"):
        monkeypatch.syspath_prepend(str(tmp_path / path))
    with pytest.raises(tm.MembraneError, match="installed packages have a:A, b:B; expected MODULE:CLASS"):
        tm.Reconstructor(cap, "twice")


def test_the_page_lists_every_default():
    rows = set(re.findall(r"`(\w+)`", "\n".join(re.findall(r"^\| (`.*?) \|", PAGE, re.M))))
    public = {name for name in {**vars(tm.Estimator), **tm.Estimator.__annotations__} if not name.startswith("_")}
    assert rows == public - {"name"}
