"""Photographs: every kind gives the planes that were put in, and damage is said in one line."""

import struct

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from strandscope.core.errors import CaptureError
from strandscope.core.raw import Mosaic, read_header, read_planes, write_dng

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
