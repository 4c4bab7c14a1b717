"""The job types of Flamenco: what they have workers do is understood by our own verbs, in an order that can be done."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from strandscope.addon.cli import full_group
from strandscope.core.cli import PRESETS

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = ROOT / "flamenco"
CONVERT, TURNTABLE = "strandscope-convert.js", "strandscope-turntable.js"
FIELDS = {"key", "type", "subtype", "choices", "propargs", "description", "default", "eval", "evalInfo", "visible", "required"}
GIVEN = {
    CONVERT: {"captures_folder": "/shoot/captures", "captures": "lock 1; red/lock2", "output_folder": "/shoot/out"},
    TURNTABLE: {"capture": "/shoot/captures/lock1", "strands": "/shoot/out/lock1.npz", "output_folder": "/shoot/out"},
}


def compiled(script, **settings):
    """What the job type and its tasks, or its error, come to with these settings, in a JavaScript engine."""
    node = shutil.which("node")
    if node is None or not SCRIPTS.is_dir():
        pytest.skip("needs node, and a working copy")
    command = [node, Path(__file__).with_name("flamenco_manager.js"), SCRIPTS / script]
    result = subprocess.run(command, input=json.dumps(GIVEN[script] | settings), capture_output=True, text=True, encoding="utf-8", check=False)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def defaults(script):
    """The settings that a user gets who changes nothing."""
    return {setting["key"]: setting["default"] for setting in compiled(script)["type"]["settings"] if "default" in setting}


def verbs(tasks):
    """The command lines that run a verb, without the program, checked by the verb itself: the verb and its values."""
    found = []
    for command in (command["parameters"] for task in tasks for command in task["commands"] if command["name"] == "exec"):
        args = command["args"]
        if command["exe"] == "{blender}":
            assert args[:2] == ["--command", "strandscope"]
            args = args[2:]
        with full_group().commands[args[0]].make_context(args[0], args[1:]) as context:
            found.append((args[0], context.params))
    return found


@pytest.mark.parametrize("script", [CONVERT, TURNTABLE])
def test_settings_are_of_the_kinds_that_flamenco_knows(script):
    told = compiled(script)["type"]
    assert told["label"]
    assert told["description"]
    for setting in told["settings"]:
        assert set(setting) <= FIELDS
        assert {"key", "type", "description"} <= set(setting)
        assert setting["type"] in ("string", "int32")
        assert setting.get("subtype", "dir_path") in ("dir_path", "file_path")
        assert setting.get("required") or "default" in setting, setting["key"]
        assert "choices" not in setting or setting["default"] in setting["choices"]
    assert {setting["key"] for setting in told["settings"] if setting.get("required")} == set(GIVEN[script])


@pytest.mark.parametrize("program", ["{strandscope}", "{blender}"])
@pytest.mark.parametrize("script", [CONVERT, TURNTABLE])
def test_the_verbs_understand_every_command_line(script, program):
    answer = compiled(script, **defaults(script) | {"program": program})
    assert answer.get("error") is None
    assert len(verbs(answer["tasks"])) == (4 if script == CONVERT else 6)


def test_nothing_but_what_is_required_gives_the_same_as_the_defaults():
    for script in (CONVERT, TURNTABLE):
        assert compiled(script)["tasks"] == compiled(script, **defaults(script))["tasks"]


@pytest.mark.parametrize("script", [CONVERT, TURNTABLE])
def test_what_a_task_waits_for_was_added_before(script):
    names = []
    for task in compiled(script)["tasks"]:
        assert set(task["dependencies"]) <= set(names)
        names.append(task["name"])
    assert len(set(names)) == len(names)


def test_each_capture_is_reconstructed_and_then_its_curves_are_blended():
    tasks = compiled(CONVERT)["tasks"]
    assert [task["dependencies"] for task in tasks] == [[], ["reconstruct lock 1"], [], ["reconstruct red/lock2"]]
    assert [task["type"] for task in tasks] == ["misc", "blender"] * 2
    (_, made), (_, blended), (_, other), _ = verbs(tasks)
    assert made["capture"] == blended["capture"] == Path("/shoot/captures/lock 1")
    assert made["output"] == blended["strands"] == Path("/shoot/out/lock 1.npz")
    assert blended["out"] == Path("/shoot/out/lock 1.blend")
    assert other["output"] == Path("/shoot/out/red/lock2.npz")


def test_settings_reach_the_verbs():
    assert next(setting for setting in compiled(CONVERT)["type"]["settings"] if setting["key"] == "preset")["choices"] == list(PRESETS)
    chosen = {"preset": "curls", "infill": 300, "cores": 4, "memory": "12 GB", "captures": "lock", "task_type": "hair"}
    answer = compiled(CONVERT, **chosen)
    values = verbs(answer["tasks"])[0][1]
    assert (values["preset"], values["infill"], values["workers"], values["memory"]) == ("curls", 300, 4, 12 * 10**9)
    assert answer["tasks"][0]["type"] == "hair"
    assert verbs(compiled(CONVERT, infill=0)["tasks"])[0][1]["no_infill"]
    assert verbs(compiled(CONVERT, params="{shoot}/own.toml")["tasks"])[0][1]["params"] == Path("{shoot}/own.toml")


def test_every_frame_is_rendered_once_and_the_film_waits_for_all():
    tasks = compiled(TURNTABLE, frames="1-12, 20, 30-31", chunk_size=5, angles=0)["tasks"]
    renders = [task for task in tasks if task["name"].startswith("render")]
    frames = []
    for task in renders:
        told = task["commands"][0]["parameters"]
        assert told["blendfile"] == "/shoot/out/lock1.blend"
        for part in told["args"][told["args"].index("--render-frame") + 1].split(","):
            first, _, last = part.partition("..")
            frames += range(int(first), int(last or first) + 1)
    assert frames == [*range(1, 13), 20, 30, 31]
    assert all(task["dependencies"] == ["blend"] for task in renders)
    assert tasks[-1]["dependencies"] == [task["name"] for task in renders]
    assert tasks[-1]["commands"][0]["name"] == "frames-to-video"


def test_every_picture_is_rendered_once_and_then_compared():
    tasks = compiled(TURNTABLE, frames="", angles=3)["tasks"]
    calls = [values for _, values in verbs(tasks)]
    assert [values["part"] for values in calls] == [(1, 3), (2, 3), (3, 3), None]
    assert len({json.dumps(values | {"part": None}, default=str, sort_keys=True) for values in calls}) == 1  # of one identity: frames are kept
    assert [len(task["dependencies"]) for task in tasks] == [0, 1, 1, 3]


@pytest.mark.parametrize(
    ("script", "settings", "message"),
    [
        (CONVERT, {"captures_folder": ""}, 'setting captures_folder is ""; expected an absolute path that all workers see'),
        (CONVERT, {"captures_folder": "//captures"}, "setting captures_folder is .* absolute"),
        (CONVERT, {"output_folder": "out"}, "setting output_folder is .* absolute"),
        (CONVERT, {"captures": " ; "}, "setting captures is .* folders inside captures_folder"),
        (CONVERT, {"captures": "lock; ../other"}, 'setting captures is "../other"'),
        (CONVERT, {"captures": "lock; /other"}, 'setting captures is "/other"'),
        (CONVERT, {"captures": "lock; lock/"}, 'setting captures is "lock"; .* each once'),
        (CONVERT, {"preset": "frizzy"}, 'setting preset is "frizzy"; expected one of auto, straight, wavy, curls'),
        (CONVERT, {"infill": -2}, "setting infill is -2; expected a whole number of at least -1"),
        (CONVERT, {"cores": 1.5}, "setting cores is 1.5"),
        (CONVERT, {"memory": "much"}, 'setting memory is "much"; expected a number and a unit'),
        (CONVERT, {"params": "own.toml"}, "setting params is .* absolute"),
        (CONVERT, {"program": "rm"}, 'setting program is "rm"; expected one of'),
        (TURNTABLE, {"strands": None}, "setting strands is .* absolute"),
        (TURNTABLE, {"frames": "", "angles": 0}, "frames to render, or angles to compare with"),
        (TURNTABLE, {"frames": "one"}, "invalid range"),
        (TURNTABLE, {"chunk_size": 0}, "setting chunk_size is 0; expected a whole number of at least 1"),
        (TURNTABLE, {"size": 8}, "setting size is 8; expected a whole number of at least 16"),
    ],
)
def test_wrong_settings_are_told(script, settings, message):
    answer = compiled(script, **settings)
    assert "tasks" not in answer
    assert re.search(message, answer["error"])


@pytest.mark.parametrize("folder", ["C:\\shoot\\captures\\", r"\\server\shoot", "/", "{shoot}"])
def test_places_of_all_systems_are_kept(folder):
    capture = compiled(CONVERT, captures_folder=folder, captures="lock")["tasks"][0]["commands"][0]["parameters"]["args"][1]
    assert capture == folder.rstrip("\\/") + "/lock"


def test_what_both_scripts_share_is_the_same():
    if not SCRIPTS.is_dir():
        pytest.skip("not in a working copy")
    ends = [(SCRIPTS / name).read_text(encoding="utf-8").partition("// ---- the same in both")[2] for name in (CONVERT, TURNTABLE)]
    assert ends[0]
    assert ends[0] == ends[1]
