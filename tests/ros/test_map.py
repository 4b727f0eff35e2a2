"""What the node reports while it maps recordings/demo.mcap, and how it serves: poses, transforms, clouds, splats, services."""

import json
import os
import pathlib
import shutil
import sys
import time

import numpy
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2
from splat_mapper_msgs.msg import KeyframeArray, MapCorrection, MapperStatus, SplatChunk, SplatDelta, SplatManifest
from splat_mapper_msgs.srv import Export, GetSplats, LoadMap, RenderView, SaveMap
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from mapper import ROOT, Checks, Mapper, Observer, wait_until
from robot import CAMERA_FRAME, Robot, load, matrix, nanos_of, odometry
from splats import Client, crc32c

check = Checks()
OUT = pathlib.Path(os.environ.get("ROS_TEST_OUT", "/tmp")) / "map"
LATE = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
DEEP = QoSProfile(depth=2000)
# Seconds that are added to the recording's stamps in its second pass.
SECOND_PASS = 20
# Small enough for two slow cores.
SMALL = """source.max_side=320 train.max_side=160 train.sh_degree=0 map.max_splats=6000 train.seeds_per_keyframe=400 train.steps=100
select.max_rate_hz=3 select.batch_size=4 select.batch_overlap=1 backend=cpu geometry=ground_truth
source.pose_topic=/ground_truth/pose source.depth_topic=/camera/depth use_sim_time=true""".split()
SOURCE = ["run", "--source", "ros2:/camera/image_raw"]


def settings(*words):
    return [part for word in words for part in ("--set", word)]


class Listening:
    """Everything that the node says."""

    def __init__(self, observer):
        listen = observer.listen
        self.pose = listen(PoseWithCovarianceStamped, "/splat_mapper/pose", BEST_EFFORT)
        self.odometry = listen(Odometry, "/splat_mapper/odometry")
        self.tf = listen(TFMessage, "/tf", 100)
        self.tf_static = listen(TFMessage, "/tf_static", LATE)
        self.path = listen(Path, "/splat_mapper/path", LATE)
        self.cloud = listen(PointCloud2, "/splat_mapper/cloud", LATE)
        self.keyframe_cloud = listen(PointCloud2, "/splat_mapper/keyframe_cloud", BEST_EFFORT)
        self.keyframes = listen(KeyframeArray, "/splat_mapper/keyframes", LATE)
        self.manifest = listen(SplatManifest, "/splat_mapper/splats/manifest", LATE)
        self.splats = listen(SplatChunk, "/splat_mapper/splats", DEEP)
        self.delta = listen(SplatDelta, "/splat_mapper/splats/delta", DEEP)
        self.correction = listen(MapCorrection, "/splat_mapper/correction", LATE)
        self.status = listen(MapperStatus, "/splat_mapper/status", LATE)
        self.diagnostics = listen(DiagnosticArray, "/diagnostics")

    def level(self, part):
        """The newest level of a part in /diagnostics."""
        for _, array in reversed(self.diagnostics):
            for status in array.status:
                if status.name.endswith(part):
                    return int.from_bytes(status.level, "little")
        return None


def matrix_of(pose):
    return matrix(pose.position, pose.orientation)


def points_of(cloud):
    """x y z of a PointCloud2, by its own fields."""
    offsets = {field.name: (field.offset, field.datatype) for field in cloud.fields}
    assert all(offsets[axis][1] == 7 for axis in "xyz"), "float32"
    data = numpy.frombuffer(bytes(cloud.data), numpy.uint8).reshape(-1, cloud.point_step)
    columns = [data[:, offsets[a][0] : offsets[a][0] + 4].copy().view("<f4")[:, 0] for a in "xyz"]
    return numpy.stack(columns, 1)


