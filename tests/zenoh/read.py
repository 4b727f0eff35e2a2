"""Reads a running mapper with other people's programs: eclipse-zenoh as the peer, rosbags as the decoder.

Usage: read.py BINARY RECORDING WORK_FOLDER. Fails with the first thing that is not as it should be; prints figures.
"""

import hashlib
import json
import os
import pathlib
import socket
import struct
import subprocess
import sys
import threading
import time

import keys
import numpy
import zenoh
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

BINARY, RECORDING, WORK = sys.argv[1], sys.argv[2], pathlib.Path(sys.argv[3])
PATIENCE_S = 240.0
HEADER = bytes([0, 1, 0, 0])


def typestore():
    """The types of ROS 2 Jazzy and ours, by their definition files."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for path in sorted(pathlib.Path("msgs/msg").glob("*.msg")):
        types.update(get_types_from_msg(path.read_text(), f"splat_mapper_msgs/msg/{path.stem}"))
    for path in sorted(pathlib.Path("msgs/srv").glob("*.srv")):
        asked, answered = path.read_text().split("---\n")
        name = f"splat_mapper_msgs/msg/{path.stem}"
        types.update(get_types_from_msg(asked, f"{name}_Request"))
        types.update(get_types_from_msg(answered, f"{name}_Response"))
    store.register(types)
    return store


STORE = typestore()


def expect(is_so, what):
    if not is_so:
        sys.exit(f"FAILED: {what}")
    print(f"ok: {what}", flush=True)


def decode(key, payload):
    """A sample by its key alone: .../pkg::msg::dds_::Name_/RIHS01_hash."""
    spelled, type_hash = key.rsplit("/", 2)[1:]
    package, kind, _, name = spelled.split("::")
    ros_type = f"{package}/{kind}/{name.rstrip('_')}"
    return ros_type, type_hash, STORE.deserialize_cdr(payload, ros_type)


def open_session(endpoint):
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


class Received:
    """All samples by topic, in order."""

    def __init__(self):
        self.lock = threading.Lock()
        self.topics = {}

    def take(self, sample):
        key = str(sample.key_expr)
        with self.lock:
            self.topics.setdefault(key, []).append(bytes(sample.payload))

    def of(self, name):
        with self.lock:
            found = {k: list(v) for k, v in self.topics.items() if "/".join(k.split("/")[2:-2]) == name}
        expect(len(found) == 1, f"{name} came under one key")
        ((key, payloads),) = found.items()
        return key, payloads


def rss_mib(pid):
    for line in pathlib.Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    return 0.0


def cpu_s(pid):
    fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def ask(session, service, request, fields):
    """A service by its key; rosbags knows no services, so that the hash is left open."""
    kind, package = service
    body = bytes(STORE.serialize_cdr(STORE.types[request](**fields), request)) if request else HEADER + b"\0"
    # A wildcard is no question: the full key is learned from the service's token.
    tokens = [str(t.ok.key_expr) for t in session.liveliness().get(f"@ros2_lv/0/**") if t.ok is not None]
    mine = [t for t in tokens if f"%splat_mapper%{kind}/" in t and "/SS/" in t]
    expect_quietly(len(mine) == 1, f"{kind} has one token")
    type_hash = mine[0].split("/")[-2]
    key = f"0/splat_mapper/{kind}/{package}/{type_hash}"
    stamp = struct.pack("<qqB", 7, 0, 16) + bytes(range(16))
    replies = [r for r in session.get(key, payload=body, attachment=stamp, timeout=40.0)]
    expect_quietly(len(replies) == 1 and replies[0].ok is not None, f"{kind} answers once")
    back = bytes(replies[0].ok.attachment)
    expect_quietly(struct.unpack("<q", back[:8])[0] == 7 and back[17:] == bytes(range(16)), f"{kind} names its asker")
    return bytes(replies[0].ok.payload)


def own(kind, name, fields, session):
    request = f"splat_mapper_msgs/msg/{name}_Request"
    answer = ask(session, (kind, f"splat_mapper_msgs::srv::dds_::{name}_"), request, fields)
    return STORE.deserialize_cdr(answer, f"splat_mapper_msgs/msg/{name}_Response")


def trigger(kind, session):
    answer = ask(session, (kind, "std_srvs::srv::dds_::Trigger_"), None, {})
    (success,) = struct.unpack_from("<?", answer, 4)
    return success


def sha_of_chunks(chunks):
    """As SplatManifest.msg says."""
    chunks = sorted(chunks, key=lambda c: c.chunk_ix)
    degree = chunks[0].sh_degree
    widths = [3, 3, 4, 1, 3 * (degree + 1) ** 2, 1]
    arrays = [[] for _ in widths]
    for chunk in chunks:
        data = bytes(chunk.data)
        n = len(data) // (4 * sum(widths))
        at = 0
        for array, width in zip(arrays, widths):
            array.append(data[at : at + 4 * width * n])
            at += 4 * width * n
        expect_quietly(len(chunk.ids) == n, "a chunk has one id per splat")
    digest = hashlib.sha256(struct.pack("<QI", chunks[0].n_splats, degree))
    for array in arrays:
        digest.update(b"".join(array))
    return digest.hexdigest()


def check_topics(received, report, map_frame="map"):
    for name in ["pose", "odometry", "path", "cloud", "keyframe_cloud", "frusta", "keyframes", "splats",
                 "splats/manifest", "status"]:
        key, payloads = received.of(name)
        ros_type, type_hash, _ = decode(key, payloads[0])
        expect(STORE.hash_rihs01(ros_type) == type_hash, f"{name}: type hash of {ros_type} as rosbags has it")
    for topic in ["0/tf/", "0/diagnostics/"]:
        expect(any(key.startswith(topic) for key in received.topics), f"{topic} came")
    _, poses = received.of("pose")
    key, _ = received.of("pose")
    poses = [decode(key, p)[2] for p in poses]
    expect(poses[-1].header.frame_id == map_frame, "poses are in the map frame")
    variances = numpy.array(poses[-1].pose.covariance).reshape(6, 6)
    expect(numpy.all(numpy.linalg.eigvalsh(variances) > 0), "a pose's covariance is positive definite")
    key, paths = received.of("path")
    path = decode(key, paths[-1])[2]
    expect(len(path.poses) == report["keyframes"]["registered"], "the path has all keyframes")
    key, clouds = received.of("cloud")
    cloud = decode(key, clouds[-1])[2]
    names = [field.name for field in cloud.fields]
    expect(names[:3] == ["x", "y", "z"], "the cloud has x y z")
    points = numpy.frombuffer(bytes(cloud.data), dtype=numpy.float32).reshape(cloud.width, -1)[:, :3]
    expect(cloud.width > 100 and numpy.isfinite(points).all(), f"the cloud's {cloud.width} points are finite")
    key, chunks = received.of("splats")
    chunks = [decode(key, p)[2] for p in chunks]
    last = [c for c in chunks if c.revision == chunks[-1].revision]
    expect(len(last) == last[0].n_chunks, "all chunks of the last snapshot came")
    expect(sha_of_chunks(last) == report["map_sha256"], "their hash is the saved map's")
    transforms = {}
    for key in [k for k in received.topics if k.startswith("0/tf/")]:
        for payload in received.topics[key]:
            for link in decode(key, payload)[2].transforms:
                transforms.setdefault(link.child_frame_id, set()).add(link.header.frame_id)
    expect(all(len(parents) == 1 for parents in transforms.values()), f"one parent each: {transforms}")


def check_services(session, report):
    answer = own("get_splats", "GetSplats", {"revision": 0, "first_chunk": 0, "max_chunks": 0}, session)
    manifest = answer.manifest
    expect(answer.success and bytes(manifest.map_sha256).hex() == report["map_sha256"], "get_splats gives the hash")
    chunks = []
    while len(chunks) < manifest.n_chunks:
        fields = {"revision": manifest.revision, "first_chunk": len(chunks), "max_chunks": 100}
        chunks += own("get_splats", "GetSplats", fields, session).chunks
    expect(sha_of_chunks(chunks) == report["map_sha256"], "get_splats brings the map")
    gone = {"revision": 4_000_000_000, "first_chunk": 0, "max_chunks": 1}
    expect(not own("get_splats", "GetSplats", gone, session).success, "a revision that is gone is refused")
    for bad in ["../evil.splatmap", "/tmp/evil.splatmap", "a.txt", "a/../../b.splatmap", "x" * 300]:
        expect(not own("save_map", "SaveMap", {"path": bad}, session).success, f"save_map refuses {bad[:20]!r}")
    saved = own("save_map", "SaveMap", {"path": "kept.splatmap"}, session)
    expect(saved.success and pathlib.Path(saved.path).stat().st_size > 1000, f"save_map: {saved.message}")
    written = own("export", "Export", {"path": "kept.ply"}, session)
    expect(written.success and pathlib.Path(written.path).stat().st_size > 1000, f"export: {written.message}")
    types = STORE.types
    info_type = types["sensor_msgs/msg/CameraInfo"]
    header = types["std_msgs/msg/Header"](stamp=types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id="")
    roi = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=0.0, y=0.0, z=0.0),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    def seen(width, height, frame=""):
        k = numpy.array([width, 0, width / 2, 0, width, height / 2, 0, 0, 1], dtype=numpy.float64)
        info = info_type(header=header, height=height, width=width, distortion_model="", d=numpy.zeros(0), k=k,
                         r=numpy.zeros(9), p=numpy.zeros(12), binning_x=0, binning_y=0, roi=roi)
        asked = types["std_msgs/msg/Header"](stamp=header.stamp, frame_id=frame)
        fields = {"header": asked, "pose": pose, "camera": info, "with_depth": True}
        return own("render_view", "RenderView", fields, session)
    image = seen(64, 48)
    expect(image.success and len(image.image.data) == 64 * 48 * 3 and len(image.depth.data) == 64 * 48 * 4,
           f"render_view shows something of mean {numpy.mean(image.image.data):.0f}")
    expect(not seen(100_000, 48).success and not seen(0, 0).success, "render_view refuses sizes that are none")
    expect(seen(64, 48, "map").success and seen(64, 48, "splat_map").success, "render_view takes poses in map and splat_map")
    unknown = seen(64, 48, "odom")
    expect(not unknown.success and "splat_map" in unknown.message, f"render_view names the frames it knows: {unknown.message}")
    asked = {"frame_id": "odom", "points": numpy.zeros(3, dtype=numpy.float32), "max_distance": 0.0}
    refused = own("get_distances", "GetDistances", asked, session)
    expect(not refused.success and refused.message, f"get_distances says why not: {refused.message}")
    corners = {"low": numpy.zeros(3, dtype=numpy.float32), "high": numpy.ones(3, dtype=numpy.float32)}
    for name, kind in [("get_ellipsoids", "GetEllipsoids"), ("get_mesh", "GetMesh"), ("get_distance_box", "GetDistanceBox")]:
        more = {"max_distance": 0.0} if kind == "GetDistanceBox" else {}
        refused = own(name, kind, {"frame_id": "odom"} | corners | more, session)
        expect(not refused.success and refused.message, f"{name} says why not: {refused.message}")
    expect(trigger("pause", session) and trigger("resume", session), "pause and resume")


def harass(session, pid):
    """Noise on every key, lengths that are lies, declarations without end: little memory, no harm."""
    rss, cpu, start = rss_mib(pid), cpu_s(pid), time.monotonic()
    tokens = [str(t.ok.key_expr) for t in session.liveliness().get("@ros2_lv/0/**") if t.ok is not None]
    services = [t for t in tokens if "/SS/" in t]
    lie = HEADER + struct.pack("<I", 1 << 30) + b"x" * 64
    for n in range(2000):
        token = services[n % len(services)]
        parts = token.split("/")
        key = "0/" + parts[-4].replace("%", "/").lstrip("/") + f"/{parts[-3]}/{parts[-2]}"
        if "reset" in key or "pause" in key:
            continue
        noise = lie if n % 2 else os.urandom(n % 5000)
        for _ in session.get(key, payload=noise, timeout=2.0):
            pass
        session.put(f"0/splat_mapper/pose/{n}/x", noise)
    declared = [session.declare_subscriber(f"0/splat_mapper/noise/{n}", lambda _: None) for n in range(10_000)]
    for subscriber in declared:
        subscriber.undeclare()
    wall = time.monotonic() - start
    more, busy = rss_mib(pid) - rss, (cpu_s(pid) - cpu) / wall
    # A node at work has all of them.
    share = busy / os.cpu_count()
    print(f"hostile peer: {wall:.1f} s, node RSS {more:+.1f} MiB, node CPU {100 * busy:.0f} % of a core", flush=True)
    expect(more < 64, "a hostile peer costs less than 64 MiB")
    expect(share < 0.2, f"a hostile peer costs {100 * share:.0f} % of the processor")


def check_recording(path):
    n = 0
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        topics = set()
        for _, channel, _, message in reader.iter_decoded_messages():
            topics.add(channel.topic)
            n += 1
            expect_quietly(message is not None, "decodes")
    expect(n > 50 and len(topics) >= 12, f"PyPI mcap reads all {n} messages of {len(topics)} topics of the recording")


def expect_quietly(is_so, what):
    if not is_so:
        sys.exit(f"FAILED: {what}")


def main():
    WORK.mkdir(parents=True, exist_ok=True)
    out, endpoint = WORK / "out", f"tcp/127.0.0.1:{free_port()}"
    recording = WORK / "sent.mcap"
    settings = ["publish.zenoh=true", "publish.scouting=false", f"publish.zenoh_listen={endpoint}",
                f"publish.map_directory={WORK / 'files'}", f"publish.record={recording}", "publish.shutdown_delay=600",
                "map.snapshot_secs=0.5", "publish.full_map_period=3"]
    command = [BINARY, "replay", RECORDING, "--out", str(out), "--max-side", "240", "--steps", "300"]
    for setting in settings:
        command += ["--set", setting]
    node = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        session, received = None, Received()
        start = time.monotonic()
        while session is None:
            try:
                with socket.create_connection(("127.0.0.1", int(endpoint.rsplit(":", 1)[1])), 1):
                    session = open_session(endpoint)
            except OSError:
                expect_quietly(time.monotonic() - start < PATIENCE_S, "the node listens")
                time.sleep(0.1)
        subscribers = [session.declare_subscriber(key, received.take) for key in ["0/splat_mapper/**", "0/tf/**", "0/diagnostics/**"]]
        while not (out / "report.json").exists():
            expect_quietly(node.poll() is None, "the node runs")
            expect_quietly(time.monotonic() - start < PATIENCE_S, "the node ends its run")
            time.sleep(0.2)
        report = json.loads((out / "report.json").read_text())
        time.sleep(1.0)
        check_topics(received, report)
        tokens = [str(t.ok.key_expr) for t in session.liveliness().get("@ros2_lv/0/**") if t.ok is not None]
        keys.check(tokens, list(received.topics), session, expect)
        deltas = [k for k in received.topics if "/splats/delta/" in k]
        if deltas:
            key, payloads = deltas[0], received.topics[deltas[0]]
            expect(STORE.hash_rihs01(decode(key, payloads[0])[0]) == key.rsplit("/", 1)[1], "type hash of deltas")
            bytes_of_map = report["splats"] * 96
            share = max(len(p) for p in payloads) / bytes_of_map
            print(f"deltas: {len(payloads)}, the largest {100 * share:.1f} % of the last whole map", flush=True)
        late = [r.ok for r in session.get("0/splat_mapper/**", timeout=20.0, consolidation=zenoh.ConsolidationMode.NONE) if r.ok]
        chunks = [decode(str(s.key_expr), bytes(s.payload))[2] for s in late if "/splats/splat_mapper_msgs" in str(s.key_expr)]
        expect(sha_of_chunks(chunks) == report["map_sha256"], "a late joiner gets the map")
        check_services(session, report)
        harass(session, node.pid)
        late = [r.ok for r in session.get("0/splat_mapper/**", timeout=20.0, consolidation=zenoh.ConsolidationMode.NONE) if r.ok]
        chunks = [decode(str(s.key_expr), bytes(s.payload))[2] for s in late if "/splats/splat_mapper_msgs" in str(s.key_expr)]
        expect(sha_of_chunks(chunks) == report["map_sha256"], "after all this the map is the same")
        del subscribers
        session.close()
        node.send_signal(2)
        start = time.monotonic()
        expect(node.wait(10) == 0, f"the node ends {time.monotonic() - start:.1f} s after SIGINT")
        check_recording(recording)
        print("all is as it should be")
    finally:
        node.kill()


main()
