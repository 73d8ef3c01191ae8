"""The node in a live ROS 2: rclpy and its messages from PyPI, discovery on this machine alone."""

import os
import shutil
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from datetime import date, timedelta
from functools import cache
from pathlib import Path
from threading import Thread
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped, Vector3Stamped, WrenchStamped
from PIL import Image as Picture
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.type_support import check_for_type_support
from sensor_msgs.msg import CameraInfo, CompressedImage, FluidPressure, Image, PointCloud2
from std_srvs.srv import Trigger
from torchmembrane_ros.health import Health
from torchmembrane_ros.node import FAILURE, SUCCESS, TrackerNode, main
from torchmembrane_ros.outgoing import quaternion, transform_of
from torchmembrane_ros.parameters import PARAMETERS

import torchmembrane as tm
from torchmembrane.files.images import to_grey
from torchmembrane.integrations.frame_messages import TOPICS
from torchmembrane.sensor.parts import Cavity
from torchmembrane.sensor.record import Record
from torchmembrane.sensor.views import View

ROOT, PACKAGE = Path(__file__).parents[3], Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
KINDS = {
    "wrench": WrenchStamped, "force_deviation": Vector3Stamped, "points": PointCloud2, "contacts": PointCloud2,
    "pressure": FluidPressure, "status": DiagnosticArray,
}  # fmt: skip
RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
PATIENCE = 20.0


@pytest.fixture(scope="module", autouse=True)
def context():
    rclpy.init()
    yield
    rclpy.try_shutdown()


@pytest.fixture(scope="module")
def sensor(tmp_path_factory):
    """The example's sensor file, on a grid of 9 x 9."""
    folder = tmp_path_factory.mktemp("sensor")
    for name in ("rest_grid.npz", "dots.csv", "rest.png"):
        shutil.copy(EXAMPLES / name, folder)
    said = (EXAMPLES / "sensor.toml").read_text().replace("[membrane]", "[membrane]\ngrid = [9, 9]")
    (folder / "sensor.toml").write_text(said)
    return folder / "sensor.toml"