def check_poses(received, robot):
    sent = {nanos + SECOND_PASS * 10**9: payload for nanos, payload in robot.poses.items()}
    poses = [m for _, m in received.pose if nanos_of(m.header.stamp) in sent]
    check("poses come, at stamps of images, best effort", len(poses) > 5, len(poses))
    check("a pose is of the map frame", all(m.header.frame_id == "map" for m in poses))
    spread = [numpy.diag(numpy.reshape(m.pose.covariance, (6, 6))) for m in poses]
    check("each says how sure it is", all(numpy.isfinite(s).all() and (s > 0).all() for s in spread))
    errors = []
    for message in poses:
        base = odometry(sent[nanos_of(message.header.stamp)]).transform
        wanted = matrix(base.translation, base.rotation)
        errors.append(numpy.linalg.norm(matrix_of(message.pose.pose)[:3, 3] - wanted[:3, 3]))
    # The recording's world is odometry's frame here, and the poses are given: what is left is tracking.
    median = float(numpy.median(errors)) if errors else numpy.inf
    check("poses are the robot's, in metres", median < 0.1, f"median error {median:.3f} m")
    moves = [m for _, m in received.odometry]
    named = {(m.header.frame_id, m.child_frame_id) for m in moves}
    check("odometry is of base_link in odom", named == {("odom", "base_link")}, named)


def parents(received):
    """Parents of each frame, over all that was broadcast."""
    found = {}
    for _, message in [*received.tf, *received.tf_static]:
        for transform in message.transforms:
            found.setdefault(transform.child_frame_id, set()).add(transform.header.frame_id)
    return found


def check_transforms(received):
    found = parents(received)
    check("each frame has one parent", all(len(p) == 1 for p in found.values()), found)
    check("map is above odom, odom above base_link", found.get("odom") == {"map"} and found.get("base_link") == {"odom"})
    own = [(at, m) for at, m in received.tf if any(t.child_frame_id == "odom" for t in m.transforms)]
    children = {t.child_frame_id for _, m in own for t in m.transforms}
    check("the node sends map to odom and leaves odom to base_link to odometry", children == {"odom", "splat_map"}, children)
    times = [at for at, _ in own]
    gaps = numpy.diff(times) if len(times) > 1 else numpy.array([numpy.inf])
    rate = 1.0 / float(numpy.median(gaps))
    check("map to odom comes at 20 Hz or more", rate >= 20.0, f"{rate:.1f} Hz, {len(own)} messages")


def check_clouds(received):
    path = received.path[-1][1] if received.path else Path()
    check("the path is of the map frame and has the keyframes", path.header.frame_id == "map" and len(path.poses) > 3, len(path.poses))
    cloud = received.cloud[-1][1] if received.cloud else PointCloud2()
    points = points_of(cloud) if cloud.data else numpy.zeros((0, 3))
    check("the cloud has points, finite, of the map frame", len(points) > 100 and numpy.isfinite(points).all() and cloud.header.frame_id == "map", len(points))
    seen = received.keyframe_cloud[-1][1] if received.keyframe_cloud else PointCloud2()
    ahead = points_of(seen) if seen.data else numpy.zeros((0, 3))
    check("a keyframe's cloud is of the camera's frame, ahead of it", len(ahead) > 100 and (ahead[:, 2] > 0).all() and seen.header.frame_id == CAMERA_FRAME, len(ahead))


def check_stream(received):
    """Every whole snapshot and delta that was received, put together as a client would."""
    by_revision, deltas = {}, {}
    for _, chunk in received.splats:
        by_revision.setdefault((bytes(chunk.map_id), chunk.revision), []).append(chunk)
    for _, piece in received.delta:
        deltas.setdefault((bytes(piece.map_id), piece.revision), []).append(piece)
    wholes = {key: chunks for key, chunks in by_revision.items() if len(chunks) == chunks[0].n_chunks}
    check("whole snapshots come in pieces", len(wholes) > 0, f"{len(wholes)} of {len(by_revision)} complete")
    check("and small enough ones", all(len(c.data) <= 262_144 for chunks in wholes.values() for c in chunks))
    good, n_followed = True, 0
    client = Client()
    for key in sorted([*wholes, *deltas], key=lambda key: key[1]):
        if key in wholes:
            client.whole(wholes[key])
            good &= client.digest() == bytes(wholes[key][0].map_sha256)
        elif len(deltas[key]) == deltas[key][0].n_pieces and client.delta(deltas[key]):
            n_followed += 1
            good &= client.digest() == bytes(deltas[key][0].map_sha256)
    check("splats put together have the digest that was announced", good and wholes, f"{n_followed} deltas")
    first = next(iter(wholes.values()), [None])[0]
    check("a chunk's checksum fits", first is not None and crc32c(bytes(first.data)) == first.crc32c)


