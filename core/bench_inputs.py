"""What ``bench`` measures on: a photograph of a dense lock, a lossless-JPEG raw file of it, the features of a lock seen by a ring of
cameras, and a volume whose surface has directions. All is drawn from a seed, in seconds, and like what the simulator makes."""

import heapq
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy import ndimage

from .features import Index, SweepFeatures, build_index, pack
from .geometry import Optics, turn
from .laplace import KNOWN, OUTSIDE, UNKNOWN
from .raw import write_dng
from .ridges import Ridges
from .simulate import BLACK, WHITE, SimulateParams, expose

STAGES = ("ridges", "decode", "growing", "directions", "index")
BOARD, HAIR = 0.10, (0.08, 0.35)  # light of the background and of hairs, 1 at white
LAYERS_PX = (9.0, 5.0, 2.5, 0.9)  # sigma of the image of a hair, from the back to the plane of focus, where it is 3 px wide
HAIRS_PER_PX = 0.12  # that cross a row, each layer
PITCH_MM, DISTANCE_MM = 1 / 35, 330.0
FRAME_MM, IN_FOCUS_MM = 0.2, 0.5  # between photographs, and how far from the plane of focus a hair is found
HAIR_PER_MM2, SEEN_DEG = 3.8, 63.0  # hairs across a slice; a camera sees those up to this far around the lock
NOISE_PX, NOISE_DEG = 0.2, 2.0  # of a feature
OFF_MM, OFF_DEG = 0.005, 0.5  # of the places that are asked, from the true ones
SURFACE = 0.3  # voxels of the lock's outer shell that have hair


@dataclass(frozen=True)
class RingParams:
    """A slice of a dense lock, as high as the photographs."""

    cameras: int = 24
    rows: int = 160  # of the photographs
    radius_mm: float = 8.0  # of the lock
    points: int = 200
    seed: int = 0


@dataclass(frozen=True)
class BenchParams:
    """What to measure, on how much."""

    stages: tuple[str, ...] = STAGES
    rounds: int = 9  # at most
    seconds: float = 20.0  # after which a measurement ends early
    rows: int = 1462  # of a channel plane
    columns: int = 2193
    ring: RingParams = RingParams()  # of cameras, for growing and the index
    grid: tuple[int, int, int] = (128, 128, 128)  # of cells, for the directions
    cycles: int = 5  # V-cycles of ours: to what single precision can tell of the other's, too
    seed: int = 0


# ---- a photograph ----------------------------------------------------------------------------------------------------


@lru_cache(maxsize=2)
def mosaic(rows: int, columns: int, seed: int) -> np.ndarray:
    """The mosaic (2 rows, 2 columns) uint16, RGGB, of 14 bit, of a dense lock with a quarter of its hairs in focus."""
    rng = np.random.default_rng([seed, 1])
    light = np.full((rows, columns), BOARD, np.float32)
    for sigma in LAYERS_PX:
        cover, glow = _layer(rows, columns, sigma, rng)
        light = light * (1 - cover) + glow
    sensor = SimulateParams()
    return expose(light * np.array([1.0, 0.9, 0.9, 0.6], np.float32)[:, None, None], sensor.full_well_e, sensor.read_noise_e, rng)


def plane(rows: int, columns: int, seed: int) -> np.ndarray:
    """The red channel plane (rows, columns) float32 of that mosaic, 0 at black and 1 at white."""
    return (mosaic(rows, columns, seed)[::2, ::2].astype(np.float32) - np.float32(BLACK)) / np.float32(WHITE - BLACK)


