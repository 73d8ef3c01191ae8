"""Jobs write every image's result once, whatever interrupts them."""

import csv
import io
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from PIL import Image

from torchmembrane.errors import MembraneError
from torchmembrane.files.images import read_image
from torchmembrane.jobs.inputs import find_inputs
from torchmembrane.jobs.local import reconstruct_files
from torchmembrane.results import frame_table, frames
from torchmembrane.results import npz as results
from torchmembrane.results.read import read_results
from torchmembrane.results.status import Status
from torchmembrane.results.store import Mesh, Settings
from torchmembrane.results.summary import UNREADABLE
from torchmembrane.sensor.record import Record
from torchmembrane.surface.shapes import spherical_cap

WIDTH, HEIGHT = 16, 12
NPZ = Settings("minimum-energy", "neo_hookean", "triangle", "npz")
PARQUET = NPZ._replace(format="parquet")
CONTRACT = {
    "vertices": (25, 3), "displacement": (25, 3), "normals": (25, 3), "markers": (7, 3), "pixels": (7, 2),
    "confidence": (7,), "traction": (25, 3), "contact": (25,), "contact_points": (4, 3), "force": (3,), "pressure": (),
    "pressure_change": (), "volume_error": (), "residual": (), "status": (), "wrench": (6,), "contact_force": (4, 3),
    "contact_normal": (4, 3), "contact_area": (4,), "contact_slip": (4,), "contact_curvature": (4, 2), "contact_at_rim": (4,),
    "coverage": (), "camera_motion": (4,),
    "force_deviation": (3,), "depth_deviation": (),
}  # fmt: skip
OF_FILE = ("path", "file_size", "file_modified", "content_hash", "time", "gauge", "seconds")


class Denting:
    """What `reconstruct_files` asks of a `Reconstructor`; black images are blank, those under 0.1 do not converge."""

    def __init__(self, fingerprint="a" * 64):
        membrane = spherical_cap(12.0, 9.0, 3.0, grid=(5, 5))
        camera = SimpleNamespace(image_size=(WIDTH, HEIGHT), bits=None)
        known = dict(
            name="cap", length_unit="mm", force_unit="N", fingerprint=fingerprint, camera=camera, tool=None, record=Record()
        )
        self.sensor = SimpleNamespace(**known, views=(), views_apart=[])
        self.estimator = SimpleNamespace(membrane=membrane, must_compile=False)
        self.vertex_pixels = membrane.rest[:, :2] + 8
        self.rest_pixels = torch.linspace(2, 10, 14).reshape(7, 2)
        self.calls, self.read_count, self.furthest_ahead = [], 0, 0

    def read(self, path):
        self.read_count += 1
        grey = torch.from_numpy(read_image(path))
        if grey.shape != (HEIGHT, WIDTH):
            raise MembraneError(f"{path}: the image is {grey.shape[1]} x {grey.shape[0]} px")
        return grey[None, None]

    def __call__(self, images):
        self.furthest_ahead = max(self.furthest_ahead, self.read_count - sum(self.calls))
        self.calls.append(len(images))
        grey, membrane = images.mean((1, 2, 3)), self.estimator.membrane
        status = torch.where(grey == 0, Status.BLANK, torch.where(grey < 0.1, Status.NOT_CONVERGED, Status.OK))
        grey = torch.where(grey == 0, torch.nan, grey)
        depth = -grey[:, None, None] * membrane.rest_normals * (~membrane.fixed)[:, None]
        fields = {key: grey.reshape(-1, *[1] * len(shape)).expand(-1, *shape) for key, shape in CONTRACT.items()}
        fields |= {"vertices": membrane.rest + depth, "displacement": depth, "status": status.int()}
        fields["confidence"] = torch.where(status == Status.BLANK, 0.0, 1.0)[:, None].expand(-1, 7)
        return results.Reconstruction(**fields)


def grey_image(path: Path, level: int) -> Path:
    Image.new("L", (WIDTH, HEIGHT), level).save(path)
    return path


@pytest.fixture
def images(tmp_path) -> list[Path]:
    (tmp_path / "images").mkdir()
    return [grey_image(tmp_path / "images" / f"i{k}.png", 40 + 30 * k) for k in range(5)]


def reconstruct(paths, out, settings=NPZ, reconstructor=None, **options):
    reconstructor = reconstructor or Denting()
    lines = []
    inputs = find_inputs(paths, options.pop("video", False))
    outcome = reconstruct_files(reconstructor, inputs, out, settings, batch=2, report=lines.append, **options)
    return outcome, lines, reconstructor


