"""Bags are read, and results written to bags in SI units."""

import subprocess
import sys
from dataclasses import replace
from io import BytesIO
from shutil import rmtree
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from torchmembrane import Camera, MembraneError, Sensor, Status
from torchmembrane.cli.main import main
from torchmembrane.integrations.frame_messages import CONTACT_FIELDS, POINT_FIELDS, cloud
from torchmembrane.integrations.messages import CHANNELS, camera_mismatch, grey_of, projected
from torchmembrane.integrations.rosbag import camera_remark
from torchmembrane.results.read import read_results
from torchmembrane.sensor.parts import Cavity

rosbags = pytest.importorskip("rosbags")
from rosbags.highlevel import AnyReader  # noqa: E402
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
TOPIC = "/finger/image_raw"
BLANK = 1
"""The picture in the bag that shows nothing."""


def header(number):
    stamp = TYPES["builtin_interfaces/msg/Time"](1_700_000_000 + number, 250_000_000 + number)
    return TYPES["std_msgs/msg/Header"](stamp, "finger_optical")


def raw(number, levels, encoding):
    """An Image of 8-bit levels `[H, W]`, its lines padded to show that `step` is obeyed."""
    kind, values, _ = CHANNELS[encoding]
    values = levels.astype(kind)[..., None].repeat(values, -1) * (257 if kind == np.uint16 else 1)
    lines = values.reshape(len(levels), -1).view(np.uint8)
    data = np.pad(lines, ((0, 0), (0, 8)))
    fields = len(levels), levels.shape[1], encoding, 0, data.shape[1], data.ravel()
    return "sensor_msgs/msg/Image", TYPES["sensor_msgs/msg/Image"](header(number), *fields)


def compressed(number, levels):
    content = BytesIO()
    Image.fromarray(levels).save(content, "PNG")
    kind = "sensor_msgs/msg/CompressedImage"
    return kind, TYPES[kind](header(number), "png", np.frombuffer(content.getvalue(), np.uint8))


def camera_info(camera, focal=None, centre=None, distortion=None, lens=None, region=(0, 0, 0, 0), binning=0):
    kind, names = "sensor_msgs/msg/CameraInfo", {"pinhole": "plumb_bob", "fisheye": "equidistant"}
    (f, g), (u, v), (width, height) = focal or camera.focal, centre or camera.centre, camera.image_size
    k = np.array([f, 0, u, 0, g, v, 0, 0, 1], float)
    left, top, columns, rows = region
    roi = TYPES["sensor_msgs/msg/RegionOfInterest"](left, top, rows, columns, False)
    d = np.asarray(camera.distortion if distortion is None else distortion, float)
    rest = d, k, np.eye(3).ravel(), np.zeros(12), binning, binning, roi
    return kind, TYPES[kind](header(0), height, width, lens or names[camera.model], *rest)


def write_bag(path, plugin, messages, compression=None):
    """A bag of `(topic, (type, message))`, a tenth of a second apart."""
    writer = Writer(path, version=8, storage_plugin=plugin)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for number, (topic, (kind, message)) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], 10**18 + number * 10**8, STORE.serialize_cdr(message, kind))
    return path


def levels_of(path):
    return np.asarray(Image.open(path))


@pytest.fixture(scope="module")
def gas_sensor(tmp_path_factory, small_sensor):
    """The small sensor with a gas inside, so that there is an absolute pressure."""
    sensor = Sensor.from_file(small_sensor / "sensor.toml")
    gas = replace(sensor, cavity=Cavity("gas", pressure=1013.0))
    return gas.to_file(tmp_path_factory.mktemp("gas") / "sensor.toml")