def fetch(observer):
    """The published map by service: (manifest, digest)."""
    request = GetSplats.Request(revision=0, first_chunk=0, max_chunks=3)
    response = observer.call(GetSplats, "/splat_mapper/get_splats", request)
    manifest, chunks = response.manifest, list(response.chunks)
    while response.success and len(chunks) < manifest.n_chunks:
        request = GetSplats.Request(revision=manifest.revision, first_chunk=len(chunks), max_chunks=3)
        response = observer.call(GetSplats, "/splat_mapper/get_splats", request)
        if not response.success:
            return fetch(observer)
        chunks += response.chunks
    client = Client()
    client.whole(chunks)
    return manifest, client.digest()


def check_services(observer):
    def file(kind, name, path):
        return observer.call(kind, f"/splat_mapper/{name}", kind.Request(path=path))

    saved = file(SaveMap, "save_map", "a.splatmap")
    check("save_map saves", saved.success and pathlib.Path(saved.path).stat().st_size > 1000, saved.message)
    out = file(SaveMap, "save_map", "../a.splatmap")
    check("save_map stays in its folder", not out.success, out.message)
    ply = file(Export, "export", "a.ply")
    check("export writes", ply.success and pathlib.Path(ply.path).read_bytes()[:3] == b"ply", ply.message)
    wrong = file(Export, "export", "a.exe")
    check("export knows what it can write", not wrong.success, wrong.message)
    missing = file(LoadMap, "load_map", "no_such.splatmap")
    check("load_map of a file that is not there is refused", not missing.success and missing.message, missing.message)

    camera = CameraInfo(width=80, height=60, k=[80.0, 0.0, 39.5, 0.0, 80.0, 29.5, 0.0, 0.0, 1.0])
    request = RenderView.Request(camera=camera, with_depth=True)
    request.pose.orientation.w = 1.0
    view = observer.call(RenderView, "/splat_mapper/render_view", request)
    fits = len(view.image.data) == 80 * 60 * 3 and len(view.depth.data) == 80 * 60 * 4
    check("render_view renders, with depth", view.success and fits and view.image.encoding == "rgb8", view.message)
    for frame, is_known in [("map", True), ("splat_map", True), ("base_link", False)]:
        request.header.frame_id = frame
        view = observer.call(RenderView, "/splat_mapper/render_view", request)
        check(f"render_view with a pose in {frame}: {is_known}", view.success == is_known, view.message)
    check("render_view names the frames it knows", "splat_map" in view.message, view.message)
    request.header.frame_id = ""
    request.camera.width = 100_000
    huge = observer.call(RenderView, "/splat_mapper/render_view", request)
    check("render_view refuses a huge image", not huge.success, huge.message)

    manifest, digest = fetch(observer)
    check("get_splats brings the published map", digest == bytes(manifest.map_sha256) and manifest.n_splats > 0, manifest.n_splats)
    gone = observer.call(GetSplats, "/splat_mapper/get_splats", GetSplats.Request(revision=4_000_000_000, max_chunks=1))
    check("get_splats says when a revision is gone", not gone.success, gone.message)


def check_switches(observer, received, robot, mapper):
    call = lambda name: observer.call(Trigger, f"/splat_mapper/{name}", Trigger.Request())  # noqa: E731
    state = lambda: received.status[-1][1].state if received.status else None  # noqa: E731
    robot.start(rate=1.0, to_ix=40)
    paused = call("pause")
    check("pause pauses", paused.success and wait_until(lambda: state() == MapperStatus.STATE_PAUSED, 5.0), paused.message)
    resumed = call("resume")
    check("resume goes on", resumed.success and wait_until(lambda: state() != MapperStatus.STATE_PAUSED, 5.0), resumed.message)
    reset = call("reset")
    check("reset begins a new map", reset.success and mapper.wait_for_log("the map begins again", 20.0), reset.message)
    robot.wait()


def check_late(received):
    late = Observer("late")
    late_received = Listening(late)
    latched = ["path", "cloud", "manifest", "keyframes", "status"]
    wait_until(lambda: all(getattr(late_received, name) for name in latched), 5.0)
    missing = [name for name in latched if not getattr(late_received, name)]
    check("who comes late gets what is latched", not missing, missing)
    late.close()
    check("the status counts", received.status[-1][1].frames_received > 0 and received.status[-1][1].keyframes_registered > 0)


