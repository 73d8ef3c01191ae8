"""`torchmembrane simulate` writes presses, data sets and truth."""

import json
import sys
from dataclasses import replace
from datetime import date
from pathlib import Path

import av
import numpy as np
import pyarrow.parquet
import pytest
import torch
import trimesh
from PIL import Image

from torchmembrane import MembraneError
from torchmembrane.camera.model import Camera
from torchmembrane.cli import main as cli
from torchmembrane.presets import NAMES, design, preset, preset_file, sensor_file
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.record import Record
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate import dataset
from torchmembrane.simulate.frames import SimulatedFrames, SimulatedFrameTable
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.mesh_indenter import MeshIndenter
from torchmembrane.simulate.pattern import Dots
from torchmembrane.simulate.simulator import Simulator

EXAMPLES = Path(__file__).parent.parent / "examples"
SPHERE = ("--indenter", "sphere", "--radius", "3", "--depth", "1")


@pytest.fixture(scope="module")
def sensor_path(tmp_path_factory) -> str:
    """A small cap with nine dots and an image of 80 x 60 px."""
    surface = Surface("spherical_cap", {"rim_radius": 8.0, "height": 4.0, "base_z": 14.0})
    x, y = (a.ravel() for a in np.meshgrid([-3.0, 0, 3], [-3.0, 0, 3]))
    dots = np.stack([x, y, 8 + np.sqrt(100 - x**2 - y**2)], -1)
    camera, markers = Camera("pinhole", (80, 60), (48, 48), (39, 30)), Markers("dots", "dark", dots)
    material = Material("neo_hookean", 1.3, shear_modulus=0.3, thickness=0.4)
    sensor = Sensor("cap", "mm", camera, surface.membrane((7, 7)), material, Cavity("liquid"), markers, surface)
    return str(sensor.to_file(tmp_path_factory.mktemp("sensor")))


def run(capsys, *arguments) -> tuple[int, str, str]:
    code = cli.main([str(argument) for argument in arguments])
    return code, *capsys.readouterr()


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def same(a, b) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[k], b[k], equal_nan=a[k].dtype.kind == "f") for k in a)


def test_forces_of_friction_do_not_depend_on_the_number_of_frames(sensor_path):
    """The path begins at the first touch, not at the first frame's pose."""
    simulator = Simulator(Sensor.from_file(sensor_path))
    travel, aim = np.array([-0.5, 0.0, -0.866]), np.array([0.0, 0.0, 18.0])
    stroke = dataset.stroke_to(simulator, Sphere(3.0), aim, travel, 1.0, friction=0.5)
    (one,) = simulator.presses(stroke, ["push"])
    *_, last = simulator.presses(stroke, ["push"], frames=4)
    assert (one.force - last.force).norm() < 0.03 * one.force[:2].norm()


def test_a_press_gives_image_truth_and_the_sensor_as_simulated(sensor_path, tmp_path, capsys):
    options = ("--direction", "0.3,0.1,1", "--noise", "40", "--name", "one")
    code, said, _ = run(capsys, "simulate", sensor_path, *SPHERE, *options, "--out", tmp_path / "out")
    assert code == 0 and "one.png" in said and " N" in said
    sensor = Sensor.from_file(tmp_path / "out" / "sensor.toml")
    with np.load(tmp_path / "out" / "one_truth.npz") as file:
        truth = dict(file)
    change = float(truth["p"] - truth["p0"])
    assert f"pressure change {change:.4g} N/mm² = {1e4 * change:.4g} hPa" in said
    with np.load(EXAMPLES / "two_contacts_truth.npz") as example:
        assert set(example) <= set(truth)
    image = np.asarray(Image.open(tmp_path / "out" / "one.png"))
    assert image.shape == (60, 80) and image.dtype == np.uint8
    assert len(truth["vertices_deformed"]) == 18**2  # finer than the solver's 7 x 7
    assert np.abs(truth["dots_nominal"] - sensor.markers.positions).max() < 1e-5
    seen = sensor.camera.point_to_pixel(torch.from_numpy(truth["dots_deformed"]).double()).numpy()
    assert np.abs(truth["uv_deformed"] - seen).max() < 1e-4 and truth["visible_deformed"].all()
    assert truth["force"] @ [0.3, 0.1, 1] < 0 and truth["p"] > truth["p0"]
    assert np.allclose(truth["force_each"].sum(0), truth["force"])
    ball = json.loads(str(truth["stroke"]))
    centre = np.array(ball["touch"]) + np.array(ball["travel"]) * ball["depth"]
    touching = truth["vertices_deformed"][truth["contact_mask"]]
    assert len(touching) > 2 and np.abs(np.linalg.norm(touching - centre, axis=1) - 3).max() < 1e-3
    assert np.linalg.norm(truth["contact_centroid_each"][0] - centre) < 3.1
    dark = image[:5, :5], sensor.markers.rest_image[:5, :5]  # where there is only noise
    assert abs(np.corrcoef(*(grey.ravel() for grey in dark))[0, 1]) < 0.6
    pixel = np.rint(truth["uv_deformed"][truth["uv_deformed"].argmin(0)[0]]).astype(int)
    assert image[pixel[1], pixel[0]] < image[pixel[1] + 4, pixel[0] + 4] - 50  # the dot is painted where the truth has it