@pytest.fixture(scope="module")
def pictures(small_sensor):
    levels = [levels_of(small_sensor / name) for name in ("press1.png", "press2.png")]
    return [levels[0], np.zeros_like(levels[0]), levels[1]]


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("form", ["mono8", "bgr8", "png"])
def test_a_bag_s_results_come_back_in_a_bag(tmp_path, gas_sensor, pictures, plugin, form, capsys):
    sensor = Sensor.from_file(gas_sensor)
    topic = f"{TOPIC}/compressed" if form == "png" else TOPIC
    made = [compressed(k, each) if form == "png" else raw(k, each, form) for k, each in enumerate(pictures)]
    messages = [("/finger/camera_info", camera_info(sensor.camera)), *((topic, each) for each in made)]
    write_bag(tmp_path / "run", plugin, messages)
    command = ["reconstruct", str(gas_sensor), str(tmp_path / "run"), "--out", str(tmp_path / "out")]
    assert main([*command, "--bag", str(tmp_path / "forces")]) == 1  # the blank one has failed
    said = capsys.readouterr()
    assert "2 frames with a wrench" in said.out and "CameraInfo" not in said.err
    results = read_results(tmp_path / "out")
    assert results.names == [f"run_{k:06d}" for k in range(3)]
    stored = {each.suffix for each in (tmp_path / "forces").iterdir()}
    assert stored == {".yaml", ".mcap" if plugin == StoragePlugin.MCAP else ".db3"}

    found = {}
    with AnyReader([tmp_path / "forces"]) as reader:
        for connection, received, content in reader.messages():
            found.setdefault(connection.topic, []).append((received, reader.deserialize(content, connection.msgtype)))
    statuses = [message.status[0] for _, message in found.pop("/torchmembrane/status")]
    assert [(each.level, each.message) for each in statuses] == [(0, "ok"), (2, Status.BLANK.text), (0, "ok")]
    names = "wrench", "force_deviation", "points", "contacts", "pressure"
    assert {topic: len(each) for topic, each in found.items()} == {f"/torchmembrane/{name}": 2 for name in names}
    for k, number in enumerate(n for n in range(3) if n != BLANK):
        frame = results[f"run_{number:06d}"]
        for each in found.values():
            received, message = each[k]
            assert received == 10**18 + (number + 1) * 10**8
            assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000 + number, 250_000_000 + number)
            assert message.header.frame_id == "finger_optical"
        wrench = found["/torchmembrane/wrench"][k][1].wrench
        np.testing.assert_allclose([wrench.force.x, wrench.force.y, wrench.force.z], frame["force"])  # N
        moment = [wrench.torque.x, wrench.torque.y, wrench.torque.z]
        np.testing.assert_allclose(moment, frame["wrench"][3:] / 1000, rtol=1e-6)  # N mm to N m
        deviation = found["/torchmembrane/force_deviation"][k][1].vector
        np.testing.assert_allclose([deviation.x, deviation.y, deviation.z], frame["force_deviation"])  # N
        touched = found["/torchmembrane/contacts"][k][1]
        contacts = np.frombuffer(touched.data, "<f4").reshape(touched.width, -1)
        assert [each.name for each in touched.fields] == list(CONTACT_FIELDS) and len(contacts) > 0
        np.testing.assert_allclose(contacts[0, :3], frame["contact_points"][0] / 1000, rtol=1e-6)
        np.testing.assert_allclose(contacts[:, 3:6].sum(0), np.nansum(frame["contact_force"], 0), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(contacts[0, 6:], [*frame["contact_normal"][0], frame["contact_area"][0] / 1e6], rtol=1e-6)
        cloud = found["/torchmembrane/points"][k][1]
        assert [(each.name, each.offset) for each in cloud.fields] == [
            (name, 4 * k) for k, name in enumerate("x y z normal_traction shear_x shear_y shear_z".split())
        ]
        points = np.frombuffer(cloud.data, "<f4").reshape(cloud.width, -1)
        np.testing.assert_allclose(points[:, :3], frame["vertices"] / 1000, rtol=1e-6)
        traction = points[:, 4:] - points[:, 3:4] * frame["normals"]  # N/mm^2 to Pa
        np.testing.assert_allclose(traction, frame["traction"] * 1e6, atol=1e-5 * abs(frame["traction"]).max() * 1e6 + 1e-6)
        np.testing.assert_allclose((points[:, 4:] * frame["normals"]).sum(-1), 0, atol=1e-5 * abs(points[:, 3:]).max() + 1e-6)
        pressure = found["/torchmembrane/pressure"][k][1].fluid_pressure
        np.testing.assert_allclose(pressure, 101300 + 1e6 * float(frame["pressure_change"]), rtol=1e-9)


def test_another_reader_of_mcap_finds_the_same(tmp_path, gas_sensor, pictures):
    """Rerun's, which knows the messages by the definitions that the bag carries."""
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: it is too large for the tests' own set-up")
    run = write_bag(tmp_path / "run", StoragePlugin.MCAP, [(TOPIC, raw(k, pictures[2 * k], "mono8")) for k in range(2)])
    forces, found = tmp_path / "forces", tmp_path / "found.rrd"
    assert main(["reconstruct", str(gas_sensor), str(run), "--out", str(tmp_path / "out"), "--bag", str(forces)]) == 0
    (bag,), rerun = forces.glob("*.mcap"), [sys.executable, "-m", "rerun", "mcap"]
    subprocess.run([*rerun, "check", "--full", str(bag)], check=True, capture_output=True)
    subprocess.run([*rerun, "convert", str(bag), "-o", str(found)], check=True, capture_output=True)
    values = {}
    from rerun.chunk import RrdReader

    for chunk in RrdReader(found).stream().to_chunks():
        for row in chunk.to_record_batch().to_pylist():
            for name, value in row.items():
                values.setdefault(f"{chunk.entity_path.removeprefix('/torchmembrane/')} {name}", []).append(value)
    results = read_results(tmp_path / "out")
    wrenches = values["wrench geometry_msgs.msg.WrenchStamped:message"]
    pressures = np.ravel(values["pressure Measurements:values"])
    for k, frame in enumerate(results):
        (message,) = wrenches[k]
        np.testing.assert_allclose([message["wrench"]["force"][axis] for axis in "xyz"], frame["force"])
        assert message["header"] == {
            "stamp": {"sec": 1_700_000_000 + k, "nanosec": 250_000_000 + k},
            "frame_id": "finger_optical",
        }
        np.testing.assert_allclose(values["points Points3D:positions"][k], frame["vertices"] / 1000, rtol=1e-6)
        np.testing.assert_allclose(pressures[k], 101300 + 1e6 * float(frame["pressure_change"]), rtol=1e-9)  # Pa


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("mode", [CompressionMode.MESSAGE, CompressionMode.FILE])
def test_compressed_bags_and_single_files_are_read(tmp_path, gas_sensor, pictures, plugin, mode):
    images = [(TOPIC, raw(k, pictures[2 * k], "mono8")) for k in range(2)]
    for name, compression in (("plain", None), ("packed", mode)):
        write_bag(tmp_path / name, plugin, images, compression)
    (storage,) = (each for each in (tmp_path / "plain").iterdir() if each.suffix in (".mcap", ".db3"))
    storage.rename(tmp_path / f"alone{storage.suffix}")
    runs = [tmp_path / "packed", tmp_path / f"alone{storage.suffix}"]
    assert main(["reconstruct", str(gas_sensor), *map(str, runs), "--out", str(tmp_path / "out")]) == 0
    results = read_results(tmp_path / "out")
    assert results.names == [f"{name}_{k:06d}" for name in ("alone", "packed") for k in range(2)]
    for k in range(2):
        found, expected = (results[f"{name}_{k:06d}"]["vertices"] for name in ("packed", "alone"))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3)  # mm, a batch's rounding (docs/jobs.md)


