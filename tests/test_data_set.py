"""A recording as a data set holds every frame with its image."""

import numpy as np
import pyarrow.parquet as pq
import pytest

import torchmembrane as tm
from torchmembrane.cli.main import main
from torchmembrane.files.images import read_image
from torchmembrane.live.loop import LiveFrame
from torchmembrane.live.recording import Recording
from torchmembrane.live.streams import TrackedStream


@pytest.fixture(scope="module")
def recording(small_sensor, small_images, tmp_path_factory):
    """A press, a black image, and a press."""
    stream, folder = (
        TrackedStream(tm.Reconstructor.from_file(small_sensor / "sensor.toml")),
        tmp_path_factory.mktemp("day") / "day",
    )
    press = read_image(small_images[1])
    with Recording(folder, stream.mesh) as kept:
        for k, image in enumerate((press, 0 * press, press)):
            kept.keep(LiveFrame(k, 1e9 + k / 2, image, stream(image, float(k)), 0.01))
    return folder


def test_a_row_is_a_frame_with_its_image(recording, tmp_path):
    assert main(["view", str(recording), "--dataset", str(tmp_path / "press")]) == 0
    results, table = tm.read_results(recording), pq.read_table(tmp_path / "press/train/metadata.parquet")
    assert table["name"].to_pylist() == results.names and table["time"].to_pylist() == [1e9, 1e9 + 0.5, 1e9 + 1]
    assert table["status_text"].to_pylist() == ["ok", tm.Status.BLANK.text, "ok"]
    for k, frame in enumerate(results):
        for key, value in frame.items():
            np.testing.assert_array_equal(np.array(table[key][k].as_py(), np.float32), value.astype(np.float32))
        kept = tmp_path / "press/train" / table["file_name"][k].as_py()
        assert kept.read_bytes() == (recording / "images" / kept.name).read_bytes()
    assert (tmp_path / "press/mesh.npz").read_bytes() == (recording / "mesh.npz").read_bytes()


def test_the_card_says_sensor_units_and_statuses(recording, tmp_path):
    assert main(["view", str(recording), "--dataset", str(tmp_path / "press")]) == 0
    card, mesh = (tmp_path / "press/README.md").read_text(), tm.read_results(recording).mesh
    assert card.startswith("---\npretty_name: press\n") and "path: train/*\n---" in card
    for said in (f"| sensor | {mesh.name} |", f"| force unit | {mesh.force_unit} |", "| 0 | ok | 2 |", "| 4 | blank or"):
        assert said in card
    lengths, powers = ("vertices", "displacement", "markers", "contact_points", "depth_deviation"), {"contact_area": "mm^2"}
    units = dict.fromkeys(lengths, "mm") | powers | {"contact_curvature": "1/mm", "wrench": "N, N mm"}
    units |= dict.fromkeys(("traction", "pressure", "pressure_change"), "N/mm^2")
    units |= dict.fromkeys(("force", "contact_force", "force_deviation"), "N") | dict.fromkeys(("pixels", "residual"), "px")
    for array, unit in units.items():
        assert f"| `{array}` | {unit} |" in card


def test_without_images_there_are_frames_alone_and_some_are_refused(recording, tmp_path, capsys):
    (tmp_path / "none").mkdir()
    assert main(["view", str(recording), "--dataset", str(tmp_path / "bare"), "--images", str(tmp_path / "none")]) == 0
    assert [path.name for path in (tmp_path / "bare/train").iterdir()] == ["metadata.parquet"]
    assert "path: train/metadata.parquet" in (tmp_path / "bare/README.md").read_text()
    (tmp_path / "none/000000.png").write_bytes((recording / "images/000000.png").read_bytes())
    assert main(["view", str(recording), "--dataset", str(tmp_path / "some"), "--images", str(tmp_path / "none")]) == 2
    assert "no image of frame '000001' and 1 more; expected one of each frame, or none" in capsys.readouterr().err
    assert main(["view", str(recording), "--dataset", str(tmp_path / "bare")]) == 2
    assert "exists already" in capsys.readouterr().err
