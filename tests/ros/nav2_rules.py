"""What Nav2 does with a map, as its sources of 2026-08 have it: the static layer, the loader of map files, the marks of an obstacle layer.

A stand-in for tests where Nav2 itself cannot be installed: facts and numbers of navigation2, none of its code.
"""

import heapq
import math
import pathlib
import re

import numpy

FREE, INSCRIBED, LETHAL, UNKNOWN = 0, 253, 254, 255
LARGEST_SIDE = 32767


def fault_of_header(header):
    """Why a message is dropped; None where it is not."""
    if not header.frame_id:
        return "no frame_id"
    if header.stamp.nanosec >= 1_000_000_000:
        return "nanoseconds beyond a second"
    return None


def fault_of_grid(grid):
    """`validateMsg` of an OccupancyGrid."""
    info, turn = grid.info, grid.info.origin.orientation
    numbers = [info.resolution, info.origin.position.x, info.origin.position.y, info.origin.position.z]
    norm = math.sqrt(turn.x**2 + turn.y**2 + turn.z**2 + turn.w**2)
    if fault_of_header(grid.header):
        return fault_of_header(grid.header)
    if not all(math.isfinite(number) for number in numbers) or not abs(norm - 1.0) <= 1e-4:
        return "a pose that is none"
    if info.resolution < 1e-6:
        return "no resolution"
    if not (0 < info.width <= LARGEST_SIDE and 0 < info.height <= LARGEST_SIDE):
        return "sides out of bounds"
    if len(grid.data) != info.width * info.height:
        return "data of another size"
    return None


class StaticLayer:
    """With `track_unknown_space` true and `subscribe_to_updates` true, all else at its default."""

    def __init__(self):
        self.costs = None
        self.info = None
        self.frame = None
        self.n_resized = 0
        self.warnings = []

    @staticmethod
    def interpret(values):
        """`interpretValue`: -1 unknown, 99 inscribed, 100 lethal, all else free."""
        values = numpy.asarray(values, dtype=numpy.int16)
        costs = numpy.full(values.shape, FREE, dtype=numpy.uint8)
        costs[values == -1] = UNKNOWN
        costs[values == 99] = INSCRIBED
        costs[values >= 100] = LETHAL
        return costs

    def take_map(self, grid):
        fault = fault_of_grid(grid)
        if fault:
            self.warnings.append(fault)
            return False
        info = grid.info
        cells = [info.origin.position.x / info.resolution, info.origin.position.y / info.resolution]
        if any(abs(cell - round(cell)) > 1e-3 for cell in cells):
            self.warnings.append("the origin is no multiple of the resolution")
        same = self.info is not None and (
            (info.width, info.height, info.resolution, info.origin.position)
            == (self.info.width, self.info.height, self.info.resolution, self.info.origin.position)
        )
        self.n_resized += not same
        self.info, self.frame = info, grid.header.frame_id
        self.costs = self.interpret(grid.data).reshape(info.height, info.width)
        return True

    def take_update(self, update):
        """False where it is dropped."""
        fault = fault_of_header(update.header)
        if self.costs is None:
            fault = "an update before a map"
        elif update.header.frame_id != self.frame:
            fault = "an update in another frame"
        elif update.x < 0 or update.y < 0 or max(update.width, update.height) > LARGEST_SIDE:
            fault = "an update out of bounds"
        elif update.x + update.width > self.info.width or update.y + update.height > self.info.height:
            fault = "an update beyond the map"
        elif len(update.data) != update.width * update.height:
            fault = "an update of another size"
        if fault:
            self.warnings.append(fault)
            return False
        rows = slice(update.y, update.y + update.height)
        columns = slice(update.x, update.x + update.width)
        self.costs[rows, columns] = self.interpret(update.data).reshape(update.height, update.width)
        return True


def load_map(path):
    """The files of map_server -> values as an OccupancyGrid has them, lowest row first, resolution, origin."""
    path = pathlib.Path(path)
    page = dict(re.findall(r"^(\w+): *(.+)$", path.read_text(), re.MULTILINE))
    assert page["mode"] == "trinary" and page["negate"] == "0", page
    image = (path.parent / page["image"].strip('"')).read_bytes()
    magic, width, height, most = image.split(maxsplit=4)[:4]
    assert magic == b"P5" and most == b"255"
    n = int(width) * int(height)
    pixels = numpy.frombuffer(image[-n:], dtype=numpy.uint8).reshape(int(height), int(width))[::-1]
    occupancy = (255 - pixels.astype(float)) / 255
    values = numpy.full(pixels.shape, -1, dtype=numpy.int8)
    values[occupancy >= float(page["occupied_thresh"])] = 100
    values[occupancy <= float(page["free_thresh"])] = 0
    origin = [float(number) for number in page["origin"].strip("[]").split(",")]
    return values, float(page["resolution"]), origin


def n_marked(heights, min_height, max_height):
    """Points that an obstacle layer marks; its default `max_obstacle_height` of 0 marks none."""
    heights = numpy.asarray(heights)
    return int(((heights >= min_height) & (heights <= max_height)).sum())


def inflated(costs, cells):
    """Lethal cells grown by a radius: where the middle of a robot cannot be."""
    blocked = costs == LETHAL
    grown = blocked.copy()
    for y in range(-cells, cells + 1):
        for x in range(-cells, cells + 1):
            if x * x + y * y <= cells * cells:
                grown |= numpy.roll(numpy.roll(blocked, y, axis=0), x, axis=1)
    return grown


def path_between(costs, start, goal, radius_cells=0):
    """A* over free cells, eight ways and no corner cut; (row, column) after (row, column), None where there is no way."""
    allowed = (costs == FREE) & ~inflated(costs, radius_cells)
    if not (allowed[start] and allowed[goal]):
        return None
    rows, columns = costs.shape
    best, before = {start: 0.0}, {}
    queue = [(math.dist(start, goal), start)]
    while queue:
        _, cell = heapq.heappop(queue)
        if cell == goal:
            path = [cell]
            while path[-1] in before:
                path.append(before[path[-1]])
            return path[::-1]
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                y, x = cell[0] + dy, cell[1] + dx
                if not (0 <= y < rows and 0 <= x < columns and allowed[y, x]):
                    continue
                if not (allowed[cell[0], x] and allowed[y, cell[1]]):
                    continue
                cost = best[cell] + math.hypot(dy, dx)
                if cost < best.get((y, x), math.inf):
                    best[y, x] = cost
                    before[y, x] = cell
                    heapq.heappush(queue, (cost + math.dist((y, x), goal), (y, x)))
    return None