def test_the_same_command_again_continues_and_its_bag_is_whole(tmp_path, gas_sensor, pictures, capsys):
    run, forces = tmp_path / "run", tmp_path / "forces"
    write_bag(run, StoragePlugin.MCAP, [(TOPIC, raw(0, pictures[0], "mono8"))])
    command = ["reconstruct", str(gas_sensor), str(run), "--out", str(tmp_path / "out"), "--bag", str(forces)]
    assert main(command) == main(command) == 0
    assert "0 reconstructed, 0 failed, 1 finished before" in capsys.readouterr().out
    rmtree(run)
    write_bag(run, StoragePlugin.MCAP, [(TOPIC, raw(k, pictures[2], "mono8")) for k in range(2)])
    assert main(command) == 0
    said = capsys.readouterr()
    assert "changed, done again" in said.err and "2 frames with a wrench" in said.out
    with AnyReader([forces]) as reader:
        assert reader.topics["/torchmembrane/wrench"].msgcount == 2
    assert sorted(each.name for each in tmp_path.iterdir()) == ["forces", "out", "run"]


@pytest.mark.parametrize("encoding", CHANNELS)
def test_every_encoding_gives_the_same_grey(encoding):
    levels = np.random.default_rng(0).integers(0, 256, (6, 10), np.uint8)
    np.testing.assert_allclose(grey_of(raw(0, levels, encoding)[1], (10, 6)), levels / 255, atol=1e-6)