@pytest.fixture(scope="module", autouse=True)
def made_once():
    """A file's reconstructor takes a while, and is the same for all nodes of these tests."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(tm.Reconstructor, "from_file", cache(tm.Reconstructor.from_file))
        yield


@pytest.fixture(scope="module")
def levels():
    """A press, grey `[H, W]`."""
    return np.asarray(Picture.open(EXAMPLES / "two_contacts.png").convert("L"))


class System:
    """A node that runs, and a client: it sends images and keeps what is published."""

    def __init__(self, sensor, name="finger", **options):
        options = {"sensor": str(sensor), "frame_id": "", **options}
        given = [Parameter(key, value=value) for key, value in options.items()]
        self.node = TrackerNode(namespace=f"/{name}", parameter_overrides=given)
        self.client, self.got = (
            rclpy.create_node("client", namespace=f"/{name}"),
            {topic: [] for topic in [*KINDS, "diagnostics"]},
        )
        for topic, kind in KINDS.items():
            self.client.create_subscription(kind, f"torchmembrane/{topic}", self.got[topic].append, 10)
        self.client.create_subscription(DiagnosticArray, "/diagnostics", self.got["diagnostics"].append, 10)
        self.executor = SingleThreadedExecutor()
        for each in (self.node, self.client):
            self.executor.add_node(each)
        self.spinning = Thread(target=self.executor.spin, daemon=True)
        self.spinning.start()

    def start(self):
        assert self.node.trigger_configure() == SUCCESS and self.node.trigger_activate() == SUCCESS
        return self

    def publisher(self, kind=Image, topic="image", reliability=RELIABLE):
        publisher = self.client.create_publisher(kind, topic, QoSProfile(depth=5, reliability=reliability))
        self.until(lambda: publisher.get_subscription_count() > 0)
        return publisher

    def until(self, condition):
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, "nothing came"
            time.sleep(0.02)

    def followed(self):
        """Images so far, those that were refused too."""
        return self.node.health.refused + len(self.got["status"])

    def call(self, kind, service, request):
        client = self.client.create_client(kind, service)
        assert client.wait_for_service(PATIENCE)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def stop(self):
        self.node.trigger_shutdown()
        self.executor.shutdown()
        self.spinning.join()
        for each in (self.client, self.node):
            each.destroy_node()


@pytest.fixture
def system_of():
    made = []

    def system(*args, **options):
        made.append(System(*args, **options))
        return made[-1]

    yield system
    for each in made:
        each.stop()


@pytest.fixture
def system(system_of, sensor):
    return system_of(sensor).start()


def image(levels, encoding="mono8", sec=7):
    height, width = levels.shape[:2]
    message = Image(height=height, width=width, encoding=encoding, step=levels.nbytes // height, data=levels.tobytes())
    message.header.stamp.sec, message.header.frame_id = sec, "finger_optical"
    return message


def xyz(vector):
    return [vector.x, vector.y, vector.z]


def cloud(message):
    return np.frombuffer(message.data, "<f4").reshape(message.width, -1)


def test_an_image_s_messages_are_the_tracker_s_result(system, sensor, levels):
    system.publisher().publish(image(np.repeat(levels[..., None], 3, -1), "bgr8"))
    system.until(lambda: all(system.got[topic] for topic in KINDS if topic != "pressure"))
    frame = tm.Tracker(tm.Reconstructor.from_file(sensor))(to_grey(levels)).frame(0)
    wrench, deviation, points, contacts, status = (system.got[topic][0] for topic in KINDS if topic != "pressure")
    for message in (wrench, deviation, points, contacts, status):
        assert message.header.stamp.sec == 7 and message.header.frame_id == "finger_optical"
    np.testing.assert_allclose(xyz(wrench.wrench.force), frame["force"], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(xyz(wrench.wrench.torque), frame["wrench"][3:] / 1000, rtol=1e-3, atol=1e-6)  # N mm to N m
    np.testing.assert_allclose(xyz(deviation.vector), frame["force_deviation"], rtol=1e-3)
    np.testing.assert_allclose(cloud(points)[:, :3], frame["vertices"] / 1000, atol=1e-7)
    assert [field.name for field in points.fields] == "x y z normal_traction shear_x shear_y shear_z".split()
    found = frame["contact_points"][np.isfinite(frame["contact_points"]).all(-1)]
    assert len(found) == 2 and status.status[0].level == b"\0" and status.status[0].message == "ok"
    np.testing.assert_allclose(cloud(contacts)[:, :3], found / 1000, atol=1e-5)


def test_bags_have_the_topics_of_the_node(system):
    topics = {name for name, _ in system.client.get_topic_names_and_types() if name.startswith("/finger/torchmembrane/")}
    own = {f"/finger/torchmembrane/{name}" for name in TOPICS}
    assert KINDS.keys() == TOPICS.keys() and own <= topics
    sent = {name for name in own if system.client.count_publishers(name)}
    assert sent == own - {"/finger/torchmembrane/pressure"}  # a liquid's absolute pressure is not known


def test_of_a_gas_the_absolute_pressure_is_published(system_of, sensor, levels, tmp_path):
    gas = replace(tm.Sensor.from_file(sensor), cavity=Cavity("gas", pressure=1013.0))
    gas = replace(gas, membrane=gas.surface.membrane((9, 9)))
    system = system_of(gas.to_file(tmp_path / "sensor.toml")).start()
    system.publisher().publish(image(levels))
    system.until(lambda: system.got["pressure"])
    change = tm.Tracker(tm.Reconstructor(gas))(to_grey(levels)).pressure_change.item()
    assert change > 0 and system.got["pressure"][0].fluid_pressure == pytest.approx(101300 + 1e6 * change, rel=1e-5)  # Pa


def test_compressed_images_are_followed(system_of, sensor):
    system = system_of(sensor, compressed=True).start()
    system.publisher(CompressedImage).publish(CompressedImage(format="png", data=(EXAMPLES / "two_contacts.png").read_bytes()))
    system.until(lambda: system.got["wrench"])


def test_the_node_subscribes_when_nothing_is_left_to_compile(system_of, sensor, monkeypatch):
    seen = []

    def warm_up(tracker):
        seen.append(system.client.count_subscribers("/finger/image"))

    monkeypatch.setattr(tm.Tracker, "warm_up", warm_up)
    system = system_of(sensor)
    system.start().publisher()
    assert seen == [0]


def test_it_lives_the_lives_of_a_lifecycle_node(system, levels):
    sent = system.publisher()
    sent.publish(image(levels))
    system.until(lambda: system.got["wrench"])
    assert system.node.trigger_deactivate() == SUCCESS
    system.until(lambda: sent.get_subscription_count() == 0)
    assert system.node.trigger_activate() == SUCCESS
    system.until(lambda: sent.get_subscription_count() == 1)
    sent.publish(image(levels))
    system.until(lambda: len(system.got["wrench"]) == 2)
    assert system.node.trigger_deactivate() == SUCCESS and system.node.trigger_cleanup() == SUCCESS
    system.until(lambda: system.client.count_publishers("/finger/torchmembrane/wrench") == 0)
    assert system.node.trigger_configure() == SUCCESS


@pytest.mark.parametrize("options, said", [
    (dict(sensor="nonsense.toml"), "nonsense.toml"),
    (dict(reliability="perhaps"), "expected one of auto, reliable, best_effort"),
    (dict(tool_frame="flange"), "flange without frame_id"),
    (dict(tool_frame="flange", frame_id="camera"), "has no [tool]"),
])  # fmt: skip
def test_what_is_wrong_is_said_and_the_node_stays_unconfigured(system_of, sensor, options, said, capfd):
    system = system_of(**{"sensor": sensor, **options})
    assert system.node.trigger_configure() == FAILURE and said in capfd.readouterr().err


@pytest.fixture(scope="module")
def mirrored(tmp_path_factory):
    """A file of the example's sensor with two views, both the same region of one image, or each with images of its own."""

    def path_of(is_region):
        one = tm.Sensor.from_file(EXAMPLES / "sensor.toml")
        width, height = one.image_size
        lens = one.camera.focal.tolist(), one.camera.centre.tolist(), one.camera.distortion.tolist()
        whole = tm.Camera(one.camera.model, (width + 100, height), *lens)
        camera = whole.in_mode((0, 0, width, height)) if is_region else one.camera
        views = tuple(View(name, camera, rest_image=one.markers.rest_image, is_region=is_region) for name in ("a", "b"))
        markers = replace(one.markers, rest_image=None)
        two = replace(one, membrane=one.surface.membrane((9, 9)), camera=camera, markers=markers, views=views)
        return two.to_file(tmp_path_factory.mktemp("views") / "sensor.toml")

    return path_of


