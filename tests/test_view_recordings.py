"""Recordings of several views give one frame for each moment.

What a view lacks at a moment is reported.
"""

import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from test_views import BESIDE, CAMERA, cap

import torchmembrane as tm
from torchmembrane.cli.main import main
from torchmembrane.jobs.moments import TimedPicture, moments
from torchmembrane.live import sources
from torchmembrane.live.loop import LiveFrame
from torchmembrane.live.recording import Recording
from torchmembrane.live.streams import TrackedStream
from torchmembrane.live.view_sources import moments_of_cameras
from torchmembrane.sensor.views import View
from torchmembrane.simulate import Simulator, Sphere
from torchmembrane.simulate.dataset import stroke_to

VIEWS = "left", "right"
RATE = 10


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A sensor file with two views, images of both at four moments of a press, the surfaces of these, and the reconstructor."""
    simulator = Simulator(cap(View("right", CAMERA, BESIDE)))
    stroke = stroke_to(simulator, Sphere(3.0), np.array([0.0, 1.0, 18.0]), np.array([0.0, 0.0, -1.0]), 1.0)
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("views") / "sensor.toml"
    states = [simulator.membrane.rest, *(state.vertices for state in simulator.presses(stroke, ["push"], 3))]
    simulator.at_rest().to_file(path)
    frames = [simulator.images(vertices, rng) for vertices in states]
    reconstructor = tm.Reconstructor.from_file(path)
    with torch.no_grad():
        result = reconstructor([np.stack(each) for each in zip(*frames, strict=True)])
    return path, frames, result.vertices.numpy(), reconstructor


def video(path, images):
    """A video without losses, `RATE` pictures a second, of images with their numbers."""
    av = pytest.importorskip("av")
    with av.open(path, "w") as container:
        stream = container.add_stream("ffv1", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = *CAMERA.image_size, "gray"
        for number, image in images:
            picture = av.VideoFrame.from_ndarray(image, format="gray")
            picture.pts = number
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return path


def command(path, *inputs, out):
    return main(["reconstruct", str(path), *map(str, inputs), "--out", str(out), "--workers", "1"])


@pytest.mark.parametrize("period", [1.0, 0.1])
@pytest.mark.parametrize("delay", [-0.3, 0.0, 0.3, 0.45])
def test_what_was_taken_together_is_together_whatever_is_lost(period, delay):
    """Two cameras of one pace, one late by a part of it: pictures of one number make a moment, whichever others are lost."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        kept = rng.random((2, 50)) > 0.2
        kept[:, :3] = True
        kept[0], kept[1] = kept[0] | ~np.roll(kept[0], 1), kept[1] | ~np.roll(kept[1], 1)  # no two in a row are lost
        streams = [[TimedPicture(period * (n + w * delay), n) for n in range(50) if kept[w, n]] for w in range(2)]
        found = list(moments([iter(stream) for stream in streams]))
        for pair in found:
            numbers = {each.picture for each in pair if each is not None}
            assert len(numbers) == 1, (pair, delay)
        assert [sum(pair[w] is not None for pair in found) for w in range(2)] == kept.sum(1).tolist()


def test_pictures_of_a_clock_that_is_set_back_are_all_there():
    """Each view is matched by itself before and after; where the clock is set back, a moment may lack a view."""
    times = [[10.0, 10.1, 10.2, 10.15, 10.25, 10.35], [10.0, 10.1, 10.2, 10.3, 10.4, 10.5]]
    found = list(moments([iter([TimedPicture(time, n) for n, time in enumerate(view)]) for view in times]))
    assert all(any(each is not None for each in moment) for moment in found)
    for w in range(2):
        assert [moment[w].picture for moment in found if moment[w] is not None] == list(range(6))
    alone = [iter([TimedPicture(time, n) for n, time in enumerate((1000.0, 1000.1, 1000.05, 1000.15))])]
    assert [moment[0].picture for moment in moments(alone)] == [0, 1, 2, 3]


