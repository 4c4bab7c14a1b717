"""Pictures must show things where they are; the folder of figures must be whole, small and made from what is there."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from strandscope.core.capture import Capture, Sweep
from strandscope.core.compare import Truth, load_truth, score
from strandscope.core.errors import StrandscopeError
from strandscope.core.figures import BAND_MM, NAMES, FigureParams, Frame, crossings, figures, gather, lit, look_at, recall_plot, slice_at, streaks
from strandscope.core.geometry import camera_points
from strandscope.core.hull import Grid
from strandscope.core.pipeline import Parameters, preset, reconstruct
from strandscope.core.simulate import SimulateParams, simulate
from strandscope.core.strands import Strands, load_strands, offsets_of

from .known import POSITIONS_MM, SHAPE, Seen, line, observe

SEEN = Seen(angles=12, noise_px=0.1)
WHITE = np.ones(3)


def strands_of(curves):
    points = np.concatenate(curves)
    n = len(points)
    return Strands(points, offsets_of(np.array([len(c) for c in curves])), np.full(n, 0.04), np.zeros(len(curves), np.uint8), np.ones(n))


class Known(Capture):
    """A capture whose photographs have the size of ``known``, and are not there."""

    shape = SHAPE


@pytest.fixture(scope="module")
def known():
    """The capture, features and curves of three fibers: the first upright, the others leaning."""
    curves = [line(at=(0.3, 0, -0.2), way=(0, 1, 0)), line(at=(-0.6, 0, 0.5)), line(at=(0.9, 0, 0.1), way=(-0.2, 1, 0.1))]
    files = tuple(f"{i}.dng" for i in range(len(POSITIONS_MM)))
    sweeps = tuple(Sweep(30.0 * k, tuple(POSITIONS_MM), files) for k in range(SEEN.angles))
    return Known(None, "known", SEEN.optics, sweeps), observe(curves, SEEN), curves


# ---- the place and what is there -------------------------------------------------------------------------------------


def test_crossings_are_where_curves_pass_a_plane():
    rising = np.array([[0.0, -1.0, 2.0], [1.0, 1.0, 3.0]])
    above = np.array([[5.0, 0.5, 0.0], [6.0, 1.0, 0.0]])
    bow = np.array([[9.0, -1.0, 0.0], [9.0, 1.0, 0.0], [9.0, -3.0, 0.0]])
    strands = strands_of([rising, above, bow])  # from one curve to the next there is no line
    places, curve = crossings(strands.points_mm, strands.offsets, 0.5)
    np.testing.assert_allclose(places, [[0.75, 0.5, 2.75], [9.0, 0.5, 0.0], [9.0, 0.5, 0.0]])
    assert curve.tolist() == [0, 2, 2]
    assert len(crossings(strands.points_mm, strands.offsets, 2.0)[0]) == 0


def test_features_come_from_around_the_height_and_lie_on_their_fibers(known):
    capture, sweeps, curves = known
    seen = gather(capture, sweeps, 0.5)
    assert 0 < len(seen) < sum(map(len, sweeps))
    assert np.abs(seen.points_mm[:, 1] - 0.5).max() <= BAND_MM
    fibers = np.concatenate(curves)
    for k in (0, 3, 7):  # beside its fiber a feature is off by its noise, along depth by the depth of field
        points = camera_points(seen.points_mm[seen.sweep == k], 30.0 * k)
        fiber = camera_points(fibers, 30.0 * k)
        nearest = [np.abs(p[:2] - fiber[np.abs(fiber[:, 2] - p[2]) < 0.6, :2]).max(axis=1).min() for p in points[::97]]
        assert np.percentile(nearest, 95) < 0.02


def test_the_place_is_chosen_or_given(known):
    capture, sweeps, curves = known
    strands, given = strands_of(curves), (-0.5, 0.2, 0.5)

    def scene(**choice):
        return look_at(capture, strands, None, Parameters(), sweeps, FigureParams(**choice))

    assert abs(scene().at_mm[1]) < 0.02  # the middle of 210 rows is half a pixel beside the axis
    assert scene(height_mm=1.25).at_mm[1] == 1.25
    chosen = scene(height_mm=1.25)
    assert np.linalg.norm(curves[chosen.fiber] - chosen.at_mm, axis=1).min() < 0.01
    assert (scene(at_mm=given).fiber, scene(at_mm=given).at_mm.tolist()) == (1, list(given))
    assert scene(fiber=2).fiber == 2
    assert scene(sweep=5).sweep == 5
    for wrong, said in (({"sweep": 12}, "no sweep 12"), ({"fiber": 3}, "no captured curve 3"), ({"height_mm": 99.0}, "passes the height 99 mm")):
        with pytest.raises(StrandscopeError, match=said):
            scene(**wrong)
    points = np.concatenate(curves)
    few = Truth(points, offsets_of(np.array([len(c) for c in curves])), points[:5], np.ones((5, 7)))
    with pytest.raises(StrandscopeError, match="visibility is of 7 sweeps; expected the capture's 12"):
        look_at(capture, strands, few, Parameters(), sweeps, FigureParams())


def test_a_slice_tells_found_missed_and_false(known):
    capture, sweeps, curves = known
    samples = np.concatenate([curve[::20] for curve in curves])
    visibility = np.zeros((len(samples), SEEN.angles))
    visibility[:, :6] = 1.0
    hidden = np.repeat([False, False, True], [len(c[::20]) for c in curves])
    visibility[hidden, 3:] = 0.0
    truth = Truth(np.concatenate(curves), offsets_of(np.array([len(c) for c in curves])), samples, visibility)
    strands = strands_of([curves[0] + [0.03, 0, 0], curves[1] + [0.3, 0, 0]])
    passing = slice_at(look_at(capture, strands, truth, Parameters(), sweeps, FigureParams()), 1.0)
    assert passing.found.tolist() == [True, False, False]
    assert passing.visible.tolist() == [True, True, False]
    assert passing.false.tolist() == [False, True]
    assert passing.seen_from.sum(axis=1).tolist() == [6, 6, 3]
    np.testing.assert_allclose(passing.curves[0], [0.33, -0.2], atol=0.001)


# ---- pictures --------------------------------------------------------------------------------------------------------


def test_light_lands_where_it_belongs_and_none_is_lost():
    frame = Frame(-1, 1, -0.5, 0.5, 200)
    sides = np.array([[[0.4, 0.0], [0.0, 0.2]], [[0.0, 0.0], [0.0, 0.0]]])
    picture = frame.fill(np.array([[0.5, 0.25], [-0.755, -0.255]]), sides, np.array([[3.0, 2.0, 1.0], [0.0, 0.0, 5.0]]))
    assert picture.shape == (100, 200, 3)
    np.testing.assert_allclose(picture.sum(axis=(0, 1)), [3, 2, 6])
    assert picture[75, 24, 2] == pytest.approx(5)  # left of the middle, and below it
    lit_rows, lit_columns = np.nonzero(picture[..., 0])
    assert (lit_columns.min(), lit_columns.max(), lit_rows.min(), lit_rows.max()) == (130, 169, 15, 34)
    assert np.ptp(picture[15:35, 130:170, 0]) < 1e-9
    assert np.all(frame.fill(np.array([[5.0, 0.0]]), sides[:1], WHITE[None]) == 0)


def test_streaks_of_all_sweeps_cross_in_the_hair(known):
    """The star: a slice is brightest where the fiber passes, to a pixel."""
    capture, sweeps, _ = known
    scene = look_at(capture, strands_of([line(way=(0, 1, 0))]), None, Parameters(), sweeps, FigureParams(height_mm=0.0))
    frame = Frame(-0.2, 0.8, -0.3, 0.7, 50)  # x to the right, -z up: around the first fiber at x = 0.3, z = -0.2
    light = streaks(scene, scene.seen.select(np.abs(scene.seen.points_mm[:, 1]) < 0.3), frame).sum(axis=-1)
    row, column = np.unravel_index(np.argmax(light), light.shape)
    assert frame.left + (column + 0.5) * frame.pixel_mm == pytest.approx(0.3, abs=0.03)
    assert frame.top - (row + 0.5) * frame.pixel_mm == pytest.approx(0.2, abs=0.03)
    away = np.hypot(*(np.indices(light.shape) - [[[row]], [[column]]])) * frame.pixel_mm
    assert light.max() > 2 * light[away > 0.2].max()  # where streaks of two opposite sides still lie on each other


def test_a_lit_ball_is_round_and_bright_above():
    grid = Grid((-2.0, -2.0, -2.0), 0.1, (40, 40, 40))
    x, y, z = np.meshgrid(*(grid.centres(a) for a in range(3)), indexing="ij")
    solid = np.clip((1.2 - np.sqrt(x**2 + (y - 0.3) ** 2 + z**2)) / 0.2 + 0.5, 0, 1).astype(np.float32)
    picture = lit(solid, grid, 300)
    pixel = 2 * 0.86 * np.sqrt(3) * 2 / 300
    shown = np.isfinite(picture)
    assert shown.sum() * pixel**2 == pytest.approx(np.pi * 1.2**2, rel=0.02)
    rows, columns = np.nonzero(shown)
    assert columns.mean() == pytest.approx(149.5, abs=1)
    assert (149.5 - rows.mean()) * pixel == pytest.approx(0.3 * np.cos(np.radians(25)), abs=0.02)  # seen from 25 degrees above
    assert np.nanmean(picture[:150]) > np.nanmean(picture[150:]) + 0.1
    assert np.nanmean(picture[:, :150]) > np.nanmean(picture[:, 150:]) + 0.1


def test_recall_of_several_methods_in_one_plot(tmp_path):
    bins = {"0-0": [None, 0], "1-3": [0.2, 50], "4-7": [0.8, 100], "8-24": [1.0, 10]}
    worse = {name: [share and share / 2, n] for name, (share, n) in bins.items()}
    scores = {"ours": {"recall": 0.9, "recall_by_visible_angles": bins}, "paper": {"recall": 0.4, "recall_by_visible_angles": worse}}
    for methods in (["ours"], ["ours", "paper"]):
        recall_plot(tmp_path / f"{len(methods)}.png", {name: scores[name] for name in methods})
    alone, both = (np.asarray(Image.open(tmp_path / f"{n}.png").convert("RGB"), int) for n in (1, 2))
    blue = [((p[..., 2] > 200) & (p[..., 0] < 150)).sum() for p in (alone, both)]
    assert blue[0] == 0
    assert blue[1] > 500  # the second line
    with pytest.raises(StrandscopeError, match="no scores"):
        recall_plot(tmp_path / "none.png", {})


# ---- the folder ------------------------------------------------------------------------------------------------------

PICTURES = {f"{name}.png" for name in NAMES.values()}


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Four fibers from eight angles."""
    folder = tmp_path_factory.mktemp("simulated") / "capture"
    simulate(folder, SimulateParams(scale="tiny", fibers=4))
    head = json.loads((folder / "capture.json").read_text(encoding="utf-8"))
    few = folder / "few.json"
    few.write_text(json.dumps(head | {"sweeps": head["sweeps"][::2], "truth": None}), encoding="utf-8")
    return folder


