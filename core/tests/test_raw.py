"""Photographs: every kind gives the planes that were put in, and damage is said in one line.

DNG is read by LibRaw and by ``dng``: whatever the file, the planes are the same, bit for bit.
"""

import struct
from contextlib import suppress
from pathlib import Path

import numba
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from strandscope.core import dng, ljpeg, raw
from strandscope.core.errors import CaptureError
from strandscope.core.raw import Mosaic, read_header, read_planes, write_dng

from .lossless import COMPRESSION_JPEG, COMPRESSION_NONE, bare, lossless_jpeg, write_raw_dng

BLACK, WHITE = 512, 15871
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
SHAPE = (12, 16)  # of a channel plane


@pytest.fixture(scope="module")
def light():
    """Light (3, H, W) of R, G, B, from black to white, different at each pixel, in steps that a 14-bit number can hold."""
    counts = np.random.default_rng(3).integers(0, WHITE - BLACK + 1, (3, *SHAPE))
    return counts / (WHITE - BLACK)


def mosaic_of(light, pattern):
    mosaic = np.empty((2 * SHAPE[0], 2 * SHAPE[1]), np.uint16)
    for site, letter in enumerate(pattern):
        mosaic[site // 2 :: 2, site % 2 :: 2] = BLACK + np.rint(light["RGB".index(letter)] * (WHITE - BLACK))
    return mosaic


def write_dng_of_pattern(path, mosaic, pattern):
    """A DNG as ``write_dng`` makes it, but with another pattern entered in its tag."""
    write_dng(path, mosaic, BLACK, WHITE)
    with tifffile.TiffFile(path) as tiff:
        place = tiff.pages[0].tags[33422].valueoffset
    with open(path, "r+b") as file:
        file.seek(place)
        file.write(bytes("RGB".index(letter) for letter in pattern))


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_dng_of_any_bayer_pattern_gives_its_planes(tmp_path, light, pattern):
    write_dng_of_pattern(tmp_path / "a.dng", mosaic_of(light, pattern), pattern)
    np.testing.assert_allclose(read_planes(tmp_path / "a.dng", "RGB"), light, atol=1e-6)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_bare_mosaic_of_any_bayer_pattern_gives_its_planes(tmp_path, light, pattern):
    np.save(tmp_path / "a.npy", mosaic_of(light, pattern))
    planes = read_planes(tmp_path / "a.npy", "BR", Mosaic(pattern, BLACK, WHITE))
    np.testing.assert_allclose(planes, light[[2, 0]], atol=1e-6)
    assert planes.dtype == np.float32


def test_the_two_greens_are_averaged(tmp_path):
    mosaic = np.full((32, 32), BLACK, np.uint16)
    mosaic[0::2, 1::2] = WHITE  # one green of each cell at white, the other at black
    write_dng(tmp_path / "a.dng", mosaic, BLACK, WHITE)
    np.testing.assert_allclose(read_planes(tmp_path / "a.dng", "G"), 0.5)


@settings(max_examples=15, deadline=None)
@given(rows=st.integers(16, 40), cols=st.integers(16, 40), seed=st.integers(0, 99))
def test_a_dng_comes_back_unchanged_at_any_size(tmp_path_factory, rows, cols, seed):
    path = tmp_path_factory.mktemp("dng") / "a.dng"
    mosaic = np.random.default_rng(seed).integers(0, 1 << 14, (2 * rows, 2 * cols), np.uint16)
    write_dng(path, mosaic, BLACK, WHITE)
    red = (mosaic[::2, ::2].astype(float) - BLACK) / (WHITE - BLACK)
    np.testing.assert_allclose(read_planes(path, "R")[0], red, atol=1e-6)
    assert (read_header(path).rows, read_header(path).cols) == mosaic.shape


@pytest.mark.parametrize("kind", ["exr", "float tiff", "16 bit tiff"])
def test_linear_images_give_their_channels(tmp_path, light, kind):
    image = np.ascontiguousarray(np.moveaxis(light, 0, -1), np.float32)
    if kind == "exr":
        import OpenEXR

        path = tmp_path / "a.exr"
        OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, {"RGB": image}).write(str(path))
    elif kind == "float tiff":
        tifffile.imwrite(path := tmp_path / "a.tif", image, photometric="rgb")
    else:
        tifffile.imwrite(path := tmp_path / "a.tiff", np.rint(image * 65535).astype(np.uint16), photometric="rgb")
    np.testing.assert_allclose(read_planes(path, "RGB"), light, atol=1e-5)
    assert (read_header(path).rows, read_header(path).cols) == SHAPE


