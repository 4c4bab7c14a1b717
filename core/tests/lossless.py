"""Raw files as cameras write them: lossless JPEG of any shape, and DNG around it or around bare numbers.

The plain way in numpy, from the standard (ITU-T T.81, annex H) and the DNG specification; LibRaw reads what comes out.
"""

import heapq
import struct
from pathlib import Path

import numpy as np

COMPRESSION_NONE, COMPRESSION_JPEG = 1, 7
_KINDS = {"B": 1, "s": 2, "H": 3, "I": 4, "2I": 5, "2i": 10}


def lossless_jpeg(samples: np.ndarray, components: int = 2, bits: int = 14, predictor: int = 1) -> bytes:
    """One stream of samples (rows, columns * components) uint16, a Huffman table each component, fitted to its numbers."""
    rows, width = samples.shape
    s = samples.astype(np.int64).reshape(rows, width // components, components)
    left, above, corner = np.zeros_like(s), np.zeros_like(s), np.zeros_like(s)
    left[:, 1:], above[1:], corner[1:, 1:] = s[:, :-1], s[:-1], s[:-1, :-1]
    guess = [left, above, corner, left + above - corner, left + ((above - corner) >> 1), above + ((left - corner) >> 1), (left + above) >> 1]
    guess = guess[predictor - 1]
    guess[0], guess[1:, 0] = left[0], s[:-1, 0]
    guess[0, 0] = 1 << (bits - 1)
    difference = (s - guess + 32768) % 65536 - 32768
    category = np.ceil(np.log2(np.abs(difference) + 1)).astype(int)
    extra = np.where(difference < 0, difference + (1 << category) - 1, difference)
    lengths, values, tables = np.empty_like(category), np.empty_like(s), b""
    for c in range(components):
        code, length, table = _huffman(category[..., c])
        tables += struct.pack(">BBHB", 0xFF, 0xC4, 3 + len(table), c) + table
        more = np.where(category[..., c] == 16, 0, category[..., c])
        lengths[..., c] = length[category[..., c]] + more
        values[..., c] = np.where(more > 0, (code[category[..., c]] << more) | extra[..., c], code[category[..., c]])
    frame = struct.pack(">BHHB", bits, rows, width // components, components) + b"".join(bytes([c, 0x11, 0]) for c in range(components))
    scan = bytes([components]) + b"".join(bytes([c, c << 4]) for c in range(components)) + bytes([predictor, 0, 0])
    head = b"\xff\xd8" + tables + b"\xff\xc3" + struct.pack(">H", 2 + len(frame)) + frame + b"\xff\xda" + struct.pack(">H", 2 + len(scan)) + scan
    return head + _packed(values.ravel(), lengths.ravel()).replace(b"\xff", b"\xff\x00") + b"\xff\xd9"


def _huffman(categories):
    """Code and length of each category 0 … 16, and the table as it stands in the stream. The code of all ones is left free."""
    counts = np.bincount(categories.ravel(), minlength=17)
    heap = [(int(n), k, {k: 0}) for k, n in enumerate(counts) if n] + [(0, 17, {17: 0})]
    heapq.heapify(heap)
    while len(heap) > 1:
        (n1, k1, a), (n2, _, b) = heapq.heappop(heap), heapq.heappop(heap)
        heapq.heappush(heap, (n1 + n2, k1, {k: depth + 1 for k, depth in (a | b).items()}))
    ordered = sorted((depth, k == 17, k) for k, depth in heap[0][2].items())
    codes, lengths, code, before = np.zeros(17, np.int64), np.zeros(17, np.int64), 0, 0
    for depth, last, k in ordered:
        code <<= depth - before
        if not last:
            codes[k], lengths[k] = code, depth
        code, before = code + 1, depth
    used = [(depth, k) for depth, last, k in ordered if not last]
    return codes, lengths, bytes(sum(depth == n for depth, _ in used) for n in range(1, 17)) + bytes(k for _, k in used)


def _packed(values, lengths):
    """The lowest ``lengths`` bits of each value, one after the other, filled up with ones to whole bytes."""
    ends = np.cumsum(lengths)
    stream = np.ones(-(-int(ends[-1]) // 8) * 8, np.uint8)
    for k in range(int(lengths.max())):
        longer = lengths > k
        stream[ends[longer] - 1 - k] = (values[longer] >> k) & 1
    return np.packbits(stream).tobytes()


def bare(samples: np.ndarray, bits: int = 16, order: str = "<") -> bytes:
    """Samples (rows, columns) without compression; fewer than 16 bits are packed, each row from a byte of its own."""
    if bits == 16:
        return samples.astype(order + "u2").tobytes()
    each = (samples[..., None] >> np.arange(bits)[::-1]) & 1
    return np.packbits(each.reshape(len(samples), -1).astype(np.uint8), axis=1).tobytes()


def write_raw_dng(path: Path, mosaic: np.ndarray, compression: int, tile=None, bits: int = 14, order: str = "<", stream=None, tags=()) -> None:
    """A DNG with the mosaic (H, W) in one strip, or in tiles (rows, columns), the last of which stand out over its edges.

    stream: tile of samples -> bytes. tags: (code, kind, values) added to the usual ones or, with the same code, in place of
    them; without values (None), left out.
    """
    rows, cols = mosaic.shape
    high, wide = tile or (rows, cols)
    padded = np.pad(mosaic, ((0, -rows % high), (0, -cols % wide)), mode="edge")
    parts = [padded[y : y + high, x : x + wide] for y in range(0, rows, high) for x in range(0, cols, wide)]
    if stream is None and compression == COMPRESSION_JPEG:
        parts = [lossless_jpeg(part, 2, bits) for part in parts]
    else:
        parts = [(stream or (lambda part: bare(part, bits, order)))(part) for part in parts]
    ends = 8 + np.cumsum([0] + [len(part) + len(part) % 2 for part in parts])
    place, size = ends[:-1].tolist(), [len(part) for part in parts]
    entries = {
        254: ("I", [0]),
        256: ("I", [cols]),
        257: ("I", [rows]),
        258: ("H", [bits]),
        259: ("H", [compression]),
        262: ("H", [32803]),
        271: ("s", b"Strandscope\0"),
        272: ("s", b"Test camera\0"),
        274: ("H", [1]),
        277: ("H", [1]),
        **({322: ("I", [wide]), 323: ("I", [high]), 324: ("I", place), 325: ("I", size)} if tile else {}),
        **({} if tile else {273: ("I", place), 278: ("I", [rows]), 279: ("I", size)}),
        284: ("H", [1]),
        33421: ("H", [2, 2]),
        33422: ("B", [0, 1, 1, 2]),
        50706: ("B", [1, 4, 0, 0]),
        50708: ("s", b"Test camera\0"),
        50714: ("H", [64]),
        50717: ("I", [(1 << bits) - 1]),
        50721: ("2i", [1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1]),
        50728: ("2I", [1, 1, 1, 1, 1, 1]),
        **{code: (kind, values) for code, kind, values in tags},
    }
    entries = {code: entry for code, entry in sorted(entries.items()) if entry[1] is not None}
    table, more = b"", b""
    after = int(ends[-1]) + 2 + 12 * len(entries) + 4
    for code, (kind, values) in entries.items():
        data = bytes(values) if kind in "sB" else struct.pack(f"{order}{len(values)}{kind[-1]}", *values)
        count = len(values) // len(kind) if kind.startswith("2") else len(values)
        inside = data.ljust(4, b"\0") if len(data) <= 4 else struct.pack(order + "I", after + len(more))
        more += data + b"\0" * (len(data) % 2) if len(data) > 4 else b""
        table += struct.pack(order + "HHI", code, _KINDS[kind], count) + inside
    start = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, int(ends[-1]))
    light = b"".join(part + b"\0" * (len(part) % 2) for part in parts)
    path.write_bytes(start + light + struct.pack(order + "H", len(entries)) + table + bytes(4) + more)
