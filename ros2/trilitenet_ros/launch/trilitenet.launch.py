"""Start the node: ``image`` names the camera's topic, ``parameters`` a file in place of config/trilitenet.yaml."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    """Return what ``ros2 launch`` runs."""
    parameters = Path(get_package_share_directory("trilitenet_ros")) / "config" / "trilitenet.yaml"
    return LaunchDescription(
        [
            DeclareLaunchArgument("image", default_value="/camera/image_raw"),
            DeclareLaunchArgument("parameters", default_value=str(parameters)),
            Node(
                package="trilitenet_ros",
                executable="perception",
                name="trilitenet",
                parameters=[LaunchConfiguration("parameters")],
                remappings=[("image", LaunchConfiguration("image"))],
                output="screen",
            ),
        ]
    )
