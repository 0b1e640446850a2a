"""Start the node: the topics of the cameras and the file with the parameters are arguments."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

TOPICS = [f"{place}/{name}" for place in ("bin", "tote") for name in ("depth", "camera_info")]


def generate_launch_description() -> LaunchDescription:
    """Return the node with its arguments; ``bin_depth:=/camera/depth/image_rect`` says what is read as bin/depth."""
    settings = Path(get_package_share_directory("pickplace_ros")) / "config" / "cell.yaml"
    arguments = [DeclareLaunchArgument("params_file", default_value=str(settings), description="the parameters")]
    remappings = []
    for topic in TOPICS:
        argument = topic.replace("/", "_")
        arguments.append(DeclareLaunchArgument(argument, default_value=topic, description=f"read as {topic}"))
        remappings.append((topic, LaunchConfiguration(argument)))
    node = Node(
        package="pickplace_ros",
        executable="pickplace_node",
        name="pickplace",
        output="screen",
        parameters=[LaunchConfiguration("params_file")],
        remappings=remappings,
    )
    return LaunchDescription([*arguments, node])
