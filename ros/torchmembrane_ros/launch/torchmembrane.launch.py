"""One sensor: ros2 launch torchmembrane_ros torchmembrane.launch.py namespace:=finger sensor:=/path/sensor.toml

Its camera publishes /finger/image_raw, or `image:=TOPIC`; results are on /finger/torchmembrane/wrench and so on.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return the launch description of one node, in the namespace of its finger."""
    declared = [
        DeclareLaunchArgument("namespace", default_value="finger"),
        DeclareLaunchArgument("sensor", description="path of the sensor file"),
        DeclareLaunchArgument("image", default_value="image_raw", description="topic of the images"),
        DeclareLaunchArgument("frame_id", default_value="", description="frame of what is published; empty: the image's"),
    ]
    node = Node(
        package="torchmembrane_ros",
        executable="tracker",
        namespace=LaunchConfiguration("namespace"),
        parameters=[{name: LaunchConfiguration(name) for name in ("sensor", "frame_id")}],
        remappings=[("image", LaunchConfiguration("image"))],
        output="screen",
    )
    return LaunchDescription([*declared, node])