def damaged(tmp_path, name, light):
    """A photograph of a kind, whole."""
    path = tmp_path / name
    mosaic = mosaic_of(light, "RGGB")
    if path.suffix == ".dng":
        write_dng(path, mosaic, BLACK, WHITE)
    elif path.suffix == ".npy":
        np.save(path, mosaic)
    else:
        tifffile.imwrite(path, np.moveaxis(light, 0, -1).astype(np.float32), photometric="rgb")
    return path


@pytest.mark.parametrize("name", ["a.dng", "a.npy", "a.tif"])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.5, 0.98])
def test_a_file_that_is_cut_short_is_said_with_its_name(tmp_path, light, name, share):
    path = damaged(tmp_path, name, light)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(CaptureError) as error:
        read_planes(path, "R", Mosaic("RGGB", BLACK, WHITE))
    assert str(path) in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_a_header_tells_that_the_light_is_cut_short(tmp_path, light):
    path = damaged(tmp_path, "a.dng", light)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(CaptureError, match=r"cut short; expected .* bytes, found"):
        read_header(path)


def test_what_has_no_planes_is_refused_in_words(tmp_path, light):
    with pytest.raises(CaptureError, match="missing"):
        read_planes(tmp_path / "none.dng")
    np.save(tmp_path / "a.npy", mosaic_of(light, "RGGB"))
    with pytest.raises(CaptureError, match="mosaic"):
        read_planes(tmp_path / "a.npy")
    np.save(tmp_path / "b.npy", np.zeros((4, 4)))
    with pytest.raises(CaptureError, match="uint16"):
        read_planes(tmp_path / "b.npy", mosaic=Mosaic("RGGB", BLACK, WHITE))
    tifffile.imwrite(tmp_path / "gray.tif", np.zeros((4, 4), np.uint16))
    with pytest.raises(CaptureError, match="R G B"):
        read_planes(tmp_path / "gray.tif")
    (tmp_path / "text.cr2").write_text("no photograph")
    with pytest.raises(CaptureError, match="LibRaw"):
        read_planes(tmp_path / "text.cr2")


def test_a_failed_write_leaves_nothing(tmp_path):
    with pytest.raises(struct.error):
        write_dng(tmp_path / "a.dng", np.zeros((32, 32), np.uint16), -1, WHITE)
    assert list(tmp_path.iterdir()) == []


# ---- DNG without LibRaw ----------------------------------------------------------------------------------------------

SHARED_RAW = Path(__file__).parents[3] / "shared" / "data" / "raw"


@pytest.fixture(autouse=True)
def _nothing_verified_yet():
    raw._verified.cache_clear()


def scene(rows, cols, bits, seed=0):
    """A mosaic (rows, cols) uint16 that is smooth but for noise, with black and white in it."""
    y, x = np.mgrid[:rows, :cols]
    light = np.sin(x / 9) * np.cos(y / 7) + 0.1 * np.random.default_rng(seed).normal(size=(rows, cols))
    return np.clip((light + 1) * (1 << (bits - 1)), 0, (1 << bits) - 1).astype(np.uint16)


def by_libraw(path, channels="RGB"):
    with raw._by_libraw(path) as (visible, sensor):
        return sensor.planes(visible, channels, path)


