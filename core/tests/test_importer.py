"""Folders of photographs of every layout become the capture that they are; what does not fit is said before anything is written."""

import numpy as np
import pytest
import tifffile

from strandscope.core import importer
from strandscope.core.capture import load_capture
from strandscope.core.errors import CaptureError, StrandscopeError
from strandscope.core.importer import Layout, Source, carry_out, describe, plan_import
from strandscope.core.raw import Mosaic, write_dng

STEPS = Layout(first_mm=-0.4, step_mm=0.2)
BLACK, WHITE = 512, 15871


def photograph(path, number, size=(40, 48)):
    """A DNG that is black but for its number, so that it can be told which is which."""
    mosaic = np.full(size, BLACK, np.uint16)
    mosaic[::2, ::2] += number
    write_dng(path, mosaic, BLACK, WHITE)


def number_of(capture, file):
    return round(float(capture.planes(file)[0].mean()) * (WHITE - BLACK))


def numbers_of(capture):
    """Which photographs a capture has, by sweep and position."""
    return [[number_of(capture, file) for file in sweep.files] for sweep in capture.sweeps]


@pytest.fixture
def photos(tmp_path):
    """3 sweeps of 12 photographs in subfolders, named so that the alphabet would put img_10 before img_2."""
    for k in range(3):
        for i in range(12):
            photograph(tmp_path / "photos" / f"pass {k + 8}" / f"img_{i}.dng", 100 * k + i)
    return tmp_path / "photos"


def state(folder):
    return {p.relative_to(folder): (p.read_bytes() if p.is_file() else None) for p in folder.rglob("*")}


def test_subfolders_become_sweeps_in_natural_order(photos, tmp_path):
    before = state(photos)
    plan = plan_import(Source(photos), tmp_path / "lock", STEPS)
    path = carry_out(plan)
    capture = load_capture(path)
    assert numbers_of(capture) == [[100 * k + i for i in range(12)] for k in range(3)]
    assert [sweep.angle_deg for sweep in capture.sweeps] == [0.0, 120.0, 240.0]
    np.testing.assert_allclose(capture.sweeps[0].positions_mm, -0.4 + 0.2 * np.arange(12), atol=1e-9)
    assert capture.optics.pitch_mm == pytest.approx(1 / 35)
    assert (capture.optics.axis_col_px, capture.optics.axis_row_px) == (11.5, 9.5)
    assert capture.name == "photos"
    assert state(photos) == before
    assert any("360" in value for name, value in describe(plan) if name == "assumed")


def test_photographs_stay_where_they_are_if_the_capture_is_their_folder(photos):
    names = sorted(p.name for p in photos.rglob("*"))
    capture = load_capture(carry_out(plan_import(Source(photos), photos, STEPS)))
    assert capture.sweeps[0].files[10] == "pass 8/img_10.dng"
    assert sorted(p.name for p in photos.rglob("*")) == sorted([*names, "capture.json"])


def test_photographs_below_the_capture_stay_too(photos, tmp_path):
    capture = load_capture(carry_out(plan_import(Source(photos), tmp_path, STEPS)))
    assert capture.sweeps[2].files[0] == "photos/pass 10/img_0.dng"


def test_elsewhere_they_are_linked_and_copied_on_demand(photos, tmp_path):
    linked = load_capture(carry_out(plan_import(Source(photos), tmp_path / "linked", STEPS)))
    copied = load_capture(carry_out(plan_import(Source(photos), tmp_path / "copied", STEPS), copy=True))
    original = photos / "pass 8/img_3.dng"
    assert (linked.folder / linked.sweeps[0].files[3]).samefile(original)
    assert not (copied.folder / copied.sweeps[0].files[3]).samefile(original)
    assert numbers_of(linked) == numbers_of(copied)


