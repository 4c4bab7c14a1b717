"""capture.json: what is written is read again, and whatever is wrong is said with file and field, never with a crash."""

import copy
import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from strandscope.core.capture import Capture, Sweep, Turntable, load_capture, save_capture
from strandscope.core.errors import CaptureError
from strandscope.core.geometry import Optics
from strandscope.core.raw import Mosaic

from .conftest import make_capture

OPTICS = Optics(330.0, 1 / 35, 31.5, 23.5, 10.0)
ODD = ["../x", "/etc/passwd", "a\\b", "", "C:/x", "\ud800", "a\0", "x" * 300, 10**400]
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.sampled_from(ODD),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=4,
)


def head_of(folder):
    return json.loads((folder / "capture.json").read_text())


def write_head(folder, head):
    (folder / "capture.json").write_text(json.dumps(head))


@pytest.mark.parametrize("positions", [(-0.4, -0.2, 0.0), (0.3, 0.1, -0.1), (0.0, 0.1, 0.5), (0.7,)])
def test_what_is_saved_is_loaded(tmp_path, positions):
    files = tuple(f"s/{i}.npy" for i in range(len(positions)))
    (tmp_path / "s").mkdir()
    for file in files:
        np.save(tmp_path / file, np.zeros((4, 4), np.uint16))
    capture = Capture(
        folder=tmp_path,
        name="Größe",
        optics=OPTICS,
        sweeps=(Sweep(15.0, positions, files),),
        turntable=Turntable(16.0, files[:1], (0.0,), 0.5),
        mosaic=Mosaic("GBRG", 512, 15871),
        unknown={"note": [1, {"a": None}]},
    )
    save_capture(capture)
    loaded = load_capture(tmp_path)
    assert loaded.sweeps[0].positions_mm == pytest.approx(positions, abs=1e-7)
    assert (loaded.name, loaded.optics, loaded.turntable, loaded.mosaic) == (capture.name, capture.optics, capture.turntable, capture.mosaic)
    assert loaded.unknown == {"note": [1, {"a": None}]}
    assert loaded.sweeps[0].files == files


def test_a_gain_is_kept_and_taken_out_of_the_photograph(noise_capture):
    head = json.loads((noise_capture / "capture.json").read_text())
    head["sweeps"][1]["gains"] = [1.0, 1.1, 0.8, 1.0, 1.0]
    plain = load_capture(noise_capture)
    (noise_capture / "capture.json").write_text(json.dumps(head))
    capture = load_capture(noise_capture)
    assert capture.sweeps[1].gains == (1.0, 1.1, 0.8, 1.0, 1.0)
    for sweep, gain in ((1, 0.8), (0, 1.0)):
        file = capture.sweeps[sweep].files[2]
        np.testing.assert_allclose(capture.planes(file) * gain, plain.planes(file), rtol=1e-6)
    save_capture(capture)
    assert load_capture(noise_capture).sweeps == capture.sweeps
    for wrong, told in (([1.0], "1 numbers"), ([1, 1, 0, 1, 1], "more than 0")):
        head["sweeps"][1]["gains"] = wrong
        (noise_capture / "capture.json").write_text(json.dumps(head))
        with pytest.raises(CaptureError, match=told):
            load_capture(noise_capture)


