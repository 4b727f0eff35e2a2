"""Maps what a camera topic shows: ros2 launch splat_mapper mapper.launch.py image:=/camera/image_raw"""

import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

# name, default, meaning
ARGUMENTS = [
    ("image", "/camera/image_raw", "topic with images; camera_info is taken from beside it"),
    ("namespace", "", "namespace of the node"),
    ("params", "", "parameter file over the shipped defaults; any subset of params.yaml"),
    ("out", "splat_mapper_out", "folder for the map and the report, written at the end"),
    ("folder", "splat_mapper_maps", "folder that the services save_map, load_map and export may touch"),
    ("odometry", "", "nav_msgs/Odometry topic; empty takes tf from odom to the camera, where there is one"),
    ("tf", "auto", "transforms that go out: auto, odom, full, off"),
    ("use_sim_time", "false", "time comes from /clock"),
    ("autostart", "true", "false waits for a lifecycle manager"),
]


def generate_launch_description():
    share = get_package_share_directory("splat_mapper")
    profile = os.path.join(share, "fastdds.xml")
    value = LaunchConfiguration

    def flag(name):
        return ParameterValue(value(name), value_type=bool)

    # An empty name of a file would be an error; the shipped one changes nothing.
    shipped = os.path.join(share, "params.yaml")
    params = PythonExpression(["'", value("params"), "' or '", shipped, "'"])

    mapper = Node(
        package="splat_mapper",
        executable="splat-mapper",
        name="splat_mapper",
        namespace=value("namespace"),
        output="screen",
        arguments=["run", "--source", ["ros2:", value("image")], "--out", value("out")],
        parameters=[
            params,
            {
                "source.odometry_topic": ParameterValue(value("odometry"), value_type=str),
                "publish.tf": ParameterValue(value("tf"), value_type=str),
                "publish.map_directory": ParameterValue(value("folder"), value_type=str),
                "use_sim_time": flag("use_sim_time"),
                "ros2.autostart": flag("autostart"),
            },
        ],
        # Both names: Fast DDS up to 2.14 (Jazzy) and from 3 on.
        additional_env={"FASTRTPS_DEFAULT_PROFILES_FILE": profile, "FASTDDS_DEFAULT_PROFILES_FILE": profile},
    )
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=meaning)
        for name, default, meaning in ARGUMENTS
    ]
    return LaunchDescription([*declared, mapper])