def summary_of(out: Path) -> dict[str, dict]:
    with open(out / "summary.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len({row["name"] for row in rows}) == len(rows)
    return {row["name"]: row for row in rows}


def test_one_result_for_each_image_with_the_contract_s_keys(images, tmp_path):
    outcome, lines, made = reconstruct(images, tmp_path / "out")
    assert outcome == (5, 0, 0, 0, 0, 0, 0) and lines == [] and made.calls == [2, 2, 1]
    for path in images:
        with np.load(tmp_path / "out" / f"{path.stem}.npz") as stored:
            assert {key: stored[key].shape for key in stored} == CONTRACT | dict.fromkeys(OF_FILE, ())
            assert {stored[key].dtype.name for key in CONTRACT if key != "status"} == {"float32"}
            expected = made(made.read(path)).frame(0)
            assert all(np.array_equal(stored[key], expected[key]) for key in CONTRACT)


def test_mesh_is_stored_once_and_says_units_and_sensor(images, tmp_path):
    made = reconstruct(images, tmp_path / "out")[2]
    membrane = made.estimator.membrane
    with np.load(tmp_path / "out" / "mesh.npz") as mesh:
        assert np.allclose(mesh["rest_vertices"], membrane.rest, atol=1e-6)
        assert np.array_equal(mesh["triangles"], membrane.triangles) and mesh["triangles"].dtype == np.int64
        assert np.array_equal(mesh["fixed"], membrane.fixed) and mesh["fixed"].dtype == bool
        assert [str(mesh[key]) for key in ("length_unit", "force_unit", "sensor")] == ["mm", "N", "a" * 64]


def test_summary_holds_what_the_frames_say(images, tmp_path):
    made = reconstruct(images, tmp_path / "out")[2]
    rows = summary_of(tmp_path / "out")
    assert list(rows) == [path.stem for path in images]
    row, level = rows["i3"], 130 / 255
    assert (row["file"], row["status"], row["status_text"]) == (str(images[3]), "0", "ok")
    assert (row["markers_found"], row["markers_total"], row["length_unit"], row["force_unit"]) == ("7", "7", "mm", "N")
    assert float(row["deepest"]) == pytest.approx(-level, abs=1e-5)
    vertices = (made.estimator.membrane.rest - level * made.estimator.membrane.rest_normals).numpy()
    where = [float(row[f"deepest_{axis}"]) for axis in "xyz"]
    assert np.linalg.norm(vertices - where, axis=1).min() < 1e-4
    assert float(row["force"]) == pytest.approx(3**0.5 * level, abs=1e-5)
    assert float(row["seconds"]) > 0


def test_the_summary_names_the_deepest_place_and_none_where_a_part_of_the_surface_is_not_known(images, tmp_path):
    class Uneven(Denting):
        """Vertex 8 twice as deep as the others; of the second image vertex 7 is not known."""

        def __call__(self, batch):
            found = super().__call__(batch)
            vertices, displacement = found.vertices.clone(), found.displacement.clone()
            displacement[:, 8] *= 2
            vertices[:, 8] += displacement[:, 8] / 2
            if self.calls == [2]:
                displacement[1, 7] = torch.nan
            return found._replace(vertices=vertices, displacement=displacement)

    made = reconstruct(images, tmp_path / "out", reconstructor=Uneven())[2]
    rows, level = summary_of(tmp_path / "out"), 130 / 255
    place = (made.estimator.membrane.rest - 2 * level * made.estimator.membrane.rest_normals)[8]
    assert float(rows["i3"]["deepest"]) == pytest.approx(-2 * level, abs=1e-5)
    assert [float(rows["i3"][f"deepest_{axis}"]) for axis in "xyz"] == pytest.approx(place.tolist(), abs=1e-4)
    assert [rows["i1"][key] for key in ("deepest", "deepest_x", "deepest_y", "deepest_z")] == [""] * 4


def test_broken_files_do_not_stop_their_batch(images, tmp_path):
    images[1].write_bytes(b"no image at all")
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH), dtype=np.uint8)
    whole = io.BytesIO()
    Image.fromarray(noise).save(whole, "png")
    images[2].write_bytes(whole.getvalue()[:-60])
    Image.new("L", (WIDTH + 1, HEIGHT)).save(images[3])
    outcome, lines, _ = reconstruct(images, tmp_path / "out")
    assert outcome == (2, 0, 0, 0, 0, 3, 0)
    assert [line.partition(":")[0] for line in lines] == [str(path) for path in images[1:4]]
    rows = summary_of(tmp_path / "out")
    for k, path in enumerate(images):
        readable = k in (0, 4)
        assert (tmp_path / "out" / f"{path.stem}.npz").exists() == readable
        assert rows[path.stem]["status"] == ("0" if readable else str(UNREADABLE))
    assert "17 x 12" in rows["i3"]["status_text"] and rows["i3"]["file"] == str(images[3])


