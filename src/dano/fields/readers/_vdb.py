"""Grids of OpenVDB (.vdb) and NanoVDB (.nvdb) files as dense fields.

The readers are dano's own: of those that the package index has, one loses tiles, which hold the inside of
most volumes, and the other is a simulator of 130 MB.

What the sparse grids of OpenVDB and NanoVDB have in common.

Both keep a tree of three levels of nodes of 32³, 16³ and 8³ entries; an entry is a child or a tile, one value
for its whole cube.
OpenVDB's .vdb files: a stream of nodes, first all topology, then all leaves.

Layout: openvdb/io/{Archive,File,GridDescriptor,Compression}.h and tree/{RootNode,InternalNode,LeafNode}.h,
file versions 222 to 224.
NanoVDB's .nvdb files: one buffer a grid, its nodes in arrays.

Layout: nanovdb/NanoVDB.h, version 32: GridData of 672 bytes, TreeData of 64, then root, upper, lower and
leaf nodes.
"""

import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dano.extras import optional
from dano.fields._grid import GridField
from dano.fields._signed_distance import extended_distances, SignedDistanceGrid
from dano.memory import decompressed


class Block(NamedTuple):
    """A cube of a sparse grid: its first voxel, and its values (8, 8, 8) or the one value of its tile."""

    origin: tuple[int, int, int]
    size: int
    values: np.ndarray | float
    active: bool


class SparseGrid(NamedTuple):
    """A grid as it stands in a file."""

    name: str  # Of the grid
    kind: str  # "fog volume", "level set", or another class, possibly ""
    # Index (i, j, k) to the file's world: x = matrix @ index + offset, shape (3, 3).
    matrix: Float[np.ndarray, "3 3"]
    offset: Float[np.ndarray, "3"]  # Shape (3,)
    background: float  # Value outside of all blocks
    blocks: list[Block]  # Leaves and tiles


Rows = list[tuple[str, str, SparseGrid | None]]
"""Name and type of each grid of a file, and the grid itself if it is one of floats."""


class Stream:
    """Reads little-endian values one after the other."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def take(self, count: int) -> bytes:
        """The next bytes.

        Raises:
            EOFError: If there are fewer.
        """
        if count < 0 or self.at + count > len(self.data):
            raise EOFError
        self.at += count
        return self.data[self.at - count : self.at]

    def unpack(self, form: str) -> tuple:
        """The next values, in the format of `struct` without its byte order."""
        return struct.unpack("<" + form, self.take(struct.calcsize("<" + form)))

    def text(self) -> str:
        """A string behind its length in bytes (uint32), UTF-8."""
        return self.take(self.unpack("I")[0]).decode()

    def mask(self, bits: int) -> np.ndarray:
        """So many bits, the lowest of each byte first, as booleans of shape (bits,)."""
        return np.unpackbits(np.frombuffer(self.take(bits // 8), np.uint8), bitorder="little").astype(bool)

    def metadata(self) -> dict[str, bytes]:
        """OpenVDB's metadata: names and raw values, whose types are passed over."""
        entries = {}
        for _ in range(self.unpack("I")[0]):
            name, _, size = self.text(), self.text(), self.unpack("I")[0]
            entries[name] = self.take(size)
        return entries


