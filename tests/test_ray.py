"""A job on Ray survives a killed worker."""

import os
import re
import signal
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from torchmembrane import ForceBalanceSettings, Reconstructor, read_results
from torchmembrane.errors import MembraneError
from torchmembrane.jobs.frame_reconstructor import FrameReconstructor, outcomes_of
from torchmembrane.jobs.inputs import find_inputs
from torchmembrane.jobs.local import reconstruct_files
from torchmembrane.results.store import Settings


def ray_workers() -> list[int]:
    """Process ids of the actors that reconstruct."""
    titles = {int(path.parent.name): path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists()}
    return [number for number, title in titles.items() if title.startswith(b"ray::") and b"RayWorker" in title]


@pytest.fixture(scope="module")
def reconstructor(small_sensor):
    return Reconstructor.from_file(small_sensor / "sensor.toml")


@pytest.fixture(scope="module")
def settled(small_sensor):
    """Frames take steps until rounding no longer decides which was the last one."""
    settings = ForceBalanceSettings(steps=(200, 32, 16), settled_step_tol=1e-5)
    return Reconstructor.from_file(small_sensor / "sensor.toml", settings=settings)


def test_rows_hold_what_the_reconstructor_gives(reconstructor, small_images, tmp_path):
    (tmp_path / "broken.png").write_bytes(b"broken")
    paths = np.array([*map(str, small_images), str(tmp_path / "broken.png")])
    rows = FrameReconstructor(reconstructor)({"path": paths})
    expected = reconstructor(reconstructor.read(*small_images)).numpy()
    assert rows["name"].tolist() == ["press0", "press1", "press2", "broken"] and rows["status"].tolist() == [0, 0, 0, -1]
    assert "not readable" in rows["status_text"][3] and np.isnan(rows["vertices"][3]).all()
    assert np.allclose(rows["vertices"][:3], expected.vertices, atol=1e-4)
    outcomes = outcomes_of(rows)
    assert [outcome.status for outcome in outcomes] == [0, 0, 0, -1] and outcomes[3].reason == rows["status_text"][3]
    assert np.array_equal(outcomes[1].stored.frame["pixels"], rows["pixels"][1], equal_nan=True)


def test_rows_of_decoded_and_of_encoded_images_are_those_of_files(reconstructor, small_images):
    paths = np.array([str(path) for path in small_images])
    engine = FrameReconstructor(reconstructor)
    by_path = engine({"path": paths})
    decoded = engine({"path": paths, "image": np.stack([np.asarray(Image.open(path)) for path in small_images])})
    encoded = engine({"path": paths, "bytes": np.array([path.read_bytes() for path in small_images], object)})
    for found in (decoded, encoded):
        assert np.array_equal(by_path["vertices"], found["vertices"]) and by_path["name"].tolist() == found["name"].tolist()
    assert by_path["content_hash"].tolist() == encoded["content_hash"].tolist()
    small = engine({"path": paths[:1], "image": np.zeros((1, 10, 10), np.uint8)})
    broken = engine({"path": paths[:1], "bytes": np.array([b"broken"], object)})
    assert "10 x 10" in small["status_text"][0] and broken["status_text"][0].startswith("not readable")


def columns(paths, **more):
    return {"path": np.array([str(path) for path in paths]), **more}


def test_no_rows_give_no_rows(reconstructor, small_images):
    engine = FrameReconstructor(reconstructor)
    one, none = engine(columns(small_images[:1])), np.array([], object)
    pandas = pytest.importorskip("pandas")
    for rows in (
        {},
        {"path": none},
        {"path": none, "bytes": none},
        {"image": np.zeros((0, 9, 9))},
        pandas.DataFrame({"path": []}),
    ):
        found = engine(rows)
        assert found.keys() == one.keys()
        for key, values in found.items():
            assert values.shape == (0, *one[key].shape[1:]) and values.dtype.kind == one[key].dtype.kind, key


@pytest.mark.parametrize("form", ["[H, W]", "[H, W, 3]", "[3, H, W]", "[1, H, W]", "[H, W, 1]", "list", "tensor", "objects"])
def test_a_row_holds_one_image_in_every_form(settled, small_images, form):
    """Also with the colours first, which alone might be three grey frames. Grey from colours is rounded otherwise."""
    torch = pytest.importorskip("torch")
    grey = np.asarray(Image.open(small_images[2]))
    made = {
        "[H, W]": grey[None],
        "[H, W, 3]": np.stack([grey] * 3, -1)[None],
        "[3, H, W]": np.stack([grey] * 3)[None],
        "[1, H, W]": grey[None, None],
        "[H, W, 1]": grey[None, ..., None],
        "list": [grey],
        "tensor": [torch.from_numpy(grey.copy())],
        "objects": np.array([None, grey], object)[1:],
    }
    rows = FrameReconstructor(settled)(columns(small_images[2:], image=made[form]))
    expected = FrameReconstructor(settled)(columns(small_images[2:]))
    assert rows["status"].tolist() == [0] and np.allclose(rows["vertices"], expected["vertices"], atol=1e-4)