def test_finished_frames_are_skipped_and_failed_ones_tried_again(images, tmp_path):
    grey_image(images[0], 3)
    grey_image(images[1], 0)
    images[2].write_bytes(b"broken")
    outcome, lines, _ = reconstruct(images, tmp_path / "out")
    assert outcome == (3, 1, 0, 0, 0, 2, 0) and len(lines) == 2
    failed = results.load_frame(tmp_path / "out" / "i1.npz")
    assert int(failed["status"]) == Status.BLANK and np.isnan(failed["vertices"]).all()
    before = {path.stem: (tmp_path / "out" / f"{path.stem}.npz").stat().st_mtime_ns for path in (images[0], images[3])}
    grey_image(images[1], 90)
    grey_image(images[2], 90)
    outcome, lines, made = reconstruct(images, tmp_path / "out")
    assert outcome == (2, 0, 0, 0, 0, 0, 3) and lines == [] and sum(made.calls) == 2
    assert before == {name: (tmp_path / "out" / f"{name}.npz").stat().st_mtime_ns for name in before}
    rows = summary_of(tmp_path / "out")
    assert [rows[f"i{k}"]["status"] for k in range(5)] == [str(Status.NOT_CONVERGED), "0", "0", "0", "0"]
    assert rows["i0"]["file"] == str(images[0]) and float(rows["i0"]["seconds"]) > 0


@pytest.mark.parametrize("settings", [NPZ, PARQUET])
def test_a_failed_frame_whose_file_breaks_has_no_result_any_more(images, tmp_path, settings):
    grey_image(images[1], 0)
    reconstruct(images, tmp_path / "out", settings)
    images[1].write_bytes(b"broken")
    reconstruct(images, tmp_path / "out", settings)
    assert read_results(tmp_path / "out").names == ["i0", "i2", "i3", "i4"]
    assert summary_of(tmp_path / "out")["i1"]["status"] == str(UNREADABLE)


def test_summary_is_rebuilt_from_the_frames(images, tmp_path):
    reconstruct(images[:3], tmp_path / "out")
    before = summary_of(tmp_path / "out")
    (tmp_path / "out" / "summary.csv").write_text("name;file\nmade by hand;\n")
    reconstruct(images[1:], tmp_path / "out")
    after = summary_of(tmp_path / "out")
    assert list(after) == [path.stem for path in images]
    assert [after[name]["file"] for name in ("i0", "i1")] == [str(images[0]), str(images[1])]
    assert all(after["i1"][key] == before["i1"][key] for key in before["i1"] if key != "seconds")


@pytest.mark.parametrize("settings", [NPZ, PARQUET])
def test_results_are_read_by_name_in_order_and_all_at_once(images, tmp_path, monkeypatch, settings):
    monkeypatch.setattr(frame_table, "PART_ROWS", 2)
    grey_image(images[1], 0)
    reconstruct(images, tmp_path / "out", settings)
    found = read_results(str(tmp_path / "out"))
    assert len(found) == 5 and found.names == [path.stem for path in images] and found.mesh.settings == settings
    assert "i3" in found and "mesh" not in found
    listed = list(found)
    assert len(listed) == 5 and list(listed[0]) == list(CONTRACT)
    batch = found.batch()
    for k, name in enumerate(found.names):
        assert all(np.array_equal(listed[k][key], found[name][key], equal_nan=True) for key in CONTRACT)
        assert all(np.array_equal(listed[k][key], getattr(batch, key)[k], equal_nan=True) for key in CONTRACT)
    assert np.isnan(found["i1"]["vertices"]).all() and int(found["i1"]["status"]) == Status.BLANK
    with pytest.raises(MembraneError, match="no frame 'i9'.*'i0'"):
        found["i9"]


