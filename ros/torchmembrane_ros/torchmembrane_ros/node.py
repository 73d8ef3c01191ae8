"""The node: it reconstructs the newest image and publishes the result; images that arrive in the meantime are dropped.

ros2 run torchmembrane_ros tracker --ros-args -p sensor:=sensor.toml -r image:=/finger/image_raw

It is a lifecycle node. In the configured state it has read the sensor file and compiled the code that the first image needs; in
the active state it subscribes, and publishes `~/wrench`, `~/force_deviation`, `~/points`, `~/contacts`, `~/status` and, for a
gas, `~/pressure` with the header of the image, and its own state on `/diagnostics`. The first CameraInfo beside the images is
compared with the sensor file. The service `~/rezero` (std_srvs/Trigger) takes the latest image as the rest state.
"""

import time
import warnings
from math import inf, nan
from pathlib import Path
from threading import Lock, Thread
from typing import Any

import rclpy
import rclpy.executors
import rclpy.time
import torch
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger

import torchmembrane as tm
from torchmembrane.files.levels import too_few_bits
from torchmembrane.integrations.frame_messages import TOPICS, SiUnits
from torchmembrane.integrations.messages import camera_mismatch, grey_of, info_topic
from torchmembrane.live.mailbox import Mailbox
from torchmembrane.results.store import Mesh, Settings

from . import parameters
from .health import SILENT, Health
from .outgoing import make, transform_of, type_of

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
AGAIN = 10.0
"""Seconds before the same warning is logged again."""
PERIOD = 1.0
"""Seconds between two messages on /diagnostics."""
WAIT = 0.1
"""Seconds after which the computing thread checks whether to stop."""