def test_more_depth_gives_more_force(sensor_path, tmp_path, capsys):
    forces = []
    for depth in ("0.5", "1"):
        run(capsys, "simulate", sensor_path, *SPHERE[:-1], depth, "--name", depth, "--out", tmp_path)
        with np.load(tmp_path / f"{depth}_truth.npz") as truth:
            forces.append(-truth["force"][2])
            assert np.abs(truth["force"][:2]).max() < 0.01 * forces[-1]
    assert forces[1] > 1.5 * forces[0] > 0


@pytest.mark.parametrize(
    "options",
    [
        ("plane",),
        ("cylinder", "--radius", "2", "--turn", "90"),
        ("wedge", "--opening", "70", "--radius", "0.5"),
        ("box", "--sides", "5,4,3", "--radius", "1"),
    ],
)
def test_every_indenter_presses(sensor_path, tmp_path, capsys, options):
    code, said, errors = run(capsys, "simulate", sensor_path, "--indenter", *options, "--depth", "0.5", "--out", tmp_path)
    assert code == 0, errors
    with np.load(tmp_path / "press_truth.npz") as truth:
        assert json.loads(str(truth["stroke"]))["indenter"] == options[0] and truth["force"][2] < -0.01


def test_a_mesh_file_presses_like_the_ball_it_approximates(sensor_path, tmp_path, capsys):
    import trimesh

    ball = tmp_path / "ball.stl"
    trimesh.creation.icosphere(4, 3.0).export(ball)
    forces = []
    for options in (SPHERE[:4], ("--indenter", ball)):
        code, _, errors = run(capsys, "simulate", sensor_path, *options, "--depth", "0.5", "--out", tmp_path / "out")
        assert code == 0, errors
        with np.load(tmp_path / "out" / "press_truth.npz") as truth:
            forces.append(truth["force"][2])
    assert forces[1] == pytest.approx(forces[0], rel=0.05)


@pytest.mark.parametrize("radius", [3000.0, 0.003])
def test_a_mesh_in_another_unit_is_refused(sensor_path, tmp_path, capsys, radius):
    import trimesh

    ball = tmp_path / "ball.stl"
    trimesh.creation.icosphere(1, radius).export(ball)
    code, _, errors = run(capsys, "simulate", sensor_path, "--indenter", ball, "--depth", "0.5", "--out", tmp_path / "out")
    assert code == 2 and f"its longest side is {2 * radius:g}; expected" in errors and "give the mesh in mm" in errors


