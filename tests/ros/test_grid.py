"""Grids over DDS as Nav2 takes them: each message accepted, late subscribers served, a planner finds its way around walls, files load."""

import os
import pathlib
import shutil
import subprocess
import sys
import time

import numpy
import rclpy
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid
from nvblox_msgs.msg import DistanceMapSlice
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from splat_mapper_msgs.msg import EllipsoidArray
from splat_mapper_msgs.srv import GetDistanceBox, GetDistances, GetEllipsoids, GetMesh
from tf2_msgs.msg import TFMessage

from mapper import ROOT, Checks, Mapper, Observer, wait_until
from nav2_rules import FREE, LETHAL, UNKNOWN, StaticLayer, load_map, path_between

check = Checks()
OUT = pathlib.Path(os.environ.get("ROS_TEST_OUT", "/tmp")) / "grid"
# As the static layer asks for it.
MAP = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RELIABLE = QoSProfile(depth=50)
WORDS = """source.max_side=320 train.max_side=160 train.sh_degree=0 map.max_splats=4000 train.seeds_per_keyframe=300 train.steps=100
backend=cpu geometry=ground_truth source.pose_topic=/ground_truth/pose source.depth_topic=/camera/depth map.snapshot_secs=0.5
grid.period=0.2 ros2.enabled=on publish.shutdown_delay=600""".split()
# A robot of 30 cm.
RADIUS_CELLS = 3


def settings(words):
    return [part for word in words for part in ("--set", word)]


