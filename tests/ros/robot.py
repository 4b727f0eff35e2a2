"""A robot made of recordings/demo.mcap: camera, calibration, depth, odometry over tf, true poses and /clock.

Knows nothing of the node under test. Messages stay bytes wherever they can: rclpy takes large ones apart slowly.
"""

import io
import struct
import threading
import time

import numpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, TransformStamped
from mcap.reader import make_reader
from PIL import Image as PilImage
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from tf2_msgs.msg import TFMessage

CAMERA_FRAME = "camera_optical"
# As many drivers publish.
SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def stamp_of(nanos):
    """Nanoseconds as a message."""
    return Time(sec=nanos // 10**9, nanosec=nanos % 10**9)


def nanos_of(stamp):
    """A message as nanoseconds."""
    return stamp.sec * 10**9 + stamp.nanosec


def load(path):
    """Payloads by topic, in order: CDR bytes."""
    messages = {}
    with open(path, "rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            messages.setdefault(channel.topic, []).append(bytes(message.data))
    return messages


def header_nanos(payload):
    """The stamp of a message that begins with a header."""
    sec, nanosec = struct.unpack_from("<iI", payload, 4)
    return sec * 10**9 + nanosec


def stamped(payload, nanos):
    """The same message at another time."""
    return payload[:4] + struct.pack("<iI", nanos // 10**9, nanos % 10**9) + payload[12:]


def text(payload, word):
    """Appends a string, aligned as CDR wants it."""
    align(payload, 4)
    payload += struct.pack("<I", len(word) + 1) + word.encode() + b"\0"


def align(payload, to):
    payload += b"\0" * (-(len(payload) - 4) % to)


def image_payload(nanos, frame_id, pixels):
    """sensor_msgs/msg/Image, rgb8, as CDR; pixels are height by width by 3."""
    height, width, _ = pixels.shape
    payload = bytearray(b"\0\1\0\0" + struct.pack("<iI", nanos // 10**9, nanos % 10**9))
    text(payload, frame_id)
    align(payload, 4)
    payload += struct.pack("<II", height, width)
    text(payload, "rgb8")
    payload += b"\0"
    align(payload, 4)
    payload += struct.pack("<II", 3 * width, pixels.size) + pixels.tobytes()
    return bytes(payload)


def jpeg_of(payload):
    """The image inside a CompressedImage."""
    return payload[payload.index(b"\xff\xd8") :]


def raw_payload(compressed, nanos):
    """A CompressedImage as Image, rgb8."""
    image = PilImage.open(io.BytesIO(jpeg_of(compressed))).convert("RGB")
    return image_payload(nanos, CAMERA_FRAME, numpy.asarray(image))


class Robot:
    """Publishes the recording on a thread of its own, at `rate` times its speed."""

    def __init__(self, node, recording, image_type=Image, with_odometry=True):
        self.node = node
        self.is_stopping = threading.Event()
        self.with_odometry = with_odometry
        self.n_sent = 0
        self.newest_nanos = 0
        self.image_type = image_type
        self.images = [(header_nanos(p), p) for p in recording["/camera/image_raw/compressed"]]
        self.info = recording["/camera/camera_info"][0]
        self.depths = {header_nanos(p): p for p in recording["/camera/depth"]}
        self.poses = {header_nanos(p): p for p in recording["/ground_truth/pose"]}
        publisher = node.create_publisher
        suffix = "/compressed" if image_type is CompressedImage else ""
        self.to_image = publisher(image_type, f"/camera/image_raw{suffix}", SENSOR)
        self.to_info = publisher(CameraInfo, "/camera/camera_info", RELIABLE)
        self.to_depth = publisher(Image, "/camera/depth", SENSOR)
        self.to_pose = publisher(PoseStamped, "/ground_truth/pose", RELIABLE)
        self.to_tf = publisher(TFMessage, "/tf", QoSProfile(depth=100))
        self.to_tf_static = publisher(TFMessage, "/tf_static", LATCHED)
        self.to_clock = publisher(Clock, "/clock", SENSOR)
        self.to_tf_static.publish(TFMessage(transforms=[mount()]))
        self.thread = None

    def close(self):
        """Takes its publishers away."""
        publishers = [self.to_image, self.to_info, self.to_depth, self.to_pose]
        for publisher in [*publishers, self.to_tf, self.to_tf_static, self.to_clock]:
            self.node.destroy_publisher(publisher)

    def start(self, rate=1.0, from_ix=0, to_ix=None, offset_nanos=0):
        """`offset_nanos` is added to every stamp: later passes of the recording are later times."""
        self.is_stopping.clear()
        arguments = (rate, self.images[from_ix:to_ix], offset_nanos)
        self.thread = threading.Thread(target=self.run, args=arguments, daemon=True)
        self.thread.start()

    def stop(self):
        self.is_stopping.set()
        self.wait()

    def wait(self):
        if self.thread is not None:
            self.thread.join()

    def run(self, rate, images, offset_nanos):
        begin, first = time.monotonic(), images[0][0]
        for nanos, payload in images:
            ahead = (nanos - first) / 1e9 / rate - (time.monotonic() - begin)
            if self.is_stopping.wait(max(ahead, 0.0)):
                return
            self.send(nanos, payload, nanos + offset_nanos)

    def send(self, nanos, payload, at):
        """The image that was taken at `nanos`, and all beside it, as if it had been taken at `at`."""
        self.to_clock.publish(Clock(clock=stamp_of(at)))
        pose = stamped(self.poses[nanos], at)
        if self.with_odometry:
            self.to_tf.publish(TFMessage(transforms=[odometry(pose)]))
        self.to_info.publish(stamped(self.info, at))
        self.to_pose.publish(pose)
        self.to_depth.publish(stamped(self.depths[nanos], at))
        is_compressed = self.image_type is CompressedImage
        self.to_image.publish(stamped(payload, at) if is_compressed else raw_payload(payload, at))
        self.n_sent += 1
        self.newest_nanos = at


def mount():
    """base_link to camera_optical: the camera looks ahead, half a metre above the robot's origin."""
    transform = TransformStamped(child_frame_id=CAMERA_FRAME)
    transform.header.frame_id = "base_link"
    transform.transform.translation.z = 0.5
    rotation = transform.transform.rotation
    rotation.x, rotation.y, rotation.z, rotation.w = -0.5, 0.5, -0.5, 0.5
    return transform


def odometry(pose_payload):
    """odom to base_link, by the true pose of the camera in the recording's world."""
    pose = deserialize_message(pose_payload, PoseStamped)
    transform = TransformStamped(child_frame_id="base_link")
    transform.header.frame_id = "odom"
    transform.header.stamp = pose.header.stamp
    mounted = mount().transform
    base = matrix(pose.pose.position, pose.pose.orientation) @ numpy.linalg.inv(
        matrix(mounted.translation, mounted.rotation)
    )
    translation, rotation = transform.transform.translation, transform.transform.rotation
    translation.x, translation.y, translation.z = base[:3, 3]
    rotation.x, rotation.y, rotation.z, rotation.w = quaternion(base[:3, :3])
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


def quaternion(m):
    """A rotation matrix as x y z w: the eigenvector of Bar-Itzhack's matrix (2000), which has no special cases."""
    k = numpy.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2], m[2, 1] - m[1, 2]],
            [m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2], m[0, 2] - m[2, 0]],
            [m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    return [float(v) for v in numpy.linalg.eigh(k)[1][:, -1]]
