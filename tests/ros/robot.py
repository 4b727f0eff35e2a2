"""A robot made of recordings/demo.mcap: camera, calibration, depth, odometry over tf, true poses and /clock.

Knows nothing of the node under test.
"""

import io
import threading
import time

import numpy
from geometry_msgs.msg import PoseStamped, TransformStamped
from mcap.reader import make_reader
from PIL import Image as Picture
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from tf2_msgs.msg import TFMessage

CAMERA_FRAME = "camera_optical"
# As publishers of drivers often are, and best effort: what a subscriber must cope with.
SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST)
RELIABLE = QoSProfile(depth=10)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def stamp_of(nanos):
    """Nanoseconds as a message."""
    from builtin_interfaces.msg import Time

    return Time(sec=nanos // 10**9, nanosec=nanos % 10**9)


def nanos_of(stamp):
    """A message as nanoseconds."""
    return stamp.sec * 10**9 + stamp.nanosec


def load(path):
    """Payloads by topic, in order: (nanoseconds of the log, CDR bytes)."""
    messages = {}
    with open(path, "rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            messages.setdefault(channel.topic, []).append((message.log_time, message.data))
    return messages


def raw_picture(compressed):
    """A CompressedImage as Image rgb8."""
    pixels = numpy.asarray(Picture.open(io.BytesIO(bytes(compressed.data))).convert("RGB"))
    image = Image(header=compressed.header, height=pixels.shape[0], width=pixels.shape[1])
    image.encoding = "rgb8"
    image.step = 3 * image.width
    image.data.frombytes(pixels.tobytes())
    return image


class Robot:
    """Publishes the recording on a thread of its own, at `rate` times its speed."""

    def __init__(self, node, recording, namespace="", picture_type=Image, with_odometry=True):
        self.node = node
        self.is_stopping = threading.Event()
        self.with_odometry = with_odometry
        self.n_sent = 0
        self.pictures = []
        for nanos, data in recording["/camera/image_raw/compressed"]:
            message = deserialize_message(data, CompressedImage)
            # Images as bytes: rclpy would take them apart with each publishing.
            self.pictures.append((nanos_of(message.header.stamp), message))
        self.picture_type = picture_type
        self.info = deserialize_message(recording["/camera/camera_info"][0][1], CameraInfo)
        self.depths = self.by_stamp(recording["/camera/depth"], Image)
        self.poses = self.by_stamp(recording["/ground_truth/pose"], PoseStamped)
        topic = f"{namespace}/camera/image_raw"
        if picture_type is CompressedImage:
            topic += "/compressed"
        publisher = node.create_publisher
        self.to_picture = publisher(picture_type, topic, SENSOR)
        self.to_info = publisher(CameraInfo, f"{namespace}/camera/camera_info", RELIABLE)
        self.to_depth = publisher(Image, f"{namespace}/camera/depth", SENSOR)
        self.to_pose = publisher(PoseStamped, "/ground_truth/pose", RELIABLE)
        self.to_tf = publisher(TFMessage, "/tf", QoSProfile(depth=100))
        self.to_tf_static = publisher(TFMessage, "/tf_static", LATCHED)
        self.to_clock = publisher(Clock, "/clock", SENSOR)
        self.thread = None

    @staticmethod
    def by_stamp(messages, kind):
        decoded = [deserialize_message(data, kind) for _, data in messages]
        return {nanos_of(message.header.stamp): message for message in decoded}

    def start(self, rate=1.0, from_ix=0, to_ix=None, offset_nanos=0):
        """`offset_nanos` is added to every stamp: later passes of the recording are later times."""
        self.is_stopping.clear()
        arguments = (rate, self.pictures[from_ix:to_ix], offset_nanos)
        self.thread = threading.Thread(target=self.run, args=arguments, daemon=True)
        self.thread.start()

    def stop(self):
        self.is_stopping.set()
        self.wait()

    def wait(self):
        if self.thread is not None:
            self.thread.join()

    def run(self, rate, pictures, offset_nanos):
        self.to_tf_static.publish(TFMessage(transforms=[mount(pictures[0][0] + offset_nanos)]))
        begin, first = time.monotonic(), pictures[0][0]
        for nanos, message in pictures:
            ahead = (nanos - first) / 1e9 / rate - (time.monotonic() - begin)
            if self.is_stopping.wait(max(ahead, 0.0)):
                return
            self.send(nanos, message, offset_nanos)

    def send(self, nanos, message, offset_nanos):
        stamp = stamp_of(nanos + offset_nanos)
        self.to_clock.publish(Clock(clock=stamp))
        pose, depth = self.poses[nanos], self.depths[nanos]
        for other in (message, pose, depth, self.info):
            other.header.stamp = stamp
        if self.with_odometry:
            self.to_tf.publish(TFMessage(transforms=[odometry(pose)]))
        self.to_info.publish(self.info)
        self.to_pose.publish(pose)
        self.to_depth.publish(depth)
        self.to_picture.publish(message if self.picture_type is CompressedImage else raw_picture(message))
        self.n_sent += 1


def mount(nanos):
    """base_link to camera_optical: the camera looks ahead from the robot's origin, half a metre above it."""
    transform = TransformStamped(child_frame_id=CAMERA_FRAME)
    transform.header.frame_id = "base_link"
    transform.header.stamp = stamp_of(nanos)
    transform.transform.translation.z = 0.5
    rotation = transform.transform.rotation
    rotation.x, rotation.y, rotation.z, rotation.w = -0.5, 0.5, -0.5, 0.5
    return transform


def odometry(pose):
    """odom to base_link, by the true pose of the camera in the recording's world."""
    transform = TransformStamped(child_frame_id="base_link")
    transform.header.frame_id = "odom"
    transform.header.stamp = pose.header.stamp
    camera = matrix(pose.pose.position, pose.pose.orientation)
    mounted = mount(0).transform
    base = camera @ numpy.linalg.inv(matrix(mounted.translation, mounted.rotation))
    transform.transform.translation.x, transform.transform.translation.y, transform.transform.translation.z = base[:3, 3]
    x, y, z, w = quaternion(base[:3, :3])
    rotation = transform.transform.rotation
    rotation.x, rotation.y, rotation.z, rotation.w = x, y, z, w
    return transform


def matrix(translation, rotation):
    """Translation and quaternion as a 4 by 4 matrix."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    out = numpy.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = translation.x, translation.y, translation.z
    return out


def quaternion(rotation):
    """A rotation matrix as x y z w: the eigenvector of Bar-Itzhack's matrix, which has no special cases."""
    m = rotation
    k = numpy.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2], m[2, 1] - m[1, 2]],
            [m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2], m[0, 2] - m[2, 0]],
            [m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    return numpy.linalg.eigh(k)[1][:, -1]
