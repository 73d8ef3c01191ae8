"""The node: newest image in, messages out; what arrives meanwhile is dropped.

ros2 run torchmembrane_ros tracker --ros-args -p sensor:=sensor.toml -r image:=/finger/image_raw

Parameters: `sensor`, the sensor file; `compressed`, whether `image` is a CompressedImage. Publishes `wrench`, `points` and, of
a gas, `pressure`, with the image's header. A frame without a surface is logged and nothing is published. The first CameraInfo
beside the images is compared with the sensor file, and what disagrees is logged. The service `rezero` (std_srvs/Trigger) takes
the latest image for the rest state.
"""

import warnings
from array import array

import rclpy
import torch
from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, FluidPressure, Image, PointCloud2, PointField
from std_srvs.srv import Trigger

import torchmembrane as tm
from torchmembrane.integrations.messages import POINT_FIELDS, SiUnits, cloud_layout, grey_of, has_wrench, info_topic, unlike
from torchmembrane.results.store import Mesh, Settings

FIELDS = [PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1) for k, name in enumerate(POINT_FIELDS)]
NEWEST = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class TrackerNode(Node):
    """Follows one sensor's camera."""

    def __init__(self) -> None:
        super().__init__("torchmembrane")
        reconstructor = tm.Reconstructor.from_file(self.declare_parameter("sensor", "sensor.toml").value)
        self.tracker = tm.Tracker(reconstructor)
        self.camera = reconstructor.sensor.camera
        self.compared = False
        mesh = Mesh.of(reconstructor, Settings.of(reconstructor, "npz"))
        self.units = SiUnits(mesh, reconstructor.sensor.gas_pressure)
        kind = CompressedImage if self.declare_parameter("compressed", False).value else Image
        self.wrenches = self.create_publisher(WrenchStamped, "wrench", 1)
        self.clouds = self.create_publisher(PointCloud2, "points", 1)
        self.pressures = self.create_publisher(FluidPressure, "pressure", 1)
        self.create_subscription(CameraInfo, info_topic(self.resolve_topic_name("image")), self.compare, NEWEST)
        self.create_subscription(kind, "image", self.follow, NEWEST)
        self.create_service(Trigger, "rezero", self.rezero)

    def follow(self, message: Image | CompressedImage) -> None:
        """Reconstruct an image, and publish what it gives."""
        try:
            frame = self.tracker(grey_of(message, self.camera.image_size, self.camera.bits)).frame(0)
        except tm.MembraneError as error:
            self.get_logger().warning(str(error))
            return
        if not has_wrench(frame):
            self.get_logger().warning(tm.Status(int(frame["status"])).text)
            return
        force, torque = (Vector3(x=x, y=y, z=z) for x, y, z in (each.tolist() for each in self.units.wrench(frame)))
        self.wrenches.publish(WrenchStamped(header=message.header, wrench=Wrench(force=force, torque=torque)))
        layout = cloud_layout(self.units.points(frame))
        layout |= {"data": array("B", layout["data"]), "fields": FIELDS}  # bytes would be checked one by one
        self.clouds.publish(PointCloud2(header=message.header, **layout))
        pressure = self.units.pressure(frame)
        if pressure is not None:
            self.pressures.publish(FluidPressure(header=message.header, fluid_pressure=pressure, variance=0.0))

    def compare(self, info: CameraInfo) -> None:
        """Say what the first CameraInfo has otherwise than the sensor file."""
        if not self.compared:
            self.compared = True
            try:
                remark = unlike(info, self.camera)
            except tm.MembraneError as error:
                remark = str(error)
            if remark:
                self.get_logger().warning(remark)

    def rezero(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Take the latest image for the rest state."""
        try:
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                self.tracker.rezero()
            response.success, response.message = True, "; ".join(str(each.message) for each in said)
        except tm.MembraneError as error:
            response.success, response.message = False, str(error)
        return response


def main() -> None:
    """Spin until interrupted."""
    torch.set_num_threads(1)
    rclpy.init()
    try:
        rclpy.spin(TrackerNode())
    except KeyboardInterrupt:
        pass
    except tm.MembraneError as error:  # of the sensor file, or its forces are relative
        raise SystemExit(f"torchmembrane: error: {error}") from error
    finally:
        rclpy.try_shutdown()