def test_videos_of_the_views_are_matched_by_their_times(recorded, tmp_path, capsys):
    """The right video lacks the second picture: that moment is solved by the left one, and said; others are as of images."""
    path, frames, expected, _ = recorded
    video(tmp_path / "press_left.mkv", [(n, frame[0]) for n, frame in enumerate(frames)])
    video(tmp_path / "press_right.mkv", [(n, frame[1]) for n, frame in enumerate(frames) if n != 1])
    assert command(path, tmp_path / "press_left.mkv", tmp_path / "press_right.mkv", out=tmp_path / "out") == 0
    said = capsys.readouterr()
    results = tm.read_results(tmp_path / "out")
    assert results.names == [f"press_left_00000{n}" for n in range(4)]
    assert [int(frame["status"]) for frame in results] == [0, 10, 0, 0]
    assert "press_left_000001: a view shows too little" in said.err and ": right (no picture at this moment)" in said.err
    assert "a view was left out in 1 frames" in said.err and "4 reconstructed," in said.out
    summary = (tmp_path / "out" / "summary.csv").read_text()
    assert summary.count("the answer is the others': right") == 1
    for n, frame in enumerate(results):
        assert np.abs(frame["vertices"] - expected[n]).max() < (0.1 if n == 1 else 5e-3), n
    (tmp_path / "press_right.mkv").unlink()
    assert command(path, tmp_path / "press_left.mkv", out=tmp_path / "other") == 2
    assert "no press_right.mkv beside it" in capsys.readouterr().err


def test_images_of_the_views_may_have_different_endings(recorded, tmp_path, capsys):
    path, frames, expected, _ = recorded
    for view, image, ending in zip(VIEWS, frames[3], ("png", "tiff"), strict=True):
        Image.fromarray(image).save(tmp_path / f"press_{view}.{ending}")
    (tmp_path / "press_right.npz").touch()  # what else lies there
    assert command(path, tmp_path / "press_left.png", out=tmp_path / "out") == 0
    frame = tm.read_results(tmp_path / "out")["press_left"]
    assert int(frame["status"]) == 0 and np.abs(frame["vertices"] - expected[3]).max() < 5e-3


@pytest.mark.parametrize("lost", VIEWS)
def test_a_frame_that_a_view_lacks_is_solved_by_the_other_whichever_it_is(recorded, tmp_path, capsys, lost):
    path, frames, expected, _ = recorded
    (tmp_path / "day").mkdir()
    for number in (2, 3):
        for view, image in zip(VIEWS, frames[number], strict=True):
            if number == 3 or view != lost:
                Image.fromarray(image).save(tmp_path / "day" / f"p{number}_{view}.png")
    assert command(path, tmp_path / "day", out=tmp_path / "out") == 0
    results = tm.read_results(tmp_path / "out")
    assert results.names == ["p2_left", "p3_left"] and [int(frame["status"]) for frame in results] == [10, 0]
    assert f"others': {lost}" in (tmp_path / "out" / "summary.csv").read_text()
    (tmp_path / "day" / "p4.png").touch()
    assert command(path, tmp_path / "day", out=tmp_path / "other") == 2
    assert "p4.png: of no view; expected NAME_left, NAME_right of each frame" in capsys.readouterr().err


@pytest.mark.parametrize("bits", [(None, 12), (12,)])
def test_a_recording_of_several_cameras_is_read_back_and_shown_with_its_images(recorded, tmp_path, capsys, bits):
    """Colours of the right camera, of 12 bits, need a TIFF; it lacks the first moment."""
    path, frames, expected, reconstructor = recorded
    stream, folder = TrackedStream(reconstructor), tmp_path / "day"
    with Recording(folder, stream.mesh, *bits) as kept:
        for number in range(1, 4):
            left, right = frames[number][0], frames[number][1][..., None] * np.uint16(16) + np.arange(3, dtype=np.uint16)
            given = [left, None if number == 1 else right]
            kept.keep(LiveFrame(number, 1e9 + number, given, stream([left, frames[number][1]], float(number)), 0.01))
    assert {file.suffix for file in (folder / "images").iterdir()} == {".png", ".tiff"}
    assert command(path, folder / "images", out=tmp_path / "out") == 0
    assert [int(frame["status"]) for frame in tm.read_results(tmp_path / "out")] == [10, 0, 0]
    assert main(["view", str(folder), "--dataset", str(tmp_path / "data")]) == 0
    names = {file.name for file in (tmp_path / "data" / "train").iterdir()}
    assert names == {"metadata.parquet", *(f"00000{number}.png" for number in range(1, 4))}
    (tmp_path / "others").mkdir()
    Image.fromarray(frames[1][0]).save(tmp_path / "others" / "away.png")
    capsys.readouterr()
    options = ["--images", str(tmp_path / "others"), "--sheet", str(tmp_path / "sheet.png")]
    assert main(["view", str(folder), *options]) == 0
    assert "no image has the name of a frame" in capsys.readouterr().err