def test_it_is_found_by_folder_and_by_file(noise_capture):
    by_folder, by_file = load_capture(noise_capture), load_capture(noise_capture / "capture.json")
    assert by_folder.sweeps == by_file.sweeps
    assert by_folder.shape == (48, 64)


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("format",), "other", "format"),
        (("version",), 2, "version"),
        (("optics", "pitch_mm"), 0, "optics.pitch_mm"),
        (("optics", "pitch_mm"), "0.03", "optics.pitch_mm"),
        (("optics", "working_distance_mm"), -330, "optics.working_distance_mm"),
        (("optics", "axis_col_px"), None, "optics.axis_col_px"),
        (("optics", "aperture_cone_deg"), True, "optics.aperture_cone_deg"),
        (("sweeps",), [], "sweeps"),
        (("sweeps", 1, "angle_deg"), "90", "sweeps[1].angle_deg"),
        (("sweeps", 1, "step_mm"), 0, "sweeps[1].step_mm"),
        (("sweeps", 2, "files"), [], "sweeps[2].files"),
        (("sweeps", 2, "positions_mm"), [0.0, 1.0], "sweeps[2].positions_mm"),
        (("sweeps", 0, "files", 3), "sweep_000/img_0000.dng", "sweeps[0].files"),
        (("sweeps", 0, "files", 3), "../capture/sweep_000/img_0003.dng", "sweeps[0].files[3]"),
        (("sweeps", 0, "files", 3), "/tmp/img.dng", "sweeps[0].files[3]"),
        (("sweeps", 0, "files", 3), "sweep_000\\img_0003.dng", "sweeps[0].files[3]"),
        (("truth",), "../truth.npz", "truth"),
        (("mosaic",), {"pattern": "RGBX", "black": 1, "white": 2}, "mosaic.pattern"),
        (("mosaic",), {"pattern": "RGGB", "black": 9, "white": 2}, "mosaic.white"),
        (("turntable",), {"f_number": 16, "files": ["sweep_000/img_0000.dng"], "angles_deg": []}, "turntable.angles_deg"),
    ],
)
def test_a_wrong_field_is_named_with_what_was_expected(noise_capture, path, value, said):
    head = head_of(noise_capture)
    target = head
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    write_head(noise_capture, head)
    with pytest.raises(CaptureError) as error:
        load_capture(noise_capture)
    message = str(error.value)
    assert message.startswith(f"{noise_capture / 'capture.json'}: {said}")
    assert "expected" in message
    assert "\n" not in message


@pytest.mark.parametrize("field", ["format", "version", "optics", "sweeps"])
def test_a_missing_field_is_named(noise_capture, field):
    head = head_of(noise_capture)
    del head[field]
    write_head(noise_capture, head)
    with pytest.raises(CaptureError, match=rf"capture\.json: {field} is .*expected"):
        load_capture(noise_capture)


def test_unknown_fields_are_ignored(noise_capture):
    head = head_of(noise_capture)
    head["future"], head["optics"]["future"], head["sweeps"][0]["future"] = 1, 2, 3
    write_head(noise_capture, head)
    assert load_capture(noise_capture).unknown == {"future": 1}


def test_a_link_out_of_the_folder_is_refused(noise_capture, tmp_path):
    photograph = noise_capture / "sweep_000/img_0000.dng"
    photograph.rename(tmp_path / "elsewhere.dng")
    photograph.symlink_to(tmp_path / "elsewhere.dng")
    with pytest.raises(CaptureError, match=r"sweeps\[0\]\.files\[0\].*leads out"):
        load_capture(noise_capture)


@pytest.fixture(scope="module")
def shared_capture(tmp_path_factory):
    """A folder whose capture.json is written anew by each example, and a head that is right."""
    folder = make_capture(tmp_path_factory.mktemp("shared") / "capture")
    return folder, head_of(folder)


def test_a_name_too_long_for_a_file_is_a_missing_file(shared_capture):
    folder, right = shared_capture
    head = copy.deepcopy(right)
    head["sweeps"][0]["files"][0] = "x" * 300
    write_head(folder, head)
    with pytest.raises(CaptureError, match="missing xxx"):
        load_capture(folder)


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_any_value_anywhere_is_loaded_or_refused_in_one_line(shared_capture, data):
    folder, right = shared_capture
    head = target = copy.deepcopy(right)
    while True:
        key = data.draw(st.sampled_from(list(target) if isinstance(target, dict) else range(len(target))))
        if not isinstance(target[key], dict | list) or data.draw(st.integers(0, 3)) == 0:
            break
        target = target[key]
    target[key] = data.draw(ANYTHING)
    write_head(folder, head)
    try:
        said = None if load_capture(folder).sweeps else "nothing"
    except CaptureError as error:
        said = str(error)
    assert said is None or (said.startswith(str(folder / "capture.json")) and len(said.splitlines()) == 1)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50, deadline=None)
@given(text=st.binary(max_size=60))
def test_any_bytes_are_refused_in_one_line(tmp_path, text):
    (tmp_path / "capture.json").write_bytes(text)
    with pytest.raises(CaptureError, match=r"capture\.json: .*"):
        load_capture(tmp_path)


def test_brackets_without_end_are_refused(tmp_path):
    (tmp_path / "capture.json").write_text("[" * 100_000)
    with pytest.raises(CaptureError, match="not valid JSON"):
        load_capture(tmp_path)