def test_views_that_share_an_image_are_followed_in_it(system_of, mirrored, levels):
    system = system_of(mirrored(is_region=True)).start()
    system.publisher().publish(image(np.pad(levels, ((0, 0), (0, 100)))))
    system.until(lambda: system.followed())
    assert system.node.health.refused == 0 and len(system.got["status"]) == 1
    info = CameraInfo(width=740, height=480)
    system.publisher(CameraInfo, "camera_info").publish(info)
    system.until(lambda: system.node.compared)


def test_views_with_images_of_their_own_are_refused_at_once(system_of, mirrored, capfd):
    assert system_of(mirrored(is_region=False)).node.trigger_configure() == FAILURE
    assert "views a, b have images of their own" in capfd.readouterr().err


def test_relative_forces_are_no_newtons(system_of, sensor, tmp_path, capfd):
    full = tm.Sensor.from_file(sensor)
    relative = replace(full, material=replace(full.material, shear_modulus=None, thickness=None))
    assert system_of(relative.to_file(tmp_path / "sensor.toml")).node.trigger_configure() == FAILURE
    assert "are relative, but messages are in newtons" in capfd.readouterr().err


def test_parameters_are_described_and_do_not_change(system):
    told = system.call(
        DescribeParameters, "torchmembrane/describe_parameters", DescribeParameters.Request(names=list(PARAMETERS))
    )
    assert all(each.description and each.read_only for each in told.descriptors)
    assert [each.integer_range[0].to_value for each in told.descriptors if each.name == "depth"] == [1000]
    wanted = [Parameter("sensor", value="nonsense").to_parameter_msg()]
    (answer,) = system.call(SetParameters, "torchmembrane/set_parameters", SetParameters.Request(parameters=wanted)).results
    assert not answer.successful and "read-only" in answer.reason


