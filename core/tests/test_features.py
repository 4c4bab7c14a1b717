"""The store against its own definition: what goes in comes out within the quantisation, and a box holds what lies in it."""

import mmap
from dataclasses import replace

import numpy as np
import pytest

from strandscope.core.capture import Sweep
from strandscope.core.errors import StrandscopeError
from strandscope.core.features import USED, KdTree, box_query, build_index, grid_shape, load_features, pack, save_features, seen_by, unpack, upright
from strandscope.core.geometry import Optics, pixels
from strandscope.core.ridges import Ridges

from .known import OPTICS, SHAPE, turn_between

IRREGULAR_MM = (-1.5, -1.31, -0.9, 0.02, 0.5, 0.51, 2.25)


def some_ridges(count, shape=SHAPE, seed=0):
    rng = np.random.default_rng(seed)
    col, row = rng.uniform(0, shape[1] - 1, count), rng.uniform(0, shape[0] - 1, count)
    return Ridges(*(np.float32(a) for a in (col, row, rng.uniform(0, np.pi, count), rng.uniform(0.05, 2, count), rng.uniform(-0.9, 0.9, count))))


def some_sweep(angle_deg=0.0, positions_mm=IRREGULAR_MM, each=120, seed=0, shape=SHAPE):
    ridges = [some_ridges(each, shape, [seed, i]) for i in range(len(positions_mm))]
    return pack(angle_deg, positions_mm, shape, ridges), ridges


def same_arrays(a, b):
    return all(np.array_equal(getattr(a, n), getattr(b, n)) for n in ("positions_mm", "cells", "col", "row", "frame", "angle", "strength", "breadth"))


# ---- an axis that leans ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "tilt",
    [
        {"tilt_deg": 0.3},
        {"tilt_towards_deg": 0.3},
        {"tilt_deg": -0.2, "tilt_towards_deg": 0.2},
        {"k1_per_mm2": 4e-4},  # 2.5 px at the corner
        {"travel_deg": 0.5, "travel_up_deg": -0.3},
        {"tilt_deg": 0.3, "k1_per_mm2": -4e-4, "k2_per_mm4": 1e-5, "travel_deg": 0.5},
    ],
)
def test_ridges_set_upright_are_where_an_upright_axis_has_them(tilt):
    """Points around the plane of focus of a rig that leans, seen through the lens; the same points, seen by an upright rig."""
    rng = np.random.default_rng(0)
    points, d = rng.uniform((-1.8, -2.8, 0.3), (1.8, 2.8, 0.7), (200, 3)), 0.5
    along = points + rng.normal(0, (0.02, 0, 0.02), (200, 3)) + (0, 0.1, 0)
    leaning = replace(OPTICS, **tilt)

    def seen(optics):
        (col, row, _), (there, above, _) = pixels(points, 0, d, optics, SHAPE).T, pixels(along, 0, d, optics, SHAPE).T
        return Ridges(col, row, np.arctan2(row - above, there - col) % np.pi, np.ones(200), np.zeros(200))

    found, wanted = upright(seen(leaning), d, leaning, SHAPE), seen(OPTICS)
    assert len(found.col) == 200
    # a tilt towards the camera is known at the plane of focus; 0.2 mm from it v is off by 0.2 mm times 0.3 degrees, 0.04 px
    np.testing.assert_allclose(found.col, wanted.col, atol=0.01)
    np.testing.assert_allclose(found.row, wanted.row, atol=0.05)
    assert np.degrees(np.abs(turn_between(found.angle, wanted.angle))).max() < 0.15


def test_ridges_that_leave_the_photograph_are_dropped():
    ridges = Ridges(*(np.float32(a) for a in ([149, 75], [0, 0], [1, 1], [1, 1], [0, 0])))
    kept = upright(ridges, 0.0, replace(OPTICS, tilt_deg=-2), SHAPE)  # the top of the picture moves to the right
    assert len(kept.col) == 1


