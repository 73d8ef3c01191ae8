"""Camera settings are held; what the driver refuses is named."""

import re
import subprocess
import sys
import time
from collections import deque
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from torchmembrane.cli.main import main
from torchmembrane.files.timestamps import time_in
from torchmembrane.live import capture
from torchmembrane.live.capture import SETTLING, STALE, Held, Photographs, hold, taken_together

ROOT = Path(__file__).parents[1]
AUTO = {"AUTO_EXPOSURE": 3.0, "AUTO_WB": 1.0, "AUTOFOCUS": 1.0}


class Driver:
    """A camera with the interface of `cv2.VideoCapture`: its images brighten until it is held.

    Args:
        lets: the properties that it takes.
        backend: of the system.
    """

    def __init__(self, lets, backend="V4L2"):
        self.values = {"EXPOSURE": 100.0, "GAIN": 7.0, "WB_TEMPERATURE": 4600.0, "FOCUS": 30.0, **AUTO}
        self.lets, self.backend, self.reads, self.held_at, self.released = set(lets), backend, 0, None, False

    def _key(self, number):
        return next((key for key in self.values if getattr(cv2, f"CAP_PROP_{key}") == number), None)

    def isOpened(self):  # noqa: N802
        return True

    def getBackendName(self):  # noqa: N802
        return self.backend

    def get(self, number):
        return self.values.get(self._key(number), 0.0)

    def set(self, number, value):
        key = self._key(number)
        if key in self.lets:
            self.values[key] = value
        if key == "AUTO_EXPOSURE":
            self.held_at = self.reads
        return key in self.lets

    def read(self):
        self.reads += 1
        self.values["EXPOSURE"] += self.held_at is None
        return True, np.full((6, 8, 3), min(self.reads, 255), np.uint8)

    def release(self):
        self.released = True


def test_settings_are_taken_from_the_automatics_and_kept_as_they_are():
    driver = Driver(Driver([]).values)
    before = dict(driver.values)
    assert hold(driver) == Held(["exposure", "gain", "white balance", "focus"], [])
    assert driver.values == before | {"AUTO_EXPOSURE": 1.0, "AUTO_WB": 0.0, "AUTOFOCUS": 0.0}
    other = Driver(Driver([]).values, "DSHOW")
    hold(other)
    assert other.values["AUTO_EXPOSURE"] == 0.25


@pytest.mark.parametrize(
    "lets, free",
    [
        (["AUTO_EXPOSURE", "EXPOSURE", "GAIN"], ["white balance", "focus"]),
        (["EXPOSURE", "GAIN", "AUTO_WB", "WB_TEMPERATURE", "AUTOFOCUS", "FOCUS"], ["exposure"]),
        ([], ["exposure", "gain", "white balance", "focus"]),
    ],
)
def test_what_a_driver_does_not_let_be_held_is_said(lets, free):
    found = hold(Driver(lets))
    assert found.free == free and f"the driver does not let {', '.join(free)} be held" in found.said


def test_a_driver_that_takes_a_setting_and_ignores_it_does_not_hold_it():
    class Deaf(Driver):
        def set(self, number, value):
            return True

    assert hold(Deaf([])).free == ["exposure", "white balance", "focus"]  # the gain is what it was


def test_photographs_are_taken_with_settings_held_and_named_by_their_time(monkeypatch, tmp_path, capsys):
    driver = Driver(Driver([]).values)
    monkeypatch.setattr(cv2, "VideoCapture", lambda number: driver)
    assert main(["capture", "--camera", "0", "--out", str(tmp_path / "rest"), "--count", "3", "--every", "0.01"]) == 0
    said, paths = capsys.readouterr().out, sorted((tmp_path / "rest").iterdir())
    assert "exposure, gain, white balance, focus held" in said and "3 photographs of 8 x 6 px" in said
    assert driver.held_at == SETTLING and driver.released and len(paths) == 3
    first = np.asarray(Image.open(paths[0]))
    assert first.shape == (6, 8, 3) and first[0, 0, 0] == SETTLING + STALE + 1
    times = [time_in(path.stem) for path in paths]
    assert all(np.isfinite(times)) and times[2] - times[0] > 0.018


