"""How infill is judged, of infill whose quality is known: the missing hair itself, and hair that is wrong in one way each."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from strandscope.core.compare import Truth
from strandscope.core.errors import StrandscopeError
from strandscope.core.filled import FOUND_MM, HULL_MM, fill_score, parted
from strandscope.core.strands import CAPTURED, INFILL, Strands, offsets_of

RADIUS = 0.03  # mm
HEIGHTS = np.arange(-3.5, 3.51, 0.1)


def hair(count=90, seed=0, reach_mm=2.2, height_mm=0.06):
    """Waves of any phase and a length of some mm, 0.3 mm apart, that run beyond the samples' cylinder: a list of (n, 3)."""
    rng, where = np.random.default_rng(seed), np.empty((0, 2))
    while len(where) < count:
        at = rng.uniform(-reach_mm, reach_mm, 2)
        if np.hypot(*at) < reach_mm and np.all(np.hypot(*(where - at).T) > 0.2):
            where = np.concatenate([where, [at]])
    curves = []
    for x, z in where:
        wave = height_mm * np.sin(2 * np.pi * HEIGHTS[:, None] / rng.uniform(3, 5) + rng.uniform(0, 2 * np.pi, 2))
        curves.append(np.stack([x + wave[:, 0], HEIGHTS, z + wave[:, 1]], axis=1))
    return curves


def truth_of(curves):
    """The truth of curves; its samples tell a cylinder of radius 2.5 and half height 2.8."""
    turn, y = np.meshgrid(np.linspace(0, 2 * np.pi, 24), np.linspace(-2.8, 2.8, 7))
    samples = np.stack([2.5 * np.cos(turn), y, 2.5 * np.sin(turn)], axis=-1).reshape(-1, 3)
    return Truth(np.concatenate(curves), offsets_of([len(c) for c in curves]), samples, np.ones((len(samples), 4)))


def strands_of(captured, filled):
    points = np.concatenate([*captured, *filled]).astype(np.float32)
    kind = np.repeat(np.array([CAPTURED, INFILL], np.uint8), [len(captured), len(filled)])
    sizes = [len(c) for c in (*captured, *filled)]
    return Strands(points, offsets_of(sizes), np.full(len(points), RADIUS, np.float32), kind, np.ones(len(points), np.float32))


def split(full, core_mm):
    """The hair outside a core, which was seen, and that inside, which was not."""
    core = [bool(np.hypot(*c[:, [0, 2]].mean(axis=0)) < core_mm) for c in full]
    return [c for c, within in zip(full, core, strict=True) if not within], [c for c, within in zip(full, core, strict=True) if within]


FULL = hair(60, reach_mm=1.8)
SEEN, UNSEEN = split(FULL, 0.65)  # 6 hidden hairs: too few for a classifier to be asked
LOCK = hair()
SHELL, CORE = split(LOCK, 1.3)


def judged(filled, captured=SEEN, full=FULL):
    return fill_score(strands_of(captured, filled), truth_of(full))


@pytest.fixture(scope="module")
def perfect():
    return judged(UNSEEN)


def test_the_missing_hair_itself_is_perfect(perfect):
    assert perfect["crossings"] == pytest.approx({"ratio": 1.0, "least": 1.0, "most": 1.0, "true": float(len(FULL))})
    assert perfect["density_correlation"] > 0.999
    assert perfect["infill_direction_deg"]["mean"] < 0.5
    assert (perfect["infill_inside"], perfect["infill_inside_wide"]) == (1.0, 1.0)
    assert (perfect["overlapping_infill"], perfect["overlapping_all"]) == (0.0, 0.0)
    assert perfect["pieces"] == perfect["hidden_pieces"] == len(UNSEEN)


def test_the_same_strands_get_the_same_figures(perfect):
    assert judged(UNSEEN) == perfect