def test_features_for_a_rig_known_better_are_those_of_its_ridges():
    sweep, ridges = some_sweep(30.0)
    optics = replace(OPTICS, tilt_deg=0.2, tilt_towards_deg=-0.2)
    better = Sweep(30.1, tuple(d + 0.1 for d in IRREGULAR_MM), tuple("abcdefg"))
    anew = pack(30.1, better.positions_mm, SHAPE, [upright(r, d, optics, SHAPE) for r, d in zip(ridges, better.positions_mm, strict=True)])
    found = seen_by(sweep, better, optics)
    assert found.angle_deg == 30.1
    assert abs(len(found) - len(anew)) <= 2  # at the rim, by the quantisation
    for told, wanted in zip(unpack(found, OPTICS), unpack(anew, OPTICS), strict=True):
        assert np.quantile(told, [0.1, 0.5, 0.9]) == pytest.approx(np.quantile(wanted, [0.1, 0.5, 0.9]), abs=2e-2)
    upright_rig = seen_by(sweep, better, OPTICS)
    assert upright_rig.col is sweep.col
    assert upright_rig.positions_mm == pytest.approx(better.positions_mm)


# ---- packing ---------------------------------------------------------------------------------------------------------


def test_what_is_packed_comes_out_again_within_the_quantisation():
    sweep, ridges = some_sweep()
    u, v, d, angle = (a.astype(float) for a in unpack(sweep, OPTICS))
    col, row = OPTICS.axis_col_px + u / OPTICS.pitch_mm, OPTICS.axis_row_px - v / OPTICS.pitch_mm  # pixel centres at integers
    assert len(sweep) == sum(len(r.col) for r in ridges)
    for i, position in enumerate(IRREGULAR_MM):
        here = np.abs(d - position) < 1e-6  # float32 of mm
        assert here.sum() == len(ridges[i].col)
        # the columns of a photograph are more than a unit apart, so their order tells which feature is which
        order, wanted = np.argsort(col[here]), np.argsort(ridges[i].col)
        assert np.diff(np.sort(ridges[i].col)).min() > 1e-4
        same = np.abs(row[here][order] - ridges[i].row[wanted]) < 1e-3  # but for neighbours closer than 1/2048 px
        assert same.mean() > 0.97
        # one unit of the store, and float32 of a few mm: 2.4e-7 mm, below 1e-5 px
        assert np.abs(col[here][order] - ridges[i].col[wanted]).max() <= 1 / 2048 + 2e-5
        assert np.abs(row[here][order] - ridges[i].row[wanted])[same].max() <= 1 / 4096 + 2e-5
        off = turn_between(angle[here][order], ridges[i].angle[wanted])[same]
        assert np.abs(off).max() <= 0.5 * np.pi / 256 + 1e-6
        assert abs(off.mean()) < 0.1 * np.pi / 256  # rounded, not cut off


def test_the_strongest_remains_the_strongest():
    ridges = some_ridges(500)
    sweep = pack(0.0, [0.0], SHAPE, [ridges])
    u, _, _, _ = unpack(sweep, OPTICS)
    strength = ridges.strength[np.argsort(ridges.col)][np.argsort(np.argsort(u))]
    order = np.argsort(strength)
    assert np.all(np.diff(sweep.strength[order].astype(int)) >= -1)  # -1: two columns closer than a unit may change places
    assert sweep.strength.max() < USED  # none is used up yet


def test_the_order_of_the_photographs_does_not_matter():
    sweep, ridges = some_sweep()
    order = np.random.default_rng(1).permutation(len(ridges))
    shuffled = pack(0.0, np.array(IRREGULAR_MM)[order], SHAPE, [ridges[i] for i in order])
    assert same_arrays(sweep, shuffled)
    backwards = pack(0.0, IRREGULAR_MM[::-1], SHAPE, ridges[::-1])
    assert same_arrays(sweep, backwards)
    assert np.array_equal(backwards.positions_mm, IRREGULAR_MM)


