"""Frames are ordered by the numbers in their names."""

import csv
import os
import warnings
from collections import namedtuple
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import torchmembrane as tm
from torchmembrane.cli.main import main
from torchmembrane.files.order import in_order, warn_of_times
from torchmembrane.jobs.inputs import find_inputs, without_rest
from torchmembrane.jobs.rest import recording_rest
from torchmembrane.live.sources import folder_images

Rest = namedtuple("Rest", "pixels")
ROOT = Path(__file__).parents[1]
SERIES = {
    "no zeros": [f"f_{k}" for k in range(1, 13)],
    "a digit more": ["f_9998", "f_9999", "f_10000", "f_10001"],
    "zeros before": ["f_08", "f_009", "f_10"],
    "text after": ["1a", "2a", "10a", "10b"],
    "two numbers": ["run2_1", "run2_10", "run10_1", "run10_2"],
    "a date": ["2026-9-30 1", "2026-10-1 1", "2026-10-1 12"],
    "only numbers": [str(k) for k in (1, 2, 9, 10, 11, 99, 100)],
    "long numbers": [f"f{k}" for k in (2, 10**40, 10**40 + 1)],
}


def written(folder, names, size=(8, 6)):
    """Images of the grey levels 0, 1, 2, ..., written in a shuffled order: their paths in the order of the levels."""
    for k in np.random.default_rng(0).permutation(len(names)):
        Image.fromarray(np.full(size[::-1], k, np.uint8)).save(folder / f"{names[k]}.png")
    return [folder / f"{name}.png" for name in names]


def test_a_rest_image_in_a_folder_is_left_out(tmp_path):
    """The sensor's, to the byte, wherever its file is; not one that is given by its name, nor where there is nothing else."""
    rest, press = written(tmp_path, ["sensor_rest", "press"])
    own = tmp_path / "mine" / "mine_rest.png"
    own.parent.mkdir()
    own.write_bytes(rest.read_bytes())

    def found(*arguments):
        inputs = without_rest(find_inputs(arguments), arguments, [tmp_path / "sensor.toml", own])
        return inputs.images, list(inputs.rest)

    assert found(tmp_path) == ([press], [rest])
    assert found(str(rest), str(press)) == ([rest, press], [])
    press.unlink()
    assert found(tmp_path) == ([rest], [])


@pytest.mark.parametrize("series", SERIES)
def test_numbers_in_names_count_as_numbers(series):
    names = SERIES[series]
    assert sorted(sorted(names), key=in_order) == names
    assert all(in_order(one) < in_order(after) for one, after in pairwise(names))


def test_numbers_of_any_length_are_compared():
    """Names of damaged results may be longer than Python makes an int of."""
    names = ["f" + "9" * 4999, "f1" + "0" * 4999]
    assert sorted(names[::-1], key=in_order) == names


def test_names_of_one_number_differ_by_their_letters():
    assert sorted(["f_1", "f_01", "g_1", "F_1"], key=in_order) == ["F_1", "f_01", "f_1", "g_1"]


@pytest.mark.parametrize("series", SERIES)
def test_folders_patterns_and_what_shells_make_of_them_come_in_order(series, tmp_path):
    paths = written(tmp_path, SERIES[series])
    assert find_inputs([tmp_path]).images == paths
    assert find_inputs([f"{tmp_path}/*.png"]).images == paths
    assert find_inputs(sorted(paths)).images == paths


def test_an_order_of_the_call_s_own_stands(tmp_path):
    paths = written(tmp_path, SERIES["no zeros"])
    for order in (paths[::-1], [*paths[3:], *paths[:3]]):
        assert find_inputs(order).images == order


def test_live_plays_images_in_order(tmp_path):
    written(tmp_path, SERIES["no zeros"])
    levels = [round(float(timed.image.mean()) * 255) for timed in folder_images(tmp_path, (8, 6), 30.0)]
    assert levels == list(range(12))


def test_the_first_frames_at_rest_are_those_of_the_lowest_numbers(tmp_path, small_sensor, monkeypatch):
    reconstructor = tm.Reconstructor.from_file(small_sensor / "sensor.toml")
    written(tmp_path, SERIES["no zeros"], reconstructor.camera.image_size)
    taken = []
    monkeypatch.setattr(
        reconstructor.observer,
        "rest_of",
        lambda images: taken.extend(images.mean((1, 2, 3)) * 255) or Rest(reconstructor.rest_pixels),
    )
    recording_rest(reconstructor, ["first:3"], find_inputs([tmp_path]))
    assert [round(float(level)) for level in taken] == [0, 1, 2]


@pytest.mark.parametrize("apart, said", [(0.2, False), (3.0, True)])
def test_times_that_go_against_the_numbers_are_said(tmp_path, small_sensor, monkeypatch, apart, said):
    """Of the file with the highest number, which is the oldest; of copies, which are made at once, nothing is said."""
    reconstructor = tm.Reconstructor.from_file(small_sensor / "sensor.toml")
    paths = written(tmp_path, SERIES["no zeros"], reconstructor.camera.image_size)
    for k, path in enumerate([paths[-1], *paths[:-1]]):
        os.utime(path, (1e9 + k * apart / 11, 1e9 + k * apart / 11))
    monkeypatch.setattr(reconstructor.observer, "rest_of", lambda images: Rest(reconstructor.rest_pixels))
    words = (
        f"{paths[-1].name} follows {paths[-2].name} by the numbers in their names, but is older by 3 s; the order of the names"
    )
    for take in (
        lambda: recording_rest(reconstructor, ["first:3"], find_inputs([tmp_path])),
        lambda: list(folder_images(tmp_path, reconstructor.camera.image_size, 30.0)),
    ):
        with pytest.warns(UserWarning, match=words) if said else warnings.catch_warnings():
            warnings.simplefilter("always" if said else "error")
            take()


def test_times_that_go_back_in_small_steps_are_said_once_they_have_gone_far_enough():
    """Each file is 0.4 s older than the one before, which copies at once may be; the fourth is 1.2 s older than the first."""
    frames = [(f"f_{k}", 100.0 - 0.4 * k) for k in range(8)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_times(frames[:3])
    with pytest.warns(UserWarning, match="f_3 follows f_0 by the numbers in their names, but is older by 1 s") as found:
        warn_of_times(frames)
    assert len(found) == 1


def test_results_and_their_summary_are_in_order(tmp_path, small_sensor):
    frames, out = tmp_path / "frames", tmp_path / "results"
    frames.mkdir()
    names = SERIES["no zeros"]
    image = next(path for path in sorted(small_sensor.glob("*.png")))
    for name in names:
        (frames / f"{name}.png").write_bytes(image.read_bytes())
    main(["reconstruct", str(small_sensor / "sensor.toml"), str(frames), "--out", str(out)])
    assert tm.read_results(out).names == names
    with open(out / "summary.csv", newline="") as file:
        assert [row["name"] for row in csv.DictReader(file)] == names


@pytest.mark.parametrize("series", SERIES)
def test_the_edge_package_has_the_same_order(series, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "export")
    from torchmembrane_edge.cli import in_order as in_order_there

    paths = [Path(name) for name in SERIES[series]]
    assert in_order_there(sorted(paths)) == paths
    assert in_order_there(paths[::-1]) == paths[::-1]