def corner(origin: tuple[int, int, int], n: int, side: int, size: int) -> tuple[int, int, int]:
    """First voxel of entry n of a node, z fastest."""
    x, y, z = origin
    return x + size * (n // side**2), y + size * (n // side % side), z + size * (n % side)


def unblosc(data: bytes) -> bytes:
    """What Blosc compressed.

    Raises:
        ValueError: If the bytes are damaged.
        ImportError: If blosc is not installed (extra `import`).
    """
    blosc = optional("blosc", "reading this VDB file needs blosc", "import")
    try:
        return blosc.decompress(data)
    except Exception as error:  # of a class that blosc does not export
        raise ValueError(f"a compressed block is damaged: {error}") from error


# The first bytes, map types and compression flags of the format, as in openvdb/io and openvdb/math/Maps.h.
_MAGIC = 0x56444220
_MAPS = {
    # What precedes the scale: doubles before it, doubles in all.
    "UniformScaleMap": (0, 15),
    "ScaleMap": (0, 15),
    "UniformScaleTranslateMap": (3, 18),
    "ScaleTranslateMap": (3, 18),
}
_ZIP, _MASKED, _BLOSC = 1, 2, 4


def read_openvdb(data: bytes) -> Rows:
    """The grids of an OpenVDB file.

    Raises:
        ValueError: If the bytes are not OpenVDB, are damaged, or are of a version that is not read.
        EOFError: If the file ends too early.
    """
    stream = Stream(data)
    magic, version = stream.unpack("qI")
    if magic != _MAGIC:
        raise ValueError("expected an OpenVDB file, got one that does not start as such")
    if not 222 <= version <= 224:
        raise ValueError(f"expected an OpenVDB file of version 222 to 224 (OpenVDB 3 to 12), got {version}")
    stream.unpack("II")
    if not stream.unpack("?")[0]:
        raise ValueError("expected an OpenVDB file with offsets of its grids, got a stream")
    stream.take(36)
    stream.metadata()
    rows = []
    for _ in range(stream.unpack("i")[0]):
        name, kind, parent = stream.text().split("\x1e")[0], stream.text(), stream.text()
        start, _, end = stream.unpack("qqq")
        readable = kind.removesuffix("_HalfFloat") in ("Tree_float_5_4_3", "Tree_double_5_4_3") and not parent
        stream.at = start
        rows.append((name, kind, _openvdb_grid(stream, name, kind) if readable else None))
        stream.at = end
    return rows


def _openvdb_grid(stream: Stream, name: str, kind: str) -> SparseGrid:
    compression = stream.unpack("I")[0]
    metadata = stream.metadata()
    matrix, offset = _transform(stream)
    tree = _OpenVdbTree(stream, compression, half=kind.endswith("_HalfFloat"), double="double" in kind)
    blocks = tree.read()
    return SparseGrid(
        metadata.get("name", name.encode()).decode(),
        metadata.get("class", b"").decode(),
        matrix,
        offset,
        tree.background,
        blocks,
    )


def _transform(stream: Stream) -> tuple[np.ndarray, np.ndarray]:
    kind = stream.text()
    if kind in _MAPS:
        skip, count = _MAPS[kind]
        numbers = np.asarray(stream.unpack(f"{count}d"))
        return np.diag(numbers[skip : skip + 3]), numbers[:3] if skip else np.zeros(3)
    if kind == "TranslationMap":
        return np.eye(3), np.asarray(stream.unpack("3d"))
    if kind in ("AffineMap", "UnitaryMap"):
        # Row vectors: x' = x M.
        affine = np.asarray(stream.unpack("16d")).reshape(4, 4)
        return affine[:3, :3].T, affine[3, :3]
    raise ValueError(f"expected a linear transform, got a {kind}")


class _OpenVdbTree:
    def __init__(self, stream: Stream, compression: int, *, half: bool, double: bool):
        self.stream, self.compression = stream, compression
        self.value = "d" if double else "f"
        self.stored = np.dtype("<f2" if half else "<f8" if double else "<f4")
        self.background = 0.0
        self.blocks: list[Block] = []
        self.leaves: list[tuple[int, int, int]] = []

    def read(self) -> list[Block]:
        """All tiles and leaves."""
        stream = self.stream
        stream.unpack("i")
        self.background = float(stream.unpack(self.value)[0])
        tiles, children = stream.unpack("II")
        for _ in range(tiles):
            x, y, z, value, active = stream.unpack(f"3i{self.value}?")
            self.blocks.append(Block((x, y, z), 4096, float(value), active))
        for _ in range(children):
            self._topology(stream.unpack("3i"), (5, 4, 3))
        for origin in self.leaves:
            mask = stream.mask(512)
            self.blocks.append(Block(origin, 8, self._values(mask).reshape(8, 8, 8), True))
        return self.blocks

    def _topology(self, origin: tuple[int, int, int], logs: tuple[int, ...]) -> None:
        stream = self.stream
        if len(logs) == 1:
            stream.take(64)
            self.leaves.append(origin)
            return
        side = 1 << logs[0]
        size = 1 << sum(logs[1:])
        child, active = stream.mask(side**3), stream.mask(side**3)
        values = self._values(active)
        for n in np.flatnonzero(~child & ((values != self.background) | active)):
            self.blocks.append(
                Block(corner(origin, int(n), side, size), size, float(values[n]), bool(active[n]))
            )
        for n in np.flatnonzero(child):
            self._topology(corner(origin, int(n), side, size), logs[1:])

    def _values(self, active: np.ndarray) -> np.ndarray:
        """Values of a node; inactive ones may be stored as one or two numbers and a mask (Compression.h)."""
        stream, how = self.stream, self.stream.unpack("b")[0]
        if not 0 <= how <= 6:
            raise ValueError("its values are stored in an unknown way")
        first = -self.background if how != 0 else self.background
        second = self.background
        if how in (2, 4, 5):
            first = float(stream.unpack(self.value)[0])
        if how == 5:
            second = float(stream.unpack(self.value)[0])
        choice = stream.mask(active.size) if how in (3, 4, 5) else np.zeros(active.size, bool)
        masked = bool(self.compression & _MASKED) and how != 6
        data = self._numbers(int(active.sum()) if masked else active.size)
        if not masked:
            return data
        values = np.where(choice, second, first).astype(np.float64)
        values[active] = data
        return values

    def _numbers(self, count: int) -> np.ndarray:
        size = count * self.stored.itemsize
        if size == 0 and self.stored.itemsize == 2:
            return np.zeros(0)  # of no half floats not even the length is written
        if not self.compression & (_ZIP | _BLOSC):
            data = self.stream.take(size)
        else:
            length = self.stream.unpack("q")[0]
            data = self.stream.take(abs(length))
            if length > 0:
                data = unblosc(data) if self.compression & _BLOSC else decompressed(data)
        if len(data) != size:
            raise ValueError(f"a block has {len(data)} bytes instead of {size}")
        return np.frombuffer(data, self.stored).astype(np.float64)


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
                _nanovdb_grid(buffer) if readable else None,
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


def _nanovdb_grid(data: bytes) -> SparseGrid:
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


_LARGEST = 512**3
"""Nodes of a dense copy above which a crop is asked for (0.5 GB in float32)."""


def load_vdb(
    path: Path,
    *,
    crop: Float[np.ndarray, "2 3"] | None,
    grid: str | None = None,
    interpolation: str = "linear",
) -> GridField | SignedDistanceGrid:
    """A grid of floats in an OpenVDB or NanoVDB file: a density, or for level sets a signed distance.

    Args:
        path: A .vdb or .nvdb file.
        crop: Box [units of the file] to be read of a density; None: all.
        grid: Name of the grid; None: the only one of floats, else the one named "density".
        interpolation: "linear", as OpenVDB's own sampler, "quadratic" or "cubic".

    Raises:
        ValueError: If the file is damaged or of an unknown version, has no such grid or none of floats, or
            its grid is turned, negative (and no level set), or too large.
        ImportError: If the file is compressed with Blosc and the package blosc is missing.
    """
    data = path.read_bytes()
    try:
        grids = read_nanovdb(data) if path.suffix.lower() == ".nvdb" else read_openvdb(data)
        found = _chosen(grids, grid)
        spacing, signs = _axes(found)
        level_set = found.kind == "level set"
        if level_set and crop is not None:
            raise ValueError(f"grid {found.name!r} is a level set, which cannot be cropped")
        low, high = _extent(found, spacing * signs, None if level_set else crop)
        values = _dense(found, low, high)
    except (struct.error, IndexError, zlib.error, EOFError, OverflowError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected an OpenVDB or NanoVDB file; it is cut off or damaged") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    flips = tuple(slice(None, None, int(sign)) for sign in signs)
    start = np.where(signs > 0, low, high)
    origin = found.offset + signs * spacing * start
    try:
        if not level_set:
            return GridField(values[flips], origin, spacing, interpolation)
        width = abs(found.background)
        whole = extended_distances(values[flips].astype(np.float64), spacing, width)
        return SignedDistanceGrid(whole, origin, spacing, interpolation)
    except ValueError as error:
        raise ValueError(f"{path}: grid {found.name!r}: {error}") from error


def _chosen(rows: Rows, wanted: str | None) -> SparseGrid:
    """The grid of this name, or the one to be taken when none is given; rows are name, type, grid."""
    usable = [grid for _, _, grid in rows if grid is not None]
    listed = ", ".join(f"{name!r} ({kind})" for name, kind, _ in rows) or "none"
    if wanted is not None:
        usable = [grid for grid in usable if grid.name == wanted]
        if len(usable) != 1:
            raise ValueError(f"expected one grid of floats named {wanted!r}, got the grids {listed}")
    if len(usable) > 1:
        usable = [grid for grid in usable if grid.name == "density"] or usable
    if len(usable) != 1:
        raise ValueError(f"expected one grid of floats, or its name as grid=…, got the grids {listed}")
    return usable[0]


def _axes(grid: SparseGrid) -> tuple[np.ndarray, np.ndarray]:
    """Spacing and direction of the axes of a grid.

    Raises:
        ValueError: If they are turned against the world's.
    """
    diagonal = np.diagonal(grid.matrix)
    skew = np.abs(grid.matrix - np.diag(diagonal)).max()
    if not np.all(np.isfinite(grid.matrix)) or np.any(diagonal == 0) or skew > 1e-6 * np.abs(diagonal).max():
        raise ValueError(
            f"grid {grid.name!r} must have axes along x, y, z, got the transform {grid.matrix.tolist()}:"
            " resample it with a uniform-scale transform"
        )
    return np.abs(diagonal), np.sign(diagonal)


def _extent(
    grid: SparseGrid, step: np.ndarray, crop: np.ndarray | None
) -> tuple[Int[np.ndarray, "3"], Int[np.ndarray, "3"]]:
    """First and last voxel to be read: around all that differs from the background, one more on each side."""
    used = [block for block in grid.blocks if block.active or not isinstance(block.values, float)]
    if not used:
        raise ValueError(f"grid {grid.name!r} has no voxels")
    low = np.min([block.origin for block in used], axis=0) - 1
    high = np.max([np.add(block.origin, block.size) for block in used], axis=0)
    if crop is not None:
        ends = np.sort((np.asarray(crop, float) - grid.offset) / step, axis=0)
        low = np.maximum(low, np.ceil(ends[0] - 1e-9).astype(int))
        high = np.minimum(high, np.floor(ends[1] + 1e-9).astype(int))
    count = high - low + 1
    if np.any(count < 2):
        raise ValueError(f"grid {grid.name!r} has less than two voxels a side within the crop")
    if np.prod(count.astype(float)) > _LARGEST:
        raise ValueError(f"grid {grid.name!r} would have {' × '.join(map(str, count))} voxels: give a crop")
    return low, high


def _dense(grid: SparseGrid, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    out = np.full(tuple(high - low + 1), grid.background, np.float32)
    # Tiles of the higher levels first: nothing overlaps, but a damaged file may.
    for block in grid.blocks:
        start = np.subtract(block.origin, low)
        a, b = np.maximum(start, 0), np.minimum(start + block.size, out.shape)
        if np.any(a >= b):
            continue
        into = tuple(slice(i, j) for i, j in zip(a, b, strict=True))
        if isinstance(block.values, np.ndarray):
            out[into] = block.values[tuple(slice(i, j) for i, j in zip(a - start, b - start, strict=True))]
        else:
            out[into] = block.values
    return out