def test_all_pictures_are_drawn_and_nothing_is_made_twice(capture, tmp_path, monkeypatch):
    out = tmp_path / "out"
    page = figures(capture, out)
    text = page.read_text(encoding="utf-8")
    assert {p.name for p in out.iterdir()} == PICTURES | {"index.html", "strands.npz", "strands.work"}
    for name in PICTURES:
        assert f'src="{name}"' in text
        assert (out / name).stat().st_size < 1_000_000
        picture = np.asarray(Image.open(out / name).convert("L"))
        assert min(picture.shape) > 300
        assert picture.std() > 5
    assert "http" not in text  # the page needs nothing but the folder
    assert f"{score(load_strands(out / 'strands.npz'), load_truth(capture / 'truth.npz'))['recall']:.3f}" in text

    made = {p: p.stat().st_mtime_ns for p in (out / "strands.npz", *(out / "strands.work").iterdir())}
    figures(capture, out, params=FigureParams(height_mm=0.4, sweep=3), only=["2b"])
    assert {p: p.stat().st_mtime_ns for p in made} == made
    assert "sweep 3 at" in page.read_text(encoding="utf-8")
    os.utime(out / "strands.npz", (1, 1))  # older than the capture

    def asked(*_args, **_more):
        raise InterruptedError

    monkeypatch.setattr("strandscope.core.figures.reconstruct", asked)
    with pytest.raises(InterruptedError):
        figures(capture, out)