def with_odometry(observer, recording):
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    words = [*SMALL, f"publish.map_directory={OUT / 'maps'}", "publish.full_map_period=4", "map.snapshot_secs=1", "publish.shutdown_delay=60"]
    mapper = Mapper(*SOURCE, "--out", str(OUT / "run"), *settings(*words), log="map.log")
    received = Listening(observer)
    mapper.wait_for_log("ROS 2 node")
    robot = Robot(observer.node, recording)
    wait_until(lambda: robot.to_info.get_subscription_count() > 0, 5.0)
    check_switches(observer, received, robot, mapper)
    robot.start(rate=1.0, offset_nanos=SECOND_PASS * 10**9)
    check("diagnostics are fine while images come", wait_until(lambda: received.level("input") == 0, 5.0))
    robot.wait()
    check("diagnostics warn when the camera stops", wait_until(lambda: received.level("input") == 1, 6.0))
    check("and call it an error after a while", wait_until(lambda: received.level("input") == 2, 10.0), received.level("input"))
    has_map = wait_until(lambda: received.cloud and received.status[-1][1].splats > 0, 60.0)
    check("a map has come", has_map, f"{received.status[-1][1].splats} splats")
    check_poses(received, robot)
    check_transforms(received)
    check_clouds(received)
    check_late(received)
    check_services(observer)
    # Time jumps back: the input ends, and the last map goes out whole.
    robot.start(to_ix=3)
    report = OUT / "run/report.json"
    check("the end of the input ends the map", wait_until(report.is_file, 60.0))
    time.sleep(1.0)
    manifest, digest = fetch(observer)
    saved = json.loads(report.read_text())["map_sha256"]
    check("splats that were sent are the map that was saved", digest.hex() == saved == bytes(manifest.map_sha256).hex(), saved[:16])
    check_stream(received)
    code, secs = mapper.end()
    check("SIGINT ends it, cleanly", code == 0 and secs <= 2.0, f"exit {code} after {secs:.2f} s")
    robot.wait()


def without_odometry(observer, recording):
    """Compressed images, another name, and nothing else on tf: the node sends the whole tree."""
    arguments = ["--ros-args", "-r", "__ns:=/bot", "-r", "__node:=mapper", "-r", "~/odometry:=/where"]
    mapper = Mapper(*SOURCE, *settings(*SMALL), *arguments, log="map_alone.log")
    mapper.wait_for_log("ROS 2 node")
    tf = observer.listen(TFMessage, "/tf", 100)
    begin = len(tf)
    poses = observer.listen(PoseWithCovarianceStamped, "/bot/mapper/pose")
    remapped = observer.listen(Odometry, "/where")
    robot = Robot(observer.node, recording, image_type=CompressedImage, with_odometry=False)
    wait_until(lambda: robot.to_image.get_subscription_count() > 0, 5.0)
    # There and back again: poses come once the first keyframes are mapped, however long that takes.
    for n in range(8):
        robot.start(rate=1.0, offset_nanos=n * SECOND_PASS * 10**9)
        robot.wait()
        if len(poses) > 3:
            break
    check("poses come under the node's own name", len(poses) > 3, len(poses))
    robot.start(rate=1.0, offset_nanos=10 * SECOND_PASS * 10**9)
    check("and odometry under the name that it was remapped to", wait_until(lambda: remapped, 5.0), len(remapped))
    links = {(t.header.frame_id, t.child_frame_id) for _, m in tf[begin:] for t in m.transforms}
    check("without odometry the node sends map to odom to base_link", {("map", "odom"), ("odom", "base_link")} <= links, links)
    code, secs = mapper.end()
    check("SIGINT while mapping ends it, whatever geometry is at", code == 0 and secs <= 2.0, f"exit {code} after {secs:.2f} s")
    robot.stop()


def main():
    rclpy.init()
    recording = load(ROOT / "recordings/demo.mcap")
    observer = Observer()
    with_odometry(observer, recording)
    observer.close()
    observer = Observer("observer_alone")
    without_odometry(observer, recording)
    observer.close()
    rclpy.shutdown()
    print(f"{check.n - check.n_failed} of {check.n} checks of the map are good")
    sys.exit(check.n_failed > 0)


if __name__ == "__main__":
    main()
