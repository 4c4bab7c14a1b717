"""The whole flow on a small simulated capture: where the hair ends up, what a run leaves behind and takes up again."""

import json
from dataclasses import replace

import numpy as np
import pytest

from strandscope.core.advection import AdvectionParams
from strandscope.core.compare import load_truth, score
from strandscope.core.errors import StrandscopeError
from strandscope.core.infill import InfillParams
from strandscope.core.pipeline import Parameters, preset, read_toml, reconstruct, write_toml
from strandscope.core.simulate import SimulateParams, simulate
from strandscope.core.strands import CAPTURED, INFILL, load_strands


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Four fibers: the folder of the capture."""
    folder = tmp_path_factory.mktemp("simulated") / "capture"
    simulate(folder, SimulateParams(scale="tiny", fibers=4))
    return folder


@pytest.fixture(scope="module")
def few(capture):
    """Six of its angles: a capture.json beside the other, for runs that need no good result."""
    head = json.loads((capture / "capture.json").read_text(encoding="utf-8"))
    head["sweeps"] = head["sweeps"][:: len(head["sweeps"]) // 6][:6]
    (capture / "few.json").write_text(json.dumps(head), encoding="utf-8")
    return capture / "few.json"


@pytest.fixture(scope="module")
def undisturbed(few, tmp_path_factory):
    """The bytes of a run of one worker."""
    out = tmp_path_factory.mktemp("undisturbed") / "strands.npz"
    reconstruct(few, out, preset())
    return out.read_bytes()


def whole(folder):
    """No file in a folder is half-written."""
    return not [p for p in folder.rglob("*") if ".part" in p.name]


# ---- the hair --------------------------------------------------------------------------------------------------------


def test_hair_ends_up_where_it_is(capture, tmp_path):
    """A sign that is wrong anywhere between the lens and the file puts the curves beside the fibers."""
    out = tmp_path / "out" / "strands.npz"
    # hair this thin has no inside to be filled: the infill is asked for a number of strands and is content with little density
    content = InfillParams(method="paper", count=5, advection=AdvectionParams(min_mean_density=0.3))
    strands = reconstruct(capture, out, replace(preset("straight"), infill=content))
    truth = load_truth(capture / "truth.npz")
    report = score(strands, truth)
    # four fibers that hardly hide one another: 1.0 and 1.0 and 5.5 um were measured; a ghost would cost 0.2, half a pixel is 14 um
    assert report["precision"] > 0.9
    assert report["recall"] > 0.85
    assert report["pos_err_um"]["mean"] < 10
    mirrored = replace(strands, points_mm=strands.points_mm * np.float32([-1, 1, 1]))
    assert score(mirrored, truth)["precision"] < 0.3  # 0.06
    assert np.count_nonzero(strands.kind == CAPTURED) >= 3
    infill = strands.select(strands.kind == INFILL)
    assert 0 < len(infill) <= 5
    assert np.all(infill.confidence == 0)
    assert np.all(strands.kind[: np.count_nonzero(strands.kind == CAPTURED)] == CAPTURED)
    again = load_strands(out)
    assert np.array_equal(again.points_mm, strands.points_mm)
    assert np.array_equal(again.kind, strands.kind)
    assert again.provenance["parameters"]["grow"]["cone_deg"] == 1.5
    assert again.provenance["parameters"]["ridges"]["offset"] > 0  # as estimated, so that the run can be repeated
    assert np.all(again.confidence[again.offsets[0] : again.offsets[1]] > 0)
    assert np.all(again.stops[again.kind == CAPTURED] > 0)
    assert np.all(again.captured.error_mm > 0)
    assert np.all(np.isnan(again.select(again.kind != CAPTURED).error_mm))
    assert whole(tmp_path)


def test_the_paper_s_method_runs(few, tmp_path):
    parameters = preset("straight", "paper")
    strands = reconstruct(few, tmp_path / "s.npz", replace(parameters, infill=None))
    assert np.all(strands.kind == CAPTURED)
    assert strands.provenance["parameters"]["ridges"]["operator"] == "paper"
    assert strands.provenance["parameters"]["infill"] is None


# ---- the same bytes, whatever happens -------------------------------------------------------------------------------------


def test_the_number_of_workers_does_not_change_a_byte(few, undisturbed, tmp_path):
    reconstruct(few, tmp_path / "s.npz", preset(), workers=2)
    assert (tmp_path / "s.npz").read_bytes() == undisturbed


@pytest.mark.parametrize(("stage", "share", "workers"), [("finding ridges", 0.6, 1), ("finding ridges", 0.6, 2), ("growing", 0.2, 1)])
def test_an_interrupted_run_leaves_nothing_half_done_and_goes_on(few, undisturbed, tmp_path, stage, share, workers):
    def interrupt(now, done, total):
        if now == stage and done >= share * total:
            raise KeyboardInterrupt

    out = tmp_path / "s.npz"
    with pytest.raises(KeyboardInterrupt):
        reconstruct(few, out, preset(), workers=workers, progress=interrupt)
    assert not out.exists()
    assert whole(tmp_path)
    finished = made(tmp_path / "s.work")
    assert 3 <= len(finished) <= 6
    reconstruct(few, out, preset())
    assert out.read_bytes() == undisturbed
    assert whole(tmp_path)
    again = made(tmp_path / "s.work")
    assert len(again) == 6
    assert {name: again[name] for name in finished} == finished  # what was finished was not made again


# ---- what lies beside the output -------------------------------------------------------------------------------------------
# A capture of noise has no fiber and is done in a moment; the work of its filter lies there nonetheless.


def made(work):
    """The features files and when each was made."""
    return {p.name: p.stat().st_mtime_ns for p in work.glob("sweep_*.features")}


def filter_only(capture, out, parameters=None):
    with pytest.raises(StrandscopeError, match="no fiber was found"):
        reconstruct(capture, out, preset() if parameters is None else parameters)
    assert not out.exists()
    return made(out.with_name(out.stem + ".work"))


def test_no_fiber_is_an_error_of_one_line(noise_capture, tmp_path):
    with pytest.raises(StrandscopeError, match=r"capture: no fiber was found in \d+ features; expected") as caught:
        reconstruct(noise_capture, tmp_path / "s.npz", preset())
    assert "\n" not in str(caught.value)


def test_only_what_is_missing_is_made_again(noise_capture, tmp_path):
    out = tmp_path / "s.npz"
    first = filter_only(noise_capture, out)
    assert len(first) == 4
    assert filter_only(noise_capture, out) == first
    (tmp_path / "s.work" / "sweep_002.features").unlink()
    second = filter_only(noise_capture, out)
    assert {name for name in first if second[name] != first[name]} == {"sweep_002.features"}


@pytest.mark.parametrize(
    ("change", "anew"),
    [
        (lambda p: replace(p, ridges=replace(p.ridges, low=0.5 * p.ridges.low)), True),
        (lambda p: replace(p, ridges=replace(p.ridges, along_px=2.5)), True),
        (lambda p: replace(p, hull=replace(p.hull, block_px=2 * p.hull.block_px)), True),
        (lambda p: replace(p, grow=replace(p.grow, cone_deg=2.0)), False),
        (lambda p: replace(p, infill=None), False),
    ],
)
def test_other_parameters_of_the_filter_make_its_work_anew(noise_capture, tmp_path, change, anew):
    out = tmp_path / "s.npz"
    first = filter_only(noise_capture, out)
    second = filter_only(noise_capture, out, change(preset()))
    assert {first[name] != second[name] for name in first} == {anew}


def test_other_photographs_make_the_work_anew(noise_capture, tmp_path):
    out = tmp_path / "s.npz"
    first = filter_only(noise_capture, out)
    one, other = noise_capture / "sweep_000/img_0000.dng", noise_capture / "sweep_001/img_0003.dng"
    one.write_bytes(other.read_bytes())
    second = filter_only(noise_capture, out)
    assert all(first[name] != second[name] for name in first)


def test_a_features_file_that_is_cut_short_is_named(noise_capture, tmp_path):
    out = tmp_path / "s.npz"
    filter_only(noise_capture, out)
    cut = tmp_path / "s.work" / "sweep_001.features"
    cut.write_bytes(cut.read_bytes()[:-7])
    with pytest.raises(StrandscopeError, match=r"sweep_001\.features: not a whole features file .* delete it and run again"):
        reconstruct(noise_capture, out, preset())


def test_too_little_memory_is_refused_in_words(noise_capture, tmp_path):
    with pytest.raises(StrandscopeError, match=r"features need about \d+\.\d GB of memory; 0\.1 GB are allowed \(--memory\)"):
        reconstruct(noise_capture, tmp_path / "s.npz", preset(), memory_bytes=10**8)
    assert not (tmp_path / "s.npz").exists()


# ---- parameters ------------------------------------------------------------------------------------------------------------


def test_presets_are_table_1():
    for name, c, box_px in (("straight", -140, (40, 30, 8)), ("wavy", -90, (60, 30, 8)), ("curls", -70, (60, 30, 8))):
        paper = preset(name, "paper")
        # c is a number of 12 bits with the black level, 128, in it
        assert paper.ridges.offset * (4095 - 128) == pytest.approx(c + 128)
        for parameters in (paper, preset(name)):
            grow = parameters.paper or parameters.grow
            assert (grow.cone_deg, grow.max_correction_px, grow.box_px) == (1.5, 0.5, box_px)
        assert paper.paper.step_mm == 0.1
        assert paper.paper is not None
        assert preset(name).ridges.offset is None  # estimated
    assert preset() == preset("auto") == preset("straight")


@pytest.mark.parametrize("parameters", [Parameters(), Parameters(infill=None), preset("wavy"), preset("curls", "paper")])
def test_toml_gives_the_parameters_back(tmp_path, parameters):
    write_toml(tmp_path / "p.toml", parameters)
    assert read_toml(tmp_path / "p.toml") == parameters
    assert whole(tmp_path)


def test_toml_without_a_word_has_the_defaults(tmp_path):
    (tmp_path / "p.toml").write_text("", encoding="utf-8")
    assert read_toml(tmp_path / "p.toml") == Parameters()
    (tmp_path / "p.toml").write_text("[grow]\ncone_deg = 2\nbox_px = [50, 30, 8]\n[ridges]\noffset = 0.1\n", encoding="utf-8")
    read = read_toml(tmp_path / "p.toml")
    assert (read.grow.cone_deg, read.grow.box_px, read.ridges.offset) == (2, (50.0, 30.0, 8.0), 0.1)
    assert read.grow.step_mm == Parameters().grow.step_mm


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[grow]\nconde_deg = 2.0\n", "grow.conde_deg is not a parameter; expected one of step_mm, cone_deg"),
        ("[growing]\ncone_deg = 2.0\n", "growing is not a parameter; expected one of ridges, grow"),
        ("[grow]\ncone_deg = 'wide'\n", "grow.cone_deg is 'wide'; expected a number"),
        ("[grow]\ncone_deg = true\n", "grow.cone_deg is True; expected a number"),
        ("[paper]\ngate = 1\n", "paper.gate is not a parameter; expected one of step_mm"),
        ("[grow]\nbox_px = [40, 30]\n", "grow.box_px is [40, 30]; expected 3 numbers"),
        ("[grow]\nbox_px = 40\n", "grow.box_px is 40; expected 3 numbers"),
        ("[ridges]\noperator = 3\n", "ridges.operator is 3; expected str"),
        ("[ridges]\noffset = 'auto'\n", "ridges.offset is 'auto'; expected a number"),
        ("grow = 3\n", "grow"),
        ("[grow\n", "not valid TOML"),
        ("\xff\xfe", "not valid TOML"),
    ],
)
def test_toml_that_is_wrong_is_an_error_that_names_file_and_field(tmp_path, text, said):
    (tmp_path / "p.toml").write_bytes(text.encode("latin-1"))
    with pytest.raises(StrandscopeError) as caught:
        read_toml(tmp_path / "p.toml")
    assert str(caught.value).startswith(f"{tmp_path / 'p.toml'}: ")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_toml_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(StrandscopeError, match=r"p\.toml: not found; expected a TOML file"):
        read_toml(tmp_path / "p.toml")
