"""Links between pieces of fibers that are known: hair whose curvature wanders as told, with a gap cut out of each."""

import numpy as np
import pytest

from strandscope.core.links import Bends, LinkParams, bends, bridge, find_links, ways_on
from strandscope.core.stops import Stop

STEP = 0.2  # mm, between points
OPEN, LEFT = int(Stop.UNOBSERVED), int(Stop.LEFT_VOLUME)


def wandering(count, length_mm, spread, kept_mm, seed=0, starts=None):
    """Curves (count, n, 3) about +y: the curvature along two axes that are carried along is an Ornstein-Uhlenbeck process."""
    rng, fine = np.random.default_rng(seed), 0.02
    fade = np.exp(-fine / kept_mm)
    bend = rng.normal(0, spread, (count, 2))
    point = np.zeros((count, 3)) if starts is None else np.asarray(starts, float)
    tangent, across = np.tile([0.0, 1.0, 0.0], (count, 1)), np.tile([1.0, 0.0, 0.0], (count, 1))
    path = []
    for _ in range(round(length_mm / fine)):
        path.append(point)
        point = point + fine * tangent
        tangent = tangent + fine * (bend[:, :1] * across + bend[:, 1:] * np.cross(across, tangent))
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        across = across - tangent * np.sum(across * tangent, axis=1, keepdims=True)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        bend = fade * bend + rng.normal(0, spread * np.sqrt(1 - fade**2), (count, 2))
    return np.stack(path[:: round(STEP / fine)], axis=1)


def flat(curves):
    """A list of (n, 3) -> points, offsets."""
    return np.concatenate(curves), np.concatenate([[0], np.cumsum([len(c) for c in curves])])