def test_a_path_gives_frames_and_a_video(sensor_path, tmp_path, capsys):
    path = ("--slide", "0.3,0,0", "--friction", "0.4", "--path", "push,slide,release", "--frames", "2")
    for video in ((), ("--video",)):
        code, said, errors = run(capsys, "simulate", sensor_path, *SPHERE, *path, *video, "--out", tmp_path / f"o{len(video)}")
        assert code == 0 and "6 frames" in said and "frame/s" in errors, errors
    frames = dict(SimulatedFrames(tmp_path / "o0"))
    assert list(frames) == [f"press_{k:06d}" for k in range(6)]
    force = np.array([frame.truth["force"] for frame in frames.values()])
    assert force[1, 2] < force[0, 2] < 0 and force[3, 0] > 10 * abs(force[1, 0])
    last = frames["press_000005"].truth
    assert not last["contact_mask"].any() and np.isnan(last["contact_centroid_each"]).all() and not force[5].any()
    with av.open(str(tmp_path / "o1" / "press.mp4")) as film:
        shown = [picture.to_ndarray(format="gray") for picture in film.decode(video=0)]
    assert len(shown) == 6
    assert np.abs(shown[1].astype(float) - frames["press_000001"].image).mean() < 3
    assert (tmp_path / "o1" / "press_000005_truth.npz").exists()


def test_a_data_set_goes_on_where_it_was_interrupted(sensor_path, tmp_path, capsys):
    call = ("simulate", sensor_path, "--random", "3", "--seed", "5", "--jobs", "1", "--noise", "35", "--out", tmp_path)
    code, said, _ = run(capsys, *call)
    assert code == 0 and "3 made, 0 failed, 0 finished earlier" in said
    before = content(tmp_path)
    assert len({before[f"s5_00000{k}_truth.npz"] for k in range(3)}) == 3
    (tmp_path / "s5_000001.png").unlink()
    code, said, _ = run(capsys, *call)
    assert code == 0 and "1 made, 0 failed, 2 finished earlier" in said
    assert content(tmp_path) == before


@pytest.mark.usefixtures("quick_processes")
def test_processes_and_formats_do_not_change_a_data_set(sensor_path, tmp_path, capsys):
    call = ("simulate", sensor_path, "--random", "2", "--indenter", "sphere,plane", "--noise", "35")
    assert run(capsys, *call, "--jobs", "1", "--out", tmp_path / "png")[0] == 0
    assert run(capsys, *call, "--jobs", "2", "--format", "parquet", "--out", tmp_path / "rows")[0] == 0
    files, rows = dict(SimulatedFrames(tmp_path / "png")), dict(SimulatedFrameTable(tmp_path / "rows"))
    assert list(files) == list(rows) == ["s0_000000", "s0_000001"]
    for name in files:
        assert np.array_equal(files[name].image, rows[name].image) and same(files[name].truth, rows[name].truth)
    assert "0 made, 0 failed, 2 finished earlier" in run(capsys, *call, "--format", "parquet", "--out", tmp_path / "rows")[1]


@pytest.mark.parametrize("format", ["png", "parquet"])
def test_a_data_set_carries_the_sensor_s_record(sensor_path, tmp_path, capsys, format):
    recorded = replace(Sensor.from_file(sensor_path), record=Record("A17", date(2026, 9, 27), 12))
    path = recorded.to_file(tmp_path / "recorded.toml")
    call = ("simulate", path, "--random", "1", "--jobs", "1", "--format", format, "--out", tmp_path / "rows")
    assert run(capsys, *call)[0] == 0
    assert Sensor.from_file(tmp_path / "rows" / "sensor.toml").record == recorded.record
    for part in (tmp_path / "rows").glob("frames/*.parquet"):
        assert pyarrow.parquet.read_schema(part).metadata[b"record"].decode() == recorded.record.text


def test_targets_of_random_presses_are_uniform_in_area_off_the_rim_and_in_view(sensor_path):
    """By the probabilities of the vertices that are drawn."""
    simulator, rng, given = Simulator(Sensor.from_file(sensor_path)), np.random.default_rng(0), []

    class Drawing:
        def __getattr__(self, name):
            return getattr(rng, name)

        def choice(self, count, p):
            given.append(p)
            return rng.choice(count, p=p)

    membrane = simulator.membrane
    seen = membrane.rest[:, 0].numpy() > 0
    for view in (None, seen):
        dataset.random_stroke(simulator, dataset.Plan(("sphere",)), Drawing(), view)
    off_rim = torch.cdist(membrane.rest, membrane.rest[membrane.fixed]).amin(1).numpy() > dataset.OFF_RIM * membrane.size
    for p, where in zip(given, (off_rim, off_rim & seen), strict=True):
        area = np.where(where, membrane.rest_area.numpy(), 0.0)
        np.testing.assert_allclose(p, area / area.sum())


