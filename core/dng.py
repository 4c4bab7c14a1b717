"""The mosaic of a DNG, read without LibRaw: bare numbers, or lossless JPEG in one strip or in tiles.

``read_layout`` tells where it lies and gives all tags that the meaning of its numbers may depend on as one signature: what
LibRaw says of one file holds for all of the same signature. Anything unusual is ``Unsupported``, and so is damage.
"""

import hashlib
import math
import struct
from dataclasses import dataclass

import numpy as np
from numba import njit

from .ljpeg import Unsupported, decode

_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}  # bytes of a value, by TIFF's number of its type
_INTEGERS = {1: "B", 3: "H", 4: "I"}
_MOST_TAGS, _MOST_BYTES, _MOST_DIRECTORIES = 256, 1 << 20, 16  # of a directory, of a tag, of a file: a camera's have far fewer

NEW_SUBFILE_TYPE, WIDTH, ROWS, BITS, COMPRESSION, PHOTOMETRIC, FILL_ORDER = 254, 256, 257, 258, 259, 262, 266
STRIP_OFFSETS, SAMPLES, ROWS_PER_STRIP, STRIP_COUNTS, PREDICTOR = 273, 277, 278, 279, 317
TILE_WIDTH, TILE_ROWS, TILE_OFFSETS, TILE_COUNTS, SUB_DIRECTORIES, SAMPLE_FORMAT = 322, 323, 324, 325, 330, 339
DNG_VERSION, LINEARIZATION, BLACK_LEVEL, WHITE_LEVEL, MASKED_AREAS = 50706, 50712, 50714, 50717, 50830
CFA, BARE, LOSSLESS_JPEG = 32803, 1, 7

# Tags that differ from shot to shot and do not bear on the mosaic, its black and its white: places in the file, times,
# exposure, white balance, noise, digests, notes, corrections of the lens, which LibRaw leaves to others.
_OF_THE_SHOT = {
    *(270, STRIP_OFFSETS, STRIP_COUNTS, 306, TILE_OFFSETS, TILE_COUNTS, SUB_DIRECTORIES, 513, 514, 700, 33434, 33437, 33723, 34377, 34665, 34853),
    *(34855, 36867, 36868, 37377, 37378, 37379, 37380, 37381, 37386, 37500, 37520, 37521, 37522, 42016, 50728, 50729, 50730, 50731, 50740),
    *(50781, 50827, 50828, 50971, 50972, 50973, 51008, 51009, 51022, 51041, 51043, 51111),
}


@dataclass(frozen=True)
class Layout:
    """Where a file has its mosaic (rows, cols), in pieces of piece_rows x piece_cols."""

    signature: bytes
    rows: int
    cols: int
    bits: int
    order: str  # "<" or ">", of numbers of 16 bits
    compression: int
    piece_rows: int
    piece_cols: int
    places: tuple[int, ...]
    sizes: tuple[int, ...]  # bytes


def read_layout(data: np.ndarray) -> Layout:
    """The layout of a whole file (n,) uint8. Raises Unsupported."""
    buffer = memoryview(data)
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(bytes(buffer[:4]))
    if order is None:
        raise Unsupported("not a TIFF")
    try:
        directories = _directories(buffer, order)
        top, raws = directories[0], [d for d in directories if _numbers(d, order, PHOTOMETRIC) == (CFA,)]
        if len(raws) != 1 or _numbers(top, order, DNG_VERSION) < (1, 1):
            raise Unsupported("not a DNG, or one with several mosaics")
        return _layout(raws[0], order, _signature(directories, order))
    except struct.error as error:
        raise Unsupported("a directory that is cut short") from error


def read_mosaic(data: np.ndarray, layout: Layout) -> np.ndarray:
    """The mosaic (rows, cols) uint16, of either byte order, of a whole file (n,) uint8; it may be a view. Raises Unsupported."""
    rows, cols = layout.rows, layout.cols
    if any(place + size > len(data) for place, size in zip(layout.places, layout.sizes, strict=True)):
        raise Unsupported("pieces beyond the end of the file")
    pieces = [data[place : place + size] for place, size in zip(layout.places, layout.sizes, strict=True)]
    if layout.compression == BARE:
        numbers = data[layout.places[0] :][: sum(layout.sizes)]
        if layout.bits == 16:
            return numbers.view(layout.order + "u2").reshape(rows, cols)
        return _unpacked(numbers.reshape(rows, -1), cols, layout.bits)
    high, wide = layout.piece_rows, layout.piece_cols
    if (high, wide) == (rows, cols):
        return _piece(pieces[0], layout)
    if high * wide * len(pieces) > 8 * len(data):  # a sample has one bit or more
        raise Unsupported("more tiles than bytes")
    mosaic = np.empty((rows, cols), np.uint16)
    corners = ((y, x) for y in range(0, rows, high) for x in range(0, cols, wide))
    for (y, x), piece in zip(corners, pieces, strict=True):
        part = mosaic[y : y + high, x : x + wide]
        part[:] = _piece(piece, layout)[: part.shape[0], : part.shape[1]]
    return mosaic