def planned(costs):
    """Ways between free cells that lie far apart -> (pairs that have one, pairs), cells of walls that a way crosses."""
    free = numpy.argwhere(costs == FREE)
    n_found, n_crossed, pairs = 0, 0, []
    for corner in [(0, 0), (0, 1), (1, 0), (1, 1)]:
        signs = numpy.where(numpy.array(corner) == 1, 1, -1)
        order = numpy.argsort(-(free * signs).sum(axis=1))
        # The first from which a robot of this size goes anywhere.
        reach = (tuple(int(v) for v in free[i]) for i in order[:: max(1, len(order) // 400)])
        fits = (cell for cell in reach if path_between(costs, cell, cell, RADIUS_CELLS))
        pairs.append(next(fits))
    ways = [(a, b) for i, a in enumerate(pairs) for b in pairs[i + 1 :]]
    for a, b in ways:
        path = path_between(costs, a, b, RADIUS_CELLS)
        n_found += path is not None
        n_crossed += sum(costs[cell] != FREE for cell in path or [])
    return n_found, len(ways), n_crossed


def ask_distances(observer, layer, slice_):
    """The service beside grid and slice: at obstacles there is no room, on free ground as much as the slice says, or less above and below it."""
    def middles(kind):
        cells = numpy.argwhere(layer.costs == kind)[::7][:3000]
        xy = (cells[:, ::-1] + 0.5) * layer.info.resolution
        xy += [layer.info.origin.position.x, layer.info.origin.position.y]
        heights = numpy.full((len(cells), 1), slice_.origin.z)
        return cells, numpy.hstack([xy, heights])

    def ask(points, frame=layer.frame):
        request = GetDistances.Request(frame_id=frame, points=[float(v) for v in points.ravel()])
        return observer.call(GetDistances, "/splat_mapper/get_distances", request)

    cells, points = middles(FREE)
    answer = ask(points)
    good = answer is not None and answer.success and len(answer.distances) == len(points)
    if not check("get_distances answers", good, answer and answer.message):
        return
    plane = numpy.array(slice_.data).reshape(slice_.height, slice_.width)[cells[:, 0], cells[:, 1]]
    room = numpy.array(answer.distances)
    known = numpy.array(answer.known)
    check("the middle of a free cell is free, or nobody knows", (room[known] > 0).all(), room[known].min())
    # Obstacles of the plane lie at any height: in space none is nearer than half a cell's diagonal less.
    closer = (room > 0.06 + numpy.hypot(plane, slice_.origin.z + 3)).sum()
    check("nothing is farther in space than it can be", closer == 0, closer)
    gradients = numpy.linalg.norm(numpy.array(answer.gradients).reshape(-1, 3), axis=1)
    units = numpy.isclose(gradients, 1, atol=1e-3) | (gradients == 0)
    check("gradients are directions", units.all() and (gradients > 0).mean() > 0.5, (gradients > 0).mean())
    other = ask(points[:1], "odom")
    check("a frame that it does not know is refused", not other.success and "map" in other.message, other.message)


def ask_boxes(observer, voxels, ellipsoids):
    """What is in a box around an occupied voxel: the services beside the topics."""
    points = numpy.frombuffer(bytes(voxels.data), dtype="<f4").reshape(-1, 3)
    check("voxels are middles of 5 cm", numpy.allclose(points / 0.05 % 1, 0.5, atol=1e-2) and len(points) > 2000, len(points))
    means = numpy.array(ellipsoids.means).reshape(-1, 3)
    axes = numpy.array(ellipsoids.semi_axes).reshape(-1, 3)
    whole = len(means) == len(axes) == len(ellipsoids.ids) == len(ellipsoids.observations) > 100
    check("ellipsoids are whole", whole and (axes > 0).all(), len(means))
    check("each was seen often enough", min(ellipsoids.observations) >= ellipsoids.min_observations >= 3)
    # Around the busiest place.
    place = points[numpy.argmax([(numpy.linalg.norm(points - p, axis=1) < 0.4).sum() for p in points[:: len(points) // 200]]) * (len(points) // 200)]
    low, high = place - 0.4, place + 0.4
    corners = {"low": low.astype(numpy.float32), "high": high.astype(numpy.float32)}

    box = observer.call(GetDistanceBox, "/splat_mapper/get_distance_box", GetDistanceBox.Request(**corners))
    good = check("get_distance_box answers", box is not None and box.success, box and box.message)
    if good:
        n_x, n_y, n_z = box.size
        distances = numpy.array(box.distances).reshape(n_z, n_y, n_x)
        index = numpy.round((place - numpy.array(box.origin)) / box.resolution).astype(int)
        here = distances[index[2], index[1], index[0]]
        check("a voxel of a surface is at the surface", abs(here) <= 0.05, here)
        request = GetDistances.Request(frame_id=box.frame_id, points=[float(v) for v in place])
        single = observer.call(GetDistances, "/splat_mapper/get_distances", request)
        check("and get_distances says the same", abs(single.distances[0] - here) < 1e-5, single.distances[0])

    mesh = observer.call(GetMesh, "/splat_mapper/get_mesh", GetMesh.Request(**corners))
    if check("get_mesh answers", mesh is not None and mesh.success, mesh and mesh.message):
        vertices = numpy.array(mesh.vertices).reshape(-1, 3)
        colors = numpy.array(mesh.colors).reshape(-1, 3)
        check("each vertex has a colour", len(colors) == len(vertices) > 50, len(vertices))
        check("some are no grey", (colors != 128).any(axis=1).mean() > 0.3, (colors != 128).any(axis=1).mean())
        check("triangles are of vertices", len(mesh.triangles) % 3 == 0 and max(mesh.triangles) < len(vertices))

    near = observer.call(GetEllipsoids, "/splat_mapper/get_ellipsoids", GetEllipsoids.Request(**corners))
    if check("get_ellipsoids answers", near is not None and near.success, near and near.message):
        found = numpy.array(near.ellipsoids.means).reshape(-1, 3)
        inside = (found >= low - 1e-4).all() and (found <= high + 1e-4).all()
        check("those of the box and no others", inside and len(found) > 0, len(found))
    large = GetMesh.Request(low=numpy.full(3, -1e3, numpy.float32), high=numpy.full(3, 1e3, numpy.float32))
    refused = observer.call(GetMesh, "/splat_mapper/get_mesh", large)
    check("too large a box is refused in words", not refused.success and "50 m" in refused.message, refused.message)


def main():
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    rclpy.init()
    observer = Observer()
    # In one list, so that their order is the wire's.
    grids = observer.listen(OccupancyGrid, "/splat_mapper/grid", MAP)
    updates = observer.listen(OccupancyGridUpdate, "/splat_mapper/grid_updates", RELIABLE)
    slices = observer.listen(DistanceMapSlice, "/splat_mapper/distance_slice", MAP)
    run = OUT / "run"
    mapper = Mapper("replay", "recordings/demo.mcap", "--out", str(run), *settings(WORDS), log="grid.log")
    mapper.wait_for_log("report.html", 240)
    check("grids come", wait_until(lambda: grids and slices, 20), f"{len(grids)} and {len(updates)} updates")
    time.sleep(1.0)

    layer = StaticLayer()
    for _, message in sorted(grids + updates, key=lambda entry: entry[0]):
        take = layer.take_map if isinstance(message, OccupancyGrid) else layer.take_update
        take(message)
    check("Nav2's static layer takes every message", not layer.warnings, "; ".join(layer.warnings))
    check("the grid seldom changes its size", layer.n_resized <= 4, layer.n_resized)
    n = {kind: int((layer.costs == kind).sum()) for kind in (FREE, LETHAL, UNKNOWN)}
    check("nothing is anything else", sum(n.values()) == layer.costs.size, n)
    check("there is room and there are walls", n[FREE] > 1000 and n[LETHAL] > 300, n)

    newest = slices[-1][1]
    distances = numpy.array(newest.data).reshape(newest.height, newest.width)
    same = distances.shape == layer.costs.shape
    check("the slice has the cells of the grid", same, distances.shape)
    known = distances != newest.unknown_value
    check("what the grid does not know, the slice does not", same and (known == (layer.costs != UNKNOWN)).all())
    check("obstacles are no distance away", same and (distances[layer.costs == LETHAL] < 0).all())

    late = Observer("late")
    late_grids = late.listen(OccupancyGrid, "/splat_mapper/grid", MAP)
    transforms = late.listen(TFMessage, "/tf_static", MAP)
    check("a late subscriber gets the grid", wait_until(lambda: late_grids, 10))
    frame = layer.frame
    is_known = lambda: frame == "map" or any(t.child_frame_id == frame for _, m in transforms for t in m.transforms)  # noqa: E731
    check("the frame of the grid is the map's, or has a transform", wait_until(is_known, 10), frame)

    n_found, n_ways, n_crossed = planned(layer.costs)
    check("a planner finds ways", n_found >= 1, f"{n_found} of {n_ways}")
    check("and none through a wall", n_crossed == 0, n_crossed)

    ask_distances(late, layer, newest)
    clouds = late.listen(PointCloud2, "/splat_mapper/voxels", MAP)
    arrays = late.listen(EllipsoidArray, "/splat_mapper/ellipsoids", MAP)
    if check("voxels and ellipsoids come late, too", wait_until(lambda: clouds and arrays, 10)):
        ask_boxes(late, clouds[-1][1], arrays[-1][1])

    page = OUT / "map.yaml"
    program = os.environ["SPLAT_MAPPER"]
    subprocess.run([program, "export", str(run / "map.splatmap"), str(page)], check=True, cwd=ROOT)
    values, resolution, _ = load_map(page)
    n_file = int((values == 0).sum())
    check("map_server's loader reads the file", resolution == 0.05 and n_file > 1000, n_file)

    code, _ = mapper.end()
    check("the node ends", code == 0, code)
    late.close()
    observer.close()
    rclpy.shutdown()
    print(f"{check.n - check.n_failed} of {check.n} checks hold")
    return check.n_failed != 0


if __name__ == "__main__":
    sys.exit(main())