def test_an_image_that_a_view_lacks_is_said_and_taken_when_it_is_there(recorded, tmp_path, capsys):
    path, frames, expected, _ = recorded
    files = [tmp_path / f"press_{view}.png" for view in VIEWS]
    Image.fromarray(frames[3][0]).save(files[0])
    assert command(path, files[0], out=tmp_path / "out") == 0
    said = capsys.readouterr().err
    assert "press_left.png: a view shows too little" in said and "right (" in said and "press_right.png" in said
    Image.fromarray(frames[3][1]).save(files[1])
    assert command(path, *files, out=tmp_path / "out") == 0
    assert "changed, done again" in capsys.readouterr().err
    frame = tm.read_results(tmp_path / "out")["press_left"]
    assert int(frame["status"]) == 0 and np.abs(frame["vertices"] - expected[3]).max() < 5e-3
    for file in files:
        file.write_bytes(b"no image")
    assert command(path, *files, out=tmp_path / "none") == 1


def test_topics_of_the_views_are_matched_by_their_stamps(recorded, tmp_path, capsys):
    """A bag of both views' images, in whatever order they were received; of the third moment the left image is missing."""
    pytest.importorskip("rosbags")
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag2 import StoragePlugin
    from test_rosbag import STORE, raw, write_bag

    path, frames, expected, _ = recorded
    late, kept = [], [(n, w) for n in range(4) for w in ((1, 0) if n % 2 else (0, 1)) if (n, w) != (2, 0)]
    for n, w in kept:
        kind, message = raw(n, frames[n][w], "mono8")
        stamp = message.header.stamp
        at = int(round(1e9 * (stamp.sec + 0.2 * n + 0.03 * w)))
        stamp = STORE.types["builtin_interfaces/msg/Time"](sec=at // 10**9, nanosec=at % 10**9)
        header = STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id=f"{VIEWS[w]}_optical")
        fields = {key: getattr(message, key) for key in ("height", "width", "encoding", "is_bigendian", "step", "data")}
        late.append((f"/{VIEWS[w]}/image", STORE.types[kind](header=header, **fields)))
    bag = tmp_path / "run"
    write_bag(bag, StoragePlugin.MCAP, [(topic, (kind, message)) for topic, message in late])
    topics = [text for view in VIEWS[::-1] for text in ("--topic", f"{view}=/{view}/image")]
    assert command(path, bag, *topics, "--bag", tmp_path / "forces", out=tmp_path / "out") == 0
    said = capsys.readouterr()
    results = tm.read_results(tmp_path / "out")
    assert [int(frame["status"]) for frame in results] == [0, 0, 10, 0] and ": left (no picture" in said.err
    for n in (0, 1, 3):
        assert np.abs(results[f"run_00000{n}"]["vertices"] - expected[n]).max() < 5e-3
    assert "4 frames with a wrench" in said.out
    with AnyReader([tmp_path / "forces"]) as reader:  # results are in the first view's frame, also where it has no picture
        sent = [reader.deserialize(content, each.msgtype).header.frame_id for each, _, content in reader.messages()]
    assert len(sent) >= 4 * 5 and set(sent) == {"left_optical"}
    for given, wanted in (
        ([], "expected the topic of each, --topic left=TOPIC --topic right=TOPIC"),
        (topics[:2], "a sensor of several views"),
    ):
        assert command(path, bag, *given, out=tmp_path / "no") == 2
        assert wanted in capsys.readouterr().err