def test_where_links_are_impossible_they_are_copied(photos, tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(importer.os, "link", refuse)
    assert numbers_of(load_capture(carry_out(plan_import(Source(photos), tmp_path / "lock", STEPS))))[2][11] == 211


def test_a_pattern_tells_angles_and_positions(tmp_path):
    for angle in (45, -45, 10.5):
        for d in (-0.5, 0.0, 0.25):
            photograph(tmp_path / "p" / f"A{angle}_x{d}_day.dng", int(angle * 10 + 1000 + d * 100))
    pattern = "a{angle}_X{position}_*.dng"
    capture = load_capture(carry_out(plan_import(Source(tmp_path / "p", pattern), tmp_path / "lock", Layout())))
    assert [sweep.angle_deg for sweep in capture.sweeps] == [-45, 10.5, 45]
    assert capture.sweeps[0].positions_mm == (-0.5, 0.0, 0.25)
    assert numbers_of(capture)[1] == [1105 - 50, 1105, 1105 + 25]
    # with a step given too, the names tell the order and the step the positions
    turned = plan_import(Source(tmp_path / "p", "*{angle}_x{position}_*"), tmp_path / "other", Layout(first_mm=3.0, step_mm=-1.0))
    assert turned.capture.sweeps[0].positions_mm == (3.0, 2.0, 1.0)


def test_a_pattern_of_numbers_needs_angles_and_steps(tmp_path):
    for sweep in (1, 2):
        for i in (1, 2, 10):
            photograph(tmp_path / "p" / f"s{sweep}i{i}.dng", 10 * sweep + i)
    layout = Layout(angles_deg=(0.0, 90.0), step_mm=0.5)
    plan = plan_import(Source(tmp_path / "p", "s{sweep}i{index}.dng"), tmp_path / "lock", layout)
    capture = load_capture(carry_out(plan))
    assert numbers_of(capture) == [[11, 12, 20], [21, 22, 30]]
    assert capture.sweeps[1].positions_mm == (-0.5, 0.0, 0.5)  # centred, and said so
    assert any("centred" in note for note in plan.notes)


def test_a_table_tells_all(photos, tmp_path):
    lines = ["position_mm, file, angle_deg, remark", *(f"{0.1 * (5 - i)}, pass 9/img_{i}.dng, {30 * (i % 2)}, x" for i in range(6))]
    (tmp_path / "log.csv").write_text("\n".join(lines), encoding="utf-8-sig")
    capture = load_capture(carry_out(plan_import(Source(photos, table=tmp_path / "log.csv"), tmp_path / "lock", Layout())))
    assert [sweep.angle_deg for sweep in capture.sweeps] == [0.0, 30.0]
    assert numbers_of(capture) == [[104, 102, 100], [105, 103, 101]]
    np.testing.assert_allclose(capture.sweeps[0].positions_mm, [0.1, 0.3, 0.5])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("file,angle_deg\na.dng,0", "line 1: the column position_mm is missing"),
        ("file,angle_deg,position_mm\npass 8/img_1.dng,0,x", "line 2: position_mm is 'x'"),
        ("file,angle_deg,position_mm\npass 8/img_1.dng,0,nan", "line 2: position_mm is 'nan'"),
        ("file,angle_deg,position_mm\npass 8/img_1.dng,0", "line 2: position_mm is None"),
        ("file,angle_deg,position_mm\n,0,1", "line 2: file is empty"),
        ("file,angle_deg,position_mm\n", "lists no photograph"),
        ("file,angle_deg,position_mm\nnone.dng,0,1", "none.dng: the photograph is missing"),
        ("file,angle_deg,position_mm\npass 8/img_1.dng,0,1\npass 8/img_1.dng,0,2", "listed twice"),
        ("file,angle_deg,position_mm\npass 8/img_1.dng,0,1\npass 8/img_2.dng,0,1", "two photographs at one position"),
        ("file,angle_deg,position_mm\npass 8/img_1.dng,0,1\npass 8/img_2.dng,360,1", "two sweeps are at 0°"),
    ],
)
def test_a_wrong_table_is_named_with_its_line(photos, tmp_path, text, said):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(CaptureError) as error:
        plan_import(Source(photos, table=tmp_path / "log.csv"), tmp_path / "lock", Layout())
    assert said in str(error.value)


def test_the_time_in_the_files_tells_the_order(tmp_path):
    for k, name in enumerate(["c", "a", "d", "b"]):
        path = tmp_path / "p" / f"{name}.dng"
        photograph(path, k)
        set_time(path, f"2026:11:22 14:0{k}:00")
    layout = Layout(angles_deg=2, first_mm=0.0, step_mm=1.0)  # one folder: two sweeps of equal length
    capture = load_capture(carry_out(plan_import(Source(tmp_path / "p", by_time=True), tmp_path / "lock", layout)))
    assert numbers_of(capture) == [[0, 1], [2, 3]]
    by_name = plan_import(Source(tmp_path / "p"), tmp_path / "other", layout)
    assert [p.stem for p in by_name.sources.values()] == ["a", "b", "c", "d"]


def set_time(path, text):
    with tifffile.TiffFile(path) as tiff:
        page = tiff.pages[0]
        kept = [t for t in page.tags.values() if t.code > 33000 or t.code in (271, 272)]
        mosaic, tags = page.asarray(), [(t.code, t.dtype, t.count, t.value, True) for t in kept]
    tifffile.imwrite(path, mosaic, photometric="CFA", planarconfig=1, metadata=None, extratags=tags, datetime=text)


def test_without_times_the_names_are_taken_and_it_is_said(photos, tmp_path):
    plan = plan_import(Source(photos, by_time=True), tmp_path / "lock", STEPS)
    assert [p.name for p in plan.sources.values()][:3] == ["img_0.dng", "img_1.dng", "img_2.dng"]
    assert any("order is that of the names" in note for note in plan.notes)


