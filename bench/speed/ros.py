"""Wrenches received and their latency from the node of ROS 2, over loopback, from colour images of 30 Hz.

python -m bench.speed.ros [--frames 600] [--grid 17 17] [--best-effort] [--json FILE]

In `.venv-ros` (`make test-ros`). The preset fingertip is pressed and dragged as in `bench.speed.live`, 640 x 480 px, and sent
as `bgr8`; the node is a process of its own. Printed: images sent, wrenches received, and the time from an image's stamp, just
before it is sent, to the arrival of its wrench, median and 99 %; the node's processor time for each wrench; the machine's
load, other programs' included. The publisher is reliable, or `--best-effort`.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from array import array
from dataclasses import replace
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

import torchmembrane as tm
from bench.data.record import write
from bench.speed.live import RATE, rendered, to_and_fro

NODE = Path(__file__).parents[2] / "ros/torchmembrane_ros"
READY, LAST = 300.0, 3.0
"""Seconds for the node to get ready, machine code compiled, and for the last wrenches to arrive."""


def messages(images: list[np.ndarray]) -> list[Image]:
    """Colour images, as cameras send them."""
    height, width = images[0].shape
    levels = (np.repeat(each[..., None], 3, -1) for each in images)
    return [
        Image(height=height, width=width, encoding="bgr8", step=3 * width, data=array("B", each.tobytes())) for each in levels
    ]


def processor_seconds(process: int) -> float:
    """That a process has taken so far."""
    user, system = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def measured(node: Node, process: int, images: list[Image], frames: int, quality: QoSProfile) -> dict:
    """Send the images to the node of this process, and wait for their wrenches."""
    publisher = node.create_publisher(Image, "/image", quality)
    latencies: list[float] = []

    def received(message: WrenchStamped) -> None:
        sent = message.header.stamp.sec + message.header.stamp.nanosec / 1e9
        latencies.append(node.get_clock().now().nanoseconds / 1e9 - sent)

    node.create_subscription(WrenchStamped, "/torchmembrane/wrench", received, 100)
    end = time.monotonic() + READY
    while publisher.get_subscription_count() == 0 and time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)
    time.sleep(2.0)
    began = processor_seconds(process)
    due, source = time.monotonic(), to_and_fro(images)
    for _ in range(frames):
        while (left := due - time.monotonic()) > 0:
            rclpy.spin_once(node, timeout_sec=left)
        image = next(source)
        image.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(image)
        due += 1 / RATE
    end = time.monotonic() + LAST
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)
    found = np.percentile(1000 * np.array(latencies), [50, 99]) if latencies else (np.nan, np.nan)
    spent = 1000 * (processor_seconds(process) - began) / max(len(latencies), 1)
    times = dict(median_ms=float(found[0]), most_ms=float(found[1]), processor_ms=spent)
    return dict(sent=frames, received=len(latencies), **times, load=os.getloadavg()[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--grid", type=int, nargs=2, default=(17, 17))
    parser.add_argument("--best-effort", action="store_true")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    sensor = tm.preset("fingertip")
    sensor = replace(sensor, membrane=sensor.surface.membrane(tuple(args.grid)))
    images = messages(rendered(sensor))
    reliability = ReliabilityPolicy.BEST_EFFORT if args.best_effort else ReliabilityPolicy.RELIABLE
    with tempfile.TemporaryDirectory() as folder:
        path = sensor.to_file(Path(folder) / "sensor.toml")
        command = [
            sys.executable,
            "-c",
            "from torchmembrane_ros.node import main; main()",
            "--ros-args",
            "-p",
            f"sensor:={path}",
        ]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(NODE), os.environ.get("PYTHONPATH", "")])}
        rclpy.init()
        with subprocess.Popen(command, env=environment) as running:
            quality = QoSProfile(depth=5, reliability=reliability)
            result = measured(rclpy.create_node("camera"), running.pid, images, args.frames, quality)
            running.terminate()
        rclpy.try_shutdown()
    print("sent {sent}, wrenches received {received}; ms: median {median_ms:.0f}, 99 % {most_ms:.0f}".format(**result))
    print("the node's processor time for each {processor_ms:.0f} ms; load {load:.1f}".format(**result))
    write(args.json, result)


if __name__ == "__main__":
    main()
