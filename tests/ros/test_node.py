"""What the node is to ROS 2 before it maps anything: names, parameters, lifecycle, silence, jumps of time, lost images."""

import json
import os
import subprocess
import sys
import tempfile
import time

import numpy
import rclpy
from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rcl_interfaces.msg import Parameter, ParameterEvent, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rcl_interfaces.srv import SetParametersAtomically
from sensor_msgs.msg import CompressedImage, Image

from mapper import ROOT, Checks, Mapper, Observer, wait_until
from robot import CAMERA_FRAME, SENSOR, Robot, image_payload, load

check = Checks()
SOURCE = ["run", "--source", "ros2:/camera/image_raw"]
# The engine has nothing to do in these tests.
IDLE = ["--set", "source.max_side=64", "--set", "track.enabled=false", "--set", "backend=cpu"]
N_THROUGHPUT = 300
UP = "ROS 2 node"


def number(name, value):
    return Parameter(
        name=name, value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
    )


def whole(name, value):
    return Parameter(
        name=name, value=ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=value)
    )


def word(name, value):
    return Parameter(
        name=name, value=ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)
    )


def names_and_arguments(observer):
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
        file.write("splat_mapper:\n  ros__parameters:\n    map:\n      max_splats: 1234\n")
        file.write("mapper:\n  ros__parameters:\n    source: {max_side: 128}\n    train.sh_degree: 2\n")
        file.flush()
        arguments = ["--ros-args", "-r", "__ns:=/bot", "-r", "__node:=mapper", "-p", "train.steps:=77"]
        arguments += ["--params-file", file.name]
        mapper = Mapper(*SOURCE, *IDLE, *arguments, log="names.log")
        check("a node under another name comes up", mapper.wait_for_log("mapper in namespace /bot"))
        request = GetParameters.Request(
            names=["train.steps", "source.max_side", "train.sh_degree", "map.max_splats", "no.such"]
        )
        values = observer.call(GetParameters, "/bot/mapper/get_parameters", request).values
        found = [v.integer_value for v in values[:4]] + [values[4].type]
        check("parameters come by argument and file, for this name only", found[:3] == [77, 128, 2], found)
        check("an unknown parameter is not set", found[4] == ParameterType.PARAMETER_NOT_SET)
    code, secs = mapper.end()
    is_said = "stopped before there was a map" in mapper.log()
    check("without an image it ends at once, and says that there is no map", code == 0 and is_said and secs < 2.0, f"{code}, {secs:.2f} s")
    for arguments, expected in [
        (["-p", "train.steps:=-1"], "parameter train.steps = -1 is out of range"),
        (["-p", "map.stepps:=1"], "unknown parameter"),
        (["-r", "what is this"], "ROS 2 does not start"),
    ]:
        mapper = Mapper(*SOURCE, *IDLE, "--ros-args", *arguments, log="arguments.log")
        mapper.process.wait(20)
        log = mapper.log()
        check(f"{' '.join(arguments)} is refused", mapper.process.returncode in (1, 2) and expected in log, log[-300:].strip())