def _layer(rows, columns, sigma, rng):
    """How much hairs at one depth hide of what is behind, and their own light: two (rows, columns) float32."""
    count = int(HAIRS_PER_PX * columns)
    start, lean, swing = rng.uniform(-0.1, 1.1, count) * columns, rng.normal(0, 0.15, count), rng.uniform(2, 12, count)
    length, phase, glow = rng.uniform(200, 700, count), rng.uniform(0, 2 * np.pi, count), rng.uniform(*HAIR, count)
    row = np.arange(rows)[:, None]
    col = start + lean * (row - rows / 2) + swing * np.sin(2 * np.pi * row / length + phase)
    left, part = np.floor(col).astype(np.int64), col % 1.0
    row, glow = np.broadcast_to(row, col.shape), np.broadcast_to(glow, col.shape)
    sums = np.zeros((2, rows, columns))
    for at, share in ((left, 1 - part), (left + 1, part)):
        there = (at >= 0) & (at < columns)
        place = (row * columns + at)[there]
        sums[0] += np.bincount(place, share[there], rows * columns).reshape(rows, columns)
        sums[1] += np.bincount(place, (share * glow)[there], rows * columns).reshape(rows, columns)
    thick, lit = (ndimage.gaussian_filter(s, sigma) * 2.2 for s in sums)  # a hair in focus hides all in its middle
    cover = 1 - np.exp(-1.5 * thick)
    return cover.astype(np.float32), (cover * lit / np.maximum(thick, 1e-9)).astype(np.float32)


# ---- a lossless-JPEG raw file ----------------------------------------------------------------------------------------


def write_lossless_dng(path: Path, pixels: np.ndarray) -> int:
    """Write a mosaic (2H, 2W) uint16 as a DNG of one lossless-JPEG strip with two components, as cameras do; returns its bytes.

    It is the uncompressed file of ``write_dng`` with the strip replaced.
    """
    import tifffile

    write_dng(path, pixels, BLACK, WHITE)
    stream = lossless_jpeg(pixels)
    with tifffile.TiffFile(path, mode="r+b") as tiff:
        page = tiff.pages[0]
        page.tags["Compression"].overwrite(7)
        page.tags["StripByteCounts"].overwrite(len(stream))
        begin = page.dataoffsets[0]
    with open(path, "r+b") as file:
        file.seek(begin)
        file.write(stream)
        file.truncate()
    return path.stat().st_size


