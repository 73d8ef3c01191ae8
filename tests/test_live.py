"""A live camera yields the newest frame and counts dropped ones.

Cameras are played by a class with the interface of `cv2.VideoCapture`.
"""

import csv
import json
import re
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections import deque
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np
import pytest
import torch
from PIL import Image

import torchmembrane as tm
from torchmembrane.cli.live import _stopped_by_signals, request_of
from torchmembrane.cli.main import main
from torchmembrane.files.grayscale import to_grayscale_batch
from torchmembrane.files.images import read_image, write_as_taken
from torchmembrane.live.background import Background
from torchmembrane.live.line import StatusLine, described, summary
from torchmembrane.live.loop import RECENT, LiveFrame, StreamStats, follow, rezeroed
from torchmembrane.live.mailbox import Mailbox, capture
from torchmembrane.live.recording import Recording, times_of
from torchmembrane.live.sources import MOST_MISSED, Timed, camera_images, folder_images, paced, video_images
from torchmembrane.live.streams import TrackedStream
from torchmembrane.sensor.sensor import Sensor

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def reconstructor(small_sensor):
    return tm.Reconstructor.from_file(small_sensor / "sensor.toml")


@pytest.fixture
def stream(reconstructor):
    return TrackedStream(reconstructor)


def frame_of(status: int = 0) -> dict[str, np.ndarray]:
    return {"status": np.array(status), "wrench": np.arange(6.0), "pressure_change": np.array(0.002)}


def seen(number: int, status: int = 0) -> LiveFrame:
    return LiveFrame(number, 0.1 * number, np.zeros((2, 2), np.uint8), frame_of(status), 0.05)


class Slow:
    """A stream that takes so many seconds for a frame, and finds in it the number that it shows."""

    def __init__(self, seconds: float):
        self.seconds, self.numbers, self.zeroed = seconds, [], 0

    def __call__(self, image, time_):
        time.sleep(self.seconds)
        self.numbers.append(int(image[0, 0]))
        return frame_of()

    def rezero(self):
        self.zeroed += 1


def numbered(count: int, rate: float):
    return paced(Timed(k / rate, np.full((2, 2), k)) for k in range(count))


def test_the_newest_frame_is_taken_and_no_lag_builds_up():
    """At ten times the rate that can be kept up: latency is that of one computation and the wait for the one before."""
    stream, stats = Slow(0.05), StreamStats()
    with capture(numbered(200, 200.0)) as mailbox:
        follow(stream, mailbox, stats, [], Event())
    assert stats.captured == 200 and stream.numbers == sorted(set(stream.numbers)) and stream.numbers[-1] == 199
    assert 5 <= stats.followed <= 24 and stats.dropped == 200 - stats.followed
    assert min(stats.latencies) >= 0.05 and stats.latency(80) < 0.15
    assert 5 < stats.rate() < 21


def test_every_frame_is_taken_where_there_is_time():
    stream, stats = Slow(0.0), StreamStats()
    with capture(numbered(10, 10.0)) as mailbox:
        follow(stream, mailbox, stats, [], Event())
    assert stream.numbers == list(range(10)) and stats.dropped == 0 and 9 < stats.rate() < 11


def test_what_breaks_the_source_is_raised_after_its_last_frame():
    def broken():
        yield np.zeros((2, 2))
        raise tm.MembraneError("the camera is gone")

    stream, stats = Slow(0.05), StreamStats()
    with pytest.raises(tm.MembraneError, match="the camera is gone"), capture(broken()) as mailbox:
        follow(stream, mailbox, stats, [], Event())
    assert stream.numbers == [0] and stats.followed == 1


def test_a_stop_ends_an_endless_source_at_once():
    stop, closed = Event(), Event()

    def endless():
        try:
            while True:
                time.sleep(0.01)
                yield np.zeros((2, 2))
        finally:
            closed.set()

    start = time.monotonic()
    with capture(endless()) as mailbox:
        follow(Slow(0.0), mailbox, StreamStats(), [lambda seen, _: seen.number > 5 and stop.set()], stop)
    assert time.monotonic() - start < 1.0 and closed.wait(1.0)


