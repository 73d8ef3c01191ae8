"""Files that systems leave in folders are not frames."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import torchmembrane as tm
from torchmembrane.cli.film import images_in
from torchmembrane.cli.main import main
from torchmembrane.errors import MembraneError
from torchmembrane.jobs.inputs import find_inputs
from torchmembrane.live.recording import Recording
from torchmembrane.live.sources import folder_images
from torchmembrane.results.store import Mesh, Settings, check_folder
from torchmembrane.simulate.frames import SimulatedFrames

ROOT = Path(__file__).parents[1]
OF_SYSTEM = ("._f_2.png", ".DS_Store", "Thumbs.db", "desktop.ini", "ehthumbs.db", "Icon\r")
HIDDEN = (".f_3.png", ".f_2.png.x7Q2aB")


@pytest.fixture
def folder(tmp_path):
    """Two images, and what should not count."""
    made = tmp_path / "frames"
    made.mkdir()
    for name in ("f_2.png", "f_10.png"):
        Image.fromarray(np.zeros((6, 8), np.uint8)).save(made / name)
    for name in (*OF_SYSTEM, *HIDDEN):
        (made / name).write_bytes(b"\0\5\x16\7 not an image")
    return made


FRAMES = ["f_2.png", "f_10.png"]


@pytest.mark.parametrize("pattern", ["{}", "{}/*", "{}/*.png", "{}/**", "{}/../*/*.png"])
def test_folders_and_patterns_pass_them_over(folder, pattern):
    assert [path.name for path in find_inputs([pattern.format(folder)]).images] == FRAMES


def test_so_does_what_a_shell_makes_of_a_pattern(folder):
    for expanded in (folder.iterdir(), [folder / name for name in (*FRAMES, *OF_SYSTEM)]):
        given = sorted(path for path in expanded if path.name not in HIDDEN)
        assert [path.name for path in find_inputs(given).images] == FRAMES


@pytest.mark.parametrize("name", [OF_SYSTEM[0], HIDDEN[0]])
def test_a_file_that_is_named_by_itself_is_meant(folder, name):
    assert find_inputs([folder / name]).images == [folder / name]
    assert find_inputs([folder / "f_2.png", folder / HIDDEN[0]]).images == [folder / "f_2.png", folder / HIDDEN[0]]


def test_a_folder_of_nothing_else_is_refused(folder):
    for name in FRAMES:
        (folder / name).unlink()
    for argument in (folder, f"{folder}/*", f"{folder}/*.png"):
        with pytest.raises(MembraneError, match="holds no files|no such file"):
            find_inputs([argument])


def test_live_and_films_pass_them_over(folder, recwarn):
    assert len(list(folder_images(folder, (8, 6), 30.0))) == 2 and not recwarn
    assert sorted(images_in(folder)) == ["f_10", "f_2"]


def test_results_pass_them_over(tmp_path, small_sensor, small_images):
    out = tmp_path / "out"
    out.mkdir()
    for name in ("._press0.npz", ".DS_Store", "Thumbs.db"):
        (out / name).write_bytes(b"\0\5\x16\7")
    command = ["reconstruct", str(small_sensor / "sensor.toml"), str(small_images[0]), "--out", str(out)]
    assert main(command) == main(command) == 0  # neither is the folder refused nor the file taken for a damaged result
    assert tm.read_results(out).names == ["press0"] and (out / "._press0.npz").exists()


def test_an_empty_folder_may_hold_them(tmp_path, small_sensor):
    made = tm.Reconstructor.from_file(small_sensor / "sensor.toml")
    settings = Settings.from_reconstructor(made, "npz")
    (tmp_path / "._old.npz").touch()
    check_folder(tmp_path, made.sensor.fingerprint, settings)
    with Recording(tmp_path, Mesh.from_reconstructor(made, settings)):
        pass
    (tmp_path / "old.npz").touch()
    with pytest.raises(MembraneError, match="is not empty"):
        Recording(tmp_path, Mesh.from_reconstructor(made, settings))


def test_simulated_frames_pass_them_over(tmp_path):
    for name in ("f_2", "f_10", "._f_2"):
        (tmp_path / f"{name}.png").touch()
        (tmp_path / f"{name}_truth.npz").touch()
    assert SimulatedFrames(tmp_path).names() == {"f_2", "f_10"}


def test_the_edge_package_passes_them_over(folder, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "export")
    from torchmembrane_edge.cli import without_system_files

    given = [folder / name for name in (*OF_SYSTEM, *FRAMES)]
    assert [path.name for path in without_system_files(given)] == FRAMES
    assert without_system_files(given[:1]) == given[:1]