def lossless_jpeg(pixels: np.ndarray) -> bytes:
    """A mosaic (h, w) uint16 as a lossless JPEG (ITU T.81, annex H) of w / 2 columns, two components, predictor 1, 16 bit."""
    height, width = pixels.shape
    counts = np.zeros(17, np.int64)
    _scan(pixels, counts, np.zeros(17, np.int64), np.zeros(17, np.int64), np.empty(0, np.uint8))
    symbols, lengths, codes = _huffman(counts)
    by_length, code_of, length_of = [0] * 16, np.zeros(17, np.int64), np.zeros(17, np.int64)
    for symbol, length, code in zip(symbols, lengths, codes, strict=True):
        by_length[length - 1] += 1
        code_of[symbol], length_of[symbol] = code, length
    out = np.empty(8 * pixels.size + 8, np.uint8)
    size = _scan(pixels, counts, code_of, length_of, out)
    frame = bytes([16]) + height.to_bytes(2) + (width // 2).to_bytes(2) + bytes([2, 0, 0x11, 0, 1, 0x11, 0])
    scan = bytes([2, 0, 0, 1, 0, 1, 0, 0])
    table = bytes([0, *by_length, *symbols])
    head = b"\xff\xd8" + _segment(0xC3, frame) + _segment(0xC4, table) + _segment(0xDA, scan)
    return head + out[:size].tobytes() + b"\xff\xd9"


def _segment(marker: int, content: bytes) -> bytes:
    return bytes([0xFF, marker]) + (len(content) + 2).to_bytes(2) + content


def _huffman(counts) -> tuple[list[int], list[int], list[int]]:
    """Symbols, lengths and codes of a Huffman code of at most 16 bits; the code of nothing but ones stays free, as JPEG wants."""
    free = 99
    least = max(int(counts.sum()) >> 12, 1)
    heap = [(max(int(n), least), s, {s: 0}) for s, n in enumerate(counts) if n > 0] + [(0, free, {free: 0})]
    heapq.heapify(heap)
    while len(heap) > 1:
        (n, s, a), (m, _, b) = heapq.heappop(heap), heapq.heappop(heap)
        heapq.heappush(heap, (n + m, s, {symbol: depth + 1 for symbol, depth in (a | b).items()}))
    ordered = sorted((depth, symbol) for symbol, depth in heap[0][2].items())
    code, last, codes = 0, ordered[0][0], []
    for depth, _ in ordered:
        code <<= depth - last
        codes.append(code)
        code, last = code + 1, depth
    return [s for _, s in ordered[:-1]], [d for d, _ in ordered[:-1]], codes[:-1]


@njit(cache=True, nogil=True)
def _scan(pixels, counts, codes, lengths, out):
    """Entropy-code a mosaic (h, w) into out, returns the bytes; with an empty out, count the classes of differences instead."""
    height, width = pixels.shape
    held, bits, size = np.uint64(0), 0, 0
    for y in range(height):
        for x in range(width):
            if x >= 2:
                before = np.int64(pixels[y, x - 2])
            elif y > 0:
                before = np.int64(pixels[y - 1, x])
            else:
                before = np.int64(32768)
            off = (np.int64(pixels[y, x]) - before + 32767) % 65536 - 32767  # modulo 65536, as annex H says
            kind, rest = 0, abs(off)
            while rest:
                kind += 1
                rest >>= 1
            if len(out) == 0:
                counts[kind] += 1
                continue
            bare = kind % 16  # 32768, the only one of its class, needs no more bits
            extra = (off if off >= 0 else off + (1 << kind) - 1) & ((1 << bare) - 1)
            length = lengths[kind] + bare
            held = (held << np.uint64(length)) | np.uint64((codes[kind] << bare) | extra)
            bits += length
            while bits >= 8:
                bits -= 8
                byte = (held >> np.uint64(bits)) & np.uint64(255)
                out[size] = byte
                size += 1
                if byte == 255:
                    out[size] = 0
                    size += 1
            held &= np.uint64((1 << bits) - 1)
    if len(out) and bits:
        byte = ((held << np.uint64(8 - bits)) | np.uint64((1 << (8 - bits)) - 1)) & np.uint64(255)
        out[size], out[size + 1] = byte, 0
        size += 2 if byte == 255 else 1
    return size


# ---- a ring of cameras -----------------------------------------------------------------------------------------------


class Ring(NamedTuple):
    """The features of a lock and places on its hairs."""

    sweeps: list[SweepFeatures]
    index: Index
    optics: Optics
    points_mm: np.ndarray  # (n, 3) float64: a hair is near here
    ways: np.ndarray  # (n, 3) unit: and runs about this way
    true_ways: np.ndarray  # (n, 3) unit: its true direction at the point of it that the place was made from


@lru_cache(maxsize=1)
def ring(params: RingParams) -> Ring:
    """Nearly upright, wavy hairs around the axis, each seen by the cameras on its side, once in every row of each photograph near its
    depth; and places near true ones, as a step of growing foretells them."""
    rng = np.random.default_rng([params.seed, 2])
    reach = params.radius_mm + 1.0
    shape = params.rows, int(2 * reach / PITCH_MM)
    optics = Optics(DISTANCE_MM, PITCH_MM, (shape[1] - 1) / 2, (params.rows - 1) / 2, 10.0)
    count = max(int(HAIR_PER_MM2 * np.pi * params.radius_mm**2), 3)
    points, ways = _hairs(count, params, rng)
    positions = np.arange(-reach, reach, FRAME_MM)
    turns = 360.0 / params.cameras * np.arange(params.cameras)
    sweeps = [_sweep(points, ways, turn_deg, positions, shape, optics, rng) for turn_deg in turns]
    high = points.shape[1]
    hair, at = rng.integers(0, count, params.points), rng.integers(high // 5, max(high - high // 5, high // 5 + 1), params.points)
    true = ways[hair, at]
    turned = true + rng.normal(0, np.radians(OFF_DEG), true.shape)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return Ring(sweeps, build_index(sweeps, optics), optics, points[hair, at] + rng.normal(0, OFF_MM, true.shape), turned, true)


def _hairs(count, params, rng):
    """Points and unit tangents (count, rows, 3) of hairs, a row apart."""
    y = (np.arange(params.rows) - (params.rows - 1) / 2) * PITCH_MM
    far, around = params.radius_mm * np.sqrt(rng.random((count, 1))), rng.uniform(0, 2 * np.pi, (count, 1))
    lean, swing = rng.normal(0, 0.08, (2, count, 1)), rng.uniform(0, 0.4, (count, 1))
    wave, phase = 2 * np.pi / rng.uniform(8, 20, (count, 1)), rng.uniform(0, 2 * np.pi, (count, 1))
    x = far * np.sin(around) + lean[0] * y + swing * np.sin(wave * y + phase)
    z = far * np.cos(around) + lean[1] * y + swing * np.cos(wave * y + phase)
    points = np.stack([x, np.broadcast_to(y, x.shape), z], -1)
    ways = np.gradient(points, PITCH_MM, axis=1)
    return points, ways / np.linalg.norm(ways, axis=-1, keepdims=True)


def _sweep(points, ways, turn_deg, positions, shape, optics, rng) -> SweepFeatures:
    theta = np.radians(turn_deg)
    u, v, w = (np.asarray(a) for a in turn(*np.moveaxis(points, -1, 0), np.cos(theta), np.sin(theta)))
    seen = np.abs(np.arctan2(u.mean(axis=1), w.mean(axis=1))) <= np.radians(SEEN_DEG)
    gu, gv, gw = turn(*np.moveaxis(ways, -1, 0), np.cos(theta), np.sin(theta))
    angle = np.arctan2(gv + v / DISTANCE_MM * gw, gu + u / DISTANCE_MM * gw)[seen]
    u, v, w = u[seen], v[seen], w[seen]
    first, found = np.searchsorted(positions, w - IN_FOCUS_MM), []
    for step in range(int(2 * IN_FOCUS_MM / FRAME_MM) + 2):
        frame = np.minimum(first + step, len(positions) - 1)
        d = positions[frame]
        near = (np.abs(w - d) <= IN_FOCUS_MM) & (first + step < len(positions))
        scale = DISTANCE_MM / (DISTANCE_MM + d - w)
        col, row = optics.axis_col_px + u * scale / PITCH_MM, optics.axis_row_px - v * scale / PITCH_MM
        found.append(np.stack([a[near] for a in (frame, col, row, angle, 0.15 * np.exp(-0.5 * ((w - d) / 0.3) ** 2))]))
    frame, col, row, angle, strength = np.concatenate(found, axis=1)
    col, row = (a + rng.normal(0, NOISE_PX, len(a)) for a in (col, row))
    angle = (angle + rng.normal(0, np.radians(NOISE_DEG), len(angle))) % np.pi
    inside = (col >= 0) & (col <= shape[1] - 1) & (row >= 0) & (row <= shape[0] - 1)
    order = np.flatnonzero(inside)[np.argsort(frame[inside], kind="stable")]
    parts = np.split(order, np.searchsorted(frame[order], np.arange(1, len(positions))))
    told = col, row, angle, strength, np.full(len(col), 0.235)
    return pack(turn_deg, positions, shape, [Ridges(*(np.float32(a[part]) for a in told)) for part in parts])


# ---- a volume --------------------------------------------------------------------------------------------------------


def surface_directions(shape: tuple[int, int, int], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions (nx, ny, nz, 3) float32, known on much of an upright lock's surface, and the kinds (nx, ny, nz) uint8 of the cells:
    unknown inside it and a little around it, outside beyond."""
    rng = np.random.default_rng([seed, 3])
    x, y, z = (np.linspace(-1, 1, n).reshape([-1 if a == b else 1 for b in range(3)]) for a, n in enumerate(shape))
    far = np.broadcast_to(np.hypot(x, z), shape)
    kinds = np.where(far > 0.95, OUTSIDE, UNKNOWN).astype(np.uint8)
    kinds[(far > 0.65) & (far < 0.8) & (rng.random(shape) < SURFACE)] = KNOWN
    lean = 0.5 * np.sin(3 * x + 2 * y), np.ones(shape), 0.5 * np.cos(2 * z - 3 * y)
    field = np.stack([np.broadcast_to(a, shape) for a in lean], -1) + rng.normal(0, 0.05, (*shape, 3))
    field /= np.linalg.norm(field, axis=-1, keepdims=True)
    return np.where((kinds == KNOWN)[..., None], field, 0).astype(np.float32), kinds