def test_channels_and_byte_order_are_obeyed():
    pixel = np.array([[[10, 20, 30]]], np.uint8)
    message = SimpleNamespace(encoding="bgr8", width=1, height=1, step=3, is_bigendian=0, data=pixel.ravel())
    np.testing.assert_allclose(grey_of(message, (1, 1)), (0.299 * 30 + 0.587 * 20 + 0.114 * 10) / 255, rtol=1e-6)
    message = SimpleNamespace(encoding="mono16", width=1, height=1, step=2, is_bigendian=1, data=np.array([1, 2], np.uint8))
    np.testing.assert_allclose(grey_of(message, (1, 1)), 258 / 65535, rtol=1e-6)


@pytest.mark.parametrize(
    "change, said",
    [
        ({"encoding": "32FC1"}, "encoding '32FC1'; expected one of mono8"),
        ({"width": 11}, "11 x 6 px, the sensor's 10 x 6"),
        ({"data": np.zeros(5, np.uint8)}, "5 bytes in lines of 18; expected 6 of 10"),
        ({"step": 9}, "in lines of 9"),
    ],
)
def test_other_images_are_refused(change, said):
    message = SimpleNamespace(**{name: getattr(raw(0, np.zeros((6, 10), np.uint8), "mono8")[1], name) for name in FIELDS})
    message.__dict__.update(change)
    with pytest.raises(MembraneError, match=said):
        grey_of(message, (10, 6))


FIELDS = ("encoding", "width", "height", "step", "is_bigendian", "data")


def test_a_cloud_is_dense_where_all_of_its_values_are_finite():
    points = np.ones((3, 7), np.float32)
    assert cloud(points, POINT_FIELDS)["is_dense"]
    points[1, 4] = np.nan
    assert not cloud(points, POINT_FIELDS)["is_dense"]


def test_a_camera_info_that_disagrees_is_said(small_sensor):
    camera = Sensor.from_file(small_sensor / "sensor.toml").camera
    assert camera_mismatch(camera_info(camera)[1], camera) is None
    assert camera_mismatch(camera_info(camera, focal=(0.0, 0.0))[1], camera) is None  # not calibrated
    u, v = camera.centre.tolist()
    assert camera_mismatch(camera_info(camera, centre=(u + 0.6, v - 0.7))[1], camera) is None
    said = camera_mismatch(camera_info(camera, centre=(u + 3, v - 4))[1], camera)
    assert "5.0 px off (rms over the image, at most 5.0); used is the sensor file" in said
    assert "distortion_model 'double_sphere' is not compared" in camera_mismatch(
        camera_info(camera, lens="double_sphere")[1], camera
    )
    small = SimpleNamespace(width=64, height=48, k=np.eye(3).ravel(), distortion_model="plumb_bob")
    with pytest.raises(MembraneError, match="CameraInfo is of 64 x 48 px images"):
        camera_mismatch(small, camera)


PINHOLE = ("pinhole", (640, 480), (400, 410), (318, 243))
FISHEYE = ("fisheye", (640, 480), (200, 205), (318, 243))


@pytest.mark.parametrize(
    "lens, distortion, ports",
    [(PINHOLE, [], []), (PINHOLE, [-0.2, 0.05, 1e-3, -2e-3, 0.01], [(2, 3, 1.49)]), (FISHEYE, [0.02, -5e-3, 1e-3, -1e-4], [])],
)
def test_a_camera_info_s_distortion_is_compared_without_the_ports(lens, distortion, ports):
    camera = Camera(*lens, distortion, ports=ports)
    assert camera_mismatch(camera_info(camera)[1], camera) is None
    stronger = [0.05, *np.zeros(4)] if not distortion else [distortion[0] + 0.05, *distortion[1:]]
    assert "px off" in camera_mismatch(camera_info(camera, distortion=stronger)[1], camera)


RATIONAL = [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, -0.02, 0.004]


@pytest.mark.parametrize("zeros", [0, 4, 6])
def test_a_sensor_s_eight_coefficients_are_compared_with_a_camera_info_s(zeros):
    camera = Camera(*PINHOLE, RATIONAL)
    info = camera_info(camera, distortion=[*RATIONAL, *[0.0] * zeros], lens="rational_polynomial")[1]
    assert camera_mismatch(info, camera) is None
    five = camera_info(camera, distortion=RATIONAL[:5], lens="rational_polynomial")[1]
    assert "px off" in camera_mismatch(five, camera)