def test_turntable_photographs_are_kept_apart(photos, tmp_path):
    for i in range(4):
        photograph(photos / "small aperture" / f"{i}.dng", 900 + i)
    capture = load_capture(carry_out(plan_import(Source(photos, turntable="small aperture"), tmp_path / "lock", STEPS)))
    assert len(capture.sweeps) == 3
    assert capture.turntable.angles_deg == (0.0, 90.0, 180.0, 270.0)
    assert [number_of(capture, file) for file in capture.turntable.files] == [900, 901, 902, 903]


def test_bare_mosaics_need_their_pattern(tmp_path):
    (tmp_path / "p").mkdir()
    for i in range(3):
        np.save(tmp_path / "p" / f"{i}.npy", np.full((8, 8), 600 + i, np.uint16))
    with pytest.raises(CaptureError, match="mosaic"):
        plan_import(Source(tmp_path / "p"), tmp_path / "lock", STEPS)
    layout = Layout(step_mm=1.0, mosaic=Mosaic("RGGB", 500, 1000))
    capture = load_capture(carry_out(plan_import(Source(tmp_path / "p"), tmp_path / "lock", layout)))
    assert capture.planes(capture.sweeps[0].files[2])[0, 0, 0] == pytest.approx(0.204)


def spoil_missing(photos):
    (photos / "pass 9/img_5.dng").unlink()
    return "sweep pass 9 has 11 photographs; expected 12"


def spoil_size(photos):
    photograph(photos / "pass 9/img_5.dng", 0, (40, 52))
    return "img_5.dng: is 52 x 40 pixels; expected 48 x 40"


def spoil_length(photos):
    path = photos / "pass 10/img_7.dng"
    path.write_bytes(path.read_bytes()[:-100])
    return "img_7.dng: the photograph is cut short"


def spoil_kind(photos):
    (photos / "pass 10/img_7.dng").rename(photos / "pass 10/img_7.arw")
    return "img_7.arw: is another kind of file; expected .dng"


def spoil_name(photos):
    (photos / "pass 10/img_7.dng").write_text("text")
    return "img_7.dng: LibRaw cannot read"


@pytest.mark.parametrize("spoil", [spoil_missing, spoil_size, spoil_length, spoil_kind, spoil_name])
def test_what_does_not_fit_is_said_before_anything_is_written(photos, tmp_path, spoil):
    said = spoil(photos)
    with pytest.raises(CaptureError) as error:
        plan_import(Source(photos), tmp_path / "lock", STEPS)
    assert said in str(error.value)
    assert len(str(error.value).splitlines()) == 1
    assert not (tmp_path / "lock").exists()


@pytest.mark.parametrize(
    ("source", "layout", "said"),
    [
        ({}, Layout(), "positions are not known"),
        ({}, Layout(angles_deg=(0.0, 90.0), step_mm=1.0), "3 sweeps found (pass 8 … pass 10); expected 2"),
        ({}, Layout(angles_deg=4, step_mm=1.0), "3 sweeps found; expected 4"),
        ({}, Layout(angles_deg=(0.0, 360.0, 90.0), step_mm=1.0), "two sweeps are at 0°"),
        ({}, Layout(positions_mm=(1.0, 2.0)), "has 12 photographs; expected 2"),
        ({"pattern": "{angle}.cr2"}, Layout(), "none of 36 photographs fits the pattern"),
        ({"turntable": "none"}, STEPS, "is not a folder"),
    ],
)
def test_flags_that_do_not_fit_are_said(photos, tmp_path, source, layout, said):
    with pytest.raises(CaptureError) as error:
        plan_import(Source(photos, **source), tmp_path / "lock", layout)
    assert said in str(error.value)


def test_a_pattern_with_an_unknown_field_is_refused(photos, tmp_path):
    with pytest.raises(StrandscopeError, match=r"\{depth\}"):
        plan_import(Source(photos, "{depth}.dng"), tmp_path / "lock", STEPS)


def test_empty_and_missing_folders_and_captures_that_are_there(photos, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(CaptureError, match="no photographs found"):
        plan_import(Source(tmp_path / "empty"), tmp_path / "lock", STEPS)
    with pytest.raises(CaptureError, match="is not a folder"):
        plan_import(Source(tmp_path / "none"), tmp_path / "lock", STEPS)
    carry_out(plan_import(Source(photos), photos, STEPS))
    with pytest.raises(CaptureError, match="is there already"):
        plan_import(Source(photos), photos, STEPS)


def test_a_capture_inside_the_folder_is_not_imported_again(photos):
    carry_out(plan_import(Source(photos), photos / "lock", STEPS))
    (photos / "lock/capture.json").unlink()
    assert len(plan_import(Source(photos), photos / "lock", STEPS).capture.sweeps) == 3


def test_an_import_that_fails_leaves_nothing_and_the_source_as_it_was(photos, tmp_path):
    before = state(tmp_path)

    def stop(stage, done, _total):
        if stage == "bringing photographs" and done == 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        carry_out(plan_import(Source(photos), tmp_path / "new/lock", STEPS), progress=stop)
    assert state(tmp_path) == before