def test_crests_on_the_rim_of_the_photograph_are_kept():
    at = np.float32([-0.5, SHAPE[1] - 0.5, 20, 20]), np.float32([10, 10, -0.5, SHAPE[0] - 0.5])
    sweep = pack(0.0, [0.0], SHAPE, [Ridges(*at, np.float32([0, 1, 2, np.pi]), *np.ones((2, 4), np.float32))])
    u, v, _, angle = unpack(sweep, OPTICS)
    col, row = OPTICS.axis_col_px + u / OPTICS.pitch_mm, OPTICS.axis_row_px - v / OPTICS.pitch_mm
    assert len(sweep) == 4
    assert col.min() > -1e-3
    assert row.min() > -1e-3
    assert col.max() < SHAPE[1] - 1 + 1e-3
    assert row.max() < SHAPE[0] - 1 + 1e-3
    assert np.all((angle >= 0) & (angle < np.pi))


def test_a_sweep_without_a_ridge(tmp_path):
    sweep = pack(15.0, IRREGULAR_MM, SHAPE, [some_ridges(0)] * len(IRREGULAR_MM))
    save_features(tmp_path / "empty", sweep)
    again = load_features(tmp_path / "empty")
    assert len(again) == 0
    assert same_arrays(sweep, again)
    everywhere = box_query(build_index([again], OPTICS), 0, np.zeros(3), np.eye(3), np.full(3, 99.0))
    assert len(everywhere) == 0


def test_bytes_a_feature_at_the_scale_of_the_paper():
    """At most 10.5 bytes, index included, at 120 million features in 24 sweeps of 376 photographs of 2193 x 1462 pixels."""
    shape, frames, features = (732, 1097), 300, 1_000_000  # as many a cell as the paper has, in a smaller sweep
    sweep, _ = some_sweep(0.0, np.linspace(-30, 30, frames), features // frames + 1, shape=shape)
    assert len(sweep) >= features
    index = build_index([sweep], OPTICS)
    a_feature = sum(np.asarray(getattr(index, name)).itemsize for name in ("col", "row", "frame", "angle", "strength"))
    everything = sum(a.nbytes for a in index if isinstance(a, np.ndarray))
    assert everything / len(sweep) <= 10.5
    strips, blocks = grid_shape((1462, 2193))
    assert a_feature + index.cells.itemsize * 24 * (strips * blocks * 376 + 1) / 120e6 <= 10.5


# ---- oriented boxes --------------------------------------------------------------------------------------------------


def turned_back(u, v, d, angle_deg):
    """Object frame of observations, from the definition: the turntable turns right-handed about +y."""
    theta = np.radians(angle_deg)
    return np.stack([u * np.cos(theta) - d * np.sin(theta), v, u * np.sin(theta) + d * np.cos(theta)], axis=1)


def random_axes(rng):
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.diag(r))


@pytest.fixture(scope="module")
def three_sweeps():
    return [some_sweep(angle, np.linspace(-2, 2, n), 150, seed=n)[0] for angle, n in ((0.0, 21), (75.0, 15), (210.0, 33))]


def test_a_box_holds_what_lies_in_it(three_sweeps):
    """box_query, the kd-tree and brute force agree on random boxes, among them large, thin and sticking out of the field."""
    rng = np.random.default_rng(2)
    index = build_index(three_sweeps, OPTICS)
    used_up = rng.random(len(index.strength)) < 0.1
    index.strength[used_up] += USED
    hits = 0
    for k, sweep in enumerate(three_sweeps):
        u, v, d, _ = (a.astype(float) for a in unpack(sweep, OPTICS))
        points, tree, left = turned_back(u, v, d, sweep.angle_deg), KdTree(sweep, OPTICS), ~used_up[index.first[k] : index.first[k + 1]]
        for _ in range(100):
            centre, axes, extents = rng.uniform(-3, 3, 3), random_axes(rng), np.exp(rng.uniform(np.log(0.1), np.log(8), 3))
            inside = np.flatnonzero(np.all(np.abs((points - centre) @ axes.T) <= extents / 2, axis=1))
            found = box_query(index, k, centre, axes, extents) - index.first[k]
            assert np.array_equal(tree.box_query(centre, axes, extents), inside)
            assert np.array_equal(found, inside[left[inside]])
            hits += len(found)
    assert hits > 5_000  # the boxes were not all empty