def is_read_quickly(path):
    """Whether LibRaw is asked about the first such file only."""
    data = np.fromfile(path, np.uint8)
    try:
        layout = dng.read_layout(data)
        dng.read_mosaic(data, layout)
    except dng.Unsupported:
        return False
    return raw._verified(raw._Kind(layout.signature, path)) is not None


def outcome(read, path):
    """The planes of a file as bytes, or what is said of it."""
    try:
        return read(path, "RGB").tobytes()
    except CaptureError as error:
        return str(error)


JPEG, BARE = {"compression": COMPRESSION_JPEG}, {"compression": COMPRESSION_NONE}
USUAL = {
    "one strip": JPEG,
    "12 bits": JPEG | {"bits": 12},
    "16 bits": JPEG | {"bits": 16},
    "highest byte first": JPEG | {"order": ">"},
    "tiles": JPEG | {"tile": (16, 32)},
    "one component": JPEG | {"stream": lambda part: lossless_jpeg(part, 1)},
    "four components": JPEG | {"stream": lambda part: lossless_jpeg(part, 4)},
    "two rows in one": JPEG | {"stream": lambda part: lossless_jpeg(part.reshape(len(part) // 2, -1), 2)},
    "active area": JPEG | {"tags": [(50829, "I", [2, 5, 60, 79])]},
    "a black level for each site": JPEG | {"tags": [(50713, "H", [2, 2]), (50714, "H", [60, 61, 62, 63])]},
    "bare, 16 bits": BARE | {"bits": 16},
    "bare, 16 bits, highest byte first": BARE | {"bits": 16, "order": ">"},
    "bare, 14 bits": BARE | {"bits": 14},
    "bare, 12 bits": BARE | {"bits": 12},
    "bare, 10 bits": BARE | {"bits": 10},
}


@pytest.mark.parametrize("kind", USUAL)
def test_what_cameras_write_is_read_quickly_and_as_by_libraw(tmp_path, kind):
    mosaic = scene(66, 90, USUAL[kind].get("bits", 14)) if "two" not in kind else scene(66, 92, 14)
    if "four" in kind:
        mosaic = mosaic[:, :88]
    write_raw_dng(path := tmp_path / "a.dng", mosaic, **USUAL[kind])
    assert is_read_quickly(path)
    np.testing.assert_array_equal(read_planes(path, "RGB"), by_libraw(path))
    assert raw._verified.cache_info().misses == 1
    if "active" not in kind:
        data = np.fromfile(path, np.uint8)
        np.testing.assert_array_equal(dng.read_mosaic(data, dng.read_layout(data)), mosaic)


def with_a_restart(part):
    """A stream that says that it starts anew after all of its rows, which is never."""
    stream = lossless_jpeg(part, 2)
    return stream[:2] + struct.pack(">HHH", 0xFFDD, 4, part.size // 2) + stream[2:]


UNUSUAL = {
    "predictor 6": JPEG | {"stream": lambda part: lossless_jpeg(part, 2, predictor=6)},
    "restarts": JPEG | {"stream": with_a_restart},
    "two components in tiles of half the width": JPEG | {"tile": (16, 44)},
    "linearization": JPEG | {"tags": [(50712, "H", [min(4 * k, 65535) for k in range(1 << 14)])]},
    "masked area": JPEG | {"tags": [(50829, "I", [0, 8, 66, 88]), (50830, "I", [0, 0, 66, 6])]},
    "no black level": JPEG | {"tags": [(50714, "H", None)]},
    "bare tiles": BARE | {"bits": 16, "tile": (16, 32)},
    "lowest bit first": BARE | {"bits": 16, "tags": [(266, "H", [2])]},
    "an old version": JPEG | {"tags": [(50706, "B", [1, 0, 0, 0])]},
}


@pytest.mark.parametrize("kind", UNUSUAL)
def test_what_is_unusual_is_left_to_libraw(tmp_path, kind):
    write_raw_dng(path := tmp_path / "a.dng", scene(66, 88, UNUSUAL[kind].get("bits", 14)), **UNUSUAL[kind])
    assert not is_read_quickly(path)
    np.testing.assert_array_equal(read_planes(path, "RGB"), by_libraw(path))


@pytest.mark.skipif(not SHARED_RAW.is_dir(), reason="no cameras' files here")
@pytest.mark.parametrize("name", ["canon_kiss_x4.dng", "canon_d30.crw"])
def test_a_cameras_own_file_is_read_as_by_libraw(name):
    path = SHARED_RAW / name
    np.testing.assert_array_equal(read_planes(path, "RGB"), by_libraw(path))
    assert is_read_quickly(path) == (path.suffix == ".dng")


def test_other_tags_are_another_kind(tmp_path):
    mosaic = scene(66, 90, 14)
    for name, black, time in (("a", 64, b"1\0"), ("b", 64, b"2\0"), ("c", 65, b"2\0")):
        write_raw_dng(path := tmp_path / f"{name}.dng", mosaic, COMPRESSION_JPEG, tags=[(50714, "H", [black]), (306, "s", time)])
        np.testing.assert_array_equal(read_planes(path, "RGB"), by_libraw(path))
    assert raw._verified.cache_info()[:2] == (1, 2)


def test_a_way_that_does_not_find_what_libraw_finds_is_given_up(tmp_path, monkeypatch):
    write_raw_dng(path := tmp_path / "a.dng", scene(66, 90, 14), COMPRESSION_JPEG)
    honest = dng.read_mosaic
    monkeypatch.setattr(dng, "read_mosaic", lambda data, layout: honest(data, layout) ^ (np.arange(90) == 31))
    for _ in range(2):
        np.testing.assert_array_equal(read_planes(path, "RGB"), by_libraw(path))
    assert not is_read_quickly(path)


def test_tags_that_are_never_the_same_are_not_verified_for_ever(tmp_path):
    mosaic = scene(24, 24, 14)
    for black in range(30):
        write_raw_dng(path := tmp_path / "a.dng", mosaic, COMPRESSION_NONE, bits=16, tags=[(50714, "H", [black])])
        np.testing.assert_array_equal(read_planes(path, "RGB"), by_libraw(path))
    assert raw._verified.cache_info().misses < 20


@settings(max_examples=60, deadline=None)
@given(
    shape=st.tuples(st.integers(1, 9), st.integers(1, 40), st.integers(1, 4)),
    bits=st.integers(2, 16),
    seed=st.integers(0, 99),
    calm=st.booleans(),
)
def test_lossless_jpeg_comes_back_unchanged(shape, bits, seed, calm):
    rng = np.random.default_rng(seed)
    rows, columns, components = shape
    samples = rng.integers(0, 1 << bits, (rows, columns * components)).astype(np.uint16)
    if calm:  # short symbols only
        samples //= max((1 << bits) // 4, 1)
    stream = np.frombuffer(lossless_jpeg(samples, components, bits), np.uint8)
    decoded = ljpeg.decode(stream, samples.size)
    assert decoded.shape == (rows, columns, components)
    np.testing.assert_array_equal(decoded.reshape(samples.shape), samples)


def test_a_stream_that_ends_early_is_told_at_each_byte():
    samples = scene(8, 24, 14)
    stream = np.frombuffer(lossless_jpeg(samples), np.uint8)
    for size in range(len(stream) - 2):  # without the marker at its end it is whole
        with pytest.raises(ljpeg.Unsupported):
            ljpeg.decode(stream[:size], samples.size)


_within_bounds = numba.njit(boundscheck=True)(ljpeg._decode.py_func)


DAMAGE = st.lists(st.tuples(st.floats(0, 0.999), st.integers(0, 255)), max_size=6)  # place as a share of the whole, byte


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 9), components=st.sampled_from([1, 2, 4]), places=DAMAGE)
def test_a_damaged_stream_reads_nothing_that_is_not_there(seed, components, places):
    samples = scene(8, 24, 14, seed)
    stream = np.frombuffer(bytearray(lossless_jpeg(samples, components)), np.uint8)
    for share, byte in places:
        stream[int(share * len(stream))] = byte
    try:
        rows, width, bits, tables, start = ljpeg._header(stream.tobytes())
        short, long = (np.stack(table) for table in zip(*(ljpeg._lookup(table) for table in tables), strict=True))
        if rows * width == samples.size:
            checked = np.zeros((rows, width), np.uint16)
            done = _within_bounds(stream[start:], short, long, bits, checked)  # an IndexError otherwise
            assert 0 <= done <= rows
        decoded = ljpeg.decode(stream, samples.size)
    except ljpeg.Unsupported:
        return
    np.testing.assert_array_equal(decoded.reshape(rows, width), checked)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300), st.booleans())