def _piece(stream: np.ndarray, layout: Layout) -> np.ndarray:
    samples = decode(stream, layout.piece_rows * layout.piece_cols)  # however they are shaped, they go row after row
    _, columns, components = samples.shape
    if components > 1 and columns * components**2 == layout.cols:
        raise Unsupported("a shape in which LibRaw sees something else")
    return samples.reshape(layout.piece_rows, layout.piece_cols)


def _layout(raw: dict, order: str, signature: bytes) -> Layout:
    def one(code, default=None):
        numbers = _numbers(raw, order, code) or (default,)
        if len(numbers) != 1 or numbers[0] is None:
            raise Unsupported(f"tag {code} has {len(numbers)} values")
        return numbers[0]

    rows, cols, bits, compression = one(ROWS), one(WIDTH), one(BITS), one(COMPRESSION)
    usual = {NEW_SUBFILE_TYPE: 0, SAMPLES: 1, FILL_ORDER: 1, PREDICTOR: 1, SAMPLE_FORMAT: 1}
    if any(one(code, value) != value for code, value in usual.items()) or not (0 < rows < 1 << 16 and 0 < cols < 1 << 16):
        raise Unsupported("an unusual mosaic")
    if LINEARIZATION in raw or MASKED_AREAS in raw or not {BLACK_LEVEL, WHITE_LEVEL} <= set(raw):
        raise Unsupported("numbers that have to be looked up, or a black level that has to be measured")
    tiled = TILE_OFFSETS in raw
    places = _numbers(raw, order, TILE_OFFSETS if tiled else STRIP_OFFSETS)
    sizes = _numbers(raw, order, TILE_COUNTS if tiled else STRIP_COUNTS)
    high, wide = (one(TILE_ROWS), one(TILE_WIDTH)) if tiled else (min(one(ROWS_PER_STRIP, rows), rows), cols)
    if not (0 < high <= rows and 0 < wide <= cols and (STRIP_OFFSETS in raw) != tiled):
        raise Unsupported("pieces larger than the mosaic")
    if not len(places) == len(sizes) == math.ceil(rows / high) * math.ceil(cols / wide):
        raise Unsupported("too many or too few pieces")
    if compression == BARE:
        joined = all(place + size == after for place, size, after in zip(places, sizes, places[1:], strict=False))
        if tiled or bits not in (10, 12, 14, 16) or not joined or sum(sizes) != rows * math.ceil(cols * bits / 8):
            raise Unsupported("bare numbers in another order")
    elif compression != LOSSLESS_JPEG or not (tiled or len(places) == 1):
        raise Unsupported("another compression")
    return Layout(signature, rows, cols, bits, order, compression, high, wide, places, sizes)


def _directories(buffer: memoryview, order: str) -> list[dict]:
    """All directories of a TIFF, the first one first: tag -> (type, count, bytes of its values)."""
    todo, found = list(struct.unpack_from(order + "I", buffer, 4)), []
    while todo:
        at, directory = todo.pop(0), {}
        (count,) = struct.unpack_from(order + "H", buffer, at)
        if count > _MOST_TAGS or len(found) == _MOST_DIRECTORIES:
            raise Unsupported("a directory that is too large, or too many")
        for entry in range(at + 2, at + 2 + 12 * count, 12):
            code, kind, number = struct.unpack_from(order + "HHI", buffer, entry)
            size = _SIZES.get(kind, _MOST_BYTES + 1) * number
            place = entry + 8 if size <= 4 else struct.unpack_from(order + "I", buffer, entry + 8)[0]
            if code in directory or place + size > len(buffer) or (size > _MOST_BYTES and code not in _OF_THE_SHOT):
                raise Unsupported(f"tag {code} twice, too large, or beyond the end of the file")
            directory[code] = kind, number, buffer[place : place + size]
        found.append(directory)
        following = struct.unpack_from(order + "I", buffer, at + 2 + 12 * count)
        todo += [place for place in (*_numbers(directory, order, SUB_DIRECTORIES), *following) if place]
    return found


def _numbers(directory: dict, order: str, code: int) -> tuple[int, ...]:
    kind, count, values = directory.get(code, (4, 0, b""))
    if kind not in _INTEGERS or len(values) > _MOST_BYTES:
        raise Unsupported(f"tag {code} is of type {kind}, {count} times")
    return struct.unpack(f"{order}{count}{_INTEGERS[kind]}", values)


def _signature(directories: list[dict], order: str) -> bytes:
    said = hashlib.blake2b(order.encode())
    for directory in directories:
        for code, (kind, count, values) in directory.items():
            of_the_shot = code in _OF_THE_SHOT
            said.update(struct.pack("<HHI", code, kind, 0 if of_the_shot else count))
            said.update(b"" if of_the_shot else values)
        said.update(b"end")
    return said.digest()


@njit(cache=True, nogil=True)
def _unpacked(packed, cols, bits):
    """Numbers (rows, cols) uint16 of fewer than 16 bits, highest first, out of rows of bytes (rows, n)."""
    rows, last = packed.shape[0], packed.shape[1] - 1
    mosaic = np.empty((rows, cols), np.uint16)
    mask = (1 << bits) - 1
    for row in range(rows):
        line = packed[row]
        for x in range(cols):
            first = x * bits
            at = first >> 3
            word = line[at] << 16 | line[min(at + 1, last)] << 8 | line[min(at + 2, last)]
            mosaic[row, x] = (word >> (24 - bits - (first & 7))) & mask
    return mosaic