def test_requests_are_answered_once_between_frames_and_a_refusal_is_said(stream):
    asked, said, slow = deque([rezeroed]), [], Slow(0.0)
    with capture(numbered(3, 100.0)) as mailbox:
        follow(slow, mailbox, StreamStats(), [], Event(), asked, said.append)
    assert slow.zeroed == 1 and said == ["the latest frame is taken for rest"] and not asked
    asked.extend(request_of(text, "mm") for text in ("z", "200g", "12hPa", "q"))
    with capture(iter(())) as mailbox:
        follow(stream, mailbox, StreamStats(), [], Event(), asked, said.append)
    for answer, name in zip(said[1:4], ("rezero", "weigh", "gauge"), strict=True):
        assert answer.startswith(f"not done: Tracker.{name}: no frame yet")
    assert said[4].startswith("'q' is not understood; expected z") and len(said) == 5


def test_known_loads_are_compared_with_the_latest_frame(stream, small_images):
    """A load that is stated as twice what is found gives a ratio of a half; a gauge is read in hPa, 1e-4 N/mm^2."""
    frame = stream(read_image(small_images[2]), 0.0)
    force, change = float(np.linalg.norm(frame["force"])), float(frame["pressure_change"])
    answer = request_of(f"{2 * force:.6f}N", "mm")(stream)
    assert "the force is found 0.500 times as large as known" in answer and stream.tracker.stiffness.ratio < 0.51
    answer = request_of(f"{change / 1e-4 / 2:.6f}hPa", "mm")(stream)
    assert "the change of pressure is found 2.000 times" in answer
    watch = stream.tracker.stiffness
    assert f"together {watch.ratio:.3f}, {watch.deviation:.0%} uncertain: a calibration is due" in answer and watch.ratio < 1.9


def test_a_mailbox_that_ended_gives_its_last_picture_first():
    mailbox = Mailbox()
    mailbox.put(np.zeros((1, 1)))
    mailbox.end()
    assert mailbox.take(0.0).number == 0 and mailbox.take(60.0) is None


def test_times_of_captures_go_forward_whatever_the_clock_does(monkeypatch):
    mailbox, pictures = Mailbox(), []
    for wall in (2e9, 1e9):
        monkeypatch.setattr(time, "time", lambda wall=wall: wall)
        mailbox.put(np.zeros((1, 1)))
        pictures.append(mailbox.take(0.0))
    assert 0 < pictures[1].time - pictures[0].time < 1 and abs(pictures[0].time - 2e9) > 1e6


def test_background_work_never_holds_up_and_counts_what_it_drops():
    go, kept = Event(), []

    def keep(item):
        go.wait(5.0)
        kept.append(item)

    with Background(keep, depth=4) as later:
        start = time.monotonic()
        for item in range(50):
            later(item)
        assert time.monotonic() - start < 1.0
        go.set()
    assert kept == list(range(len(kept))) and 4 <= len(kept) <= 5 and later.dropped == 50 - len(kept)


def test_an_error_in_the_background_is_raised_in_the_end_and_what_failed_is_counted():
    def keep(item):
        raise OSError("no space left")

    with pytest.raises(OSError, match="no space left"), Background(keep) as later:
        for item in range(3):
            later(item)
    assert later.dropped == 3


def test_items_after_an_error_in_the_background_are_tried_and_the_first_error_is_told_at_once():
    kept, told, go = [], [], Event()

    def keep(item):
        if item in (1, 3):
            raise OSError(f"no space for {item}")
        kept.append(item)

    with (
        pytest.raises(OSError, match="no space for 1"),
        Background(keep, tell=lambda error: (told.append(error), go.set())) as later,
    ):
        for item in range(3):
            later(item)
        assert go.wait(5.0) and str(told[0]) == "no space for 1"  # before the block ends
        later(3)
        later(4)
    assert kept == [0, 2, 4] and len(told) == 1 and later.failed == later.dropped == 2 and later.late == 0


