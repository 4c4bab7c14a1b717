"""Photographs on disk -> linear channel planes, and raw files out of mosaics.

A channel plane is one colour of the Bayer mosaic at half resolution (sec. 4.1: no demosaicing), float32, black level
subtracted, 1.0 at white level. An RGB file (EXR, TIFF) gives its planes at full resolution.

LibRaw reads the cameras' raw files. A DNG of a usual layout is read by ``dng``, several times as fast, once the first file of its
kind has been read both ways and found the same.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from functools import lru_cache
from pathlib import Path

import numpy as np

from .errors import CaptureError
from .files import atomic

LINEAR_SUFFIXES = {".exr", ".tif", ".tiff"}
RAW_SUFFIXES = {
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".iiq", ".kdc", ".mef", ".mos", ".mrw", ".nef", ".nrw"),
    *(".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
}
_ROWS_AT_ONCE = 32  # of a plane, while it is made: they stay in the cache
CAMERA_NAME = "Virtual macro camera"
# Of the virtual camera: XYZ (D65) -> R, G, B, and its response to a neutral. They matter to raw developers only.
_COLOR_MATRIX = (2.4967, -1.0463, -0.3736, -0.4291, 1.3896, 0.0811, -0.0643, 0.1044, 0.7407)
_NEUTRAL = (0.8598, 1.0, 0.7944)


@dataclass(frozen=True)
class Mosaic:
    """How to read a bare 16-bit ``.npy`` Bayer mosaic."""

    pattern: str  # colours of the first two rows, such as "RGGB"
    black: int  # number that means no light
    white: int  # number at saturation


def read_planes(path: Path, channels: str = "R", mosaic: Mosaic | None = None) -> np.ndarray:
    """The channel planes (len(channels), H, W), float32, linear, 0 at black and 1 at white. channels: of "R", "G", "B".

    The two greens of a Bayer cell are averaged. Raises CaptureError for a file that is missing, damaged, or of a kind
    that has no planes of its own (no Bayer pattern).
    """
    path = Path(path)
    if not path.is_file():
        raise CaptureError(f"{path}: the photograph is missing")
    suffix = path.suffix.lower()
    if suffix == ".npy":
        if mosaic is None:
            raise CaptureError(f'{path}: a .npy photograph needs "mosaic" (pattern, black, white) in capture.json')
        return _bayer_planes(_load_npy(path), mosaic.pattern, (mosaic.black,) * 4, mosaic.white, channels, path)
    if suffix in LINEAR_SUFFIXES:
        return _linear_planes(path, channels)
    return _raw_planes(path, channels)


def reduced(plane: np.ndarray, by: int) -> np.ndarray:
    """A channel plane (H, W), or several (C, H, W), of which ``by`` times ``by`` pixels have become one; what is left over at the
    right and below is cut off. The middle of pixel i lies at ``by`` i + (by - 1) / 2."""
    if by == 1:
        return plane
    rows, columns = plane.shape[-2] // by, plane.shape[-1] // by
    whole = plane[..., : rows * by, : columns * by].reshape(*plane.shape[:-2], rows, by, columns, by)
    return np.ascontiguousarray(whole.mean(axis=(-3, -1), dtype=np.float32))


@dataclass(frozen=True)
class Header:
    """What a photograph says of itself without its light being read."""

    rows: int  # of the mosaic or image
    cols: int
    taken: tuple[float, int] | None  # seconds and shot number, in the order of taking; None where the file does not tell
    shutter_s: float | None = None  # None where the file does not tell, as of the next two
    f_number: float | None = None
    iso: float | None = None


def read_header(path: Path) -> Header:
    """Size and time of a photograph, without decoding it: a millisecond or two.

    Raises CaptureError for a file that is missing, of no known kind, or ends before its own table of contents says.
    """
    path = Path(path)
    if not path.is_file():
        raise CaptureError(f"{path}: the photograph is missing")
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return Header(*_load_npy(path).shape, taken=None)
    if suffix in LINEAR_SUFFIXES:
        return Header(*_linear_size(path), taken=None)
    _expect_whole(path)
    import rawpy

    try:
        with _quiet_stderr(), rawpy.RawPy() as raw:
            raw.open_file(str(path))
            when = raw.other
            taken = (when.timestamp.timestamp(), when.shot_order) if when.timestamp.year > 1970 else None
            exposure = (float(value) if 0 < value < 1e6 else None for value in (when.shutter_speed, when.aperture, when.iso_speed))
            return Header(raw.sizes.height, raw.sizes.width, taken, *exposure)
    except (rawpy.LibRawError, OSError, ValueError) as error:
        raise CaptureError(f"{path}: LibRaw cannot read this photograph, it may be cut short or damaged ({_one_line(error)})") from error


def _linear_size(path: Path) -> tuple[int, int]:
    try:
        if path.suffix.lower() == ".exr":
            import OpenEXR

            with OpenEXR.File(str(path), header_only=True) as exr:
                low, high = exr.header()["dataWindow"]
                return int(high[1] - low[1] + 1), int(high[0] - low[0] + 1)
        import tifffile

        with tifffile.TiffFile(path) as tiff:
            return tiff.pages[0].shape[:2]
    except Exception as error:  # both libraries raise their own and the standard kinds for damaged files
        raise CaptureError(f"{path}: cannot be read as an image ({_one_line(error)})") from error


def _expect_whole(path: Path) -> None:
    """Raise CaptureError if a raw file that is built like a TIFF (DNG, CR2, NEF, ARW, …) ends before its image does."""
    import tifffile

    try:
        with _quiet_stderr(), tifffile.TiffFile(path) as tiff:
            pages = [page for top in tiff.pages for page in (top, *(top.pages or ()))]
            ends = [o + n for page in pages for o, n in zip(page.dataoffsets, page.databytecounts, strict=False)]
    except Exception:  # not built like a TIFF, or with a dialect of its own: LibRaw will say
        return
    size = path.stat().st_size
    if ends and max(ends) > size:
        raise CaptureError(f"{path}: the photograph is cut short; expected {max(ends)} bytes, found {size}")


def _bayer_planes(mosaic, pattern, blacks, white, channels, path) -> np.ndarray:
    """Planes (len(channels), H, W) of a mosaic (2H, 2W); blacks: of the four sites of a cell, row by row."""
    height, width = mosaic.shape[0] // 2, mosaic.shape[1] // 2
    if len(pattern) != 4 or not set(channels) <= set(pattern):
        raise CaptureError(f"{path}: the Bayer pattern is {pattern!r}; expected four letters of R, G and B, as in 'RGGB'")
    planes = np.zeros((len(channels), height, width), np.float32)
    for plane, channel in zip(planes, channels, strict=True):
        sites = [i for i, letter in enumerate(pattern) if letter == channel]
        for site in sites:
            cell = mosaic[site // 2 : 2 * height : 2, site % 2 : 2 * width : 2]
            black, span = np.float32(blacks[site]), np.float32(len(sites) * (white - blacks[site]))
            for row in range(0, height, _ROWS_AT_ONCE):
                part = cell[row : row + _ROWS_AT_ONCE].astype(np.float32)
                part -= black
                part /= span
                plane[row : row + _ROWS_AT_ONCE] += part
    return planes


def _load_npy(path: Path) -> np.ndarray:
    try:
        mosaic = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise CaptureError(f"{path}: not a complete .npy file ({_one_line(error)})") from error
    if mosaic.ndim != 2 or mosaic.dtype != np.uint16:
        raise CaptureError(f"{path}: expected a mosaic (rows, columns) of uint16, found {mosaic.shape} of {mosaic.dtype}")
    return mosaic


def _linear_planes(path: Path, channels: str) -> np.ndarray:
    try:
        if path.suffix.lower() == ".exr":
            import OpenEXR

            with OpenEXR.File(str(path), separate_channels=True) as exr:
                found = {name: np.array(c.pixels, np.float32) for name, c in exr.channels().items()}
        else:
            import tifffile

            image = tifffile.imread(path)
            if image.ndim != 3 or image.shape[2] < 3:
                raise CaptureError(f"{path}: expected a linear image (rows, columns, R G B), found shape {image.shape}")
            scale = np.iinfo(image.dtype).max if np.issubdtype(image.dtype, np.integer) else 1
            found = {name: image[..., i].astype(np.float32) / scale for i, name in enumerate("RGB")}
    except CaptureError:
        raise
    except Exception as error:  # both libraries raise their own and the standard kinds for damaged files
        raise CaptureError(f"{path}: cannot be read as an image ({_one_line(error)})") from error
    missing = [c for c in channels if c not in found]
    if missing:
        raise CaptureError(f"{path}: expected channels R, G, B; found {', '.join(sorted(found))}")
    return np.stack([found[c] for c in channels])


def _raw_planes(path: Path, channels: str) -> np.ndarray:
    if path.suffix.lower() == ".dng":
        from . import dng  # and with it numba, which takes a third of a second

        try:
            data = np.fromfile(path, np.uint8)
            layout = dng.read_layout(data)
            sensor = None if _ever_new_kinds() else _verified(_Kind(layout.signature, path))
            if sensor is not None:
                return sensor.planes(sensor.visible(dng.read_mosaic(data, layout)), channels, path)
        except (dng.Unsupported, OSError):  # LibRaw may understand it, or says what is wrong
            pass
    with _by_libraw(path) as (visible, sensor):
        return sensor.planes(visible, channels, path)


@dataclass(frozen=True)
class _Sensor:
    """What LibRaw makes of a file's tags: where in its mosaic the visible one lies, and what the numbers there mean."""

    pattern: str
    blacks: tuple[int, ...]  # of the four sites of a cell, row by row
    white: int
    top: int
    left: int
    height: int
    width: int
    mosaic_shape: tuple[int, int]

    def visible(self, mosaic: np.ndarray) -> np.ndarray:
        return mosaic[self.top : self.top + self.height, self.left : self.left + self.width]

    def planes(self, visible: np.ndarray, channels: str, path: Path) -> np.ndarray:
        return _bayer_planes(visible, self.pattern, self.blacks, self.white, channels, path)