@pytest.mark.parametrize(
    "image, said",
    [
        (np.zeros((2, 120, 160, 1), np.uint8), "image is .2, 120, 160, 1.; expected one image a row"),
        (np.zeros((2, 120, 160), np.uint8), "other than one or three channels"),
        (np.zeros((120, 160, 4), np.uint8), "without alpha"),
        ([[[1], [1, 2]]], "image is a list, not an array"),
        (np.zeros((120, 160), np.int32), "images of type torch.int32"),
        ("a.png", "expected uint8, uint16, or float"),
        (np.float32(1.0), "expected"),
    ],
)
def test_an_image_that_is_none_is_a_row_with_its_reason(reconstructor, small_images, image, said):
    given = np.empty(2, object)
    given[0], given[1] = image, np.asarray(Image.open(small_images[2]))
    rows = FrameReconstructor(reconstructor)(columns(["a.png", "b.png"], image=given))
    assert rows["status"].tolist() == [-1, 0] and re.search(said, rows["status_text"][0])


@pytest.mark.parametrize("content", ["text", 1.5, np.array([1, 2])])
def test_content_that_is_no_bytes_is_a_row_with_its_reason(reconstructor, small_images, content):
    rows = FrameReconstructor(reconstructor)(columns(["a.png", "b.png"], bytes=[content, small_images[2].read_bytes()]))
    assert rows["status"].tolist() == [-1, 0] and "expected bytes, the content of the file" in rows["status_text"][0]


def test_pandas_gives_what_a_dict_does(reconstructor, small_images):
    pandas = pytest.importorskip("pandas")
    given = columns(small_images, bytes=[path.read_bytes() for path in small_images])
    expected, found = (FrameReconstructor(reconstructor)(rows) for rows in (given, pandas.DataFrame(given)))
    assert all(np.array_equal(found[key], expected[key], equal_nan=key == "vertices") for key in ("name", "status", "vertices"))


def batches():
    arrow, image = pytest.importorskip("pyarrow"), np.zeros((2, 9, 9))
    return {
        "images without paths": ({"image": image}, "columns image; expected a column path.*include_paths=True"),
        "other columns": ({"x": [1]}, "columns x; expected a column path"),
        "a table of Arrow": (arrow.table({"path": ["a"]}), 'rows are a pyarrow.lib.Table; expected .*batch_format="numpy"'),
        "a row": ({"path": "a.png"}, "column path is a str; expected a list or an array.*map_batches in place of map"),
        "a row's array": ({"path": np.array("a.png")}, "column path is a numpy.ndarray; expected a list or an array"),
        "rows one by one": ([{"path": "a.png"}], "rows are a list; expected a dict of arrays"),
        "nothing": (None, "rows are a NoneType"),
        "different lengths": ({"path": ["a"], "image": image}, "columns of different lengths, {'path': 1, 'image': 2}"),
    }


@pytest.mark.parametrize("kind", batches())
def test_other_batches_are_refused_in_words(reconstructor, kind):
    rows, said = batches()[kind]
    with pytest.raises(MembraneError, match=said):
        FrameReconstructor(reconstructor)(rows)


def test_a_path_of_a_sensor_is_no_reconstructor(small_sensor):
    with pytest.raises(MembraneError, match="reconstructor is a str; expected a tm.Reconstructor"):
        FrameReconstructor(str(small_sensor / "sensor.toml"))


def test_a_killed_worker_is_replaced_and_each_frame_is_there_once(reconstructor, small_images, tmp_path):
    ray = pytest.importorskip("ray")
    from torchmembrane.jobs.ray_engine import RayEngine

    class Killing(RayEngine):
        def __call__(self, *arguments):
            for number, group in enumerate(super().__call__(*arguments)):
                if number == 0:
                    os.kill(ray_workers()[0], signal.SIGKILL)
                yield group

    paths = [tmp_path / f"k{k:02d}.png" for k in range(40)]
    for k, path in enumerate(paths):
        Image.open(small_images[k % 3]).save(path)
    (tmp_path / "broken.png").write_bytes(b"broken")
    settings = Settings.from_reconstructor(reconstructor, "parquet")
    inputs = find_inputs([*paths[:30], tmp_path / "broken.png"])
    ray.init(num_cpus=2, log_to_driver=False, logging_level="error", include_dashboard=False)
    try:
        counts = reconstruct_files(reconstructor, inputs, tmp_path / "out", settings, batch=1, engine=Killing("cpu", 2))
        assert (counts.reconstructed, counts.failed) == (30, 1)
        engine = RayEngine("cpu", 2)
        counts = reconstruct_files(reconstructor, find_inputs(paths), tmp_path / "out", settings, engine=engine)
        assert (counts.reconstructed, counts.skipped) == (10, 30)
    finally:
        ray.shutdown()
    reconstruct_files(reconstructor, find_inputs(paths), tmp_path / "alone", settings)
    found, alone = read_results(tmp_path / "out"), read_results(tmp_path / "alone")
    assert found.names == alone.names == [path.stem for path in paths]
    assert np.allclose(found.batch().vertices, alone.batch().vertices, atol=1e-3)


def test_what_ray_does_not_do_is_refused(reconstructor, small_images, tmp_path):
    pytest.importorskip("ray")
    from torchmembrane.jobs.ray_engine import RayEngine

    settings = Settings.from_reconstructor(reconstructor, "parquet")
    with pytest.raises(MembraneError, match="figures"):
        reconstruct_files(
            reconstructor, find_inputs(small_images), tmp_path / "out", settings, engine=RayEngine(), figures=True
        )