@pytest.mark.parametrize("source", ["ends", "breaks off"])
def test_a_recording_that_cannot_be_written_is_told_at_once_and_counted(
    small_sensor, small_images, camera, capsys, tmp_path, monkeypatch, source
):
    """The folder of images goes away amid the recording: said while it goes on, and what else ends the command as well."""
    monkeypatch.setattr("torchmembrane.live.sources.BREATH", 0.0)
    monkeypatch.setattr(sys, "stdin", [])
    record, images = tmp_path / "kept", [np.array(Image.open(path).convert("RGB")) for path in small_images]

    class Slow(Capture):
        def read(self):
            time.sleep(0.2 if self.images else 0.0)  # at a camera's pace, until it breaks off
            if len(self.images) == 5:
                shutil.rmtree(record / "images")
            if len(self.images) == 1 and source == "ends":
                signal.raise_signal(signal.SIGINT)
            return super().read()

    played = Slow(images * 3)
    monkeypatch.setattr("cv2.VideoCapture", lambda number: played)
    assert main(["live", str(small_sensor / "sensor.toml"), "--camera", "0", "--grid", "7", "7", "--record", str(record)]) == 2
    out, err = capsys.readouterr()
    told = re.search(r"warning: .*/kept/images/(\d+)\.png: not written \(No such file or directory\); .*; frames that", out)
    counted = re.search(
        r"recorded in .*kept; 0 frames left out, because there was no time for them, (\d+) frames that could not be kept", out
    )
    assert told and counted and told.start() < out.index("captured") < counted.start()
    results = tm.read_results(record)
    assert int(told[1]) not in map(int, results.names) and int(counted[1]) >= 1
    assert ("--camera 0: no image in" if source == "breaks off" else "not written (No such file") in err


def test_a_recording_that_cannot_be_closed_says_so_beside_another_error(stream, small_images, tmp_path):
    image = read_image(small_images[0])
    for error in (None, tm.MembraneError("the source broke off")):
        folder = tmp_path / f"day{error is None}"
        expected = pytest.raises(tm.MembraneError, match="cannot be finished" if error is None else "the source broke off")
        with warnings.catch_warnings(record=True) as said, expected:
            warnings.simplefilter("always")
            with Recording(folder, stream.mesh) as recording:
                recording.keep(LiveFrame(0, 0.0, image, stream(image, 0.0), 0.0))
                stream.tracker.reset()
                shutil.rmtree(folder)
                folder.touch()
                if error is not None:
                    raise error
        assert (len(said) == 1) == (error is not None) and all("cannot be finished" in str(each.message) for each in said)


def test_rezero_of_live_says_that_a_contact_was_found(stream, small_images, recwarn):
    asked, said = deque(), []
    image = read_image(small_images[2])

    def pressed():
        yield image
        time.sleep(0.5)
        asked.append(rezeroed)
        yield image

    with capture(pressed()) as mailbox:
        follow(stream, mailbox, StreamStats(), [], Event(), asked, said.append)
    assert said == ["the latest frame is taken for rest"]
    assert any("a contact of" in str(each.message) and "reads as none from now on" in str(each.message) for each in recwarn)


@pytest.mark.parametrize("rate", ["0", "1e-300", "1e300", "nan", "-1"])
def test_a_rate_at_which_nothing_can_be_played_is_refused(small_sensor, tmp_path, capsys, rate):
    with pytest.raises(SystemExit) as ended:
        main(["live", str(small_sensor / "sensor.toml"), "--images", str(tmp_path), "--rate", rate])
    assert ended.value.code == 2 and "expected a number from 0.001 to 1e+06" in capsys.readouterr().err


class Capture:
    """A camera of so many images, played by the interface of `cv2.VideoCapture`: BGR, and at times no image."""

    def __init__(self, images, missed=(), opens=True, after=None):
        self.images, self.missed, self.opens, self.after = list(images), set(missed), opens, after
        self.reads, self.released, self.asked = 0, False, {}

    def isOpened(self):  # noqa: N802
        return self.opens

    def set(self, key, value):
        self.asked[key] = value

    def read(self):
        self.reads += 1
        if self.reads in self.missed or not self.images:
            if not self.images and self.after:
                self.after()
            return False, None
        time.sleep(0.02)
        return True, np.ascontiguousarray(self.images.pop(0)[..., ::-1])

    def release(self):
        self.released = True