def test_boxes_beside_around_and_between(three_sweeps):
    index = build_index(three_sweeps, OPTICS)
    everything = box_query(index, 1, np.zeros(3), np.eye(3), np.full(3, 50.0))
    assert np.array_equal(everything, np.arange(index.first[1], index.first[2]))  # more than the first room for hits
    for beside in ([50, 0, 0], [0, -50, 0], [0, 0, 50], [-9, 9, -9]):
        assert len(box_query(index, 1, np.array(beside, float), np.eye(3), np.ones(3))) == 0
    between = np.array([0.0, 0.0, 0.1])  # of the first sweep's planes of focus, 0.2 mm apart
    assert len(box_query(index, 0, between, np.eye(3), np.array([50, 50, 0.19]))) == 0
    assert len(box_query(index, 0, between, np.eye(3), np.array([50, 50, 0.21]))) == 300


# ---- files -----------------------------------------------------------------------------------------------------------


def test_a_file_gives_back_the_sweep_without_reading_it_into_memory(tmp_path):
    sweep, _ = some_sweep(47.5)
    save_features(tmp_path / "sweep.features", sweep)
    again = load_features(tmp_path / "sweep.features")
    assert same_arrays(sweep, again)
    assert (again.angle_deg, again.shape) == (47.5, SHAPE)
    assert [p.name for p in tmp_path.iterdir()] == ["sweep.features"]
    for name in ("col", "row", "frame", "angle", "strength", "cells"):
        array = owner = getattr(again, name)
        while isinstance(owner, np.ndarray):
            owner = owner.base
        assert isinstance(owner, mmap.mmap), name
        assert not array.flags.writeable
    assert build_index([again], OPTICS).strength.flags.writeable  # growing uses features up, not the file


@pytest.mark.parametrize("spoil", ["end", "middle", "header", "nothing", "text"])
def test_a_file_that_is_not_whole_is_named_in_one_line(tmp_path, spoil):
    path = tmp_path / "sweep_004.features"
    save_features(path, some_sweep()[0])
    whole = path.read_bytes()
    spoilt = {"end": whole[:-1], "middle": whole[: len(whole) // 2], "header": whole[:40], "nothing": b"", "text": b"no features\n" * 99}
    path.write_bytes(spoilt[spoil])
    with pytest.raises(StrandscopeError, match=r"sweep_004\.features: not a whole features file") as caught:
        load_features(path)
    assert "\n" not in str(caught.value)


def test_sweeps_of_other_sizes_are_refused():
    sweeps = [some_sweep(each=3)[0], some_sweep(each=3, shape=(SHAPE[0], SHAPE[1] + 2))[0]]
    with pytest.raises(StrandscopeError, match="2 sizes; expected one"):
        build_index(sweeps, OPTICS)


def test_the_index_counts_every_sweep_from_its_own_beginning():
    sweeps = [some_sweep(angle, each=n, seed=n)[0] for angle, n in ((0.0, 5), (30.0, 0), (60.0, 9))]
    index = build_index(sweeps, Optics(300.0, 0.02, 70.0, 100.0, 8.0))
    assert np.array_equal(np.diff(index.first), [len(s) for s in sweeps])
    assert np.allclose(np.hypot(index.cos, index.sin), 1)
    assert np.allclose(np.degrees(np.arctan2(index.sin, index.cos)), [0, 30, 60])
    assert (index.distance, index.pitch, index.axis_col, index.axis_row) == (300.0, 0.02, 70.0, 100.0)