def cut_lock(gap_mm=2.0, fibers=60, noise_mm=0.002, seed=0):
    """Pieces of a lock, 1.7 fibers a mm²: fiber f's lower one is curve 2 f, its upper one 2 f + 1. -> curves, stops, links that are right."""
    rng = np.random.default_rng(seed)
    where = rng.uniform(-3, 3, (fibers, 3)) * (1, 0, 1)
    pieces = []
    for curve in wandering(fibers, 24.0, 0.03, 3.0, seed, where):
        first = rng.integers(50, 70 - round(gap_mm / STEP) // 2)
        seen = curve + rng.normal(0, noise_mm, curve.shape)
        pieces += [seen[:first], seen[first + round(gap_mm / STEP) - 1 :]]
    return pieces, [[LEFT, OPEN], [OPEN, LEFT]] * fibers, {(4 * f + 1, 4 * f + 2) for f in range(fibers)}


def linked(pieces, stops, params=None, error_mm=0.002):
    points, offsets = flat(pieces)
    return find_links(points, offsets, np.full(len(points), error_mm), np.array(stops), params)


def ends_of(links):
    return {tuple(sorted(link.ends)) for link in links}


def arc(radius_mm, low_mm, high_mm, at=(0.0, 0.0, 0.0)):
    """Points of a circle in the plane of x and y, by their place along it."""
    turn = np.arange(low_mm, high_mm, STEP) / radius_mm
    return np.asarray(at) + radius_mm * np.stack([1 - np.cos(turn), np.sin(turn), 0 * turn], axis=1)


# ---- bends -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("spread", "kept_mm"), [(0.05, 2.0), (0.1, 1.5), (0.03, 4.0)])
def test_how_curvature_wanders_is_measured(spread, kept_mm):
    found = bends(*flat(wandering(80, 40.0, spread, kept_mm)))
    assert found.spread == pytest.approx(spread, rel=0.1)
    assert found.kept_mm == pytest.approx(kept_mm, rel=0.25)  # some 800 to 2000 lengths in all


@pytest.mark.parametrize(
    "noise_mm",
    [
        0.001,
        0.002,
        0.008,
    ],
)
def test_errors_of_points_do_not_count_as_bends(noise_mm):
    curves = wandering(80, 40.0, 0.05, 2.0)
    clean, noisy = bends(*flat(curves)), bends(*flat(curves + np.random.default_rng(1).normal(0, noise_mm, curves.shape)))
    assert noisy.spread == pytest.approx(clean.spread, rel=0.1)
    assert noisy.kept_mm == pytest.approx(clean.kept_mm, rel=0.25)


def test_bends_depend_neither_on_the_order_nor_on_the_direction_of_curves():
    curves = list(wandering(20, 20.0, 0.05, 2.0))
    assert bends(*flat([c[::-1] for c in curves[::-1]])) == pytest.approx(bends(*flat(curves)), rel=1e-6)


def test_bends_of_a_circle_are_kept_and_those_of_lines_are_slight():
    circle = bends(*flat([arc(20.0, 0, 30)]))
    assert np.sqrt(2) * circle.spread == pytest.approx(1 / 20, rel=0.2)  # of a vector, in two directions
    assert circle.kept_mm > 5
    line = bends(*flat([np.arange(0, 20, STEP)[:, None] * [0.0, 0.6, 0.8]]))
    assert line.spread <= 0.05
    assert line.kept_mm > 0


@pytest.mark.parametrize("curves", [[np.zeros((2, 3))], [np.zeros((30, 3))], [np.arange(6.0)[:, None].repeat(3, axis=1)] * 2])
def test_bends_without_curves_that_tell_are_slight(curves):
    assert bends(*flat(curves)) == Bends(0.05, 2.0)


# ---- links -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gap_mm", "share"), [(1.0, 0.95), (2.0, 0.9), (4.0, 0.75)])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_pieces_of_one_fiber_are_linked(gap_mm, share, seed):
    pieces, stops, truth = cut_lock(gap_mm, seed=seed)
    links, left = linked(pieces, stops)
    found = ends_of(links)
    assert len(found & truth) >= share * len(truth)
    assert len(found - truth) <= 0.1 * len(found)
    assert {e for pair in found for e in pair} | set(left.tolist()) == {e for pair in truth for e in pair}


def test_each_end_is_used_once_and_the_surest_links_come_first():
    pieces, stops, _ = cut_lock(3.0)
    links, left = linked(pieces, stops, LinkParams(least_score=-6.0))
    used = [end for link in links for end in link.ends]
    assert len(set(used)) == len(used)
    assert not set(used) & set(left.tolist())
    scores = [link.score for link in links]
    assert scores == sorted(scores, reverse=True)
    assert scores[-1] >= -6.0
    stricter, _ = linked(pieces, stops, LinkParams(least_score=scores[len(scores) // 2]))
    assert 0 < len(stricter) < len(links)
    assert ends_of(stricter) <= ends_of(links)


def test_the_length_of_a_link_is_that_of_the_gap():
    pieces, stops, truth = cut_lock(2.0)
    lengths = [link.length_mm for link in linked(pieces, stops)[0] if tuple(sorted(link.ends)) in truth]
    assert np.median(lengths) == pytest.approx(2.0, rel=0.03)
    assert np.abs(np.array(lengths) - 2.0).max() < 0.2


@pytest.mark.parametrize("shuffle", [False, True])
def test_neither_order_nor_direction_of_curves_matter(shuffle):
    pieces, stops, _ = cut_lock(2.0)
    rng = np.random.default_rng(4)
    order = rng.permutation(len(pieces)) if shuffle else np.arange(len(pieces))
    turned = rng.random(len(pieces)) < 0.5
    mixed = [pieces[c][::-1] if turned[c] else pieces[c] for c in order]
    again, left = linked(mixed, [stops[c][::-1] if turned[c] else stops[c] for c in order])

    def before(end):
        curve = order[end // 2]
        return int(2 * curve + (end % 2 ^ turned[curve]))

    links, also = linked(pieces, stops)
    assert {tuple(sorted(map(before, link.ends))) for link in again} == ends_of(links)
    assert sorted(map(before, left.tolist())) == sorted(also.tolist())


def test_where_the_lock_stands_does_not_matter():
    pieces, stops, _ = cut_lock(2.0)
    moved = [piece[:, [2, 0, 1]] * (1, -1, -1) + (30, -20, 10) for piece in pieces]
    assert ends_of(linked(moved, stops)[0]) == ends_of(linked(pieces, stops)[0])


def test_hair_of_different_locks_is_not_linked():
    one, stops, _ = cut_lock(2.0, fibers=20)
    other = [piece + np.array([9.0, 0.0, 0.0]) for piece in cut_lock(2.0, fibers=20, seed=1)[0]]
    mixed = [piece for k, piece in enumerate(one + other) if k % 4 in (0, 3)]  # of each fiber only one piece: nothing to be linked
    links, left = linked(mixed, [s for k, s in enumerate(stops * 2) if k % 4 in (0, 3)])
    points, _ = flat(mixed)
    for link in links:
        a, b = (mixed[end // 2][-1 if end % 2 else 0] for end in link.ends)
        assert np.linalg.norm((a - b)[[0, 2]]) < 0.5 * abs(a[1] - b[1])  # of hair that leans by 0.2 or so
    assert len(links) <= 2
    assert len(left) + 2 * len(links) == len(mixed)
    assert np.ptp(points[:, 0]) > 9


def test_what_lies_side_by_side_or_behind_is_not_linked():
    y = np.arange(0, 8, STEP)[:, None] * [0.0, 1.0, 0.0]
    for other in (
        y + np.array([0.3, 0, 0]),
        y + np.array([0.3, 4.0, 0]),
        y[::-1] + np.array([0.3, 0, 0]),
        y + np.array([6.0, 9.0, 0]),
        y + np.array([0.0, 40.0, 0]),
    ):
        assert linked([y, other], [[OPEN, OPEN]] * 2)[0] == []
    ahead, left = linked([y, y + np.array([0.0, 9.0, 0])], [[OPEN, OPEN]] * 2)
    assert ends_of(ahead) == {(1, 2)}
    assert left.tolist() == [0, 3]


def test_a_curve_is_not_linked_with_itself():
    turn = np.arange(0.3, 2 * np.pi - 0.3, STEP / 4.0)
    ring = np.stack([4 * np.cos(turn), 4 * np.sin(turn), 0 * turn], axis=1)
    links, left = linked([ring], [[OPEN, OPEN]])
    assert (links, left.tolist()) == ([], [0, 1])


@pytest.mark.parametrize(("stops", "left"), [([[LEFT, LEFT]] * 2, []), ([[LEFT, OPEN], [LEFT, LEFT]], [1]), ([[0, LEFT], [LEFT, LEFT]], [0])])
def test_ends_that_left_the_volume_are_closed(stops, left):
    y = np.arange(0, 8, STEP)[:, None] * [0.0, 1.0, 0.0]
    links, ends = linked([y, y + np.array([0.0, 9.0, 0])], stops)
    assert (links, ends.tolist()) == ([], left)


def test_errors_that_are_not_known_do_not_stop_a_link():
    pieces, stops, truth = cut_lock(1.0, fibers=20)
    points, offsets = flat(pieces)
    links, _ = find_links(points, offsets, np.full(len(points), np.nan), np.array(stops))
    assert len(ends_of(links) & truth) > 0.8 * len(truth)
    assert all(np.isfinite([link.score, link.length_mm]).all() for link in links)


@pytest.mark.parametrize("past_mm", [0.1, 0.3, 0.6])
def test_ends_that_run_past_each_other_are_linked_by_nothing_between(past_mm):
    line = np.arange(0, 8, STEP)[:, None] * [0.0, 1.0, 0.0]
    pieces = [line, line + np.array([0.01, line[-1, 1] - past_mm, 0.0])]
    (link,), left = linked(pieces, [[LEFT, OPEN], [OPEN, LEFT]])
    assert tuple(sorted(link.ends)) == (1, 2)
    assert link.length_mm == pytest.approx(-past_mm, abs=0.1)
    assert len(left) == 0
    _, new = joined(pieces, replace_link(link))
    assert new.stop == new.start


def test_no_link_is_longer_than_allowed():
    y = np.arange(0, 8, STEP)[:, None] * [0.0, 1.0, 0.0]
    pieces, stops = [y, y + np.array([0.0, 9.8, 0])], [[LEFT, OPEN], [OPEN, LEFT]]
    assert len(linked(pieces, stops, LinkParams(longest_mm=3.0))[0]) == 1
    assert linked(pieces, stops, LinkParams(longest_mm=1.5))[0] == []


# ---- ways and bridges ------------------------------------------------------------------------------------------------


def test_the_way_on_is_that_of_the_hair_and_not_of_its_last_points():
    line = np.arange(0, 8, STEP)[:, None] * [0.0, 0.6, 0.8]
    leaning = line.copy()
    leaning[-2:] += [[0.02, 0, 0], [0.04, 0, 0]]  # the last step is off by 6°
    points, offsets = flat([leaning, line[::-1] + np.array([3.0, 0, 0])])
    ways = ways_on(points, offsets, np.full(len(points), 0.004), np.array([0, 1, 2, 3]))
    assert np.linalg.norm(ways, axis=1) == pytest.approx(np.ones(4))
    off = np.degrees(np.arccos(np.clip(ways @ [0.0, 0.6, 0.8] * (-1, 1, 1, -1), -1, 1)))
    assert off.max() < 1.5


def test_the_way_on_a_circle_is_its_tangent():
    points, offsets = flat([arc(15.0, 0, 12)])
    last = (len(points) - 1) * STEP / 15.0
    ways = ways_on(points, offsets, np.full(len(points), 0.002), np.array([1, 0]))
    expected = np.array([[np.sin(last), np.cos(last), 0], [0, -1, 0]])
    assert np.degrees(np.arccos(np.clip(np.sum(ways * expected, axis=1), -1, 1))).max() < 1.5


def test_no_ends_no_ways():
    points, offsets = flat([arc(15.0, 0, 12)])
    assert ways_on(points, offsets, np.full(len(points), 0.002), np.empty(0, np.int64)).shape == (0, 3)


def joined(pieces, link, step_mm=STEP, params=None):
    """The lower piece, the bridge and the upper piece of a link between a last and a first point -> the path, and the bridge's slice."""
    points, offsets = flat(pieces)
    between = bridge(points, offsets, np.full(len(points), 0.002), link, step_mm, params)
    one, other = pieces[link.ends[0] // 2], pieces[link.ends[1] // 2]
    return np.concatenate([one, between, other]), slice(len(one), len(one) + len(between))


def test_a_bridge_meets_both_ends_with_their_directions():
    pieces, stops, truth = cut_lock(2.0, noise_mm=0.0005)
    for link in linked(pieces, stops)[0]:
        if link.ends not in truth:
            continue
        path, new = joined(pieces, link)
        part = path[new.start - 3 : new.stop + 3]
        steps = np.diff(part, axis=0)
        size = np.linalg.norm(steps, axis=1)
        assert np.abs(size - STEP).max() < 0.04
        turns = np.degrees(np.arccos(np.clip(np.sum(steps[1:] * steps[:-1], axis=1) / size[1:] / size[:-1], -1, 1)))
        assert turns.max() < 2.5  # 0.03 a mm is 0.3° a step, and noise of 0.5 µm adds as much


def test_bridges_lie_where_the_hidden_hair_is():
    curves = wandering(30, 24.0, 0.03, 3.0, 7, np.random.default_rng(7).uniform(-3, 3, (30, 3)) * (1, 0, 1))
    off = []
    for curve in curves:
        pieces = [curve[:50], curve[59:]]
        link = next(iter(linked(pieces, [[LEFT, OPEN], [OPEN, LEFT]])[0]), None)
        if link:
            path, _ = joined(pieces, replace_link(link))
            off.append(np.linalg.norm(path - np.concatenate([curve[:50], curve[50:59], curve[59:]]), axis=1).max())
    assert len(off) >= 25
    assert np.median(off) < 0.03  # a fiber of 2 mm that bends by 0.03 a mm strays by 0.02 between two ends


def replace_link(link):
    """The link from the lower to the upper piece."""
    return link._replace(ends=tuple(sorted(link.ends)))


def test_a_bridge_of_an_arc_is_the_arc():
    radius = 20.0
    pieces = [arc(radius, 0, 10), arc(radius, 13, 23)]
    (link,), _ = linked(pieces, [[LEFT, OPEN], [OPEN, LEFT]])
    path, new = joined(pieces, replace_link(link))
    off = np.abs(np.hypot(path[new, 0] - radius, path[new, 1]) - radius)
    assert off.max() < 0.01  # the chord is 0.06 mm off
    assert np.abs(path[new, 2]).max() < 1e-6


def test_a_bridge_seen_the_other_way_is_the_same():
    pieces, stops, _ = cut_lock(2.0)
    link = linked(pieces, stops)[0][0]
    points, offsets = flat(pieces)
    error = np.full(len(points), 0.002)
    there = bridge(points, offsets, error, link, STEP)
    back = bridge(points, offsets, error, link._replace(ends=link.ends[::-1]), STEP)
    assert np.allclose(there, back[::-1], atol=1e-9)


@pytest.mark.parametrize(("gap_mm", "step_mm", "count"), [(0.1, 0.2, 0), (0.2, 0.2, 0), (0.4, 0.2, 1), (2.0, 0.2, 9), (2.0, 0.5, 3), (2.0, 5.0, 0)])
def test_points_of_a_bridge_are_about_a_step_apart(gap_mm, step_mm, count):
    line = np.arange(0, 6, STEP)[:, None] * [0.0, 1.0, 0.0]
    pieces = [line, line + np.array([0.0, line[-1, 1] + gap_mm, 0.0])]
    (link,), _ = linked(pieces, [[LEFT, OPEN], [OPEN, LEFT]])
    path, new = joined(pieces, replace_link(link), step_mm)
    assert new.stop - new.start == count
    assert np.diff(path[new.start - 1 : new.stop + 1, 1]) == pytest.approx(np.full(count + 1, gap_mm / (count + 1)), abs=0.02)


def test_the_same_pieces_give_the_same_links():
    pieces, stops, _ = cut_lock(3.0)
    one, other = linked(pieces, stops), linked([p.copy() for p in pieces], stops)
    assert one[0] == other[0]
    assert np.array_equal(one[1], other[1])
