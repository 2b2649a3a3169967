"""NanoVDB's .nvdb files: one buffer a grid, its nodes in arrays.

Layout: nanovdb/NanoVDB.h, version 32: GridData of 672 bytes, TreeData of 64, then root, upper, lower and
leaf nodes.
"""

import struct

import numpy as np

from dano.fields.readers._sparse import Block, corner, Rows, SparseGrid, Stream, unblosc
from dano.memory import decompressed

_NANO_CLASSES = {1: "level set", 2: "fog volume"}


def read_nanovdb(data: bytes) -> Rows:
    """The grids of a NanoVDB file.

    Raises:
        ValueError: If the bytes are not NanoVDB, are damaged, or are of a version that is not read.
        EOFError: If the file ends too early.
    """
    rows = []
    for name, kind, buffer in _buffers(data):
        readable = kind in (1, 2)
        rows.append(
            (
                name,
                {1: "float", 2: "double"}.get(kind, f"type {kind}"),
                _grid(buffer) if readable else None,
            )
        )
    return rows


def _buffers(data: bytes) -> list[tuple[str, int, bytes]]:
    """Name, type and decompressed buffer of each grid."""
    if data[:8] == b"NanoVDB1":
        return [(data[40:296].split(b"\0")[0].decode(), struct.unpack_from("<I", data, 636)[0], data)]
    stream, found = Stream(data), []
    while stream.at < len(data):
        if stream.take(8) not in (b"NanoVDB0", b"NanoVDB2"):
            raise ValueError("expected a NanoVDB file, got one that does not start as such")
        version, count, codec = stream.unpack("IHH")
        if version >> 21 != 32:
            raise ValueError(f"expected a NanoVDB file of version 32, got {version >> 21}")
        heads = []
        for _ in range(count):
            head = stream.take(176)
            size, stored = struct.unpack_from("<QQ", head)
            name = stream.take(struct.unpack_from("<I", head, 136)[0]).split(b"\0")[0].decode()
            heads.append((name, struct.unpack_from("<I", head, 32)[0], size, stored))
        for name, kind, size, stored in heads:
            buffer = stream.take(stored) if codec == 0 else _decompressed(stream, size, codec)
            if len(buffer) != size:
                raise ValueError(f"grid {name!r} has {len(buffer)} bytes instead of {size}")
            found.append((name, kind, buffer))
    return found


def _decompressed(stream: Stream, size: int, codec: int) -> bytes:
    """One piece or several, each after its length, which the size in the file's head may count or not."""
    pieces = bytearray()
    while len(pieces) < size:
        piece = stream.take(stream.unpack("q")[0])
        pieces += decompressed(piece) if codec == 1 else unblosc(piece)
    return bytes(pieces)


def _grid(data: bytes) -> SparseGrid:
    name = data[40:296].split(b"\0")[0].decode()
    matrix = np.frombuffer(data, "<f8", 9, 296 + 88).reshape(3, 3)
    offset = np.frombuffer(data, "<f8", 3, 296 + 88 + 144)
    kind, value_type = struct.unpack_from("<II", data, 632)
    value = np.dtype("<f4" if value_type == 1 else "<f8")
    root = 672 + struct.unpack_from("<4q", data, 672)[3]
    count = struct.unpack_from("<I", data, root + 24)[0]
    # The background follows the size of the table, aligned to its own size.
    background_at = root + (28 if value.itemsize == 4 else 32)
    background = float(np.frombuffer(data, value, 1, background_at)[0])
    table = root + _aligned(background_at - root + 5 * value.itemsize, 32)
    blocks: list[Block] = []
    for row in range(count):
        at = table + 32 * row
        key, child, state = struct.unpack_from("<QqI", data, at)
        # Key: z, y, x of the 4096³ cube, 21 bits each, as unsigned numbers.
        x, y, z = ((key >> shift & 0x1FFFFF) << 12 for shift in (42, 21, 0))
        x, y, z = (int(n - (1 << 32) if n >= 1 << 31 else n) for n in (x, y, z))
        if child:
            _node(data, root + child, (x, y, z), (5, 4, 3), value, background, blocks)
        else:
            tile = float(np.frombuffer(data, value, 1, at + (20 if value.itemsize == 4 else 24))[0])
            blocks.append(Block((x, y, z), 4096, tile, bool(state)))
    return SparseGrid(name, _NANO_CLASSES.get(kind, ""), matrix, offset, background, blocks)


def _node(
    data: bytes,
    at: int,
    origin: tuple[int, int, int],
    logs: tuple[int, ...],
    value: np.dtype,
    background: float,
    blocks: list[Block],
) -> None:
    if len(logs) == 1:
        # Box 12 + 4, mask 64, least, largest, mean and deviation, then the values.
        start = at + _aligned(80 + 4 * value.itemsize, 32)
        blocks.append(Block(origin, 8, np.frombuffer(data, value, 512, start).reshape(8, 8, 8), True))
        return
    side, size = 1 << logs[0], 1 << sum(logs[1:])
    count = side**3
    masks = np.frombuffer(data, np.uint8, count // 4, at + 32)
    active, child = np.unpackbits(masks, bitorder="little").astype(bool).reshape(2, count)
    table = at + _aligned(32 + count // 4 + 4 * value.itemsize, 32)
    offsets = np.frombuffer(data, "<i8", count, table)
    values = np.frombuffer(data, value, count * 8 // value.itemsize, table)[:: 8 // value.itemsize]
    for n in np.flatnonzero(child):
        first = corner(origin, int(n), side, size)
        _node(data, at + int(offsets[n]), first, logs[1:], value, background, blocks)
    for n in np.flatnonzero(~child & ((values != background) | active)):
        blocks.append(Block(corner(origin, int(n), side, size), size, float(values[n]), bool(active[n])))


def _aligned(size: int, to: int) -> int:
    return -(-size // to) * to