def parameters(observer):
    mapper = Mapper(*SOURCE, *IDLE, log="parameters.log")
    mapper.wait_for_log(UP)
    service = "/splat_mapper/"
    listed = observer.call(ListParameters, service + "list_parameters", ListParameters.Request()).result
    check("all parameters are listed", len(listed.names) > 100 and "train.steps" in listed.names, len(listed.names))
    below = ListParameters.Request(prefixes=["ros2"], depth=1)
    below = observer.call(ListParameters, service + "list_parameters", below).result.names
    check("parameters are listed by prefix", below and all(n.startswith("ros2.") for n in below), len(below))

    request = DescribeParameters.Request(names=["train.steps", "ros2.image_timeout", "backend"])
    steps, silence, backend = observer.call(
        DescribeParameters, service + "describe_parameters", request
    ).descriptors
    check("a whole number has its range and is read-only", steps.read_only and steps.integer_range[0].to_value == 10_000_000)
    check("a live number has its range and can be set", not silence.read_only and silence.floating_point_range[0].to_value == 3600.0)
    check("a choice says of what", "wgpu" in backend.additional_constraints and backend.description, backend.additional_constraints)

    events = observer.listen(ParameterEvent, "/parameter_events")
    cases = [number("ros2.image_timeout", 0.5), number("ros2.image_timeout", -1.0), whole("train.steps", 5)]
    cases += [word("no.such", "x"), word("ros2.image_timeout", "soon")]
    results = observer.call(SetParameters, service + "set_parameters", SetParameters.Request(parameters=cases)).results
    check("of several parameters, the good one is set", [r.successful for r in results] == [True] + [False] * 4)
    reasons = [r.reason for r in results[1:]]
    for reason, expected in zip(reasons, ["out of range", "start", "unknown", "out of range"]):
        check(f"a refusal says why ({expected})", expected in reason, reason)
    reported = wait_until(lambda: any(e.changed_parameters for _, e in events), 5.0)
    check("a change is reported on /parameter_events", reported)
    both = SetParametersAtomically.Request(parameters=[number("ros2.image_timeout", 9.0), whole("seed", 5)])
    both = observer.call(SetParametersAtomically, service + "set_parameters_atomically", both).result
    now = observer.call(GetParameters, service + "get_parameters", GetParameters.Request(names=["ros2.image_timeout"]))
    check("atomically, all are set or none", not both.successful and now.values[0].double_value == 0.5, both.reason)
    check("silence is reported after the time that was set", mapper.wait_for_log("nobody publishes \"/camera/image_raw\"", 5.0))
    mapper.end()


def lifecycle(observer):
    mapper = Mapper(*SOURCE, *IDLE, "--set", "ros2.autostart=false", log="lifecycle.log")
    mapper.wait_for_log(UP)
    events = observer.listen(TransitionEvent, "/splat_mapper/transition_event")

    def state():
        response = observer.call(GetState, "/splat_mapper/get_state", GetState.Request())
        return response.current_state.label

    def change(**transition):
        request = ChangeState.Request(transition=Transition(**transition))
        return observer.call(ChangeState, "/splat_mapper/change_state", request).success

    check("without autostart the node waits, unconfigured", state() == "unconfigured")
    check("a step from elsewhere is refused", not change(id=Transition.TRANSITION_ACTIVATE))
    walk = [("configure", "inactive"), ("activate", "active"), ("deactivate", "inactive")]
    walk += [("cleanup", "unconfigured"), ("configure", "inactive"), ("activate", "active")]
    ids = {"configure": 1, "cleanup": 2, "activate": 3, "deactivate": 4}
    for label, expected in walk:
        done = change(id=ids[label])
        check(f"{label} leads to {expected}", done and state() == expected)
    possible = observer.call(
        GetAvailableTransitions, "/splat_mapper/get_available_transitions", GetAvailableTransitions.Request()
    )
    labels = [t.transition.label for t in possible.available_transitions]
    check("the steps from here are listed", labels == ["deactivate", "shutdown"], labels)
    reported = wait_until(lambda: len(events) == len(walk), 5.0)
    check("each step is reported", reported and events[-1][1].goal_state.label == "active", len(events))
    check("shutdown by label is done", change(label="shutdown"))
    ended = wait_until(lambda: mapper.process.poll() is not None, 5.0)
    check("and ends the process", ended, mapper.process.poll())
    mapper.end()


def silence(observer, recording):
    arguments = ["--set", "ros2.reliability=reliable", "--set", "ros2.image_timeout=0.5"]
    mapper = Mapper(*SOURCE, *IDLE, *arguments, log="silence.log")
    mapper.wait_for_log(UP)
    check("no publisher is reported", mapper.wait_for_log("nobody publishes \"/camera/image_raw\"", 5.0))
    robot = Robot(observer.node, recording, with_odometry=False)
    robot.start(to_ix=20)
    check("QoS that does not suit is reported", mapper.wait_for_log("set it to best_effort", 5.0))
    robot.stop()
    robot.close()
    mapper.end()

    mapper = Mapper(*SOURCE, *IDLE, "--set", "ros2.image_transport=compressed", "--set", "ros2.image_timeout=0.5", log="transport.log")
    check("compressed images are subscribed beside the topic", mapper.wait_for_log("/camera/image_raw/compressed is subscribed"))
    mapper.end()
    late = Mapper("run", "--source", "ros2:/late/image_raw", *IDLE, log="late.log")
    late.wait_for_log(UP)
    publisher = observer.node.create_publisher(CompressedImage, "/late/image_raw/compressed", SENSOR)
    found = late.wait_for_log("/late/image_raw/compressed is subscribed as sensor_msgs/msg/CompressedImage", 5.0)
    check("a publisher that comes late is found, and what it sends", found)
    # An image that is sent before both sides know of each other is lost.
    wait_until(lambda: publisher.get_subscription_count() > 0, 5.0)
    publisher.publish(recording["/camera/image_raw/compressed"][0])
    check("a camera without CameraInfo is waited for, then taken as uncalibrated", late.wait_for_log("counts as uncalibrated", 6.0))
    late.end()
    observer.node.destroy_publisher(publisher)


