"""OpenVDB files, written by hand: not every Blender brings OpenVDB's Python module, and the command line has no Blender.

A grid is a tree of three levels (Museth 2013, sec. 3.1): cubes of 8³ voxels, of 16³ of these, of 32³ of these. A file tells the tree
from the root down, which voxels are active, then the values of the active ones. Version 224 of the format, as of OpenVDB 5 … 13.
"""

import struct
import uuid
from io import BytesIO
from pathlib import Path

import numpy as np

from .errors import StrandscopeError
from .files import atomic

_MAGIC, _FORMAT, _LIBRARY = 0x56444220, 224, (13, 0)
_ACTIVE_VALUES_ONLY = 2  # the flag of this compression
_OTHERS_ARE_BACKGROUND = b"\x00"  # how a node says so
_LEAF, _LOWER, _UPPER = 8, 16, 32  # cells along an edge of a node


def write_vdb(path: Path, grids: dict[str, np.ndarray], to_world: np.ndarray) -> None:
    """Write volumes (nx, ny, nz) float32 by their names, atomically; 0 is what is not there, and takes no room.

    to_world (4, 4): from the indices (i, j, k, 1) of a voxel to its centre, columns of points. A volume without a value is a grid
    without a voxel. The same volumes give the same bytes. Raises StrandscopeError where the file cannot be written.
    """
    out = BytesIO()
    out.write(struct.pack("<qIIIB", _MAGIC, _FORMAT, *_LIBRARY, True))
    out.write(str(uuid.UUID(int=0)).encode())
    out.write(_metadata({}) + struct.pack("<I", len(grids)))
    for name, volume in grids.items():
        _write_grid(out, name, volume, np.asarray(to_world, np.float64))
    with atomic(path) as part:
        part.write_bytes(out.getbuffer())


def _write_grid(out: BytesIO, name: str, volume: np.ndarray, to_world: np.ndarray) -> None:
    if volume.ndim != 3:
        raise StrandscopeError(f"the volume {name} has shape {volume.shape}; expected (nx, ny, nz)")
    places, leaves = _leaves(np.asarray(volume, "<f4"))
    active = [_bits(leaf != 0) for leaf in leaves]
    out.write(_text(name) + _text("Tree_float_5_4_3") + _text(""))
    offsets_at = out.tell()
    out.write(bytes(24))
    start = out.tell()
    out.write(struct.pack("<I", _ACTIVE_VALUES_ONLY))
    out.write(_metadata({"class": "fog volume", "name": name}))
    out.write(_text("AffineMap") + to_world.T.astype("<f8").tobytes())  # OpenVDB multiplies rows of points from the left
    out.write(struct.pack("<IfI", 1, 0.0, 0))  # one buffer a leaf, the background, no tile
    order = _write_topology(out, places, active)
    middle = out.tell()
    for i in order:
        out.write(active[i] + _OTHERS_ARE_BACKGROUND + leaves[i][leaves[i] != 0].tobytes())
    end = out.tell()
    out.seek(offsets_at)
    out.write(struct.pack("<qqq", start, middle, end))
    out.seek(end)


def _leaves(volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cubes of 8³ voxels with a value: where they are, in cubes (n, 3), and their values (n, 8, 8, 8)."""
    padded = np.pad(volume, [(0, -n % _LEAF) for n in volume.shape])
    blocks = padded.reshape([m for n in padded.shape for m in (n // _LEAF, _LEAF)]).transpose(0, 2, 4, 1, 3, 5)
    places = np.argwhere(blocks.any(axis=(3, 4, 5)))
    return places, np.ascontiguousarray(blocks[tuple(places.T)])


def _write_topology(out: BytesIO, places: np.ndarray, active: list[bytes]) -> list[int]:
    """The tree from its root to the leaves at ``places``; returns their numbers in the order in which they stand in it."""
    order = []
    across = _LOWER * _UPPER
    roots = _groups(places, across)
    out.write(struct.pack("<I", len(roots)))
    for root, inside in roots:
        out.write((root * across * _LEAF).astype("<i4").tobytes())
        lower = _groups(places[inside] - root * across, _LOWER)
        _write_node(out, _UPPER, np.array([place for place, _ in lower]))
        for place, members in lower:
            cells = places[inside][members] - root * across - place * _LOWER
            _write_node(out, _LOWER, cells)
            order += list(inside[members])
            out.write(b"".join(active[i] for i in inside[members]))
    return order


def _groups(places: np.ndarray, across: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The nodes of ``across``³ cells that cells lie in: where each is (3,), and which cells (n,) it has, in the order of the file."""
    keys, number = np.unique(places // across, axis=0, return_inverse=True)
    return [(key, np.flatnonzero(number.ravel() == i)) for i, key in enumerate(keys)]


def _write_node(out: BytesIO, size: int, children: np.ndarray) -> None:
    """Which of its size³ cells a node has as nodes of their own; the others hold the background."""
    mask = np.zeros((size, size, size), bool)
    mask[tuple(children.T)] = True
    out.write(_bits(mask) + bytes(size**3 // 8) + _OTHERS_ARE_BACKGROUND)


def _bits(mask: np.ndarray) -> bytes:
    return np.packbits(mask.ravel(), bitorder="little").tobytes()


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _metadata(texts: dict[str, str]) -> bytes:
    return struct.pack("<I", len(texts)) + b"".join(_text(name) + _text("string") + _text(value) for name, value in texts.items())