@pytest.mark.parametrize(
    "lens, model, distortion, known",
    [
        ("rational_polynomial", PINHOLE, [*RATIONAL, 1e-3, 0.0, 0.0, 0.0], 8),
        ("rational_polynomial", PINHOLE, [*RATIONAL, 0.0, 0.0, 0.0, 0.0, 0.0, 1e-2], 8),
        ("equidistant", FISHEYE, [0.01, 0.0, 0.0, 0.0, 1e-3], 4),
    ],
)
def test_a_camera_info_with_more_coefficients_than_are_modelled_is_not_compared(lens, model, distortion, known):
    said = camera_mismatch(camera_info(Camera(*model), distortion=distortion, lens=lens)[1], Camera(*model))
    assert f"{lens} with coefficients after the first {known} (thin prisms, tilt) is not compared" in said


def test_a_rational_lens_is_projected_as_opencv_does():
    cv2 = pytest.importorskip("cv2")
    camera, d = Camera(*PINHOLE), np.array([-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, -0.02, 0.004])
    info = camera_info(camera, distortion=d, lens="rational_polynomial")[1]
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 3), (20, 3))
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), info.k.reshape(3, 3), d)[0][:, 0]
    np.testing.assert_allclose(projected(info, points), expected)


def test_only_a_camera_info_beside_the_images_is_one(tmp_path, small_sensor, pictures):
    """Of another type on its topic, and one that disagrees."""
    camera, image = Sensor.from_file(small_sensor / "sensor.toml").camera, (TOPIC, raw(0, pictures[0], "mono8"))
    other = camera_info(camera, centre=(camera.centre + 30).tolist())
    for name, beside, said in (("image", raw(0, pictures[0], "mono8"), False), ("info", other, True)):
        bag = write_bag(tmp_path / name, StoragePlugin.MCAP, [("/finger/camera_info", beside), image]) / "metadata.yaml"
        assert (camera_remark(bag, TOPIC, camera) is not None) == said


def test_a_camera_info_is_beside_the_topic_of_compressed_images_too(tmp_path, small_sensor, pictures):
    camera = Sensor.from_file(small_sensor / "sensor.toml").camera
    messages = [
        ("/finger/camera_info", camera_info(camera, centre=(camera.centre + 30).tolist())),
        (f"{TOPIC}/compressed", compressed(0, pictures[0])),
    ]
    bag = write_bag(tmp_path / "run", StoragePlugin.MCAP, messages) / "metadata.yaml"
    assert "px off" in camera_remark(bag, f"{TOPIC}/compressed", camera)


def widened(camera, factor, margin):
    """The camera whose images, cropped by a margin and binned by a factor, are this one's."""
    (width, height), (f, g), (u, v) = camera.image_size, camera.focal.tolist(), camera.centre.tolist()
    size = width * factor + 2 * margin, height * factor + 2 * margin
    centre = tuple(factor * c + (factor - 1) / 2 + margin for c in (u, v))
    return Camera(camera.model, size, (factor * f, factor * g), centre, camera.distortion.tolist())


@pytest.mark.parametrize("factor, margin", [(2, 0), (1, 40), (2, 30)])
def test_a_bag_of_a_mode_s_images_is_read_with_the_camera_info_of_the_whole_chip(
    tmp_path, gas_sensor, pictures, factor, margin, capsys
):
    camera = Sensor.from_file(gas_sensor).camera
    chip, (width, height) = widened(camera, factor, margin), camera.image_size
    region = (margin, margin, factor * width, factor * height) if margin else (0, 0, 0, 0)
    info = camera_info(chip, region=region, binning=factor)
    run = write_bag(
        tmp_path / "run", StoragePlugin.MCAP, [("/finger/camera_info", info), (TOPIC, raw(0, pictures[0], "mono8"))]
    )
    assert main(["reconstruct", str(gas_sensor), str(run), "--out", str(tmp_path / "out")]) == 0
    assert "CameraInfo" not in capsys.readouterr().err


def test_where_images_are_of_the_file_s_size_a_camera_info_of_another_is_said(tmp_path, small_sensor, pictures):
    camera = Sensor.from_file(small_sensor / "sensor.toml").camera
    info = "/finger/camera_info", camera_info(camera, binning=2)  # by drivers whose sizes are those of the mode already
    for form in (raw, lambda k, levels, _: compressed(k, levels)):
        bag = write_bag(tmp_path / form.__name__, StoragePlugin.MCAP, [info, (TOPIC, form(0, pictures[0], "mono8"))])
        remark = camera_remark(bag / "metadata.yaml", TOPIC, camera)
        assert "CameraInfo is of 80 x 60 px images" in remark and "CameraInfo is not compared" in remark
    bag = write_bag(tmp_path / "small", StoragePlugin.MCAP, [info, (TOPIC, raw(0, pictures[0][::2, ::2], "mono8"))])
    with pytest.raises(MembraneError, match="metadata.yaml, /finger/camera_info: CameraInfo is of 80 x 60 px images"):
        camera_remark(bag / "metadata.yaml", TOPIC, camera)