def test_images_that_cannot_be_followed_are_said_once_and_counted(system, levels, capfd):
    sent = system.publisher()
    for each in 4 * [levels[:-1], 0 * levels]:
        done = system.followed()
        sent.publish(image(each))
        system.until(lambda done=done: system.followed() > done)
    said = capfd.readouterr().err
    assert said.count("479 px") == 1 and said.count(tm.Status.BLANK.text) == 1
    assert system.got["wrench"] == [] and {each.status[0].level for each in system.got["status"]} == {b"\2"}
    before = len(system.got["diagnostics"])
    system.until(lambda: len(system.got["diagnostics"]) > before + 1)
    told = {each.key: each.value for each in system.got["diagnostics"][-1].status[0].values}
    assert (told["images received"], told["images followed"], told["images refused"]) == ("8", "4", "4")
    assert told[f"status 4: {tm.Status.BLANK.text}"] == "4" and told["age of the sensor file, days"] == "0"


def test_the_age_of_a_recorded_calibration_is_told(sensor):
    dated = replace(tm.Sensor.from_file(sensor), record=Record("A17", date.today() - timedelta(days=40)))
    told = {each.fields["key"]: each.fields["value"] for each in Health(dated, sensor).message(0, 0.0).fields["values"]}
    assert (told["serial"], told["age of the calibration, days"]) == ("A17", "40")


def test_diagnostics_tell_rate_and_latency(system, levels):
    sent = system.publisher()
    for _ in range(10):
        message = image(levels)
        message.header.stamp = system.client.get_clock().now().to_msg()
        sent.publish(message)
        time.sleep(0.1)
    before = len(system.got["diagnostics"])
    system.until(lambda: len(system.got["diagnostics"]) > before)
    (status,) = system.got["diagnostics"][-1].status
    told = {each.key: each.value for each in status.values}
    assert status.level == b"\0" and 3 < float(told["rate, Hz"]) < 12 and 0 < float(told["latency, ms (median)"]) < 2000


def test_rezero_takes_the_latest_image(system, levels):
    early = system.call(Trigger, "torchmembrane/rezero", Trigger.Request())
    assert not early.success and "no frame yet" in early.message
    sent = system.publisher()
    sent.publish(image(levels))
    system.until(lambda: system.got["wrench"])
    told = system.call(Trigger, "torchmembrane/rezero", Trigger.Request())
    assert told.success and "a contact of" in told.message
    sent.publish(image(levels))
    system.until(lambda: len(system.got["wrench"]) == 2)
    assert max(abs(each) for each in xyz(system.got["wrench"][1].wrench.force)) < 0.05


def test_rezero_says_where_the_latest_image_is_old(system, levels, monkeypatch):
    sent = system.publisher()
    sent.publish(image(np.asarray(Picture.open(EXAMPLES / "rest.png").convert("L"))))
    system.until(lambda: system.got["wrench"])
    monkeypatch.setattr("torchmembrane_ros.node.SILENT", 0.1)
    time.sleep(0.6)
    told = system.call(Trigger, "torchmembrane/rezero", Trigger.Request())
    assert told.success and "s old, and no later one could be followed" in told.message


