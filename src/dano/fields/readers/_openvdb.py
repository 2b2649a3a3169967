"""OpenVDB's .vdb files: a stream of nodes, first all topology, then all leaves.

Layout: openvdb/io/{Archive,File,GridDescriptor,Compression}.h and tree/{RootNode,InternalNode,LeafNode}.h,
file versions 222 to 224.
"""

import numpy as np

from dano.fields.readers._sparse import Block, corner, Rows, SparseGrid, Stream, unblosc
from dano.memory import decompressed

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
        rows.append((name, kind, _grid(stream, name, kind) if readable else None))
        stream.at = end
    return rows


def _grid(stream: Stream, name: str, kind: str) -> SparseGrid:
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