def test_strands_that_are_given_are_left_as_they_are(capture, tmp_path):
    given = tmp_path / "given" / "s.npz"
    reconstruct(capture / "few.json", given, replace(preset(), infill=None))
    before = {p: p.stat().st_mtime_ns for p in given.parent.rglob("*")}
    figures(capture / "few.json", tmp_path / "a", given, only=["10", "3"])  # without truth and infill; its features are beside it
    assert {p.name for p in (tmp_path / "a").iterdir()} == {"figure_3_ribbons.png", "figure_10_hair.png", "index.html"}
    figures(capture, tmp_path / "b", given, only=["3"])  # another capture: features of its own
    assert (tmp_path / "b" / "strands.work").is_dir()
    assert not (tmp_path / "b" / "strands.npz").exists()
    assert {p: p.stat().st_mtime_ns for p in given.parent.rglob("*")} == before


def test_what_cannot_be_drawn_is_told(capture, tmp_path):
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(StrandscopeError, match="is a file; expected a folder"):
        figures(capture, file)
    with pytest.raises(StrandscopeError, match="not found"):
        figures(capture, tmp_path / "out", tmp_path / "none.npz")
    with pytest.raises(StrandscopeError, match="no figure '7'"):
        figures(capture, tmp_path / "out", only=["2b", "7"])
    with pytest.raises(StrandscopeError, match="no figure 'recall'"):
        figures(capture / "few.json", tmp_path / "out", only=["recall"])  # its hair is not known
    assert file.read_text() == "mine"