def test_stamps_that_no_clock_gives_do_not_stop_the_node(system, levels):
    """Zero, as of a driver that sets none, tells no latency; a negative one, as of a clock that was never set, neither."""
    sent = system.publisher()
    for k, sec in enumerate((-5, 0)):
        sent.publish(image(levels, sec=sec))
        system.until(lambda k=k: len(system.got["wrench"]) == k + 1)
    told = {each.fields["key"]: each.fields["value"] for each in system.node.health.message(2, 0.0).fields["values"]}
    assert told["latency, ms (median)"] == "nan" and told["images followed"] == "2"
    message = image(levels)
    message.header.stamp = system.client.get_clock().now().to_msg()
    sent.publish(message)
    system.until(lambda: len(system.got["wrench"]) == 3)
    told = {each.fields["key"]: each.fields["value"] for each in system.node.health.message(3, 0.0).fields["values"]}
    assert 0 < float(told["latency, ms (median)"]) < 5000


def test_an_error_of_one_image_does_not_end_the_node(system, levels, monkeypatch, capfd):
    sent, follow = system.publisher(), system.node.follow

    def follow_but_first(message):
        if message.header.stamp.sec == 1:
            raise RuntimeError("out of memory")
        follow(message)

    monkeypatch.setattr(system.node, "follow", follow_but_first)
    sent.publish(image(levels, sec=1))
    system.until(lambda: system.node.health.refused == 1)
    sent.publish(image(levels))
    system.until(lambda: system.got["wrench"])
    assert "RuntimeError: out of memory" in capfd.readouterr().err


def test_a_camera_that_is_lost_is_no_camera_whose_images_are_refused(sensor, monkeypatch):
    """One image was refused once; afterwards images were followed, and then none came."""
    health, now = Health(tm.Sensor.from_file(sensor), sensor), [0.0]
    monkeypatch.setattr("torchmembrane_ros.health.time.monotonic", lambda: now[0])
    health.refuse()
    said = health.message(1, 0.0).fields["message"]
    health.add(0.1, tm.Status.OK)
    now[0] = 60.0
    lost = health.message(2, 0.0).fields["message"]
    health.refuse()
    assert (said, lost) == ("images come, none can be followed", "no images come")
    assert health.message(3, 0.0).fields["message"] == "images come, none can be followed"


def test_an_image_of_few_bits_is_said_to_be_one(system, levels, capfd):
    """10 bits in 16 that the sensor file does not state: the image is too dark to show dots."""
    rng = np.random.default_rng(0)
    system.publisher().publish(image(4 * levels.astype("<u2") + rng.integers(0, 4, levels.shape, dtype="<u2"), "mono16"))
    system.until(lambda: system.got["status"])
    assert "bits = 10" in capfd.readouterr().err


def test_images_of_another_type_are_said_to_be_of_one(system, capfd):
    apart = rclpy.Context()  # as of another process: within one, a topic has one type
    rclpy.init(context=apart)
    camera = rclpy.create_node("camera", context=apart)
    camera.create_publisher(CompressedImage, "/finger/image", 5)
    said = (
        "/finger/image carries sensor_msgs/msg/CompressedImage; expected sensor_msgs/msg/Image, as the parameter compressed is"
    )
    heard = []
    system.until(lambda: heard.append(capfd.readouterr().err) or said in "".join(heard))
    camera.destroy_node()
    rclpy.shutdown(context=apart)


def test_the_subscription_is_what_publishers_offer(system, levels):
    """Reliable, so that no colour image is lost, and best effort where a publisher offers no more."""
    assert system.node.reliability == RELIABLE
    sent = system.client.create_publisher(Image, "image", QoSProfile(depth=5, reliability=BEST_EFFORT))
    system.until(lambda: sent.get_subscription_count() > 0)
    assert system.node.reliability == BEST_EFFORT


