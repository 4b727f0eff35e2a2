"""Maps, and drives on the map with Nav2: ros2 launch splat_mapper nav2.launch.py image:=/camera/image_raw nav2_params:=mine.yaml

No map_server and no AMCL: the grid and map -> odom come from the mapper. Nav2's parameters are `nav2_params` (Nav2's own where none are given) with
nav2.params.yaml over them.
"""

import os
import tempfile

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration


def merged(below, above):
    """Both trees of parameters; where they meet, `above` counts."""
    if not (isinstance(below, dict) and isinstance(above, dict)):
        return above
    both = dict(below)
    for key, value in above.items():
        both[key] = merged(below[key], value) if key in below else value
    return both


def nav2(context):
    share = get_package_share_directory("splat_mapper")
    bringup = get_package_share_directory("nav2_bringup")
    own = LaunchConfiguration("nav2_params").perform(context)
    with open(own or os.path.join(bringup, "params", "nav2_params.yaml")) as file:
        below = yaml.safe_load(file)
    with open(os.path.join(share, "nav2.params.yaml")) as file:
        above = yaml.safe_load(file)
    with tempfile.NamedTemporaryFile("w", prefix="nav2_params_", suffix=".yaml", delete=False) as file:
        yaml.safe_dump(merged(below, above), file)
    arguments = {
        "params_file": file.name,
        "use_sim_time": LaunchConfiguration("use_sim_time"),
        "autostart": "true",
    }
    launch = PythonLaunchDescriptionSource(os.path.join(bringup, "launch", "navigation_launch.py"))
    return [IncludeLaunchDescription(launch, launch_arguments=arguments.items())]


def generate_launch_description():
    share = get_package_share_directory("splat_mapper")
    value = LaunchConfiguration
    passed = ["image", "params", "out", "odometry", "use_sim_time"]
    mapper = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(os.path.join(share, "launch", "mapper.launch.py")),
        launch_arguments={name: value(name) for name in passed}.items(),
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("image", default_value="/camera/image_raw", description="topic with images"),
            DeclareLaunchArgument("params", default_value="", description="parameter file of the mapper"),
            DeclareLaunchArgument("out", default_value="splat_mapper_out", description="folder for map and report"),
            DeclareLaunchArgument("odometry", default_value="", description="nav_msgs/Odometry topic; empty takes tf"),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="time comes from /clock"),
            DeclareLaunchArgument("nav2_params", default_value="", description="parameters of Nav2; empty takes its own"),
            mapper,
            OpaqueFunction(function=nav2),
        ]
    )
