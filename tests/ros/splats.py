"""A client of the splat topics, by the text of msgs/msg alone: chunks and deltas in, the map's digest out."""

import hashlib
import struct

import numpy


def widths(sh_degree):
    """Bytes of one splat in each of the seven arrays of SplatChunk.data."""
    return [12, 12, 16, 4, 12 * (sh_degree + 1) ** 2, 4]


def rows(data, n, sh_degree):
    """Each array as n rows of bytes."""
    out, at = [], 0
    for width in widths(sh_degree):
        block = numpy.frombuffer(data, numpy.uint8, n * width, at).reshape(n, width)
        out.append(block)
        at += n * width
    assert at == len(data), f"{len(data)} bytes for {n} splats of degree {sh_degree}"
    return out


def crc32c(data):
    """Castagnoli, a byte at a time over a table."""
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = (byte >> 1) ^ (0x82F63B78 if byte & 1 else 0)
        table.append(byte)
    crc = 0xFFFFFFFF
    for byte in data:
        crc = table[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc ^ 0xFFFFFFFF


class Client:
    """Splats by id."""

    def __init__(self):
        self.splats = {}
        self.key = None
        self.sh_degree = 0

    def whole(self, chunks):
        """All chunks of one revision."""
        first = chunks[0]
        self.splats = {}
        self.sh_degree = first.sh_degree
        for chunk in sorted(chunks, key=lambda c: c.chunk_ix):
            self.put(chunk)
        self.key = (bytes(first.map_id), first.epoch, first.revision)

    def delta(self, pieces):
        """All pieces of one delta; false where another revision is held."""
        first = pieces[0]
        if self.key != (bytes(first.map_id), first.epoch, first.base_revision):
            return False
        for piece in pieces:
            for gone in piece.removed:
                del self.splats[gone]
        for piece in pieces:
            self.put(piece)
        self.key = (bytes(first.map_id), first.epoch, first.revision)
        return True

    def put(self, message):
        data = bytes(message.data)
        arrays = rows(data, len(message.ids), message.sh_degree)
        for ix, splat_id in enumerate(message.ids):
            self.splats[splat_id] = [array[ix].tobytes() for array in arrays]

    def digest(self):
        """SHA-256 as SplatManifest.map_sha256 has it."""
        ordered = [self.splats[splat_id] for splat_id in sorted(self.splats)]
        sha = hashlib.sha256(struct.pack("<QI", len(ordered), self.sh_degree))
        for array in range(len(widths(self.sh_degree))):
            sha.update(b"".join(splat[array] for splat in ordered))
        return sha.digest()