def test_garbage_is_not_understood(garbage, after_a_head):
    samples = scene(8, 24, 14)
    stream = lossless_jpeg(samples)
    data = np.frombuffer((stream[: len(stream) // 2] if after_a_head else b"") + garbage, np.uint8)
    with suppress(ljpeg.Unsupported):
        assert ljpeg.decode(data, samples.size).size == samples.size
    with pytest.raises(dng.Unsupported):
        dng.read_layout(np.frombuffer(b"II*\0" + garbage, np.uint8))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Whole files of several kinds, by their names, verified."""
    folder = tmp_path_factory.mktemp("whole")
    for name in ("one strip", "tiles", "bare, 14 bits", "bare, 16 bits"):
        write_raw_dng(folder / f"{name}.dng", scene(66, 90, 14), **USUAL[name])
    return folder


@settings(max_examples=60, deadline=None)
@given(name=st.sampled_from(["one strip", "tiles", "bare, 14 bits", "bare, 16 bits"]), places=DAMAGE)
def test_damaged_light_is_read_as_by_libraw(whole, tmp_path_factory, name, places):
    source = whole / f"{name}.dng"
    data = np.fromfile(source, np.uint8)
    layout = dng.read_layout(data)
    assert raw._verified(raw._Kind(layout.signature, source)) is not None
    for share, byte in places:
        place, size = layout.places[piece := int(share * len(layout.places))], layout.sizes[piece]
        header = ljpeg._header(data[place : place + size].tobytes())[-1] if layout.compression == COMPRESSION_JPEG else 0
        data[place + header + int(share * (size - header))] = byte  # after a damaged header LibRaw gives what was in memory before
    data.tofile(path := tmp_path_factory.mktemp("damaged") / "a.dng")
    assert outcome(read_planes, path) == outcome(by_libraw, path)


@settings(max_examples=300, deadline=None)
@given(name=st.sampled_from(["one strip", "tiles", "bare, 14 bits", "bare, 16 bits"]), data=st.data())
def test_a_damaged_directory_is_read_as_it_is_or_not_at_all(whole, name, data):
    file = np.fromfile(whole / f"{name}.dng", np.uint8)
    directory = int(file[4:8].view("<u4")[0])
    for _ in range(data.draw(st.integers(1, 4))):
        file[data.draw(st.one_of(st.integers(0, 7), st.integers(directory, len(file) - 1)))] = data.draw(st.integers(0, 255))
    try:
        layout = dng.read_layout(file)
        mosaic = dng.read_mosaic(file, layout)
    except dng.Unsupported:
        return
    assert mosaic.shape == (layout.rows, layout.cols)


def test_a_file_that_is_cut_short_after_whole_ones_is_said_as_before(whole, tmp_path):
    for source in whole.iterdir():
        read_planes(source)
        data = source.read_bytes()
        (path := tmp_path / source.name).write_bytes(data[: int(0.9 * len(data))])
        assert outcome(read_planes, path) == outcome(by_libraw, path)
        with pytest.raises(CaptureError, match="LibRaw"):
            read_planes(path)


def test_bare_numbers_are_what_they_say():
    assert bare(np.array([[1, 2, 3, 0x3FF]], np.uint16), 10) == bytes([0, 64, 32, 15, 255])
