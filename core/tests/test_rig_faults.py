"""Whatever happens to a capture, it ends whole; and what is not whole is seen."""

import json
import os
from collections import Counter

import pytest

from strandscope.core import rig_faults
from strandscope.core.rig import logbook, session
from strandscope.core.rig.controller import ControllerConfig, stage_config, start_controller
from strandscope.core.rig.session import SessionParams
from strandscope.core.rig.stage import Stage
from strandscope.core.rig_faults import FAULTS, FaultParams, attempt, prove, trials
from strandscope.core.virtual_rig import SimulatedWorld, VirtualCamera, VirtualCameraConfig, stamped

PARAMS = FaultParams()


@pytest.mark.skipif(os.name != "posix", reason="a disk that is full cannot be had there")
@pytest.mark.parametrize(("seed", "faults"), [(2, FAULTS[::2]), (4, FAULTS[1::2])])  # a camera on USB, and one on a cable
def test_a_capture_with_faults_ends_whole(tmp_path, seed, faults):
    trial = attempt(tmp_path / "trial", seed, faults, PARAMS)
    assert not trial.wrong
    assert trial.moved == 0
    assert trial.shots >= len(PARAMS.plan)
    assert not (tmp_path / "trial").exists()  # nothing is left of what is proven
    assert ("cable" if seed == 4 else "USB") in trial.kind


def test_all_kinds_of_faults_have_their_turn(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(rig_faults, "attempt", lambda _folder, seed, faults, _params: made.append((seed, faults)))
    list(trials(tmp_path, FaultParams(faults=4 * len(FAULTS) + 3)))
    counts = Counter(fault for _, faults in made for fault in faults)
    assert set(counts) == set(FAULTS)
    assert sum(counts.values()) == 4 * len(FAULTS) + 3
    assert max(counts.values()) - min(counts.values()) <= 1
    assert len({seed for seed, _ in made}) == len(made)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A capture of stamped photographs without faults."""
    folder = tmp_path_factory.mktemp("whole")
    config = ControllerConfig(time_factor=60.0)
    with start_controller(config) as controller:
        wiring = stage_config(controller.url, config)
        with Stage.open(wiring) as stage:
            camera = VirtualCamera(stamped(), SimulatedWorld(controller, wiring), VirtualCameraConfig(60.0))
            session.run(PARAMS.plan, stage, camera, folder, params=SessionParams(reserve_bytes=0))
            assert not any(controller.moved(*shot) for shot in camera.shots)
    return folder


def copied(whole, to):
    for path in sorted(whole.rglob("*")):
        if path.is_file():
            (to / path.relative_to(whole)).parent.mkdir(parents=True, exist_ok=True)
            (to / path.relative_to(whole)).write_bytes(path.read_bytes())
    return to


def test_a_whole_capture_is_proven(whole):
    assert prove(whole, PARAMS.plan) == []


@pytest.mark.parametrize("damage", ["gone", "cut", "swapped", "twice", "one too many", "a line changed", "not planned"])
def test_what_is_wrong_with_a_capture_is_seen(whole, tmp_path, damage):
    folder = copied(whole, tmp_path)
    one, two = folder / "sweep_000/img_0001.dng", folder / "sweep_002/img_0003.dng"
    book = folder / session.LOGBOOK
    match damage:
        case "gone":
            (folder / "rig/checks/sweep_001.dng").unlink()
        case "cut":
            one.write_bytes(one.read_bytes()[:-100])
        case "swapped":
            data = one.read_bytes()
            one.write_bytes(two.read_bytes())
            two.write_bytes(data)
        case "twice":
            one.write_bytes(two.read_bytes())
        case "one too many":
            (folder / "sweep_000/img_0099.dng").write_bytes(one.read_bytes())
        case "a line changed":
            book.write_bytes(book.read_bytes().replace(b'"frame": 2', b'"frame": 3', 1))
        case "not planned":
            plan = rig_faults.Plan(**json.loads(json.dumps(vars(PARAMS.plan))) | {"angles_deg": (0.0, 90.0, 180.0)})
            assert prove(folder, plan)
            return
    assert prove(folder, PARAMS.plan)


def test_photographs_under_each_others_names_are_told_by_what_they_show(whole, tmp_path):
    """Even where the logbook agrees with the files."""
    folder = copied(whole, tmp_path)
    records, _ = logbook.read((folder / session.LOGBOOK).read_bytes())
    safe = {record["file"]: record for record in records if record["what"] == "safe"}
    one, two = "sweep_000/img_0001.dng", "sweep_000/img_0002.dng"
    (folder / session.LOGBOOK).unlink()
    data = (folder / one).read_bytes()
    (folder / one).write_bytes((folder / two).read_bytes())
    (folder / two).write_bytes(data)
    with session.Logbook(folder / session.LOGBOOK) as book:
        for record in records:
            if record.get("file") in (one, two) and record["what"] == "safe":
                other = safe[two if record["file"] == one else one]
                record = record | {"sha256": other["sha256"]}
            book.write(record["what"], **{name: value for name, value in record.items() if name not in ("n", "time", "what", "crc")})
    wrong = prove(folder, PARAMS.plan)
    assert len(wrong) == 2
    assert all("planned" in words for words in wrong)