class TrackerNode(LifecycleNode):
    """Node for one sensor's camera. A thread computes from the newest image; the executor's thread stays free for callbacks."""

    def __init__(self, **options: Any) -> None:
        super().__init__("torchmembrane", **options)
        parameters.declare(self)
        self.lock = Lock()  # of the tracker
        self.outputs: dict[str, Any] = {}
        self.subscriptions_made: list[Any] = []
        self.thread: Thread | None = None
        self.transforms: Any = None
        self.followed_at = -inf

    def on_configure(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Read the sensor file and prepare for images."""
        try:
            self._configure()
        except tm.MembraneError as error:
            self.get_logger().error(str(error))
            self._release()
            return FAILURE
        except Exception as error:  # rclpy goes on to on_error without a word
            self.get_logger().error(f"{type(error).__name__}: {error}")
            raise
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe to the images and start the computation."""
        super().on_activate(state)
        self.mailbox, self.compared = Mailbox(), False
        self.thread = Thread(target=self._compute, args=(self.mailbox,), name="compute", daemon=True)
        self.thread.start()
        newest = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        info = self.create_subscription(CameraInfo, info_topic(self.resolve_topic_name("image")), self.compare, newest)
        self.subscriptions_made = [info, self._subscribe()]
        self.timer = self.create_timer(PERIOD, self.report)
        self.get_logger().info(f"ready: {self.health.name}, waits for images on {self.resolve_topic_name('image')}")
        return SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribe from the images; the next activation starts from the rest state."""
        self.stop()
        self.tracker.reset()
        return super().on_deactivate(state)

    def on_cleanup(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Discard the sensor."""
        self._release()
        return SUCCESS

    def on_shutdown(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Stop all activity."""
        self.stop()
        self._release()
        return SUCCESS

    def on_error(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Return to the unconfigured state after an error in a transition."""
        self.stop()
        self._release()
        return SUCCESS

    def compare(self, info: CameraInfo) -> None:
        """Log how the first CameraInfo differs from the sensor file."""
        if not self.compared:
            self.compared = True
            try:
                remark = camera_mismatch(info, self.camera)
            except tm.MembraneError as error:
                remark = str(error)
            if remark:
                self.get_logger().warning(remark)

    def rezero(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Take the latest image as the rest state."""
        try:
            with self.lock, warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                self.tracker.rezero()
                age = time.monotonic() - self.followed_at
            remedy = "no later one could be followed: call again when images come"
            told = [f"the latest image is {age:.0f} s old, and {remedy}"] if age > SILENT else []
            response.success, response.message = True, "; ".join([*told, *(str(each.message) for each in said)])
        except tm.MembraneError as error:
            response.success, response.message = False, str(error)
        return response

    def report(self) -> None:
        """Publish the state of the node, and subscribe again if new image publishers offer another reliability."""
        status = self.health.message(self.mailbox.captured, self.tracker.drift).built(make)
        self.diagnostics.publish(DiagnosticArray(header=Header(stamp=self.get_clock().now().to_msg()), status=[status]))
        self._warn_of_other_types()
        if self._reliability() != self.reliability:
            self.destroy_subscription(self.subscriptions_made.pop())
            self.subscriptions_made.append(self._subscribe())

    def follow(self, message: Image | CompressedImage) -> None:
        """Reconstruct an image and publish the result."""
        try:
            grey = grey_of(message, self.camera.image_size, self.camera.bits)
            with self.lock, warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                frame = self.tracker(grey).frame(0)
                self.followed_at = time.monotonic()
        except tm.MembraneError as error:
            self.health.refuse()
            self.get_logger().warning(str(error), throttle_duration_sec=AGAIN)
            return
        for each in said:
            self.get_logger().warning(str(each.message))
        status = tm.Status(int(frame["status"]))
        if not status.has_surface:
            hint = "" if self.health.statuses[status] else too_few_bits(grey)
            self.get_logger().warning(f"{status.text}{hint}", throttle_duration_sec=AGAIN)
        header = Header(stamp=message.header.stamp, frame_id=self.get_parameter("frame_id").value or message.header.frame_id)
        for topic, each in self.units.messages(frame).items():
            self.outputs[topic].publish(each._replace(fields={"header": header, **each.fields}).built(make))
        self.health.add(self._age(message.header.stamp), status)

    def _age(self, stamp: Any) -> float:
        """Return the time since a stamp, s; NaN if the stamp is not set."""
        if stamp.sec < 0 or not (stamp.sec or stamp.nanosec):
            return nan
        age = self.get_clock().now() - rclpy.time.Time.from_msg(stamp, self.get_clock().clock_type)
        return float(age.nanoseconds / 1e9)

    def _configure(self) -> None:
        parameters.refuse_wrong(self)
        path = Path(self.get_parameter("sensor").value)
        reconstructor = tm.Reconstructor.from_file(path)
        sensor = reconstructor.sensor
        if sensor.views_apart:
            raise tm.MembraneError(
                f"{path}: the views {', '.join(sensor.views_apart)} have images of their own; expected one view, or views that "
                "are regions of one image, as the node takes the images of one topic: reconstruct a bag of all views"
            )
        (self.camera,) = sensor.image_cameras
        self.units = SiUnits(
            Mesh.from_reconstructor(reconstructor, Settings.from_reconstructor(reconstructor, "npz")), sensor.gas_pressure
        )
        tool_frame, frame_id = (self.get_parameter(name).value for name in ("tool_frame", "frame_id"))
        if tool_frame:
            self._send_transform(transform_of(sensor, tool_frame, frame_id))
        began, self.tracker = time.monotonic(), tm.Tracker(reconstructor)
        self.get_logger().info("compiles machine code where there is none yet, which takes a minute or more")
        self.tracker.warm_up()
        self.get_logger().info(f"configured in {time.monotonic() - began:.0f} s: {path}")
        self.health = Health(sensor, path)
        for name in self.units.topics():
            self.outputs[name] = self.create_lifecycle_publisher(type_of(TOPICS[name]), f"~/{name}", 5)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 5)
        self.rezero_service = self.create_service(Trigger, "~/rezero", self.rezero)

    def _send_transform(self, transform: Any) -> None:
        """Publish a transform on /tf_static, where later subscribers find it too."""
        from tf2_msgs.msg import TFMessage

        kept = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.transforms = self.create_publisher(TFMessage, "/tf_static", kept)
        self.transforms.publish(TFMessage(transforms=[transform]))

    def _warn_of_other_types(self) -> None:
        """Log that a publisher sends messages of another type on the topic of the images, which ROS drops without a word."""
        topic, is_compressed = self.resolve_topic_name("image"), self.get_parameter("compressed").value
        expected = f"sensor_msgs/msg/{'CompressedImage' if is_compressed else 'Image'}"
        others = {each.topic_type for each in self.get_publishers_info_by_topic(topic)} - {expected}
        if others:
            said = f"{topic} carries {', '.join(sorted(others))}; expected {expected}"
            self.get_logger().warning(f"{said}, as the parameter compressed is {is_compressed}", throttle_duration_sec=AGAIN)

    def _reliability(self) -> ReliabilityPolicy:
        """Return the reliability of the image subscription: as configured, or what all publishers offer."""
        asked = self.get_parameter("reliability").value
        offered = [each.qos_profile.reliability for each in self.get_publishers_info_by_topic(self.resolve_topic_name("image"))]
        is_best_effort = ReliabilityPolicy.BEST_EFFORT in offered if asked == "auto" else asked == "best_effort"
        return ReliabilityPolicy.BEST_EFFORT if is_best_effort else ReliabilityPolicy.RELIABLE

    def _subscribe(self) -> Any:
        self.reliability = self._reliability()
        depth = self.get_parameter("depth").value
        quality = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=self.reliability)
        kind = CompressedImage if self.get_parameter("compressed").value else Image
        return self.create_subscription(kind, "image", self.mailbox.put, quality)

    def _compute(self, mailbox: Mailbox) -> None:
        while not mailbox.ended and self.context.ok():
            picture = mailbox.take(WAIT)
            if picture is not None:
                try:
                    self.follow(picture.image)
                except Exception as error:  # of whatever kind: the next image may be better
                    if self.context.ok():  # else ROS was ended while a message was on its way
                        self.health.refuse()
                        self.get_logger().error(f"{type(error).__name__}: {error}", throttle_duration_sec=AGAIN)

    def stop(self) -> None:
        """Stop the thread and unsubscribe from the images."""
        if self.thread is not None:
            self.mailbox.end()
            self.thread.join()
            self.thread = None
            self.destroy_timer(self.timer)
            while self.subscriptions_made:
                self.destroy_subscription(self.subscriptions_made.pop())

    def _release(self) -> None:
        for publisher in self.outputs.values():
            self.destroy_lifecycle_publisher(publisher)
        if self.outputs:
            self.destroy_publisher(self.diagnostics)
            self.destroy_service(self.rezero_service)
        if self.transforms is not None:
            self.destroy_publisher(self.transforms)
        self.outputs, self.transforms = {}, None


def main() -> None:
    """Run the node until it is interrupted."""
    torch.set_num_threads(1)
    rclpy.init()
    node = TrackerNode()
    try:
        if node.get_parameter("autostart").value:
            if node.trigger_configure() != SUCCESS:
                raise SystemExit("torchmembrane: not configured; the error above says why")
            node.trigger_activate()
        rclpy.spin(node)
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        pass
    except Exception:
        if rclpy.ok():  # else ROS was ended while a message was on its way
            raise
    finally:
        node.stop()
        node.destroy_node()
        rclpy.try_shutdown()