@pytest.mark.parametrize("settings", [NPZ, PARQUET])
def test_no_frame_is_read_before_it_is_asked_for(images, tmp_path, monkeypatch, settings):
    reconstruct(images, tmp_path / "out", settings)
    read, kind = [], frames.FrameFiles if settings is NPZ else frames.FrameTable
    whole = kind.read
    monkeypatch.setattr(kind, "read", lambda self, names: read.extend(names := list(names)) or whole(self, names))
    found = read_results(tmp_path / "out")
    assert len(found) == 5 and "i3" in found and read == []
    assert found["i3"]["status"] == 0 and read == ["i3"]
    next(iter(found))
    assert "i0" in read


def test_a_folder_without_results_is_refused(images, tmp_path):
    with pytest.raises(MembraneError, match="mesh.npz"):
        read_results(tmp_path)
    images[0].write_bytes(b"broken")
    reconstruct(images[:1], tmp_path / "out")
    with pytest.raises(MembraneError, match="no frames"):
        read_results(tmp_path / "out")


def test_single_numbers_as_a_table(images, tmp_path):
    grey_image(images[1], 0)
    reconstruct(images, tmp_path / "out", PARQUET)
    found = read_results(tmp_path / "out")
    table = found.to_pandas()
    assert list(table.index) == found.names and list(table.columns) == [key for key, shape in CONTRACT.items() if shape == ()]
    assert table["status"].tolist() == [0, Status.BLANK, 0, 0, 0] and table["status"].dtype == np.int32
    assert np.array_equal(table["pressure"].to_numpy(), found.batch().pressure, equal_nan=True)


@pytest.mark.parametrize("settings", [NPZ, PARQUET])
def test_an_interrupted_run_keeps_what_is_done_and_goes_on(images, tmp_path, settings):
    class Interrupted(Denting):
        def __call__(self, batch):
            if len(self.calls) == 1:
                raise KeyboardInterrupt
            return super().__call__(batch)

    with pytest.raises(KeyboardInterrupt):
        reconstruct(images, tmp_path / "out", settings, Interrupted())
    assert read_results(tmp_path / "out").names == list(summary_of(tmp_path / "out")) == ["i0", "i1"]
    assert reconstruct(images, tmp_path / "out", settings)[0] == (3, 0, 0, 0, 0, 0, 2)
    assert read_results(tmp_path / "out").names == [path.stem for path in images]
    assert not [path for path in (tmp_path / "out").rglob("*") if "partial" in path.name or path.name[0] == "."]


def test_only_few_batches_are_in_memory(images, tmp_path):
    paths = [grey_image(images[0].parent / f"m{k:02d}.png", 99) for k in range(24)]
    assert reconstruct(paths, tmp_path / "out")[2].furthest_ahead <= 4


def test_the_next_batch_is_read_while_one_is_computed(images, tmp_path):
    class Patient(Denting):
        def __call__(self, batch):
            deadline = time.monotonic() + 5
            while self.read_count < min(sum(self.calls) + 4, len(images)):
                assert time.monotonic() < deadline, "nothing is read meanwhile"
                time.sleep(0.001)
            return super().__call__(batch)

    assert reconstruct(images, tmp_path / "out", reconstructor=Patient())[0] == (5, 0, 0, 0, 0, 0, 0)


def test_two_images_of_one_name_are_refused(images, tmp_path):
    (tmp_path / "other").mkdir()
    twin = grey_image(tmp_path / "other" / "i3.jpg", 50)
    with pytest.raises(MembraneError, match="name 'i3'.*i3.png.*i3.jpg"):
        find_inputs([*images, twin])


def test_an_image_that_would_overwrite_the_mesh_is_refused(tmp_path):
    with pytest.raises(MembraneError, match="mesh.npz"):
        find_inputs([grey_image(tmp_path / "mesh.png", 50)])


