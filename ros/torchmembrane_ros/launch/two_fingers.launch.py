"""Two sensors: ros2 launch torchmembrane_ros two_fingers.launch.py left:=/path/left.toml right:=/path/right.toml

Their cameras publish /left/image_raw and /right/image_raw; results are on /left/torchmembrane/wrench and so on.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return the launch description of two nodes, each in the namespace of its finger."""
    fingers = ("left", "right")
    declared = [DeclareLaunchArgument(finger, description=f"sensor file of the {finger} finger") for finger in fingers]
    nodes = [
        Node(
            package="torchmembrane_ros",
            executable="tracker",
            namespace=finger,
            parameters=[{"sensor": LaunchConfiguration(finger)}],
            remappings=[("image", "image_raw")],
            output="screen",
        )
        for finger in fingers
    ]
    return LaunchDescription([*declared, *nodes])
