"""What the sparse grids of OpenVDB and NanoVDB have in common.

Both keep a tree of three levels of nodes of 32³, 16³ and 8³ entries; an entry is a child or a tile, one value
for its whole cube.
"""

import struct
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dano.extras import optional


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