def test_a_frame_that_is_refused_stops_no_other(tmp_path, gas_sensor, pictures, capsys):
    """One of each: an encoding without a grey value, data that are too short, a damaged file."""
    odd = raw(1, pictures[0], "mono8")[1]
    short, spoiled = raw(2, pictures[0], "mono8")[1], compressed(3, pictures[0])[1]
    odd.encoding, short.data, spoiled.data = "32FC1", short.data[:100], spoiled.data[:300]
    kinds = [raw(0, pictures[0], "mono8"), (odd.__msgtype__, odd), (short.__msgtype__, short), raw(3, pictures[2], "mono8")]
    run = write_bag(tmp_path / "run", StoragePlugin.MCAP, [(TOPIC, each) for each in kinds])
    packed = write_bag(
        tmp_path / "packed", StoragePlugin.MCAP, [(TOPIC, (spoiled.__msgtype__, spoiled)), (TOPIC, compressed(1, pictures[0]))]
    )
    assert main(["reconstruct", str(gas_sensor), str(run), str(packed), "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr()
    assert "3 reconstructed, 3 failed" in said.out
    for text in ("run_000001: image of encoding '32FC1'", "run_000002: the image has 100 bytes", "packed_000000: "):
        assert text in said.err


def test_a_bag_in_the_working_folder_names_its_frames_by_that_folder(tmp_path, gas_sensor, pictures, monkeypatch):
    run = write_bag(tmp_path / "run", StoragePlugin.MCAP, [(TOPIC, raw(0, pictures[0], "mono8"))])
    monkeypatch.chdir(run)
    assert main(["reconstruct", str(gas_sensor), ".", "--out", str(tmp_path / "out")]) == 0
    assert read_results(tmp_path / "out").names == ["run_000000"]


def test_what_cannot_be_is_refused_in_one_line(tmp_path, gas_sensor, small_images, pictures, capsys):
    messages = [("/a/image", raw(0, pictures[0], "mono8")), ("/b/image", raw(0, pictures[0], "mono8"))]
    run = write_bag(tmp_path / "run", StoragePlugin.MCAP, messages)
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(next(run.glob("*.mcap")).read_bytes()[:5000])
    (tmp_path / "there").mkdir()
    image, named = small_images[0], [run, "--topic", "/a/image"]
    for options, said in (
        ([run], "image topics: /a/image, /b/image; expected one: name it by --topic"),
        ([run, "--topic", "/c"], "no images on topic /c"),
        ([broken], "not readable as a bag of ROS 2"),
        ([image, "--topic", "/a/image"], "none of the inputs is a bag"),
        ([image, "--bag", tmp_path / "new"], "none of the inputs is a bag"),
        ([*named, "--bag", tmp_path / "there"], "exists already"),
        ([*named, "--bag", tmp_path / "new", "--estimator", "minimum-energy"], "minimum-energy finds no forces"),
        ([*named, "--bag", tmp_path / "new", "--shard", "1/2"], "--bag with --shard"),
    ):
        assert main(["reconstruct", str(gas_sensor), *map(str, options), "--out", str(tmp_path / "out")]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert said in line


def test_relative_forces_are_no_newtons(tmp_path, gas_sensor, pictures, capsys):
    """A gas would want its modulus: of a liquid."""
    full = Sensor.from_file(gas_sensor)
    material = replace(full.material, shear_modulus=None, thickness=None)
    sensor = replace(full, material=material, cavity=Cavity("liquid")).to_file(tmp_path / "sensor" / "sensor.toml")
    run = write_bag(tmp_path / "run", StoragePlugin.MCAP, [(TOPIC, raw(0, pictures[0], "mono8"))])
    command = ["reconstruct", str(sensor), str(run), "--out", str(tmp_path / "out"), "--bag", str(tmp_path / "forces")]
    assert main(command) == 2 and not (tmp_path / "forces").exists()
    assert "forces of cap are relative, but messages are in newtons: add shear_modulus" in capsys.readouterr().err