def test_lengths_are_those_inside_the_samples_cylinder(perfect):
    bend = np.mean([np.linalg.norm(np.diff(c, axis=0), axis=1).sum() / 7.0 for c in FULL])  # of 5.6 mm height each
    assert perfect["true_mm"] == pytest.approx(5.6 * bend * len(FULL), rel=0.02)
    assert perfect["infill_mm"] == pytest.approx(5.6 * bend * len(UNSEEN), rel=0.02)
    assert perfect["captured_mm"] + perfect["infill_mm"] == pytest.approx(perfect["true_mm"], rel=1e-3)


@pytest.mark.parametrize("share", [0.0, 0.5, 2.0])
def test_too_little_and_too_much_are_told(share):
    rng = np.random.default_rng(1)
    some = [UNSEEN[k] for k in rng.permutation(len(UNSEEN))[: max(round(share * len(UNSEEN)), 1)]]
    if share > 1:
        some = UNSEEN + [c + np.array([0.1, 0.0, 0.1]) for c in UNSEEN]
    report = judged(some)
    wanted = (len(SEEN) + len(some)) / len(FULL)
    assert report["crossings"]["ratio"] == pytest.approx(wanted, rel=0.01)
    assert report["density_correlation"] < 0.995


def test_the_worst_plane_is_told():
    upper = [c[c[:, 1] > 0.05] for c in UNSEEN]
    crossings = judged(upper)["crossings"]
    assert crossings["most"] == pytest.approx(1.0)
    assert crossings["least"] == pytest.approx(len(SEEN) / len(FULL))
    assert crossings["least"] < crossings["ratio"] < crossings["most"]


@pytest.mark.parametrize("angle_deg", [5, 20])
def test_hair_that_leans_has_the_wrong_direction(angle_deg):
    straight = hair(60, reach_mm=1.8, height_mm=0.0)
    seen, unseen = split(straight, 0.65)
    leaning = [c + np.tan(np.radians(angle_deg)) * c[:, 1:2] * [1.0, 0.0, 0.0] for c in unseen]
    report = judged(leaning, seen, straight)
    assert report["infill_direction_deg"] == pytest.approx({"mean": angle_deg, "median": angle_deg}, abs=0.5)
    assert report["density_correlation"] < 0.99


def test_hair_in_the_air_is_outside():
    rim = max(np.hypot(c[:, 0], c[:, 2]).max() for c in FULL)
    small = [c for c in FULL if np.hypot(c[:, 0], c[:, 2]).max() < 1.2]  # the truth ends at 1.2: the cylinder reaches 2.5
    far = [np.stack([0 * HEIGHTS + r, HEIGHTS, 0 * HEIGHTS], axis=1) for r in (1.2 + 0.3 * HULL_MM, 1.2 + 1.6 * HULL_MM, 2.4)]
    report = judged(far, small, small)
    assert rim < 2.5
    assert report["infill_inside"] <= 1 / 3 + 0.01
    assert report["infill_inside"] < report["infill_inside_wide"] < 0.7


@pytest.mark.parametrize(("apart", "overlaps"), [(0.85, True), (0.95, False), (1.2, False)])
def test_hair_that_runs_through_other_hair_is_told(apart, overlaps):
    beside = [SEEN[0] + np.array([0.0, 0.0, apart * 2 * RADIUS])]
    report = fill_score(strands_of(SEEN[:1], beside), truth_of(FULL))
    assert report["overlapping_infill"] == pytest.approx(float(overlaps), abs=0.35)  # waves lean, which brings them nearer
    if apart != 0.95:
        assert report["overlapping_infill"] == report["overlapping_all"] == float(overlaps)


def test_half_of_a_strand_that_overlaps_counts_half():
    gap = np.where(HEIGHTS < 0, 1.5, 0.5) * 2 * RADIUS
    line = np.stack([0 * HEIGHTS, HEIGHTS, 0 * HEIGHTS], axis=1)
    report = fill_score(strands_of([line], [line + gap[:, None] * [1.0, 0.0, 0.0]]), truth_of(FULL))
    assert report["overlapping_infill"] == pytest.approx(0.5, abs=0.03)
    assert report["overlapping_all"] == pytest.approx(0.5, abs=0.03)