@dataclass(frozen=True)
class _Kind:
    """Files with the same tags, and one of them."""

    signature: bytes
    path: Path = field(compare=False)


@lru_cache(maxsize=64)
def _verified(kind: _Kind) -> _Sensor | None:
    """What LibRaw says of the first file of a kind, if it also finds the very numbers that ``dng`` does; else None, for all of them."""
    from . import dng

    with _by_libraw(kind.path) as (visible, sensor):
        try:
            data = np.fromfile(kind.path, np.uint8)
            mosaic = dng.read_mosaic(data, dng.read_layout(data))
        except dng.Unsupported:
            return None
        same = mosaic.shape == sensor.mosaic_shape and np.array_equal(sensor.visible(mosaic), visible)
        return sensor if same else None


def _ever_new_kinds() -> bool:
    """Whether it does not pay to verify kinds, since files have turned out to be of another one each time."""
    found = _verified.cache_info()
    return found.misses > 16 + found.hits


@contextmanager
def _by_libraw(path: Path) -> Iterator[tuple[np.ndarray, _Sensor]]:
    """The visible mosaic of a raw file, which goes when this ends, and what LibRaw says of it. Raises CaptureError."""
    import rawpy

    try:
        with _quiet_stderr(), rawpy.imread(str(path)) as raw:
            if raw.raw_pattern is None or raw.raw_pattern.shape != (2, 2):
                raise CaptureError(f"{path}: has no 2x2 Bayer pattern (a linear or demosaiced raw); expected a camera's own raw file")
            names, sites, size = raw.color_desc.decode("ascii", "replace"), raw.raw_pattern.ravel(), raw.sizes
            blacks = tuple(raw.black_level_per_channel[i] for i in sites)
            place = (size.top_margin, size.left_margin, size.height, size.width)
            yield (
                raw.raw_image_visible,
                _Sensor("".join(names[i] for i in sites), blacks, raw.white_level, *place, (size.raw_height, size.raw_width)),
            )
    except (rawpy.LibRawError, OSError, ValueError) as error:
        raise CaptureError(f"{path}: LibRaw cannot read this photograph, it may be cut short or damaged ({_one_line(error)})") from error