def test_a_camera_info_of_the_image_that_regions_share_is_compared_with_it(tmp_path, capsys):
    """The first view is a region of the image of a camera whose CameraInfo is of the whole image."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import StoragePlugin
    from test_rosbag import camera_info, raw, write_bag

    whole = tm.Camera("pinhole", (320, 120), (100, 100), (79.5, 59.5), [0.01, 0.0])
    other = tm.Camera("pinhole", (320, 120), (100, 100), (239.5, 59.5)).in_mode((160, 0, 160, 120))
    first = whole.in_mode((0, 0, 160, 120))
    views = View("left", first, is_region=True), View("right", other, BESIDE, is_region=True)
    sensor = replace(cap(camera=first), views=views)
    (camera,) = sensor.image_cameras
    assert camera.image_size == whole.image_size
    torch.testing.assert_close(camera.state_dict(), whole.state_dict())
    path, image = sensor.to_file(tmp_path / "sensor.toml"), raw(0, np.zeros((120, 320), np.uint8), "mono8")
    for name, centre, is_said in (("same", (79.5, 59.5), False), ("moved", (89.5, 59.5), True)):
        info = camera_info(whole, centre=centre)
        write_bag(tmp_path / name, StoragePlugin.MCAP, [("/finger/camera_info", info), ("/finger/image_raw", image)])
        assert command(path, tmp_path / name, out=tmp_path / f"out_{name}") == 1  # the image is blank
        assert ("CameraInfo" in capsys.readouterr().err) == is_said


def frames_of(images, seconds):
    for image in images:
        time.sleep(seconds)
        yield image


def test_the_newest_of_each_camera_make_a_moment():
    """The slower of two cameras sets the pace; no picture is given twice; one that stops is waited for only so long."""
    numbers = [np.full((1, 1), n) for n in range(12)]
    given = list(moments_of_cameras({"left": frames_of(numbers, 0.02), "right": frames_of(numbers[:4], 0.06)}))
    both = [[int(each.item()) for each in moment] for moment in given if None not in moment]
    assert [right for _, right in both] == sorted({right for _, right in both}) and len(both) >= 3
    lefts = [int(moment[0].item()) for moment in given if moment[0] is not None]
    assert lefts == sorted(set(lefts)) and lefts[-1] == 11
    for left, right in both:
        assert left >= right  # never one from before


def test_a_camera_that_fails_is_said_and_the_others_go_on():
    def failing():
        yield np.zeros((1, 1))
        raise tm.MembraneError("unplugged")

    with pytest.warns(UserWarning, match="view right: unplugged; the other views go on"):
        given = list(moments_of_cameras({"left": frames_of([np.ones((1, 1))] * 4, 0.05), "right": failing()}))
    assert given[-1][1] is None and given[-1][0] is not None
    with pytest.raises(tm.MembraneError, match="unplugged"):
        list(moments_of_cameras({"right": failing()}))


@pytest.fixture
def cameras(monkeypatch):
    """Cameras 0 and 2 of OpenCV; a list of their frames is given to each, and then nothing any more."""
    given = {0: [], 2: []}

    def opened(camera, size):
        assert size == CAMERA.image_size
        return camera

    def images_of(camera, name, size):
        yield from frames_of(given[camera], 0.05)

    monkeypatch.setattr("sys.stdin", None)
    monkeypatch.setattr(sources, "opened_camera", opened)
    monkeypatch.setattr(sources, "images_of", images_of)
    return given


def test_live_follows_a_camera_for_each_view(recorded, cameras, tmp_path, capsys):
    """What it records, reconstruct finds again."""
    path, frames, expected, _ = recorded
    for camera, view in ((0, 0), (2, 1)):
        cameras[camera] += [frames[n][view] for n in (0, 0, 3, 3, 3)]
    call = ["live", str(path), "--camera", "left=0", "--camera", "right=2", "--record", str(tmp_path / "kept")]
    assert main(call) == 0
    assert "followed" in capsys.readouterr().out
    images = sorted(file.name for file in (tmp_path / "kept" / "images").iterdir())
    results = tm.read_results(tmp_path / "kept")
    assert len(results) >= 1 and images == [f"{name}_{view}.png" for name in results.names for view in VIEWS]
    assert np.abs(results[results.names[-1]]["vertices"] - expected[3]).max() < 5e-3
    for given, said in (
        (["--camera", "0"], "a sensor of several views; expected --camera left=NUMBER"),
        (call[2:4], "several views"),
    ):
        assert main(["live", str(path), *given]) == 2
        assert said in capsys.readouterr().err


def test_live_plays_the_views_images_and_says_which_view_lacks_one(recorded, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin", None)
    path, frames, *_ = recorded
    folder = tmp_path / "frames"
    folder.mkdir()
    for n, frame in enumerate(frames[:3]):
        for view, image in zip(VIEWS, frame, strict=True):
            Image.fromarray(image).save(folder / f"{n}_{view}.png")
    (folder / "2_right.png").write_bytes(b"no image")
    assert main(["live", str(path), "--images", str(folder), "--rate", "1", "--record", str(tmp_path / "kept")]) == 0
    said = capsys.readouterr()
    assert "2_right.png" in said.out and "view right lacks it" in said.out
    assert "left out: the answer is the others': right" in (tmp_path / "kept" / "summary.csv").read_text()