def test_neither_order_nor_direction_of_curves_matter(perfect):
    rng = np.random.default_rng(3)
    mixed = [UNSEEN[k][:: rng.choice([-1, 1])] for k in rng.permutation(len(UNSEEN))]
    report = judged(mixed, SEEN[::-1])
    for name in ("infill_mm", "density_correlation", "infill_inside"):
        assert report[name] == pytest.approx(perfect[name], rel=0.01)
    assert report["crossings"] == pytest.approx(perfect["crossings"])


def test_short_pieces_are_not_judged():
    report = judged([c[33:39] for c in UNSEEN])  # 0.5 mm of each
    assert report["pieces"] == 0
    assert report["told_apart"] is None


def test_without_infill_there_is_nothing_to_judge():
    with pytest.raises(StrandscopeError, match="no infill to judge"):
        fill_score(strands_of(SEEN, []), truth_of(FULL))


# ---- told apart ------------------------------------------------------------------------------------------------------


def told(filled):
    return fill_score(strands_of(SHELL, filled), truth_of(LOCK))


def test_the_missing_hair_itself_cannot_be_told_apart():
    pytest.importorskip("sklearn")
    perfect, again = told(CORE), told(CORE)
    assert perfect == again
    assert perfect["pieces"] == perfect["hidden_pieces"] == len(CORE)
    assert perfect["told_apart"] < 0.5  # all pieces are there twice, once of each kind: a forest that was taught the one is wrong on the other


def test_other_hair_of_the_same_kind_can_hardly_be_told_apart():
    pytest.importorskip("sklearn")
    other = [c for c in hair(seed=4) if np.hypot(*c[:, [0, 2]].mean(axis=0)) < 1.3]
    assert told(other)["told_apart"] < 0.75  # of some 30 pieces of each kind: half of them, and two deviations of 0.09


@pytest.mark.parametrize("wrong", ["combed", "frizzy", "crowded"])
def test_hair_of_another_kind_is_told_apart(wrong):
    pytest.importorskip("sklearn")
    rng = np.random.default_rng(5)
    if wrong == "combed":
        fill = [np.stack([0 * c[:, 0] + c[:, 0].mean(), c[:, 1], 0 * c[:, 2] + c[:, 2].mean()], axis=1) for c in CORE]
    elif wrong == "frizzy":
        fill = [c + 0.05 * np.sin(6 * c[:, 1:2] + rng.uniform(0, 6, 2)) @ np.array([[1, 0, 0], [0, 0, 1]]) for c in CORE]
    else:
        fill = [c + at for c in CORE[::2] for at in (np.zeros(3), np.array([0.07, 0.0, 0.0]))]
    assert told(fill)["told_apart"] > 0.85


def test_pieces_of_one_fiber_are_not_each_others_neighbours():
    pytest.importorskip("sklearn")
    halves = [part for c in CORE for part in (c[:35], c[35:])]
    count = len(SHELL)
    joins = np.array([[2 * (count + a) + 1, 2 * (count + b)] for a, b in pairwise(range(len(halves)))][::2], np.int64)
    joined = fill_score(replace(strands_of(SHELL, halves), joins=joins), truth_of(LOCK))
    assert joined["pieces"] == 2 * len(CORE)
    assert joined["told_apart"] < 0.75


def test_true_hair_is_parted_into_what_was_found_and_what_was_not():
    found, hidden = np.stack([0 * HEIGHTS, HEIGHTS, 0 * HEIGHTS], axis=1), np.stack([0 * HEIGHTS + 1, HEIGHTS, 0 * HEIGHTS], axis=1)
    half = parted(strands_of([found, hidden], []), strands_of([found[HEIGHTS < 0] + (0.05, 0, 0)], []))
    assert half.kind.tolist() == [CAPTURED, INFILL, INFILL]
    assert abs(half[0][:, 1].max() - half[1][:, 1].min()) < 1e-5
    assert abs(half[0][:, 1].max()) < 2 * FOUND_MM
    np.testing.assert_allclose(half[2], hidden, atol=1e-6)
