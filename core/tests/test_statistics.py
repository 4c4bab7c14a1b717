"""Statistics of hair that was made so that they are known: lattices, lines at random, helices, bundles, and hairs that leave the others."""

import json
from dataclasses import replace

import numpy as np
import pytest

from strandscope.core.cli import run
from strandscope.core.errors import StrandscopeError, StrandsError
from strandscope.core.statistics import describe, load_hair, side_by_side
from strandscope.core.statistics_page import LOOKS, plot
from strandscope.core.strands import CAPTURED, INFILL, Strands, offsets_of, save_strands

from .known import helix

HEIGHTS = np.arange(-5, 5.01, 0.25)


def hair(curves, kind=None, radius_mm=0.04):
    """Strands of a list of (n, 3) curves."""
    points = np.concatenate(curves).astype(np.float32)
    kinds = np.zeros(len(curves), np.uint8) if kind is None else np.asarray(kind, np.uint8)
    radius, offsets = np.full(len(points), radius_mm, np.float32), offsets_of(np.array([len(curve) for curve in curves]))
    return Strands(points, offsets, radius, kinds, np.ones(len(points), np.float32))


def uprights(where, heights=HEIGHTS):
    """Vertical curves through places (n, 2) x, z."""
    return [np.stack([np.full(len(heights), x), heights, np.full(len(heights), z)], axis=1) for x, z in where]


def lattice(count, spacing_mm):
    """count² places (n, 2), about the axis."""
    line = (np.arange(count) - (count - 1) / 2) * spacing_mm
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


def captured(strands, **kwargs):
    return side_by_side(strands, **kwargs)["sets"]["captured"]


# ---- density, distances, angles --------------------------------------------------------------------------------------


def test_a_lattice_has_its_spacing_and_density():
    numbers = captured(hair(uprights(lattice(14, 0.5)), radius_mm=0.05))
    assert numbers["curves"] == 196
    assert numbers["length_mm"] == pytest.approx(1960, rel=1e-5)
    assert numbers["planes"]["mean_per_mm2"] == pytest.approx(4.0, rel=0.04)  # the window is made of pixels of 0.1 mm
    assert numbers["density_per_mm2"]["median"] == pytest.approx(4.0, rel=0.04)
    assert numbers["nearest_mm"]["p5"] == pytest.approx(0.5, abs=1e-5)
    assert numbers["nearest_mm"]["p95"] == pytest.approx(0.5, abs=1e-5)
    assert numbers["nearest_radii"]["median"] == pytest.approx(5.0, abs=1e-4)
    assert numbers["nearest_deg"]["p95"] == pytest.approx(0.0, abs=1e-3)
    assert numbers["running_through_others"] == 0
    assert numbers["flyaways"] == {"share_of_curves": 0, "share_of_length": 0}


def test_a_lattice_has_pairs_at_its_distances_only():
    """At the bins of 1, √2, 2 and √5 spacings; the sum over all distances is that of any hair so dense."""
    told = captured(hair(uprights(lattice(24, 0.51))), radius_mm=4.5)["pair_correlation"]
    distance, g = np.array(told["distance_mm"]), np.array(told["g"])
    there = {int(0.51 * k / 0.05) for k in np.sqrt([1, 2, 4, 5, 8])}
    assert set(np.flatnonzero(g > 0)) == there
    assert np.sum(g * distance) / np.sum(distance) == pytest.approx(1.0, rel=0.15)  # 24 others within 1.5 mm, of 26.2


