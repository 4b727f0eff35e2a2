"""Plays a recording to the mapper: ros2 launch splat_mapper replay.launch.py bag:=FOLDER image:=/camera/image_raw

Without ROS 2, `splat-mapper replay FOLDER` reads the recording itself, which loses no frame and gives the same map each time.
"""

import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, ExecuteProcess, IncludeLaunchDescription
from launch.actions import RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration


def generate_launch_description():
    share = get_package_share_directory("splat_mapper")
    value = LaunchConfiguration
    mapper = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(os.path.join(share, "launch", "mapper.launch.py")),
        launch_arguments={"image": value("image"), "out": value("out"), "use_sim_time": "true"}.items(),
    )
    player = ExecuteProcess(
        # The delay lets subscriptions find their publishers.
        cmd=["ros2", "bag", "play", value("bag"), "--clock", "--rate", value("rate"), "--delay", "3"],
        output="screen",
    )
    # The mapper ends as by Ctrl-C: it writes its folder first.
    end = RegisterEventHandler(OnProcessExit(target_action=player, on_exit=[EmitEvent(event=Shutdown())]))
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="rosbag2 folder or MCAP file"),
            DeclareLaunchArgument("image", default_value="/camera/image_raw", description="topic with images"),
            DeclareLaunchArgument("out", default_value="splat_mapper_out", description="folder for map and report"),
            DeclareLaunchArgument("rate", default_value="1.0", description="multiple of the recorded speed"),
            mapper,
            player,
            end,
        ]
    )