@dataclass(frozen=True)
class Shot:
    """What a camera notes of a photograph."""

    taken: datetime
    shutter_s: float
    f_number: float


def write_dng(path: Path, mosaic: np.ndarray, black: int, white: int, shot: Shot | None = None) -> None:
    """Write a mosaic (2H, 2W) uint16, RGGB, as an uncompressed DNG that LibRaw reads back unchanged; atomically."""
    import tifffile

    tags = [
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, bytes([0, 1, 1, 2]), True),  # CFAPattern
        (50706, "B", 4, bytes([1, 4, 0, 0]), True),  # DNGVersion
        (50707, "B", 4, bytes([1, 1, 0, 0]), True),  # DNGBackwardVersion
        (50708, "s", 0, CAMERA_NAME, True),  # UniqueCameraModel
        (50710, "B", 3, bytes([0, 1, 2]), True),  # CFAPlaneColor
        (50711, "H", 1, 1, True),  # CFALayout: rectangular
        (50713, "H", 2, (1, 1), True),  # BlackLevelRepeatDim
        (50714, "H", 1, black, True),  # BlackLevel
        (50717, "H", 1, white, True),  # WhiteLevel
        (50721, "2i", 9, _rationals(_COLOR_MATRIX), True),  # ColorMatrix1
        (50728, "2I", 3, _rationals(_NEUTRAL), True),  # AsShotNeutral
        (50778, "H", 1, 21, True),  # CalibrationIlluminant1: D65
        (271, "s", 0, "Strandscope", True),  # Make
        (272, "s", 0, CAMERA_NAME, True),  # Model
        (274, "H", 1, 1, True),  # Orientation
    ]
    if shot:
        tags += [
            (306, "s", 0, shot.taken.strftime("%Y:%m:%d %H:%M:%S"), True),  # DateTime
            (33434, "2I", 1, (round(shot.shutter_s * 1e6), 1_000_000), True),  # ExposureTime
            (33437, "2I", 1, _rationals([shot.f_number]), True),  # FNumber
        ]
    with atomic(path) as part:
        tifffile.imwrite(part, mosaic, photometric="CFA", planarconfig=1, subfiletype=0, metadata=None, extratags=tags)


def _rationals(values) -> tuple[int, ...]:
    return tuple(int(v) for x in values for v in (round(x * 10000), 10000))


def _one_line(error: Exception) -> str:
    text = error.args[0] if error.args and isinstance(error.args[0], bytes) else str(error)
    return " ".join((text.decode(errors="replace") if isinstance(text, bytes) else text).split()) or type(error).__name__


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """LibRaw prints its complaints by itself; ours says the same with the file's name."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