def test_another_sensor_s_folder_is_refused_untouched(images, tmp_path):
    reconstruct(images[:1], tmp_path / "out")
    before = {path: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    with pytest.raises(MembraneError, match="another sensor.*aaaaaaaaaaaa.*bbbbbbbbbbbb"):
        reconstruct(images, tmp_path / "out", reconstructor=Denting("b" * 64))
    assert before == {path: path.read_bytes() for path in (tmp_path / "out").iterdir()}


@pytest.mark.parametrize("option, value", [("energy", "harmonic"), ("format", "parquet"), ("locator", "soft")])
def test_other_settings_are_refused(images, tmp_path, option, value):
    reconstruct(images[:1], tmp_path / "out")
    with pytest.raises(MembraneError, match=f"{option} .*{value}.*--{option}"):
        reconstruct(images, tmp_path / "out", NPZ._replace(**{option: value}))


@pytest.mark.parametrize("name, value", [("element", "quadrilateral"), ("volume", "linear")])
def test_what_no_option_chooses_is_not_advised(images, tmp_path, name, value):
    reconstruct(images[:1], tmp_path / "out", NPZ._replace(**{name: value}))
    with pytest.raises(MembraneError, match=f"made with {name} {value}.*choose another folder$"):
        reconstruct(images, tmp_path / "out")


def test_a_folder_from_before_there_was_a_choice_of_locators_was_made_with_fit(images, tmp_path):
    reconstruct(images[:1], tmp_path / "out", NPZ._replace(locator="soft"))
    path = tmp_path / "out" / "mesh.npz"
    with np.load(path) as data:
        older = {key: data[key] for key in data if key != "locator"}
    assert Mesh.load(path).settings.locator == "soft"
    np.savez(path, **older)
    assert Mesh.load(path).settings == NPZ and NPZ.locator == "fit"


def test_a_folder_of_frames_in_parquet_without_their_mesh_is_refused(images, tmp_path):
    (tmp_path / "out" / "frames").mkdir(parents=True)
    with pytest.raises(MembraneError, match="no mesh.npz"):
        reconstruct(images, tmp_path / "out")


def test_a_folder_of_other_files_is_refused(images, tmp_path):
    (tmp_path / "out").mkdir()
    np.savez(tmp_path / "out" / "i0.npz", precious=1)
    with pytest.raises(MembraneError, match="no mesh.npz"):
        reconstruct(images, tmp_path / "out")
    (tmp_path / "out" / "mesh.npz").write_bytes(b"something else")
    with pytest.raises(MembraneError, match="not a mesh.npz"):
        reconstruct(images, tmp_path / "out")
    with pytest.raises(MembraneError, match="is a file"):
        reconstruct(images, images[0])


def test_folders_globs_and_files(images, tmp_path, monkeypatch):
    folder = images[0].parent
    (folder / "notes.txt").write_text("no image")
    grey_image(folder / "A.JPG", 9)
    assert find_inputs([folder]).images == sorted(images + [folder / "A.JPG"])
    assert find_inputs([str(folder / "i[1-3].png")]).images == images[1:4]
    assert find_inputs([str(tmp_path / "**" / "*.png")]).images == images
    bracket = grey_image(folder / "x[1].png", 9)
    assert find_inputs([bracket]).images == [bracket]
    monkeypatch.chdir(folder)
    assert find_inputs(["i4.png", "i0.png"]).images == [Path("i4.png"), Path("i0.png")]
    for nothing in ("i9.png", "*.tif", str(tmp_path / "images" / "none")):
        with pytest.raises(MembraneError, match="no such file"):
            find_inputs([nothing])
    (tmp_path / "empty").mkdir()
    with pytest.raises(MembraneError, match="no files"):
        find_inputs([tmp_path / "empty"])


def test_parquet_holds_the_same_as_npz(images, tmp_path):
    grey_image(images[1], 0)
    reconstruct(images, tmp_path / "npz")
    reconstruct(images, tmp_path / "parquet", PARQUET)
    one, other = read_results(tmp_path / "npz"), read_results(tmp_path / "parquet")
    assert one.names == other.names == [path.stem for path in images]
    one, other = one.batch(), other.batch()
    for key in CONTRACT:
        a, b = getattr(one, key), getattr(other, key)
        assert a.dtype == b.dtype and torch.equal(torch.nan_to_num(a, -7), torch.nan_to_num(b, -7))
    assert not list((tmp_path / "parquet").glob("i*.npz"))


def test_parquet_can_be_read_by_others(images, tmp_path):
    reconstruct(images, tmp_path / "out", PARQUET)
    table = pq.read_table(tmp_path / "out" / "frames")
    assert table.column_names == ["name", "status_text", *OF_FILE, *CONTRACT]
    assert b'"vertices": [25, 3]' in table.schema.metadata[b"shapes"] and table.schema.metadata[b"length_unit"] == b"mm"
    vertices = np.array(table["vertices"].to_pylist()).reshape(-1, 25, 3)
    assert np.shape(table["vertices"][0].as_py()) == (25, 3) and np.shape(table["contact_points"][0].as_py()) == (4, 3)
    assert table["path"].to_pylist() == [str(path) for path in images] and set(table["status_text"].to_pylist()) == {"ok"}
    assert np.array_equal(vertices.astype(np.float32), read_results(tmp_path / "out").batch().vertices.numpy())


def test_a_frame_tried_again_is_one_row_of_the_dataset(images, tmp_path, monkeypatch):
    monkeypatch.setattr(frame_table, "PART_ROWS", 2)
    grey_image(images[1], 0)
    reconstruct(images, tmp_path / "out", PARQUET)
    assert len(list((tmp_path / "out" / "frames").glob("part-*.parquet"))) == 3
    grey_image(images[1], 90)
    outcome, _, made = reconstruct(images, tmp_path / "out", PARQUET)
    assert outcome == (1, 0, 0, 0, 0, 0, 4) and made.calls == [1]
    assert sorted(pq.read_table(tmp_path / "out" / "frames")["name"].to_pylist()) == [path.stem for path in images]
    assert read_results(tmp_path / "out").batch().status.tolist() == [0] * 5


def write_video(path: Path, levels) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray"
        for level in levels:
            picture = av.VideoFrame.from_ndarray(np.full((HEIGHT, WIDTH), level, np.uint8), format="gray")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return path


def test_a_video_gives_numbered_frames(tmp_path):
    video = write_video(tmp_path / "press.mkv", [100, 0, 120, 130, 140])
    outcome, lines, _ = reconstruct([video], tmp_path / "out")
    assert outcome == (4, 0, 0, 0, 0, 1, 0)
    assert len(lines) == 1 and lines[0].startswith(f"{video}, press_000001: blank")
    found = read_results(tmp_path / "out")
    assert found.names == [f"press_{k:06d}" for k in range(5)]
    batch = found.batch()
    assert torch.allclose(batch.pressure[[0, 2, 3, 4]] * 255, torch.tensor([100.0, 120, 130, 140]), atol=0.01)
    assert reconstruct([video], tmp_path / "out")[0] == (0, 0, 0, 0, 0, 1, 4)
    assert summary_of(tmp_path / "out")["press_000003"]["file"] == str(video)


def test_a_video_of_another_suffix_or_in_a_folder(tmp_path):
    (tmp_path / "videos").mkdir()
    video = write_video(tmp_path / "videos" / "a.mkv", [100, 110])
    assert find_inputs([tmp_path / "videos"], video=True).videos == [video]
    assert find_inputs([video.rename(tmp_path / "a.film")], video=True).videos == [tmp_path / "a.film"]


def test_bad_videos_are_reported_and_the_rest_goes_on(images, tmp_path):
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    outcome, lines, _ = reconstruct([tmp_path / "broken.mp4", *images], tmp_path / "out")
    assert outcome == (5, 0, 0, 0, 0, 1, 0) and str(tmp_path / "broken.mp4") in lines[0]
    assert summary_of(tmp_path / "out")["broken_000000"]["status"] == str(UNREADABLE)


def test_a_missing_extra_is_named(images, tmp_path, monkeypatch):
    (tmp_path / "press.mp4").touch()
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MembraneError, match=r"torchmembrane\[video\]"):
        reconstruct([tmp_path / "press.mp4"], tmp_path / "out")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MembraneError, match=r"torchmembrane\[parquet\]"):
        reconstruct(images, tmp_path / "out", PARQUET)
    assert not (tmp_path / "out").exists()


def test_figures_beside_results(images, tmp_path):
    reconstruct(images[:2], tmp_path / "out")
    outcome, _, made = reconstruct(images[:2], tmp_path / "out", figures=True)
    assert outcome == (2, 0, 0, 0, 0, 0, 0)
    for path in images[:2]:
        assert Image.open(tmp_path / "out" / f"{path.stem}.png").size == (1066, 1170)
    assert reconstruct(images[:2], tmp_path / "out", figures=True)[0] == (0, 0, 0, 0, 0, 0, 2)


def test_figures_never_overwrite_images(images):
    with pytest.raises(MembraneError, match="overwrite"):
        reconstruct(images, images[0].parent, figures=True)


def test_a_stored_mesh_reads_back(images, tmp_path):
    made = reconstruct(images[:1], tmp_path / "out")[2]
    mesh, expected = Mesh.load(tmp_path / "out" / "mesh.npz"), Mesh.from_reconstructor(made, NPZ)
    assert mesh.settings == NPZ and mesh.image_size.tolist() == [WIDTH, HEIGHT]
    assert all(np.array_equal(a, b) for a, b in zip(mesh, expected, strict=True))