def test_lines_at_random_are_as_dense_and_as_near_as_poisson_says():
    """λ = 6 fibers per mm²: P(nearest > r) = exp(-λ π r²), g = 1 everywhere. In the region lie 300 of them: a mean is known to 6 %."""
    rng = np.random.default_rng(8)
    numbers = captured(hair(uprights(rng.uniform(-7, 7, (6 * 14 * 14, 2)))), radius_mm=4.0)
    density = numbers["curves"] / (np.pi * 16)
    assert numbers["planes"]["mean_per_mm2"] == pytest.approx(density, rel=0.015)  # the window is a circle of the region
    assert numbers["density_at_fibers_per_mm2"]["mean"] == pytest.approx(6.0, rel=0.1)
    for name, share in (("p25", 0.25), ("median", 0.5), ("p75", 0.75)):
        assert numbers["nearest_mm"][name] == pytest.approx(np.sqrt(-np.log(1 - share) / (6 * np.pi)), rel=0.12)
    g = np.array(numbers["pair_correlation"]["g"])
    assert g[4:].mean() == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(g[4:], 1.0, atol=0.25)


def test_density_at_fibers_does_not_ask_where_they_run():
    """Lines with all directions alike through a ball of radius B: N / (π B²) of length per volume, whatever the plane one looks at."""
    rng = np.random.default_rng(5)
    ways = rng.normal(size=(3000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    side = np.cross(ways, rng.normal(size=(3000, 3)))
    at = side / np.linalg.norm(side, axis=1, keepdims=True) * 6 * np.sqrt(rng.random((3000, 1)))
    half = np.sqrt(np.maximum(16 - (at**2).sum(1), 0))[:, None]  # only what is within 4 mm of the middle
    near = half[:, 0] > 0.1
    strands = hair(list(at[near, None] + np.linspace(-1, 1, 41)[None, :, None] * (half * ways)[near, None]))
    numbers = captured(strands, inside_mm=(-2, 2), radius_mm=2.0)
    density = 3000 / (np.pi * 36)
    assert numbers["density_at_fibers_per_mm2"]["mean"] == pytest.approx(density, rel=0.12)  # 16 m of hair: known to 5 %
    assert numbers["planes"]["mean_per_mm2"] == pytest.approx(0.5 * density, rel=0.15)  # the mean of the cosine of the slope is a half
    assert numbers["nearest_deg"]["median"] == pytest.approx(60.0, abs=4.0)  # cos is evenly spread


def test_angles_grow_with_distance_where_hair_fans_out():
    """Fibers of a fan in a plane, 2° from each to the next and 0.2 mm apart in the middle: k neighbours away it is 2 k degrees."""
    curves = []
    for k in range(-8, 9):
        way = np.array([np.sin(np.radians(2 * k)), np.cos(np.radians(2 * k)), 0])
        curves.append(np.array([0.2 * k, 0, 0]) + HEIGHTS[:, None] * way)
    told = captured(hair(curves), inside_mm=(-0.1, 0.1))["parallelism"]
    for k in (1, 2, 3, 4, 5):
        assert told["median_deg"][int(round(0.2 * k * np.cos(np.radians(k)) / 0.05, 6))] == pytest.approx(2 * k, abs=0.3)


def test_hair_that_runs_through_other_hair_is_told():
    places = np.array([(x, 0.0) for x in (0.0, 0.05, 1.0, 1.085, 2.0, 3.0, 4.0, 5.0)])  # sums of radii 0.08
    assert captured(hair(uprights(places)))["running_through_others"] == pytest.approx(2 / 8)


# ---- bends -----------------------------------------------------------------------------------------------------------


def test_helices_have_their_curvature_torsion_hand_and_wavelength():
    rise = 12.0 / (2 * np.pi)
    square = 1.0 + rise**2
    coils = [helix(1.0, 12.0, True, half_mm=20)[::20] + np.array([3.0 * k, 0, 0]) for k in range(4)]
    numbers = captured(hair(coils))
    assert numbers["curvature_per_mm"]["p5"] == pytest.approx(1.0 / square, rel=0.02)
    assert numbers["curvature_per_mm"]["p95"] == pytest.approx(1.0 / square, rel=0.02)
    assert numbers["torsion_per_mm"]["median"] == pytest.approx(rise / square, rel=0.05)
    assert numbers["bending_enough_for_torsion"] == 1.0
    curvature, torsion = (numbers["spectra"][name] for name in ("curvature", "torsion"))
    assert curvature["peak_mm"] == pytest.approx(2 * np.pi * square / rise, rel=0.03)
    assert curvature["right_handed"] > 0.99
    assert max(torsion["power"]) < 1e-3 * max(curvature["power"])  # it is the same everywhere
    mirrored = captured(hair([coil * [-1, 1, 1] for coil in coils]))
    assert mirrored["torsion_per_mm"]["median"] == pytest.approx(-numbers["torsion_per_mm"]["median"], rel=1e-3)
    assert mirrored["spectra"]["curvature"]["right_handed"] < 0.01


def test_it_does_not_matter_which_end_of_a_curve_is_first():
    rng = np.random.default_rng(3)
    curves = [helix(0.6, 10.0, half_mm=6)[::25] + np.array([x, 0, z]) for x, z in rng.uniform(-2, 2, (12, 2))]
    one, other = side_by_side(hair(curves))["sets"]["captured"], side_by_side(hair([curve[::-1] for curve in curves]))["sets"]["captured"]
    for name in ("density_per_mm2", "density_at_fibers_per_mm2", "nearest_mm", "nearest_deg", "curvature_per_mm", "torsion_per_mm"):
        for figure in ("mean", "p5", "median", "p95"):
            assert one[name][figure] == pytest.approx(other[name][figure], rel=1e-3, abs=1e-4), name
    assert one["clumps"] == other["clumps"]
    assert one["flyaways"] == other["flyaways"]


# ---- clumps, flyaways ------------------------------------------------------------------------------------------------


def bundle(size, at, spacing_mm=0.2):
    """size places (n, 2) of a lattice, nearest to a place."""
    places = lattice(9, spacing_mm)
    return places[np.argsort(np.hypot(*places.T), kind="stable")[:size]] + at


def test_bundles_are_clumps_of_their_size():
    sizes = [1, 1, 2, 3, 6, 12]
    curves = [curve for k, size in enumerate(sizes) for curve in uprights(bundle(size, (4.0 * k, 0)))]
    told = captured(hair(curves))["clumps"]
    assert told["curves"] == 25
    assert told["largest"] == 12
    assert told["share_in_clumps"] == pytest.approx(21 / 25)
    assert told["size_from"] == [1, 2, 3, 5, 9, 17, 33]
    np.testing.assert_allclose(told["share"], np.array([2, 2, 3, 6, 12, 0, 0]) / 25)


def test_fibers_are_of_one_clump_only_where_they_stay_together():
    """Two bundles that touch over 5.6 of some 11 mm, and a fiber across all at 40°, remain two bundles of five."""
    heights = np.arange(-5, 5.01, 0.1)
    apart = np.clip(np.abs(heights) - 2.8, 0, 1.5)
    left = [curve - np.outer(apart, [1, 0, 0]) for curve in uprights(bundle(5, (-0.3, 0)), heights)]
    right = [curve + np.outer(apart, [1, 0, 0]) for curve in uprights(bundle(5, (0.3, 0)), heights)]
    across = np.stack([heights * np.tan(np.radians(40)), heights, np.full(len(heights), 0.3)], axis=1)
    told = captured(hair([*left, *right, across]))["clumps"]
    np.testing.assert_allclose(told["share"], np.array([1, 0, 0, 10, 0, 0, 0]) / 11)
    together = captured(hair([*left, *right]), inside_mm=(-2.7, 2.7))["clumps"]
    assert together["largest"] == 10  # there they are one


def test_curves_that_leave_the_others_are_flyaways():
    """Of 169 hairs three bow out for more than 2 mm, and four for less."""
    places, heights = lattice(13, 0.5), np.arange(-5, 5.01, 0.1)
    curves = uprights(places, heights)
    rim = np.flatnonzero(places[:, 0] == places[:, 0].max())
    for n, k in enumerate(rim[::2]):
        far, half = (6.0, 3.0) if n < 3 else (1.2, 0.6)
        out = far * np.clip(1 - ((heights - (n - 3)) / half) ** 2, 0, 1)
        curves[k] = curves[k] + np.outer(out, [1, 0, 0.0])
    told = captured(hair(curves))["flyaways"]
    assert len(rim[::2]) == 7
    assert told["share_of_curves"] == pytest.approx(3 / 169)
    assert 0.01 < told["share_of_length"] < 0.03  # of 1.7 m, three times some 11 mm


# ---- sets side by side -----------------------------------------------------------------------------------------------


def test_neighbours_are_of_all_kinds_and_told_by_the_kind_that_asks():
    places = np.array([(0.0, 0.0), (0.3, 0.0), (4.0, 0.0), (4.7, 0.0)])
    strands = hair(uprights(places), kind=[CAPTURED, INFILL, CAPTURED, CAPTURED])
    sets = side_by_side(strands)["sets"]
    assert list(sets) == ["captured", "infill", "captured and infill"]
    assert sets["infill"]["nearest_mm"]["median"] == pytest.approx(0.3, abs=1e-5)
    assert sets["captured"]["nearest_mm"]["p5"] == pytest.approx(0.3, abs=1e-5)
    assert sets["captured"]["nearest_mm"]["p95"] == pytest.approx(0.7, abs=1e-5)
    for name in ("curves", "length_mm"):
        assert sets["captured and infill"][name] == pytest.approx(sets["captured"][name] + sets["infill"][name])
    total = np.sum([sets[name]["planes"]["crossings"] for name in ("captured", "infill")], axis=0)
    np.testing.assert_array_equal(sets["captured and infill"]["planes"]["crossings"], total)
    np.testing.assert_array_equal(total, 4)


def test_hair_beside_counts_only_where_the_strands_reach():
    """Others that stand farther out, and higher, are left out, and yet stand beside those that count."""
    strands = hair(uprights(lattice(9, 0.5)))
    other = hair(uprights(lattice(29, 0.5), np.arange(-20, 20.1, 0.25)))
    report = side_by_side(strands, other)
    reach = np.hypot(2.0, 2.0)
    assert report["region"] == pytest.approx({"low_mm": -5.0, "high_mm": 5.0, "radius_mm": reach}, abs=1e-6)
    within = int(np.sum(np.hypot(*lattice(29, 0.5).T) <= reach + 1e-9))
    beside = report["sets"]["beside"]
    assert beside["curves"] == within
    assert beside["length_mm"] == pytest.approx(10 * within, rel=0.03)
    assert beside["planes"]["mean_per_mm2"] == pytest.approx(within / (np.pi * reach**2), rel=0.05)
    assert beside["nearest_mm"]["p95"] == pytest.approx(0.5, abs=1e-5)
    assert beside["density_at_fibers_per_mm2"]["mean"] > 1.2 * report["sets"]["captured"]["density_at_fibers_per_mm2"]["mean"]  # none is at a rim


@pytest.mark.parametrize(
    "strands",
    [
        hair([np.array([[0, 0, 0], [0, 0.05, 0]])]),
        hair([np.array([[0, 1, 0], [3, 1, 0]]), np.array([[0, 1, 1], [3, 1, 1]])]),
        hair(uprights([(0, 0), (3, 0)]), kind=[INFILL, INFILL]),
        hair([np.zeros((3, 3)), np.array([[0, 0, 0], [0, 9, 0]])]),
    ],
    ids=["one short curve", "all flat", "infill only", "one without length"],
)
def test_little_hair_has_numbers_that_json_can_hold(tmp_path, strands):
    report = side_by_side(strands, beside=strands)
    assert json.loads(json.dumps(report, allow_nan=False))["sets"]
    assert len(describe(report)) > 10
    plot(report, tmp_path / "page.png")
    assert (tmp_path / "page.png").stat().st_size > 50_000


def test_where_no_hair_is_is_said():
    strands = hair(uprights([(0, 0)]))
    with pytest.raises(StrandscopeError, match="between the heights 7 and 9 mm"):
        side_by_side(strands, inside_mm=(7, 9))
    with pytest.raises(StrandscopeError, match="the lower one first"):
        side_by_side(strands, inside_mm=(2, 1))


# ---- files, the page, the command line -------------------------------------------------------------------------------


@pytest.fixture
def files(tmp_path):
    """A strands file with two kinds, and a truth file."""
    kinds = [CAPTURED, INFILL] * 12 + [CAPTURED]
    save_strands(tmp_path / "strands.npz", hair(uprights(lattice(5, 0.4)), kind=kinds))
    true = hair(uprights(lattice(6, 0.35)))
    np.savez(tmp_path / "truth.npz", points=true.points_mm, offsets=true.offsets, radii=np.linspace(0.03, 0.05, 36, dtype=np.float32))
    return tmp_path


def test_the_hair_of_a_truth_file_is_read(files):
    true = load_hair(files / "truth.npz")
    assert len(true) == 36
    np.testing.assert_allclose(true.radius_mm[true.offsets[:-1]], np.linspace(0.03, 0.05, 36), rtol=1e-6)
    assert len(load_hair(files / "strands.npz")) == 25
    arrays = dict(np.load(files / "truth.npz"))
    for name, change, said in (
        ("radii", lambda a: a[:-1], "radii"),
        ("offsets", lambda a: a[:-1], "radii"),
        ("points", lambda a: a[:-1], "offsets"),
        ("points", lambda a: a * np.nan, "points"),
    ):
        np.savez(files / "bad.npz", **arrays | {name: change(arrays[name])})
        with pytest.raises(StrandsError, match=rf"bad\.npz: {said}"):
            load_hair(files / "bad.npz")


def test_the_page_shows_every_set(files):
    from matplotlib.colors import to_rgb
    from PIL import Image

    report = side_by_side(load_hair(files / "strands.npz"), load_hair(files / "truth.npz"))
    assert list(report["sets"]) == list(LOOKS)
    plot(report, files / "page.png", "truth")
    pixels = np.asarray(Image.open(files / "page.png").convert("RGB")).astype(float)
    for name, look in LOOKS.items():
        near = np.abs(pixels - 255 * np.array(to_rgb(look["color"]))).max(axis=2) < 3
        assert near.sum() > 500, name


def test_stats_writes_numbers_and_page(files, capsys):
    command = ["stats", "strands.npz", "--json", "s.json", "--plots", "p.png", "--beside", "truth.npz", "--inside", "-4,4", "--progress", "none"]
    assert run([str(files / word) if "." in word and not word.startswith("-") else word for word in command]) == 0
    printed = capsys.readouterr().out
    assert "captured curves" in printed
    assert "nearest neighbour, mm" in printed
    assert "truth.npz" in printed
    numbers = json.loads((files / "s.json").read_text(encoding="utf-8"))
    assert numbers["curves"] == 13
    assert numbers["infill_curves"] == 12
    assert numbers["region"]["low_mm"] == -4
    assert numbers["sets"]["beside"]["nearest_mm"]["median"] == pytest.approx(0.35, abs=1e-5)
    assert (files / "p.png").read_bytes()[:4] == b"\x89PNG"
    assert run(["stats", str(files / "strands.npz"), "--inside", "4"]) == 2
    assert "LOW,HIGH" in capsys.readouterr().err


def test_a_file_without_hair_still_has_its_counts(files, capsys):
    nothing = replace(load_hair(files / "strands.npz").select(np.zeros(25, bool)))
    save_strands(files / "none.npz", nothing)
    assert run(["stats", str(files / "none.npz"), "--progress", "none"]) == 0
    assert "captured curves" in capsys.readouterr().out