def doctor(observer, recording):
    robot = Robot(observer.node, recording)
    printed = subprocess.run([os.environ["SPLAT_MAPPER"], "doctor"], capture_output=True, text=True, check=False, cwd=ROOT).stdout
    found = [line for line in printed.splitlines() if "ros 2 images" in line]
    wanted = "/camera/image_raw (sensor_msgs/msg/Image, best effort, by /observer, with CameraInfo)"
    check("doctor sees the camera, how it publishes, and its calibration", any(wanted in line for line in found), found)
    robot.close()
    off = Mapper(*SOURCE, "--set", "ros2.enabled=off", log="off.log")
    off.process.wait(10)
    check("a ROS source without the node is refused", "ros2.enabled=off" in off.log(), off.log().strip()[-200:])


def time_jumps(observer, recording):
    for action, expected in [("end", "the input ends"), ("ignore", "not later than"), ("reset", "a new map begins")]:
        mapper = Mapper(*SOURCE, *IDLE, "--set", f"ros2.on_time_jump={action}", "--set", "use_sim_time=true", log=f"jump_{action}.log")
        mapper.wait_for_log(UP)
        robot = Robot(observer.node, recording)
        wait_until(lambda: robot.to_image.get_subscription_count() > 0, 5.0)
        robot.start(from_ix=60, to_ix=65)
        robot.wait()
        mapper.wait_for_log("first image", 5.0)
        robot.start(to_ix=5)
        robot.wait()
        check(f"time that jumps back: {action}", mapper.wait_for_log(expected, 5.0))
        if action == "end":
            check("and the process ends by itself", wait_until(lambda: mapper.process.poll() is not None, 5.0))
        mapper.end()
        robot.close()


def throughput(observer):
    """640 x 480 rgb8 at 30 Hz, best effort: none is lost on the way into the node."""
    out = tempfile.mkdtemp()
    arguments = ["--out", out, "--set", "source.max_frames=0", "--set", "ros2.camera_info_timeout=0"]
    mapper = Mapper(*SOURCE, *IDLE, *arguments, log="throughput.log")
    mapper.wait_for_log(UP)
    publisher = observer.node.create_publisher(Image, "/camera/image_raw", SENSOR)
    matched = wait_until(lambda: publisher.get_subscription_count() > 0, 10.0)
    check("the subscription is found", matched)
    time.sleep(0.5)
    pixels = numpy.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=numpy.uint8)
    begin, took = time.monotonic(), 0.0
    for n in range(N_THROUGHPUT):
        time.sleep(max(0.0, n / 30.0 - (time.monotonic() - begin)))
        before = time.monotonic()
        publisher.publish(image_payload(10**18 + n * 33_333_333, CAMERA_FRAME, pixels))
        took += time.monotonic() - before
    secs = time.monotonic() - begin
    time.sleep(1.0)
    mapper.end()
    frames = json.load(open(f"{out}/report.json"))["frames"]
    figures = f"{N_THROUGHPUT} sent in {secs:.1f} s ({1e3 * took / N_THROUGHPUT:.2f} ms each), {frames}"
    check("no image is lost on its way", frames["received"] == N_THROUGHPUT, figures)
    observer.node.destroy_publisher(publisher)


def main():
    rclpy.init()
    observer = Observer()
    recording = load(ROOT / "recordings/demo.mcap")
    names_and_arguments(observer)
    parameters(observer)
    lifecycle(observer)
    silence(observer, recording)
    doctor(observer, recording)
    time_jumps(observer, recording)
    throughput(observer)
    observer.close()
    rclpy.shutdown()
    print(f"{check.n - check.n_failed} of {check.n} checks of the node are good")
    sys.exit(check.n_failed > 0)


if __name__ == "__main__":
    main()