@pytest.fixture
def camera(monkeypatch):
    """Have OpenCV open such a camera."""
    import cv2

    def given(*arguments, **options) -> Capture:
        played = Capture(*arguments, **options)
        monkeypatch.setattr(cv2, "VideoCapture", lambda number: played)
        return played

    return given


def test_a_camera_gives_red_green_blue_of_the_sensor_s_size(camera):
    import cv2

    images = [np.random.default_rng(k).integers(0, 255, (6, 8, 3), np.uint8) for k in range(4)]
    played = camera(images, missed=(2, 3))
    source = camera_images(0, (8, 6))
    for image in images:
        np.testing.assert_array_equal(next(source), image)
    asked = {cv2.CAP_PROP_FRAME_WIDTH: 8, cv2.CAP_PROP_FRAME_HEIGHT: 6, cv2.CAP_PROP_ORIENTATION_AUTO: 0}
    assert played.asked == asked and not played.released
    source.close()
    assert played.released


PICTURE = np.random.default_rng(0).integers(0, 255, (6, 8), np.uint8)
"""Asymmetric: mirrored or turned it is another."""


class AsCaptured(Capture):
    """Frames as they are given."""

    def read(self):
        return True, self.images[0]


def colour(grey):
    return np.stack([grey // 2, grey, grey // 3], -1)


LAYOUTS = {
    "grey": (PICTURE, PICTURE),
    "grey, one channel": (PICTURE[..., None], PICTURE),
    "grey, 16 bits": (PICTURE.astype(np.uint16) * 257, PICTURE.astype(np.uint16) * 257),
    "BGR": (colour(PICTURE)[..., ::-1], colour(PICTURE)),
    "BGRA": (np.dstack([colour(PICTURE)[..., ::-1], PICTURE]), colour(PICTURE)),
    "BGR, 16 bits": (colour(PICTURE)[..., ::-1].astype(np.uint16) * 257, colour(PICTURE).astype(np.uint16) * 257),
    "BGR, rows backwards in memory": (colour(PICTURE)[::-1].copy()[::-1, :, ::-1], colour(PICTURE)),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_frames_of_every_layout_are_the_picture_and_are_kept_as_it(layout, monkeypatch, tmp_path):
    """None is mirrored, turned or of other colours; what is kept has the same grey values."""
    import cv2

    given, expected = LAYOUTS[layout]
    monkeypatch.setattr(cv2, "VideoCapture", lambda number: AsCaptured([given]))
    seen = next(camera_images(0, (8, 6)))
    np.testing.assert_array_equal(seen, expected)
    assert seen.dtype == expected.dtype
    one = torch.zeros((), dtype=torch.float64)
    grey = to_grayscale_batch(seen, (8, 6), "rgb", one)[0, 0].numpy()
    kept = read_image(write_as_taken(tmp_path / "kept", seen), (8, 6))
    np.testing.assert_allclose(kept, grey, atol=0.51 / 255 if seen.dtype == np.uint8 and seen.ndim == 3 else 1e-5)


@pytest.fixture
def edge_cli(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "export")
    import torchmembrane_edge.cli

    return torchmembrane_edge.cli


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_edge_package_takes_frames_of_every_layout_alike(layout, edge_cli):
    given, expected = LAYOUTS[layout]
    np.testing.assert_array_equal(edge_cli._red_first(given), expected)


def test_frames_of_two_channels_are_refused(monkeypatch, edge_cli):
    import cv2

    monkeypatch.setattr(cv2, "VideoCapture", lambda number: AsCaptured([np.dstack([PICTURE, PICTURE])]))
    with pytest.raises(tm.MembraneError, match=r"--camera 0: frames \[6, 8, 2\]; expected grey, BGR or BGRA"):
        next(camera_images(0, (8, 6)))
    with pytest.raises(edge_cli.EdgeError, match=r"frames \[6, 8, 2\]; expected grey, BGR or BGRA"):
        edge_cli._red_first(np.dstack([PICTURE, PICTURE]))


def test_a_camera_s_failures_are_said(camera, monkeypatch):
    camera([], opens=False)
    with pytest.raises(tm.MembraneError, match="--camera 3: cannot be opened"):
        camera_images(3, (8, 6))
    played = camera([np.zeros((4, 8, 3), np.uint8)])
    with pytest.raises(tm.MembraneError, match="images of 8 x 4 px; expected the sensor's 8 x 6"):
        next(camera_images(0, (8, 6)))
    assert played.released
    played = camera([np.zeros((6, 8, 3), np.uint8)])
    monkeypatch.setattr("torchmembrane.live.sources.BREATH", 0.0)
    source = camera_images(0, (8, 6))
    next(source)
    with pytest.raises(tm.MembraneError, match=f"no image in {MOST_MISSED} reads"):
        next(source)
    assert played.released


def test_a_camera_may_miss_any_number_of_reads_but_not_in_a_row(camera, monkeypatch):
    monkeypatch.setattr("torchmembrane.live.sources.BREATH", 0.0)
    monkeypatch.setattr("torchmembrane.live.sources.MOST_MISSED", 3)
    camera([np.zeros((6, 8, 3), np.uint8)] * 3, missed=(2, 3, 5, 6))
    source = camera_images(0, (8, 6))
    for _ in range(3):
        next(source)
    with pytest.raises(tm.MembraneError, match="no image in 3 reads"):
        next(source)


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Ten pictures at 25 Hz."""
    import av

    path = tmp_path_factory.mktemp("video") / "ten.mp4"
    with av.open(str(path), "w") as container:
        track = container.add_stream("h264", rate=25)
        track.width, track.height, track.pix_fmt = 64, 48, "yuv420p"
        for k in range(10):
            image = np.full((48, 64, 3), 20 * k, np.uint8)
            container.mux(track.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(track.encode())
    return path


def test_a_video_is_played_at_its_own_pace_or_at_the_one_given(video):
    for rate, expected in ((None, 25.0), (100.0, 100.0)):
        found = list(video_images(video, (64, 48), rate))
        assert [due for due, _ in found] == pytest.approx([k / expected for k in range(10)])
        assert [image.mean() for _, image in found] == pytest.approx([20 * k for k in range(10)], abs=4)


def test_no_video_is_said(video, tmp_path):
    (tmp_path / "text.mp4").write_text("none")
    for path, said in (("text.mp4", "not readable as a video"), ("nothing.mp4", "no such file")):
        with pytest.raises(tm.MembraneError, match=said):
            next(video_images(tmp_path / path, (64, 48), None))
    with pytest.raises(tm.MembraneError, match="images of 64 x 48 px; expected the sensor's 32 x 24"):
        next(video_images(video, (32, 24), None))


def test_frames_come_when_they_are_due_and_late_ones_at_once():
    def late():
        yield Timed(1.0, np.zeros(1))
        time.sleep(0.1)
        yield Timed(1.02, np.zeros(1))
        yield Timed(1.2, np.zeros(1))

    start, at = time.monotonic(), []
    for _ in paced(late()):
        at.append(time.monotonic() - start)
    assert all(due - 0.001 <= came < due + 0.09 for due, came in zip((0.0, 0.1, 0.2), at, strict=True))


def test_a_broken_image_of_a_folder_is_left_out_and_said(small_images, tmp_path):
    (tmp_path / "a.png").write_bytes(small_images[0].read_bytes())
    (tmp_path / "b.png").write_bytes(b"no image")
    (tmp_path / "c.png").write_bytes(small_images[1].read_bytes())
    with pytest.warns(UserWarning, match=r"b.png: not readable.*left out"):
        found = list(folder_images(tmp_path, (160, 120), 10.0))
    assert [due for due, _ in found] == [0.0, 0.2]


def test_a_tracker_keeps_the_time_of_its_latest_frame_and_refuses_an_earlier_one(reconstructor, small_images):
    tracker, image = tm.Tracker(reconstructor), reconstructor.read(small_images[0])
    tracker(image, time=2.0)
    assert tracker.time == 2.0
    for wrong in (2.0, 1.0):
        with pytest.raises(tm.MembraneError, match=rf"time {wrong} after one of 2.0.*reset\(\)"):
            tracker(image, time=wrong)
    tracker(image)
    assert tracker.time is None
    tracker(image, time=1.0)
    tracker.reset()
    tracker(image, time=0.5)
    assert tracker.time == 0.5


def test_the_line_says_rate_latency_status_and_wrench(stream):
    stats = StreamStats()
    for k in (0, 2, 4):
        stats.add(seen(k))
    text = described(seen(4), stats, stream.mesh)
    assert text == (
        "5.0 Hz, 50 ms (95 %: 50), 2 dropped | ok | force +0.000 +1.000 +2.000 N | moment +3.000 +4.000 +5.000 N mm | "
        "pressure +20 hPa"
    )
    blank = described(seen(6, status=int(tm.Status.BLANK)), stats, stream.mesh)
    assert "blank or saturated image" in blank and "force" not in blank
    assert summary(StreamStats()) == "no frame was captured"
    stats.add(seen(6, status=int(tm.Status.BLANK)))
    assert "7 captured, 4 followed, 1 of them without a surface, 3 dropped" in summary(stats)


def test_rate_and_latency_of_the_line_are_of_the_latest_frames_and_of_the_summary_of_all(stream):
    stats = StreamStats()
    for k in range(3 * RECENT):
        at, latency = (k, 0.5) if k < 2 * RECENT else (2 * RECENT + 0.1 * (k - 2 * RECENT), 0.05)
        stats.add(seen(k)._replace(time=float(at), latency=latency))
    assert described(seen(3 * RECENT), stats, stream.mesh).startswith("10.0 Hz, 50 ms (95 %: 50), 0 dropped | ok")
    assert "latency 500 ms in the median, 500 ms at 95 %" in summary(stats)


def test_the_line_is_rewritten_in_a_terminal_and_plain_elsewhere(stream, monkeypatch):
    class Screen:
        def __init__(self, terminal):
            self.written, self.isatty = [], lambda: terminal

        def write(self, text):
            self.written.append(text)

        def flush(self):
            pass

    monkeypatch.setenv("COLUMNS", "60")
    stats = StreamStats()
    stats.add(seen(0))
    for terminal in (True, False):
        screen = Screen(terminal)
        line = StatusLine(stream.mesh, screen)
        line(seen(0), stats)
        line(seen(0), stats)  # too soon
        line.say("said")
        shown, said = screen.written
        assert ("\n" in shown) != terminal and shown.startswith("\r\x1b[K") == terminal and said.endswith("said\n")
        assert not terminal or len(shown.removeprefix("\r\x1b[K")) == 59


def test_a_recording_reads_back_as_results_and_reconstructs_to_the_same(reconstructor, stream, small_images, tmp_path):
    kept = []
    with Recording(tmp_path / "day", stream.mesh) as recording:
        for k, path in enumerate(small_images):
            grey = np.asarray(Image.open(path).convert("L"))
            image = np.repeat(grey[..., None], 3, -1) if k % 2 else read_image(path)
            kept.append(LiveFrame(3 * k, 1e9 + k, image, stream(image, float(k)), 0.01))
            recording.keep(kept[-1])
    results = tm.read_results(tmp_path / "day")
    assert results.names == ["000000", "000003", "000006"]
    for each in kept:
        for key, value in each.frame.items():
            np.testing.assert_array_equal(results[each.name][key], value)
        np.testing.assert_allclose(
            read_image(tmp_path / "day" / "images" / f"{each.name}.png"), reconstructor.grey(each.image)[0, 0], atol=1e-6
        )
    assert times_of(tmp_path / "day") == {each.name: each.time for each in kept}
    with open(tmp_path / "day" / "summary.csv", newline="") as file:
        assert [row["name"] for row in csv.DictReader(file)] == results.names
    with pytest.raises(tm.MembraneError, match="is not empty"):
        Recording(tmp_path / "day", stream.mesh)


def test_the_command_follows_a_camera_and_says_what_ended_it(small_sensor, small_images, camera, capsys, tmp_path, monkeypatch):
    """The camera is unplugged after its images: the summary is said, what was recorded is whole."""
    monkeypatch.setattr("torchmembrane.live.sources.BREATH", 0.0)
    monkeypatch.setattr(sys, "stdin", [])
    images = [np.array(Image.open(path).convert("RGB")) for path in small_images]
    camera(images)
    record = tmp_path / "kept"
    options = ["--grid", "7", "7", "--record", str(record), "--life", str(tmp_path / "life.json")]
    code = main(["live", str(small_sensor / "sensor.toml"), "--camera", "0", *options])
    out, err = capsys.readouterr()
    assert code == 2 and "--camera 0: no image in" in err
    followed = int(re.search(r"frames: 3 captured, (\d) followed", out)[1])
    results = tm.read_results(record)
    assert len(results) == followed and results["000002"]["vertices"].shape == (49, 3)
    hardest = max(float(np.linalg.norm(frame["force"])) for frame in results)
    life = json.loads((tmp_path / "life.json").read_text())
    assert life["frames"] == followed and life["force"] == pytest.approx(hardest) and f"force {hardest:.3g} N" in out
    (tmp_path / "life.json").write_text("another file")
    assert main(["live", str(small_sensor / "sensor.toml"), "--images", str(small_sensor), *options[:3], *options[5:]]) == 2
    assert "name another file" in capsys.readouterr().err
    sensor = Sensor.from_file(small_sensor / "sensor.toml")
    tracker = tm.Tracker(tm.Reconstructor(replace(sensor, membrane=sensor.surface.membrane((7, 7)))))
    for name in results.names:
        expected = tracker(images[int(name)])
        np.testing.assert_allclose(results[name]["vertices"], expected.vertices[0], atol=1e-4)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "no source; expected one of --camera NUMBER, --video FILE, --images FOLDER"),
        (["--camera", "0", "--images", "."], "--camera and --images; expected one"),
        (["--camera", "0", "--rate", "9"], "a camera sets its own rate"),
        (["--camera", "0", "--model", "a.onnx", "--grid", "9", "9"], "--grid with --model"),
        (["--camera", "0", "--model", "a.onnx", "--estimator", "paper"], "--estimator with --model"),
        (["--camera", "0", "--model", "a.onnx", "--device", "cuda"], "--device with --model"),
        (["--camera", "0", "--device", "cuda"], "--device cuda: torch sees no CUDA device; pass --device cpu"),
    ],
)
def test_wrong_usage_of_the_command_is_said(small_sensor, options, said, capsys, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert main(["live", str(small_sensor / "sensor.toml"), *options]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_asks_for_the_end_and_the_second_is_an_interruption(number):
    before = signal.getsignal(number)
    with _stopped_by_signals() as stop:
        assert not stop.is_set()
        signal.raise_signal(number)
        assert stop.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert signal.getsignal(number) == before


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.full), signal.SIGTERM])
def test_a_signal_ends_the_command_with_its_summary(small_sensor, small_images, tmp_path, number):
    """From a folder of a minute; `z` is answered on the way."""
    for k in range(1800):
        (tmp_path / f"{k:04d}.png").hardlink_to(small_images[0]) if k else (tmp_path / "0000.png").symlink_to(small_images[0])
    command = [sys.executable, "-m", "torchmembrane", "live", str(small_sensor / "sensor.toml"), "--images", str(tmp_path)]
    pipes = dict(stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    with subprocess.Popen(command, **pipes) as process:
        assert " ms " in process.stdout.readline()
        process.stdin.write("z\n")
        process.stdin.flush()
        lines = [process.stdout.readline(), process.stdout.readline()]
        assert any("is taken for rest" in line for line in lines)
        process.send_signal(number)
        out, err = process.communicate(timeout=20)
    assert process.returncode == 0 and not err and "latency" in out.splitlines()[-1]
