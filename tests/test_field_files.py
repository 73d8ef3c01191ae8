"""Files of results hold principal stretches and tensions."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from test_views import cap

import torchmembrane as tm
from torchmembrane.cli.choices import FIELDS as CHOICES
from torchmembrane.cli.main import main
from torchmembrane.integrations import rerun
from torchmembrane.mechanics.principal import FIELDS
from torchmembrane.results.frame_shapes import FIELDS as STORED
from torchmembrane.results.surface_file import save_surface
from torchmembrane.simulate import Simulator, Sphere
from torchmembrane.simulate.dataset import stroke_to


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A folder of results with both fields, of a press and a black image, and the call that made it."""
    folder = tmp_path_factory.mktemp("fields")
    simulator = Simulator(cap())
    stroke = stroke_to(simulator, Sphere(3.0), np.array([0.0, 1.0, 18.0]), np.array([0.0, 0.0, -1.0]), 1.0)
    (state,) = simulator.presses(stroke, ["push"])
    sensor = simulator.at_rest().to_file(folder)
    Image.fromarray(simulator.image(state.vertices, np.random.default_rng(0))).save(folder / "press.png")
    Image.fromarray(np.full((120, 160), 30, np.uint8)).save(folder / "black.png")
    images = [str(folder / "press.png"), str(folder / "black.png")]
    call = ["reconstruct", str(sensor), *images, "--out", str(folder / "out"), "--workers", "1"]
    assert main([*call, "--fields", "tension", "stretch"]) == 1  # of the black image
    return folder / "out", call, tm.Reconstructor.from_file(sensor)


def test_files_hold_the_fields_of_their_surfaces(results):
    folder, _, reconstructor = results
    found = tm.read_results(folder)
    frame, batch = found["press"], found.batch()
    assert CHOICES == FIELDS == tuple(STORED) and found.mesh.fields == "stretch tension"
    row = batch._replace(**{key: value[found.names.index("press")][None] for key, value in batch._asdict().items()})
    for name, values in reconstructor.fields(row).items():
        np.testing.assert_allclose(frame[name], values[0].numpy(), rtol=1e-5)
        assert np.isnan(found["black"][name]).all()
    at_rest = reconstructor.fields(reconstructor.from_pixels(reconstructor.rest_pixels))
    assert frame["stretch"].max() > 1.01 * float(at_rest["stretch"].max())  # pressed, it is stretched more


def test_a_folder_is_of_one_choice_of_fields(results, tmp_path, capsys):
    folder, call, _ = results
    assert main([*call, "--fields", "stretch", "tension"]) == 1  # whatever their order
    for fields, said in (([], "this call asks for none"), (["--fields", "stretch"], "this call asks for stretch")):
        assert main([*call, *fields]) == 2
        assert said in capsys.readouterr().err
    assert main([*call[:4], "--out", str(tmp_path / "out"), "--format", "parquet", "--fields", "stretch"]) == 2
    assert "pass --format npz" in capsys.readouterr().err


def test_a_surface_is_read_back_from_its_file(results, tmp_path, capsys):
    """PLY and VTK hold vertices, triangles and fields as the frame has them."""
    found = tm.read_results(results[0])
    frame, mesh = found["press"], found.mesh
    V, T = len(frame["vertices"]), len(mesh.triangles)
    fields = ["normals", "displacement", "traction", "stretch", "tension"]
    for suffix in (".ply", ".vtk"):
        path = tmp_path / f"press{suffix}"
        assert main(["view", str(results[0]), "--frame", "press", "--surface", str(path)]) == 0
        assert f"surface with {', '.join(fields)} in {path}" in capsys.readouterr().out
        lines = path.read_text().splitlines()
        if suffix == ".ply":
            start = lines.index("end_header") + 1
            columns = [line.split()[-1] for line in lines if line.startswith("property float")]
            assert columns[:6] == ["x", "y", "z", "nx", "ny", "nz"] and columns[-2:] == ["tension_1", "tension_2"]
            rows = np.array([line.split() for line in lines[start : start + V]], float)
            faces = lines[start + V :]
            parts = dict(zip(("vertices", *fields), np.split(rows, np.cumsum([3, 3, 3, 3, 2]), 1), strict=True))
        else:
            at = {name: k for k, line in enumerate(lines) for name in [line.split()[1:2]] for name in name}
            start = lines.index(f"POLYGONS {T} {4 * T}") + 1
            faces, parts = lines[start : start + T], {"vertices": np.array([line.split() for line in lines[5 : 5 + V]], float)}
            for name in fields:
                begin = at[name] + 1 + (name in STORED)
                parts[name] = np.array([line.split() for line in lines[begin : begin + V]], float)
        for name, values in parts.items():
            np.testing.assert_allclose(values, frame[name], rtol=1e-6, atol=1e-7, err_msg=name)
        np.testing.assert_array_equal(np.array([line.split() for line in faces], int)[:, 1:], mesh.triangles)


def test_what_is_no_surface_is_refused(results, tmp_path):
    found = tm.read_results(results[0])
    with pytest.raises(tm.MembraneError, match=r"expected a file \.ply or \.vtk"):
        save_surface(tmp_path / "press.stl", found["press"], found.mesh)
    with pytest.raises(tm.MembraneError, match="the frame has no surface"):
        save_surface(tmp_path / "black.ply", found["black"], found.mesh)


class Recorder:
    """Stands for rerun's module and its recording: every entity is its name and what it is made of."""

    def __init__(self):
        self.logged, self.ViewCoordinates = {}, SimpleNamespace(RDF=None)

    def __getattr__(self, name):
        return lambda *values, **named: self if name == "RecordingStream" else (name, values, named)

    def log(self, path, entity, static=False):
        self.logged[path] = entity


def test_rerun_shows_the_fields(results, tmp_path, monkeypatch):
    """Each as the surface in its own colours, and its largest value as a curve."""
    found, recorder = tm.read_results(results[0]), Recorder()
    monkeypatch.setattr(rerun, "load_rerun", lambda: recorder)
    monkeypatch.setattr(rerun.RerunLog, "_blueprint", lambda _: None)
    log, frame = rerun.RerunLog(found.mesh), found["press"]
    log.add(0, frame)
    for name in FIELDS:
        kind, _, made = recorder.logged[f"fields/{name}"]
        assert kind == "Mesh3D" and len(np.unique(made["vertex_colors"], axis=0)) > 5
        assert recorder.logged[f"largest/{name}"][1] == ([float(frame[name].max())],)
    recorder.logged.clear()
    log.add(1, {key: value for key, value in frame.items() if key not in FIELDS})
    assert not [path for path in recorder.logged if "fields" in path or "largest" in path]
    lost = {key: np.full_like(frame[key], np.nan) for key in FIELDS} | {"status": np.array(4)}  # no surface: none stays drawn
    log.add(2, frame | lost)
    assert {recorder.logged[path][0] for path in ("surface/now", *(f"fields/{name}" for name in FIELDS))} == {"Clear"}
