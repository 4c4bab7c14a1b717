"""Strands files: whole, finite, reproducible to the byte; and the numbers that are taken of them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from strandscope.core.errors import StrandsError
from strandscope.core.strands import (
    CAPTURED,
    INFILL,
    Strands,
    clip,
    concatenate,
    describe,
    fibers,
    lengths,
    load_strands,
    offsets_of,
    save_strands,
    statistics,
)


def make(curves, kind=None):
    """Strands of a list of (n, 3) curves."""
    points = np.concatenate(curves).astype(np.float32)
    kinds = np.zeros(len(curves), np.uint8) if kind is None else np.asarray(kind, np.uint8)
    sizes = [len(curve) for curve in curves]
    return Strands(
        points, offsets_of(sizes), np.full(len(points), 0.04, np.float32), kinds, np.ones(len(points), np.float32), provenance={"capture": "x"}
    )


def vertical(x, low, high, n=5):
    return np.stack([np.full(n, x), np.linspace(low, high, n), np.zeros(n)], axis=1)


@settings(max_examples=25, deadline=None)
@given(sizes=st.lists(st.integers(2, 9), max_size=6), seed=st.integers(0, 99))
def test_what_is_saved_is_loaded_and_the_bytes_are_the_same(tmp_path_factory, sizes, seed):
    rng = np.random.default_rng(seed)
    n = sum(sizes)
    points, radius, confidence = rng.normal(size=(n, 3)), rng.uniform(0.01, 0.1, n), rng.uniform(size=n)
    error = np.where(rng.random(n) < 0.3, np.nan, rng.uniform(0, 0.1, n))
    strands = Strands(
        points_mm=points.astype(np.float32),
        offsets=offsets_of(np.array(sizes, int)),
        radius_mm=radius.astype(np.float32),
        kind=rng.integers(0, 2, len(sizes)).astype(np.uint8),
        confidence=confidence.astype(np.float32),
        stops=rng.integers(0, 5, (len(sizes), 2)).astype(np.uint8),
        error_mm=error.astype(np.float32),
        evidence=rng.uniform(0, 24, n).astype(np.float32),
        joins=rng.permutation(2 * len(sizes))[: 2 * (len(sizes) // 2)].reshape(-1, 2).astype(np.int64),
        provenance={"b": 1, "a": "ü"},
    )
    folder = tmp_path_factory.mktemp("strands")
    for name in ("one.npz", "two.npz"):
        save_strands(folder / name, strands)
    loaded = load_strands(folder / "one.npz")
    for field in ("points_mm", "offsets", "radius_mm", "kind", "confidence", "stops", "error_mm", "evidence", "joins"):
        np.testing.assert_array_equal(getattr(loaded, field), getattr(strands, field))
        assert getattr(loaded, field).dtype == getattr(strands, field).dtype
    assert loaded.provenance == strands.provenance
    assert (folder / "one.npz").read_bytes() == (folder / "two.npz").read_bytes()


@pytest.mark.parametrize(
    ("array", "change", "said"),
    [
        ("points", lambda a: np.where(np.arange(a.size).reshape(a.shape) == 4, np.nan, a), r"points\[1, 1\] is nan"),
        ("points", lambda a: a[:, :2], "points .*shape"),
        ("radius", lambda a: 0 * a, "radius"),
        ("radius", lambda a: a * np.inf, r"radius\[0\] is inf"),
        ("confidence", lambda a: a[:-1], "confidence"),
        ("confidence", lambda a: a - 1.5, "confidence"),
        ("error", lambda a: a[:-1], "error"),
        ("error", lambda a: a - 1, "error"),
        ("error", lambda a: a + np.inf, "error"),
        ("offsets", lambda a: a[::-1].copy(), "offsets"),
        ("offsets", lambda a: a + 0.5, "offsets"),
        ("offsets", lambda a: np.r_[a[:-1], a[-1] + 1], "offsets"),
        ("offsets", lambda a: a[:0], "offsets"),
        ("offsets", lambda _: np.array(3), "offsets"),
        ("kind", lambda a: a + 7, "kind"),
        ("kind", lambda a: a.astype(int) - 1, "kind"),
        ("stops", lambda a: a[:, 0], "stops"),
        ("evidence", lambda a: a[:-1], "evidence"),
        ("evidence", lambda a: a[:, None], "evidence"),
        ("evidence", lambda a: a - 13, "evidence"),
        ("evidence", lambda a: np.where(a > 5, np.nan, a), "evidence"),
        ("evidence", lambda a: a + np.inf, "evidence"),
        ("joins", lambda a: a.ravel(), "joins"),
        ("joins", lambda a: np.c_[a, a], "joins"),
        ("joins", lambda a: a.astype(float), "joins"),
        ("joins", lambda a: a + 1, r"joins is not of ends; expected 0 … 3"),
        ("joins", lambda a: a - 2, "joins"),
        ("joins", lambda a: np.r_[a, a], "joins"),
        ("joins", lambda _: np.array([[1, 3], [2, 3]]), "joins"),
        ("provenance", lambda _: np.array("{"), "provenance"),
    ],
)
def test_a_bad_array_is_named(tmp_path, array, change, said):
    good = replace(make([vertical(0, 0, 1), vertical(1, 0, 1)]), error_mm=np.full(10, 0.01), evidence=np.arange(10.0), joins=np.array([[1, 3]]))
    save_strands(tmp_path / "good.npz", good)
    arrays = dict(np.load(tmp_path / "good.npz"))
    arrays[array] = change(arrays[array])
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(StrandsError, match=rf"bad\.npz: {said}.*") as error:
        load_strands(tmp_path / "bad.npz")
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize("share", [0.0, 0.3, 0.95])
def test_a_file_that_is_cut_short_is_refused(tmp_path, share):
    path = tmp_path / "cut.npz"
    save_strands(path, make([vertical(0, 0, 1)]))
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(StrandsError, match=r"cut\.npz: not a complete \.npz file"):
        load_strands(path)


def test_nans_are_not_written(tmp_path):
    strands = make([vertical(np.nan, 0, 1)])
    with pytest.raises(StrandsError, match="nan"):
        save_strands(tmp_path / "nan.npz", strands)
    assert list(tmp_path.iterdir()) == []


def test_points_and_offsets_are_enough(tmp_path):
    np.savez(tmp_path / "least.npz", points=np.eye(3), offsets=np.array([0, 3]))
    strands = load_strands(tmp_path / "least.npz")
    assert (len(strands), strands.kind[0], strands.confidence[0]) == (1, CAPTURED, 1.0)
    assert strands.error_mm is None
    assert strands.evidence is None
    assert strands.joins is None
    assert statistics(strands)["expected_error_mm"] == {}
    assert ("expected error", "unknown") in describe(statistics(strands))


def test_expected_errors_stay_with_their_points():
    known = replace(make([vertical(0, 0, 1), vertical(1, 0, 2, 7)]), error_mm=np.arange(12, dtype=np.float32))
    unknown = make([vertical(2, 0, 3)], kind=[INFILL])
    both = concatenate([known, unknown], {})
    np.testing.assert_array_equal(both.error_mm, [*range(12), *[np.nan] * 5])
    np.testing.assert_array_equal(both.select(np.array([False, True, True])).error_mm, [*range(5, 12), *[np.nan] * 5])
    assert concatenate([unknown, unknown], {}).error_mm is None
    assert statistics(both)["expected_error_mm"]["median"] == 5.5


def test_curves_are_chosen_whole():
    strands = make([vertical(0, 0, 1), vertical(1, 0, 2, 7), vertical(2, 0, 3)], kind=[CAPTURED, INFILL, CAPTURED])
    np.testing.assert_array_equal(strands.captured.offsets, [0, 5, 10])
    np.testing.assert_array_equal(strands.captured[1], strands[2])
    again = concatenate([strands.select(np.array([True, False, False])), strands.select(np.array([False, True, True]))], {})
    np.testing.assert_array_equal(again.points_mm, strands.points_mm)
    np.testing.assert_array_equal(again.offsets, strands.offsets)


# ---- joins and evidence ----------------------------------------------------------------------------------------------


def braid(seed=0, curves=12):
    """Strands with some joins, no two ends of the same place."""
    rng = np.random.default_rng(seed)
    strands = make([rng.normal(size=(rng.integers(2, 6), 3)) for _ in range(curves)], kind=rng.integers(0, 2, curves))
    joins = rng.permutation(2 * curves)[: curves // 3 * 2].reshape(-1, 2)
    return replace(strands, joins=joins, evidence=rng.uniform(0, 9, len(strands.points_mm)).astype(np.float32))


def tips(strands):
    """Places of the ends that are joined, as a set of pairs."""
    where = [strands.points_mm[strands.offsets[e // 2 + 1] - 1 if e % 2 else strands.offsets[e // 2]] for e in strands.joins.ravel()]
    return {frozenset((tuple(a.tolist()), tuple(b.tolist()))) for a, b in zip(where[::2], where[1::2], strict=True)}


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 99), keep=st.lists(st.booleans(), min_size=12, max_size=12))
def test_joins_of_curves_that_are_kept_stay_joins_of_the_same_ends(seed, keep):
    strands, keep = braid(seed), np.array(keep)
    chosen = strands.select(keep)
    expected = replace(strands, joins=strands.joins[[all(keep[join // 2]) for join in strands.joins]])
    assert tips(chosen) == tips(expected)
    assert chosen.joins.shape == expected.joins.shape
    np.testing.assert_array_equal(chosen.evidence, strands.evidence[np.repeat(keep, np.diff(strands.offsets))])
    np.testing.assert_array_equal(strands.select(np.ones(12, bool)).joins, strands.joins)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 99), count=st.integers(1, 3))
def test_joins_of_parts_are_joins_of_the_same_ends(seed, count):
    parts = [braid(seed + k, curves=3 * k + 3) for k in range(count)]
    whole = concatenate(parts, {})
    assert tips(whole) == set().union(*map(tips, parts))
    np.testing.assert_array_equal(whole.evidence, np.concatenate([p.evidence for p in parts]))
    first = np.arange(len(whole)) < len(parts[0])
    np.testing.assert_array_equal(whole.select(first).joins, parts[0].joins)


def test_parts_without_joins_or_evidence_keep_those_of_others():
    known, unknown = braid(), replace(braid(1), joins=None, evidence=None)
    both = concatenate([unknown, known], {})
    np.testing.assert_array_equal(both.joins, known.joins + 2 * len(unknown))
    np.testing.assert_array_equal(both.evidence, np.r_[np.zeros(len(unknown.points_mm)), known.evidence])
    neither = concatenate([unknown, unknown], {})
    assert neither.joins is None
    assert neither.evidence is None


def test_fibers_are_what_joins_hang_together():
    strands = make([vertical(x, 0, 1) for x in range(6)])
    assert fibers(strands).tolist() == [0, 1, 2, 3, 4, 5]
    assert fibers(replace(strands, joins=np.empty((0, 2), np.int64))).tolist() == [0, 1, 2, 3, 4, 5]
    chain = replace(strands, joins=np.array([[11, 4], [1, 10], [7, 2]]))  # 5 with 2, 0 with 5, 3 with 1
    assert fibers(chain).tolist() == [0, 1, 0, 1, 2, 0]
    assert fibers(replace(strands, joins=np.array([[0, 1]]))).tolist() == [0, 1, 2, 3, 4, 5]  # a ring
    assert fibers(strands.select(np.zeros(6, bool))).tolist() == []


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 99))
def test_fibers_do_not_depend_on_the_order_of_joins(seed):
    strands, rng = braid(seed), np.random.default_rng(seed)
    fiber = fibers(strands)
    shuffled = replace(strands, joins=np.array([rng.permutation(join) for join in rng.permutation(strands.joins)]))
    assert fibers(shuffled).tolist() == fiber.tolist()
    assert len(np.unique(fiber)) >= len(strands) - len(strands.joins)
    assert all(fiber[one // 2] == fiber[other // 2] for one, other in strands.joins)
    joined = np.unique(strands.joins // 2)
    alone = np.setdiff1d(np.arange(len(strands)), joined)
    assert np.all(np.bincount(fiber)[fiber[alone]] == 1)


def test_captured_curves_lose_their_joins_with_infill():
    strands = replace(make([vertical(x, 0, 1) for x in range(3)], kind=[CAPTURED, INFILL, CAPTURED]), joins=np.array([[1, 2], [3, 5], [0, 4]]))
    np.testing.assert_array_equal(strands.captured.joins, [[0, 2]])
    assert fibers(strands).tolist() == [0, 0, 0]


def test_bad_joins_and_evidence_are_not_written(tmp_path):
    for change in ({"joins": np.array([[0, 99]])}, {"joins": np.array([[0, 1], [1, 2]])}, {"evidence": np.array([1.0])}):
        with pytest.raises(StrandsError, match=next(iter(change))):
            save_strands(tmp_path / "bad.npz", replace(braid(), **change))
    assert list(tmp_path.iterdir()) == []


# ---- numbers ---------------------------------------------------------------------------------------------------------


def test_lengths_do_not_run_from_curve_to_curve():
    strands = make([vertical(0, 0, 1), vertical(100, 0, 2.5), vertical(-100, 4, 3)])
    np.testing.assert_allclose(lengths(strands.points_mm, strands.offsets), [1.0, 2.5, 1.0], rtol=1e-6)


def test_statistics_of_hair_that_can_be_counted_by_hand():
    # 10 mm high; three curves all the way, one through half, and one that goes up and comes down again in the upper half
    hook = np.array([[5, 5, 0], [5, 10, 0], [6, 10, 0], [6, 5, 0]], float)
    strands = make([vertical(x, 0, 10) for x in range(3)] + [vertical(4, 0, 5), hook, vertical(9, -50, 50)], kind=[0, 0, 0, 0, 0, INFILL])
    numbers = statistics(strands)
    assert numbers["curves"] == 5
    assert numbers["infill_curves"] == 1
    assert numbers["height_mm"] == pytest.approx(10)
    assert numbers["mean_curves_crossing_a_horizontal_plane"] == pytest.approx(4.0)  # 3 and one of the other two everywhere
    assert numbers["length_mm"] == pytest.approx({"total": 46.0, "mean": 9.2, "median": 10.0, "longest": 11.0})
    assert numbers["infill_length_mm"] == pytest.approx(100)
    assert len(describe(numbers)) > 5


def test_statistics_of_no_hair_at_all():
    numbers = statistics(make([vertical(0, 0, 1)]).select(np.array([False])))
    assert numbers["curves"] == 0
    assert numbers["mean_curves_crossing_a_horizontal_plane"] == 0


@pytest.mark.parametrize("seed", range(5))
def test_a_clipped_curve_is_what_lies_inside_and_ends_at_the_border(seed):
    rng = np.random.default_rng(seed)
    strands = make([np.cumsum(rng.normal(0, 0.3, (rng.integers(2, 30), 3)), axis=0) for _ in range(20)])
    depth = 0.4 - np.abs(strands.points_mm[:, 1].astype(float))
    pieces, of = clip(strands, depth)
    beyond, of_beyond = clip(strands, -depth)
    both = [lengths(part.points_mm, part.offsets) for part in (pieces, beyond)]
    found = np.bincount(of, both[0], len(strands)) + np.bincount(of_beyond, both[1], len(strands))
    np.testing.assert_allclose(found, lengths(strands.points_mm, strands.offsets), rtol=1e-5)
    crossed = np.diff(np.sign(depth)) != 0
    crossed[strands.offsets[1:-1] - 1] = False
    tips_inside = np.r_[pieces.offsets[:-1], pieces.offsets[1:] - 1]
    whole = np.isin(pieces.points_mm[tips_inside], strands.points_mm).all(axis=1)
    assert np.sum(~whole) == np.sum(crossed)  # each border is where one piece ends


def test_clipping_ends_pieces_where_the_depth_is_0_and_tells_their_curves():
    strands = make([vertical(0, -1, 1), vertical(1, 2, 3), vertical(2, -0.25, 0.25), vertical(3, 0, 2, 3)])
    pieces, of = clip(strands, 0.6 - np.abs(strands.points_mm[:, 1].astype(float)))
    assert of.tolist() == [0, 2, 3]
    for i, (low, high) in enumerate([(-0.6, 0.6), (-0.25, 0.25), (0, 0.6)]):
        np.testing.assert_allclose(pieces[i][[0, -1], 1], [low, high], atol=1e-6)
    assert len(clip(strands, np.full(len(strands.points_mm), -1.0))[0]) == 0