def test_colour_images_of_a_reliable_publisher_all_arrive(system, levels):
    sent, colour = system.publisher(), np.repeat(levels[..., None], 3, -1)
    for k in range(20):
        sent.publish(image(colour, "bgr8", sec=k))
        time.sleep(0.05)
    system.until(lambda: system.node.mailbox.captured == 20)


def test_a_camera_info_that_disagrees_is_said_once(system, sensor, capfd):
    camera = tm.Sensor.from_file(sensor).camera
    sent = system.publisher(CameraInfo, "camera_info")
    (f, g), (u, v) = camera.focal.tolist(), camera.centre.tolist()
    info = CameraInfo(
        width=640, height=480, distortion_model="equidistant", d=[0.0] * 4, k=[f, 0.0, u + 3, 0.0, g, v, 0.0, 0.0, 1.0]
    )
    for _ in range(3):
        sent.publish(info)
    system.until(lambda: system.node.compared)
    time.sleep(0.3)
    assert capfd.readouterr().err.count("CameraInfo") == 1


def test_the_transform_is_the_camera_s_pose_on_the_tool(sensor):
    tool = tm.Pose(np.array([10.0, 120.0, -40.0]), np.array([1.5, 0.0, 30.0]))
    made = transform_of(replace(tm.Sensor.from_file(sensor), tool=tool), "flange", "camera")
    assert (made.header.frame_id, made.child_frame_id) == ("flange", "camera")
    np.testing.assert_allclose(xyz(made.transform.translation), [0.0015, 0, 0.03])
    x, y, z, w = (getattr(made.transform.rotation, each) for each in "xyzw")
    turned = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    np.testing.assert_allclose(turned, tool.rotation, atol=1e-9)
    assert np.linalg.norm(quaternion(np.eye(3))) == pytest.approx(1) and abs(quaternion(np.eye(3))[3]) == pytest.approx(1)


@pytest.mark.parametrize("ended", [True, False])
def test_an_end_while_a_message_is_on_its_way_is_no_error(monkeypatch, ended):
    """As rclpy has it: SIGTERM makes publishers invalid at once, also for a timer that is publishing."""

    def spin(_):
        raise RuntimeError("publisher's context is invalid")

    nothing = lambda *_: None  # noqa: E731
    stand_in = SimpleNamespace(init=nothing, spin=spin, try_shutdown=nothing, ok=lambda: not ended, executors=rclpy.executors)
    monkeypatch.setattr("torchmembrane_ros.node.rclpy", stand_in)
    given = SimpleNamespace(value=False)
    node = SimpleNamespace(get_parameter=lambda _: given, stop=nothing, destroy_node=nothing)
    monkeypatch.setattr("torchmembrane_ros.node.TrackerNode", lambda: node)
    with nullcontext() if ended else pytest.raises(RuntimeError, match="context is invalid"):
        main()


class Sent(type(TransformStamped)):
    """Of a stand-in for `tf2_msgs/TFMessage`, which PyPI has not: a message of its first transform."""

    def __instancecheck__(cls, message):
        return isinstance(message, TransformStamped)

    def __call__(cls, transforms):
        return transforms[0]


class OneTransform(TransformStamped, metaclass=Sent):
    pass


