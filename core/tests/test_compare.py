"""The score must tell good from bad by known amounts, and drawn curves must lie where geometry says."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from strandscope.core.capture import load_capture
from strandscope.core.compare import Shot, Truth, choose_shot, depth_of_field_mm, in_focus, load_truth, overlay, score, summary
from strandscope.core.errors import StrandscopeError, StrandsError
from strandscope.core.geometry import Optics, pixels
from strandscope.core.strands import INFILL, Strands, offsets_of

ANGLES = 24


def strands_of(curves, kind=None):
    points = np.concatenate([np.asarray(c, float) for c in curves]) if curves else np.zeros((0, 3))
    kinds = np.zeros(len(curves), np.uint8) if kind is None else np.asarray(kind, np.uint8)
    n = len(points)
    return Strands(points, offsets_of(np.array([len(c) for c in curves], int)), np.full(n, 0.04), kinds, np.ones(n))


@pytest.fixture(scope="module")
def hairs():
    """16 gently waving hairs, 10 mm long, 0.5 mm apart, a point each 0.1 mm."""
    y = np.linspace(-5, 5, 101)
    return [np.stack([0.5 * (k % 4) + 0.1 * np.sin(y + k), y, 0.5 * (k // 4) + 0.1 * np.cos(y + k)], axis=1) for k in range(16)]


@pytest.fixture(scope="module")
def truth(hairs):
    """Those hairs, the last four of them hidden from all angles."""
    samples = np.concatenate(hairs)
    visibility = np.ones((len(samples), ANGLES), np.float16)
    visibility[12 * 101 :] = 0.4
    return Truth(samples, offsets_of(np.full(16, 101)), samples, visibility)


def test_the_truth_itself_is_perfect(hairs, truth):
    report = score(strands_of(hairs), truth)
    assert (report["recall"], report["recall_all"], report["precision"], report["f1"]) == (1.0, 1.0, 1.0, 1.0)
    assert report["fragments_per_matched_hair"] == 1.0
    assert report["identity_switch_fraction"] == report["switches_per_100mm"] == 0.0
    assert report["matched_hairs"] == report["curves_following"] == 16
    assert report["pos_err_um"]["p95"] < 0.5  # chords of 0.1 mm on a radius of some 5 mm are 0.25 µm from the arc
    assert report["dir_err_deg"]["p95"] < 0.5
    assert report["length_mm"] == pytest.approx(16 * 10.03, rel=0.01)


def test_a_shift_is_measured_in_micrometres(hairs, truth):
    report = score(strands_of([np.add(hair, [0.03, 0, 0]) for hair in hairs]), truth)
    # across hairs that lean at most 0.1 from the vertical, 30 µm sideways are 30 µm and less by up to cos 6°
    assert report["pos_err_um"]["mean"] == pytest.approx(30, abs=0.3)
    assert report["dir_err_deg"]["p95"] < 0.6
    assert report["recall"] == 1.0


def test_expected_errors_are_compared_with_measured_ones(hairs, truth):
    """Half of the hairs lie 5 um off and say 4, half 20 um and say 25; what is not known is left out."""
    shifts = np.where(np.arange(16) < 8, 0.005, 0.02)
    strands = strands_of([np.add(hair, [shift, 0, 0]) for hair, shift in zip(hairs, shifts, strict=True)])
    error = np.repeat(np.where(shifts < 0.01, 0.004, 0.025), 101)
    error[:50] = np.nan
    report = score(replace(strands, error_mm=error), truth)
    first, second = report["calibration"]
    assert (first["from_um"], first["to_um"], first["points"]) == (3.2, 10.0, 8 * 101 - 50)
    assert (second["from_um"], second["to_um"], second["points"]) == (10.0, 31.6, 8 * 101)
    assert [first["expected_um"], second["expected_um"]] == pytest.approx([4, 25])
    assert [first["measured_um"], second["measured_um"]] == pytest.approx([5, 20], rel=0.02)
    assert ("error 3.2 to 10 µm", "expected 4 µm, measured 5 (medians of 758 points)") in summary(report)
    assert "calibration" not in score(strands, truth)


def test_a_tilt_is_measured_in_degrees(truth, hairs):
    rng = np.random.default_rng(0)
    pieces = []
    for hair in hairs:  # short straight pieces, turned by 5° about their middle on the hair
        for i in range(5, 95, 10):
            g = hair[i + 1] - hair[i - 1]
            g /= np.linalg.norm(g)
            side = np.cross(g, rng.normal(size=3))
            g = np.cos(np.radians(5)) * g + np.sin(np.radians(5)) * side / np.linalg.norm(side)
            pieces.append(hair[i] + np.linspace(-0.3, 0.3, 7)[:, None] * g)
    assert score(strands_of(pieces), truth)["dir_err_deg"]["median"] == pytest.approx(5, abs=0.3)


def test_what_is_beyond_the_tolerance_is_neither_found_nor_right(hairs, truth):
    away = [np.add(hair, [0.0, 0, -9.0]) for hair in hairs[:4]]
    report = score(strands_of(hairs[:12] + away), truth)
    assert report["precision"] == pytest.approx(12 / 16, abs=0.01)
    assert report["precision_in_volume"] == pytest.approx(1.0)
    assert score(strands_of([np.add(hair, [0.12, 0, 0]) for hair in hairs]), truth, tolerance_mm=0.1)["recall"] < 0.02
    assert score(strands_of([np.add(hair, [0.12, 0, 0]) for hair in hairs]), truth, tolerance_mm=0.15)["recall"] == 1.0


def test_half_of_the_hairs_is_half_of_the_recall_and_hidden_hairs_do_not_count(hairs, truth):
    report = score(strands_of(hairs[:6]), truth)
    assert report["recall"] == 0.5
    assert report["recall_all"] == pytest.approx(6 / 16)
    assert report["precision"] == 1.0
    assert report["gt_samples_visible"] == 12 * 101
    assert report["recall_by_visible_angles"]["0-0"] == [0.0, 4 * 101]
    assert report["recall_by_visible_angles"][f"16-{ANGLES}"] == [0.5, 12 * 101]


def test_cutting_in_three_gives_three_pieces(hairs, truth):
    report = score(strands_of([part for hair in hairs for part in (hair[:34], hair[33:67], hair[66:])]), truth)
    assert report["fragments_per_matched_hair"] == 3.0
    assert report["identity_switch_fraction"] == 0.0
    assert report["recall"] == 1.0


def test_splicing_neighbours_is_a_switch_in_each_curve(hairs, truth):
    spliced = [np.concatenate([hairs[k][:50], hairs[k ^ 1][51:]]) for k in range(16)]
    report = score(strands_of(spliced), truth)
    assert report["identity_switch_fraction"] == report["identity_switch_raw"] == 1.0
    assert report["fragments_per_matched_hair"] == 2.0
    assert report["switches_per_100mm"] == pytest.approx(100 * 16 / report["length_mm"])


def test_a_curve_between_two_touching_hairs_is_not_called_a_switch():
    y = np.linspace(0, 10, 101)
    left, right = (np.stack([np.full_like(y, x), y, 0 * y], axis=1) for x in (-0.035, 0.035))
    between = np.stack([0.02 * np.sin(3 * y), y, 0 * y], axis=1)  # now nearer to one, now to the other
    samples = np.concatenate([left, right])
    report = score(strands_of([between]), Truth(samples, np.array([0, 101, 202]), samples, np.ones((202, ANGLES))))
    assert report["identity_switch_raw"] == 1.0
    assert report["identity_switch_fraction"] == 0.0


def test_infill_is_left_out(hairs, truth):
    astray = [np.add(hair, [3.0, 0, 3.0]) for hair in hairs]
    report = score(strands_of(hairs + astray, kind=[0] * 16 + [INFILL] * 16), truth)
    assert report == score(strands_of(hairs), truth)


def test_no_curves_and_curves_without_length_score_nothing(truth):
    for nothing in (strands_of([]), strands_of([np.ones((3, 3))])):
        report = score(nothing, truth)
        assert report["recall"] == report["precision"] == report["f1"] == report["length_mm"] == 0.0
        assert summary(report)


def test_the_order_of_curves_and_points_does_not_matter(hairs, truth):
    jittered = [hair + np.random.default_rng(1).normal(0, 0.02, hair.shape) for hair in hairs]
    one, other = score(strands_of(jittered), truth), score(strands_of([hair[::-1] for hair in jittered[::-1]]), truth)
    for name in ("recall", "precision", "fragments_per_matched_hair", "identity_switch_fraction"):
        assert one[name] == pytest.approx(other[name], abs=1e-9)
    assert one["pos_err_um"]["mean"] == pytest.approx(other["pos_err_um"]["mean"], rel=1e-6)


@pytest.mark.parametrize("array", ["points", "offsets", "sample_points", "visibility"])
def test_a_bad_truth_file_is_named(tmp_path, truth, array):
    arrays = {"points": truth.points_mm, "offsets": truth.offsets, "sample_points": truth.sample_points_mm, "visibility": truth.visibility}
    np.savez(tmp_path / "good.npz", **arrays)
    assert len(load_truth(tmp_path / "good.npz").offsets) == 17
    np.savez(tmp_path / "bad.npz", **(arrays | {array: arrays[array][:-1]}))
    with pytest.raises(StrandsError, match=r"bad\.npz: .*expected"):
        load_truth(tmp_path / "bad.npz")
    del arrays[array]
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(StrandsError, match=rf"bad\.npz: the array '{array}' is missing"):
        load_truth(tmp_path / "bad.npz")


# ---- pictures --------------------------------------------------------------------------------------------------------------


def test_depth_of_field_is_the_papers():
    assert depth_of_field_mm(Optics(330.0, 1 / 35, 0, 0, 10.0)) == pytest.approx(1.2, abs=0.1)


def vertical(x, z, n=15):
    return np.stack([np.full(n, x), np.linspace(-0.5, 0.5, n), np.full(n, z)], axis=1)


def test_only_what_is_near_the_plane_of_focus_is_drawn_and_where_it_appears(noise_capture):
    capture = load_capture(noise_capture)
    strands = strands_of([vertical(0.1, 0.0), vertical(0.2, 5.0), vertical(-0.2, 0.3)])
    segments, curve = in_focus(capture, strands, Shot(0, 2))  # angle 0, d = 0
    assert sorted(set(curve.tolist())) == [0, 2]
    expected = pixels(strands[0], 0.0, 0.0, capture.optics)[:, :2]
    np.testing.assert_allclose(segments[curve == 0][:, 0], expected[:-1])
    np.testing.assert_allclose(segments[curve == 0][:, 1], expected[1:])
    _, turned = in_focus(capture, strands, Shot(1, 2))  # from +90°, depth is -x: all three are within 0.2 mm
    assert set(turned.tolist()) == {0, 1, 2}


def test_the_photograph_with_most_hair_in_focus_is_chosen(noise_capture):
    capture = load_capture(noise_capture)
    # the depth of field is 1.1 mm: only a plane at 0.4 mm holds what is at 0.9 mm
    assert choose_shot(capture, strands_of([vertical(0.0, 0.9), vertical(0.1, 0.9)])) == Shot(0, 4)
    assert choose_shot(capture, strands_of([vertical(0.9, 0.0)]), sweep=1) == Shot(1, 0)  # seen from +90° it is at -0.9
    assert choose_shot(capture, strands_of([vertical(0.0, 0.9)]), angle_deg=-85.0, position_mm=0.21) == Shot(3, 3)
    with pytest.raises(StrandscopeError, match="no sweep 4; expected 0 … 3"):
        choose_shot(capture, strands_of([]), sweep=4)


def test_the_picture_shows_three_panels_with_the_curve_in_the_third(noise_capture, tmp_path):
    capture = load_capture(noise_capture)
    caption = overlay(capture, strands_of([vertical(0.3, 0.0)]), Shot(0, 2), tmp_path / "o.png")
    assert "1 of 1 curves" in caption
    picture = np.asarray(Image.open(tmp_path / "o.png")).astype(int)
    zoom = 14  # 64 pixels wide -> at least 840
    width = 64 * zoom
    assert picture.shape[1] == 3 * width + 8
    third = picture[: 48 * zoom, 2 * (width + 4) :]
    colored = third.max(axis=2) - third.min(axis=2) > 60
    col, row, _ = pixels([0.3, 0.0, 0.0], 0.0, 0.0, capture.optics)
    rows, cols = np.nonzero(colored)
    assert cols.mean() + 0.5 == pytest.approx((col + 0.5) * zoom, abs=1.0)
    assert rows.mean() + 0.5 == pytest.approx((row + 0.5) * zoom, abs=1.0)


def test_a_picture_needs_a_name_that_says_png(noise_capture, tmp_path):
    with pytest.raises(StrandscopeError, match=r"\.png"):
        overlay(load_capture(noise_capture), strands_of([]), Shot(0, 0), tmp_path / "o.gif")
    assert not (tmp_path / "o.gif").exists()
