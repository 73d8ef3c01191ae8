"""Results as films, and in the viewer Rerun."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import torchmembrane as tm
from torchmembrane.cli.main import main
from torchmembrane.files.images import read_image
from torchmembrane.integrations.rerun import LONGER, LONGEST_FORCE, RerunLog
from torchmembrane.live.loop import LiveFrame
from torchmembrane.live.recording import Recording
from torchmembrane.live.streams import TrackedStream
from torchmembrane.plot.film import GIF_RATES, RATES, write_film


def pictures(count: int, shape=(31, 42)) -> list[np.ndarray]:
    """Grey, lighter from one to the next; of odd height."""
    return [np.full((*shape, 3), 40 * k, np.uint8) for k in range(count)]


@pytest.fixture(scope="module")
def stream(small_sensor):
    return TrackedStream(tm.Reconstructor.from_file(small_sensor / "sensor.toml"))


@pytest.fixture(scope="module")
def recording(stream, small_images, tmp_path_factory):
    """A folder of three presses, and of a black image."""
    folder = tmp_path_factory.mktemp("film") / "day"
    images = [*map(read_image, small_images), np.zeros((120, 160), np.float32)]
    with Recording(folder, stream.mesh) as kept:
        for k, image in enumerate(images):
            kept.keep(LiveFrame(k, 1e9 + k / 2, image, stream(image, float(k)), 0.01))
    return folder


@pytest.mark.parametrize("ending", ["mp4", "mov", "mkv"])
def test_a_video_shows_the_pictures_at_their_rate(tmp_path, ending):
    import av

    write_film(tmp_path / f"film.{ending}", pictures(6), 12.5)
    with av.open(str(tmp_path / f"film.{ending}")) as container:
        found = list(container.decode(video=0))
        assert float(container.streams.video[0].average_rate) == 12.5
    assert [each.to_ndarray(format="rgb24").mean() for each in found] == pytest.approx([40 * k for k in range(6)], abs=4)
    assert [each.time for each in found] == pytest.approx([k / 12.5 for k in range(6)], abs=1e-3)
    assert [path.name for path in tmp_path.iterdir()] == [f"film.{ending}"]


def test_a_gif_shows_the_pictures_and_the_last_one_longer(tmp_path):
    write_film(tmp_path / "film.gif", pictures(4), 10, last=0.5)
    film, found = Image.open(tmp_path / "film.gif"), []
    for k in range(film.n_frames):
        film.seek(k)
        found.append((film.info["duration"], np.asarray(film.convert("RGB")).mean()))
    assert found == [(100, 0.0), (100, 40.0), (100, 80.0), (600, 120.0)] and film.info["loop"] == 0


def test_films_that_cannot_be_are_said_and_leave_nothing(tmp_path):
    for name, shown, said in (
        ("film.avi", pictures(2), "expected a film's name, ending in .gif"),
        ("film.gif", [], "no pictures"),
        ("film.mp4", [*pictures(2), *pictures(1, (8, 8))], r"\[8, 8, 3\] after one \[31, 42, 3\]"),
    ):
        with pytest.raises(tm.MembraneError, match=said):
            write_film(tmp_path / name, shown, 10)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", ["gif", "mp4"])
@pytest.mark.parametrize("rate", [1e-300, 0.0005, 0.001, 0.01, 12.5, 50, 60, 1000, 1e4, 1e300, float("inf"), float("nan")])
def test_a_film_has_a_rate_that_its_format_holds(tmp_path, ending, rate):
    path, (least, most) = tmp_path / f"film.{ending}", GIF_RATES if ending == "gif" else RATES
    if not least <= rate <= most:
        with pytest.raises(tm.MembraneError, match=rf"film.{ending}: .* pictures a second; expected {least:g} to {most:g}"):
            write_film(path, pictures(3), rate)
        assert not list(tmp_path.iterdir())
        return
    write_film(path, pictures(3), rate)
    if ending == "gif":
        film = Image.open(path)
        film.seek(1)
        assert film.n_frames == 3 and film.info["duration"] == pytest.approx(1000 / rate, abs=10)
    else:
        import av

        with av.open(str(path)) as container:
            assert float(container.streams.video[0].average_rate) == pytest.approx(rate)
            assert len(list(container.decode(video=0))) == 3


@pytest.mark.parametrize("name, rate", [("day.gif", "0.001"), ("day.mp4", "1e300")])
def test_the_command_refuses_a_rate_before_it_draws(recording, tmp_path, capsys, name, rate):
    assert main(["view", str(recording), "--video-out", str(tmp_path / name), "--rate", rate]) == 2
    assert f"{name}: {float(rate):g} pictures a second; expected" in capsys.readouterr().err


def test_all_frames_of_a_folder_are_drawn_as_a_film_also_one_without_surface(recording, tmp_path, capsys):
    assert main(["view", str(recording), "--video-out", str(tmp_path / "day.gif"), "--rate", "4"]) == 0
    film = Image.open(tmp_path / "day.gif")
    assert film.n_frames == 4 and film.size == (1066, 1170) and film.info["duration"] == 250
    assert "4 frames drawn" in capsys.readouterr().out
    film.seek(3)
    flow = np.asarray(film.convert("L"))[200:360, 150:450]
    assert np.median(flow) < 150  # its black image, lightened, and not the white of none
    assert main(["view", str(recording), "--video-out", "day.txt"]) == 2
    assert "expected a film's name" in capsys.readouterr().err


def test_a_job_s_frames_are_drawn_as_a_film_with_their_images(small_sensor, small_images, tmp_path, capsys):
    command = ["reconstruct", str(small_sensor / "sensor.toml"), *map(str, small_images), "--out", str(tmp_path / "out")]
    assert main([*command, "--video-out", str(tmp_path / "press.txt")]) == 2 and not (tmp_path / "out").exists()
    assert "expected a film's name" in capsys.readouterr().err
    assert main([*command, "--video-out", str(tmp_path / "press.gif")]) == 0
    film = Image.open(tmp_path / "press.gif")
    flow = np.asarray(film.convert("L"))[200:360, 150:450]
    assert film.n_frames == 3 and np.median(flow) < 250  # its image, lightened, and not the white of none


def test_a_file_of_rerun_is_refused_without_rerun(recording, capsys):
    assert main(["view", str(recording), "--save", "day.rrd"]) == 2
    assert "expected --rerun with it" in capsys.readouterr().err


def read_back(path: Path) -> dict[str, list[dict]]:
    """The rows of each entity of a file of Rerun, in the order of its frames, those of none first."""
    from rerun.chunk import RrdReader

    rows: dict[str, list[dict]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        rows.setdefault(chunk.entity_path, []).extend(chunk.to_record_batch().to_pylist())
    return {entity: sorted(each, key=lambda row: row.get("frame", -1)) for entity, each in rows.items()}


def values(row: dict, name: str) -> np.ndarray:
    (key,) = (key for key in row if key.endswith(f":{name}"))
    return np.array(row[key])


def test_rerun_gets_what_the_results_hold(recording, tmp_path):
    """Its own tool finds the file sound; surfaces, contacts, wrenches and times are the folder's."""
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: it is too large for the tests' own set-up")
    path = tmp_path / "day.rrd"
    assert main(["view", str(recording), "--rerun", "--save", str(path)]) == 0
    subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", str(path)], check=True, capture_output=True)
    results, rows = tm.read_results(recording), read_back(path)
    good = [frame for frame in results if tm.Status(int(frame["status"])).has_surface]
    assert len(good) == 3 and len(rows["/camera/image"]) == 4 and len(rows["/status"]) == 2
    *surfaces, cleared = rows["/surface/now"]
    assert values(cleared, "is_recursive").all()
    for frame, surface, force, moment, pressure in zip(
        good, surfaces, rows["/force"][-3:], rows["/moment"][-3:], rows["/pressure"][-3:], strict=True
    ):
        np.testing.assert_allclose(values(surface, "vertex_positions"), frame["vertices"])
        np.testing.assert_allclose(values(force, "scalars"), frame["wrench"][:3])
        np.testing.assert_allclose(values(moment, "scalars"), frame["wrench"][3:])
        np.testing.assert_allclose(values(pressure, "scalars"), [frame["pressure_change"]])
    assert [row["time"].timestamp() for row in rows["/force"][-3:]] == [1e9, 1e9 + 0.5, 1e9 + 1]
    found = np.isfinite(good[2]["contact_points"]).all(1)
    assert found.any()
    np.testing.assert_allclose(values(rows["/surface/now/contacts"][2], "positions"), good[2]["contact_points"][found])
    arrows = values(rows["/surface/now/forces"][2], "vectors")
    extent = np.ptp(results.mesh.rest_vertices, 0).max()
    assert np.linalg.norm(arrows, axis=1).max() == pytest.approx(LONGEST_FORCE * extent, rel=1e-3)
    flow = values(rows["/camera/image/flow"][2], "vectors")
    moved = (good[2]["pixels"] - results.mesh.rest_pixels)[good[2]["confidence"] > 0]
    np.testing.assert_allclose(flow, LONGER * moved, atol=1e-4)


def test_rerun_that_is_missing_is_said(stream, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(tm.MembraneError, match=r'pip install "torchmembrane\[rerun\]"'):
        RerunLog(stream.mesh, "never.rrd")


@pytest.mark.parametrize("content", ["import no_such_module", "from ctypes import CDLL; CDLL('libnone.so.7')"])
def test_rerun_that_is_broken_is_not_called_missing(stream, monkeypatch, tmp_path, content):
    (tmp_path / "rerun").mkdir()
    (tmp_path / "rerun/__init__.py").write_text(content)
    monkeypatch.delitem(sys.modules, "rerun", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(tm.MembraneError, match=r"is installed but cannot be imported \(.*(no_such_module|libnone)"):
        RerunLog(stream.mesh, "never.rrd")