def test_presses_that_fail_are_reported_and_give_1(sensor_path, tmp_path, capsys, monkeypatch):
    draw, seen = dataset.random_stroke, []

    def refuse_first(simulator, plan, rng):
        seen.append(1)
        if len(seen) <= dataset.ATTEMPTS:
            raise MembraneError("too stiff")
        return draw(simulator, plan, rng)

    monkeypatch.setattr(dataset, "random_stroke", refuse_first)
    code, said, errors = run(capsys, "simulate", sensor_path, "--random", "2", "--jobs", "1", "--out", tmp_path)
    assert code == 1 and "1 made, 1 failed" in said and "s0_000000" in errors and "too stiff" in errors
    assert set(dict(SimulatedFrames(tmp_path))) == {"s0_000001"}


def test_a_folder_of_another_look_or_sensor_is_refused(sensor_path, tmp_path, capsys):
    call = ("simulate", sensor_path, *SPHERE, "--out", tmp_path)
    assert run(capsys, *call, "--noise", "40")[0] == 0
    before = content(tmp_path)
    code, _, errors = run(capsys, *call, "--noise", "30")
    assert code == 2 and "noise 40" in errors
    assert run(capsys, "simulate", "preset:bubble", *SPHERE, "--out", tmp_path)[0] == 2
    assert content(tmp_path) == before
    code, _, errors = run(capsys, "simulate", sensor_path, *SPHERE, "--out", Path(sensor_path).parent)
    assert code == 2 and "other files" in errors


@pytest.mark.parametrize(
    "options, expected",
    [
        ((), "--depth is missing"),
        (("--indenter", "sphere", "--depth", "1"), "--radius"),
        (("--indenter", "ball", "--depth", "1"), "'ball'"),
        ((*SPHERE, "--aim", "40,0,0"), "does not meet"),
        ((*SPHERE, "--direction", "0,0,0"), "--direction"),
        ((*SPHERE, "--missing", "9"), "missing"),
        ((*SPHERE, "--grid", "7,7"), "finer"),
        ((*SPHERE, "--path", "push,slide"), "--slide"),
        ((*SPHERE, "--video"), "--path"),
        ((*SPHERE, "--format", "parquet"), "--random"),
        (("--random", "3", "--depth", "1"), "--depth"),
        (("--random", "3", "--indenter", "cone"), "cone"),
        (("--random", "3", "--direction", "1,0,0"), "--direction with --random"),
        (("--random", "3", "--turn", "0"), "--turn with --random"),
        (("--random", "3", "--name", "press"), "--name with --random"),
        (("--random", "3", "--frames", "10"), "--frames with --random"),
        (("--random", "3", "--video"), "--video with --random"),
        ((*SPHERE, "--frames", "10"), "--frames without --path"),
        ((*SPHERE, "--path", "push", "--slide", "1,0,0"), "--slide with --path push, which has no slide"),
        (("--indenter", "sphere", "--radius", "3", "--depth", "30"), "press"),
        ((*SPHERE, "--direction=0,0,-1"), "--direction 0,0,-1: the indenter would push the membrane from within"),
        ((*SPHERE, "--slide", "1e300,0,0"), "--slide 1e+300,0,0: not possible for this membrane; expected lengths from"),
        (("--indenter", "sphere", "--radius", "1e300", "--depth", "1"), "--radius 1e+300: not possible"),
        (("--indenter", "sphere", "--radius", "3", "--depth", "1e300"), "--depth 1e+300: not possible"),
        ((*SPHERE, "--increment", "1e-9"), "--increment 1e-09: not possible"),
        (("--indenter", "box", "--sides", "4,4,1e6", "--radius", "0.5", "--depth", "1"), "--sides 4,4,1e+06: not possible"),
        ((*SPHERE, "--dots", "5,9"), "--dots, radii of small and large dots: dots 0 and"),
        ((*SPHERE, "--name", "sensor_rest"), "--name sensor_rest"),
        (("--indenter", "/etc/passwd", "--depth", "1"), "/etc/passwd: its name is not that of a mesh; expected a closed mesh"),
    ],
)
def test_wrong_calls_give_2_and_a_message_and_no_folder(sensor_path, tmp_path, capsys, options, expected):
    code, _, errors = run(capsys, "simulate", sensor_path, *options, "--out", tmp_path / "out")
    begun = ("simulate --random: loading packages\n", "simulate --random: 0 %: the sensor in the simulator\n")
    for line in begun if "--random" in options else ():
        errors = errors.removeprefix(line)
    assert code == 2 and errors.startswith("torchmembrane: error: ") and expected in errors
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "option",
    [
        ("--depth", "0"),
        ("--depth", "nan"),
        ("--direction", "1,2"),
        ("--path", "push,wait"),
        ("--random", "0"),
        ("--grid", "9"),
        ("--seed", "-1"),
        ("--friction", "nan"),
    ],
)
def test_values_that_cannot_be_are_usage_errors(sensor_path, tmp_path, capsys, option):
    with pytest.raises(SystemExit) as stop:
        cli.main(["simulate", sensor_path, "--out", str(tmp_path), *option])
    assert stop.value.code == 2 and "expected" in capsys.readouterr().err