def test_transforms_of_two_fingers_reach_a_listener_that_comes_later(system_of, sensor, monkeypatch):
    check_for_type_support(TransformStamped)
    messages = ModuleType("tf2_msgs.msg")
    messages.TFMessage = OneTransform
    monkeypatch.setitem(sys.modules, "tf2_msgs", ModuleType("tf2_msgs"))
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", messages)
    path = sensor.with_name("tool.toml")
    path.write_text(sensor.read_text() + "\n[tool]\nrotation = [0, 90, 0]\ntranslation = [1.5, 0, 30]\n")
    for finger in ("left", "right"):
        system = system_of(path, finger, tool_frame=f"{finger}_flange", frame_id=f"{finger}_camera")
        assert system.node.trigger_configure() == SUCCESS
    kept = []
    latched = QoSProfile(depth=10, reliability=RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    system.client.create_subscription(TransformStamped, "/tf_static", kept.append, latched)
    system.until(lambda: len(kept) == 2)
    assert {(each.header.frame_id, each.child_frame_id) for each in kept} == {
        ("left_flange", "left_camera"),
        ("right_flange", "right_camera"),
    }
    np.testing.assert_allclose(xyz(kept[0].transform.translation), [0.0015, 0, 0.03])
    assert system.node.trigger_cleanup() == SUCCESS  # the pose of a sensor that is let go of reaches no later listener
    system.until(lambda: system.client.count_publishers("/tf_static") == 1)


def launched(name, monkeypatch, **arguments):
    """Nodes that a launch file starts, beside stand-ins of the packages launch and launch_ros, which PyPI has not."""
    made = {"LaunchDescription": list, "DeclareLaunchArgument": lambda name, **_: None, "LaunchConfiguration": arguments.get}
    modules = ["launch", "launch.actions", "launch.substitutions", "launch_ros", "launch_ros.actions"]
    for module in modules:
        stand_in = ModuleType(module)
        stand_in.__dict__.update(made, Node=lambda **options: SimpleNamespace(**options))
        monkeypatch.setitem(sys.modules, module, stand_in)
    scope = {}
    exec((PACKAGE / "launch" / name).read_text(), scope)
    return [each for each in scope["generate_launch_description"]() if each]


def test_two_fingers_of_one_launch_file_follow_their_own_cameras(sensor, levels, monkeypatch):
    nodes = launched("two_fingers.launch.py", monkeypatch, left=str(sensor), right=str(sensor))
    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{PACKAGE}", "OMP_NUM_THREADS": "1"}
    client = rclpy.create_node("client")
    running = []
    for each in nodes:
        ((name, value),) = each.parameters[0].items()
        ((old, new),) = each.remappings
        told = ["--ros-args", "--params-file", str(PACKAGE / "config/torchmembrane.yaml")]
        told += ["-p", f"{name}:={value}", "-r", f"__ns:=/{each.namespace}", "-r", f"{old}:={new}"]
        start = [sys.executable, "-c", "from torchmembrane_ros.node import main; main()", *told]
        running.append(subprocess.Popen(start, env=environment))
    try:
        got = {each.namespace: [] for each in nodes}
        for finger, kept in got.items():
            client.create_subscription(WrenchStamped, f"/{finger}/torchmembrane/wrench", kept.append, 10)
        sent = {finger: client.create_publisher(Image, f"/{finger}/image_raw", 5) for finger in got}
        end = time.monotonic() + 120
        while not all(got.values()) and time.monotonic() < end:
            for publisher, each in zip(sent.values(), (levels, np.asarray(Picture.open(EXAMPLES / "rest.png"))), strict=True):
                publisher.publish(image(each))
            rclpy.spin_once(client, timeout_sec=0.2)
        left, right = (np.linalg.norm(xyz(each[-1].wrench.force)) for each in got.values())
        assert left > 1 > 0.2 > right  # N: the left finger is pressed, the right one is not
    finally:
        for each in running:
            each.terminate()
        assert [each.wait(30) for each in running] == [0, 0]
        client.destroy_node()


def test_one_finger_s_launch_file_names_the_node_s_parameters(monkeypatch):
    (node,) = launched(
        "torchmembrane.launch.py", monkeypatch, sensor="s.toml", frame_id="", namespace="finger", image="image_raw"
    )
    assert (
        node.namespace == "finger"
        and node.remappings == [("image", "image_raw")]
        and node.parameters[0].keys() <= PARAMETERS.keys()
    )