def test_photographs_of_two_cameras_bear_the_names_of_their_views(monkeypatch, tmp_path):
    drivers = {number: Driver(Driver([]).values) for number in (0, 2)}
    monkeypatch.setattr(cv2, "VideoCapture", lambda number: drivers[number])
    call = ["capture", "--camera", "left=0", "--camera", "right=2", "--out", str(tmp_path), "--count", "2"]
    assert main(call) == 0
    names = sorted(path.stem for path in tmp_path.iterdir())
    assert [name.partition("_")[2] for name in names] == ["left", "right"] * 2 and names[0][:-5] == names[1][:-6]
    assert all(np.isfinite(time_in(name)) for name in names) and all(driver.released for driver in drivers.values())


class Queue(Driver):
    """A camera of 100 Hz whose driver keeps four images that nobody has read, and drops later ones; their level is the time,
    hundredths of a second."""

    def __init__(self):
        super().__init__([])
        self.start, self.waiting, self.taken = time.monotonic(), deque(), 0

    def read(self):
        while not self.waiting:
            time.sleep(0.001)
            self._fill()
        self._fill()
        return True, np.full((6, 8, 3), self.waiting.popleft(), np.uint16)

    def _fill(self):
        begun, self.taken = self.taken, int(100 * (time.monotonic() - self.start))
        self.waiting.extend(list(range(begun + 1, self.taken + 1))[: 4 - len(self.waiting)])


def test_photographs_of_two_cameras_are_of_the_same_moment(monkeypatch):
    """However long the camera that is read later has waited: its driver still holds images of the photographs before."""
    drivers = {}
    monkeypatch.setattr(cv2, "VideoCapture", lambda number: drivers.setdefault(number, Queue()))
    cameras = [Photographs(0), Photographs(1)]
    for _, images in taken_together(cameras, 5, 0.4):
        left, right = (driver.start + image[0, 0, 0] / 100 for driver, image in zip(drivers.values(), images, strict=True))
        assert 0 <= right - left < 0.3 and time.monotonic() - left < 0.35
    assert all(driver.released for driver in drivers.values())


def test_two_photographs_in_one_millisecond_have_two_names(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", lambda number: Driver([]))
    names = [name for name, _ in Photographs(0).take(20)]
    assert len(set(names)) == 20 and names == sorted(names)


def test_after_a_late_photograph_the_next_one_waits_as_long(monkeypatch):
    """The time between two photographs is counted from the first of them, not from when it was due."""

    class Late(Driver):
        def read(self):
            time.sleep(0.02 * (self.reads == SETTLING + STALE))
            return super().read()

    monkeypatch.setattr(cv2, "VideoCapture", lambda number: Late([]))
    first, second = (time_in(name) for name, _ in Photographs(0).take(2, 0.03))
    assert second - first > 0.028


def test_a_photograph_of_another_size_than_the_sensor_s_is_refused(monkeypatch, small_sensor, tmp_path, capsys):
    monkeypatch.setattr(cv2, "VideoCapture", lambda number: Driver([]))
    call = ["capture", str(small_sensor / "sensor.toml"), "--camera", "0", "--out", str(tmp_path / "rest")]
    assert main(call) == 2
    assert "images of 8 x 6 px; expected the sensor's 160 x 120" in capsys.readouterr().err and not (tmp_path / "rest").exists()


@pytest.mark.parametrize(
    "options", [["capture", "--out", "rest"], pytest.param(["live", "preset:bubble"], marks=pytest.mark.full)]
)
def test_only_this_package_s_words_reach_the_terminal_where_there_is_no_camera(options, tmp_path):
    command = [sys.executable, "-m", "torchmembrane", *options, "--camera", "987"]
    done = subprocess.run(
        command, cwd=tmp_path, env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}, capture_output=True, text=True
    )
    lines = (done.stdout + done.stderr).splitlines()
    assert done.returncode == 2 and "--camera 987: cannot be opened" in done.stderr
    assert lines and all(re.match("torchmembrane: ", line) for line in lines), lines


def test_what_live_alone_has_comes_first_in_its_help(capsys):
    with pytest.raises(SystemExit):
        main(["live", "--help"])
    said = capsys.readouterr().out
    places = [said.index(f"\n  --{name} ") for name in ("camera", "video", "images", "record", "model", "estimator", "device")]
    assert max(places[:5]) < min(places[5:])


def test_the_module_says_its_settings_as_opencv_calls_them():
    names = [name for setting in capture.SETTINGS for name in (setting.value, setting.switch) if name]
    assert all(hasattr(cv2, f"CAP_PROP_{name}") for name in names)