def test_unknown_presets_are_refused(tmp_path, capsys):
    code, _, errors = run(capsys, "simulate", "preset:thumb", *SPHERE, "--out", tmp_path)
    assert code == 2 and "fingertip, bubble, half_cylinder" in errors
    assert sensor_file("preset:bubble") == preset_file("bubble") and sensor_file("a/b.toml") == Path("a/b.toml")


def test_help_shows_examples_and_exit_codes(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["simulate", "--help"])
    said = capsys.readouterr().out
    assert stop.value.code == 0 and "torchmembrane simulate preset:fingertip" in said and "exit code" in said


def test_a_simulation_on_the_solver_s_own_grid_is_refused():
    with pytest.raises(MembraneError, match="flatter"):
        Simulator(preset("bubble"), preset("bubble").membrane.grid)


@pytest.mark.parametrize("name", NAMES)
def test_every_dot_of_a_preset_is_found_in_its_rest_image(name):
    sensor = preset(name)
    reconstructor = Reconstructor(sensor)
    rest = reconstructor(torch.from_numpy(sensor.markers.rest_image)).frame(0)
    assert sensor.name == name and int(rest["status"]) == 0 and (rest["confidence"] > 0.8).all()
    strength = reconstructor.observer.locator.strength  # what each dot's own blob is expected to have
    assert strength.min() > 0.3 * strength.median()
    off = (reconstructor.observer.measured_rest - reconstructor.rest_pixels).norm(dim=-1)
    assert off.square().mean().sqrt() < 0.2  # of the outline's centre from the centre's image


def test_presets_are_what_their_design_makes():
    made, kept = design.fingertip(), preset("fingertip")
    assert np.array_equal(made.markers.positions, kept.markers.positions)
    assert np.abs(made.markers.rest_image - kept.markers.rest_image).max() < 2 / 255
    assert torch.equal(made.membrane.rest, kept.membrane.rest) and made.material == kept.material


@pytest.mark.parametrize(
    "option, expected",
    [
        ("--name=../../evil", "a file's name"),
        ("--name=/tmp/evil", "a file's name"),
        ("--name=.hidden", "a file's name"),
        ("--noise=nan", "a number from 0 to 200"),
        ("--noise=-1", "a number from 0 to 200"),
        ("--highlight=5", "a number from 0 to 1"),
        ("--blur=1000", "a number from 0 to 20"),
        ("--turn=nan", "a number from -360 to 360"),
        ("--friction=1e9", "a number from 0 to 10"),
        ("--grid=100000,100000", "each at most 129"),
        ("--frames=9999999999999", "a whole number"),
    ],
)
def test_values_that_make_no_sense_name_the_option_and_what_was_expected(sensor_path, tmp_path, capsys, option, expected):
    with pytest.raises(SystemExit) as ended:
        cli.main(["simulate", sensor_path, *SPHERE, "--out", str(tmp_path / "out"), option])
    *_, last = capsys.readouterr().err.strip().splitlines()
    assert ended.value.code == 2 and option.partition("=")[0] in last and expected in last
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "content", [b"", b"solid\n", b"x" * 84, bytes(80) + b"\xff" * 4, b"ply\nformat ascii 1.0\nelement vertex 9"]
)
@pytest.mark.parametrize("kind", ["stl", "obj", "ply"])
def test_a_damaged_mesh_is_refused_in_one_line(tmp_path, kind, content):
    path = tmp_path / f"part.{kind}"
    path.write_bytes(content)
    with pytest.raises(MembraneError) as caught:
        MeshIndenter.read(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value) and "expected a closed mesh" in str(caught.value)


def of_icosahedron(kind, **options):
    content = trimesh.creation.icosahedron().export(file_type=kind, **options)
    return content.encode() if isinstance(content, str) else content


MESHES = {
    "lying.stl": (
        of_icosahedron("stl")[:80] + b"\7\0\0\0" + of_icosahedron("stl")[84:],
        "it states 7 triangles, which take 434 bytes",
    ),
    "endless.stl": (
        of_icosahedron("stl")[:80] + b"\xff" * 4 + of_icosahedron("stl")[84:],
        "and holds 1084; as text it has no facet",
    ),
    "cut.stl": (of_icosahedron("stl")[:-30], "it states 20 triangles, which take 1084 bytes, and holds 1054"),
    "longer.stl": (of_icosahedron("stl") + b"\xff\0", "and holds 1086"),
    "short.stl": (b"solid \xe9", "it holds 7 bytes and no facet"),
    "random.stl": (np.random.default_rng(0).bytes(3000), "as text it has no facet"),
    "random.obj": (np.random.default_rng(0).bytes(3000), "0 triangles"),
    "comment.ply": (of_icosahedron("ply").replace(b"ply\n", b"ply\ncomment \xe9\n", 1), "codec can't decode"),
    "binary.stl": (of_icosahedron("stl"), ""),
    "text.stl": (of_icosahedron("stl_ascii").replace(b"solid", b"solid caf\xe9", 1), ""),
    "capital.stl": (of_icosahedron("stl_ascii").upper(), ""),
    "comment.obj": (b"# caf\xe9\n" + of_icosahedron("obj"), ""),
}


@pytest.mark.parametrize("name", MESHES)
def test_a_mesh_is_read_or_refused_whatever_guesses_encodings(name, tmp_path, monkeypatch):
    """trimesh imports a package that is not installed with it where text is not UTF-8."""
    for package in ("charset_normalizer", "chardet"):
        monkeypatch.setitem(sys.modules, package, None)
    content, reason = MESHES[name]
    path = tmp_path / name
    path.write_bytes(content)
    if not reason:
        assert len(MeshIndenter.read(path).triangles) == 20
        return
    with pytest.raises(MembraneError, match=r"expected a closed mesh as STL, OBJ or PLY") as caught:
        MeshIndenter.read(path)
    assert str(path) in str(caught.value) and reason in str(caught.value) and "module" not in str(caught.value)


def test_dots_may_be_as_large_as_do_not_overlap():
    sensor = preset("fingertip")
    nearest = np.sort(np.linalg.norm(sensor.markers.positions[:, None] - sensor.markers.positions, axis=-1), 1)[:, 1].min()
    assert Dots.from_sensor(sensor, [0.49 * nearest, 0.49 * nearest]).radii.max() < nearest / 2
    with pytest.raises(MembraneError, match="overlap"):
        Dots.from_sensor(sensor, [0.51 * nearest, 0.51 * nearest])
