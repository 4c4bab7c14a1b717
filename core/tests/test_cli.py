"""The command line: help for newcomers, one line an error, exit codes, progress for people and for programs."""

import json
import os
import signal
import subprocess
import sys

import click
import pytest

from strandscope.core import cli
from strandscope.core.cli import common, main_group, run
from strandscope.core.errors import StrandscopeError

VERBS = ["simulate", "import", "calibrate", "reconstruct", "batch", "overlay", "figures", "stats", "score", "accuracy", "bench", "growth"]


def group_of(work):
    """A program with one verb, ``go``, that calls work(session)."""

    @click.group()
    @common
    def group():
        pass

    @group.command()
    @common
    @click.pass_obj
    def go(session):
        work(session)

    return group


def failing(error):
    def work(_session):
        raise error

    return group_of(work)


def test_the_verbs_are_there():
    assert set(VERBS) <= set(main_group.commands)


@pytest.mark.parametrize("verb", VERBS)
def test_help_says_what_a_verb_does_and_gives_an_example(verb, capsys):
    assert run([verb, "--help"]) == 0
    text = capsys.readouterr().out
    assert "Example" in text
    assert f"strandscope {verb}" in text
    assert main_group.commands[verb].short_help
    for option in main_group.commands[verb].params:
        assert not isinstance(option, click.Option) or option.help, option.name


def test_help_and_version_load_nothing_heavy():
    code = "import sys; from strandscope.core.cli import run; run(['--help']); run(['--version']); print(sorted(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = result.stdout.splitlines()[-1]
    assert not any(f"'{heavy}'" in loaded for heavy in ("numpy", "scipy", "numba", "skimage", "matplotlib", "rich", "bpy"))
    assert "0.1." in result.stdout


def test_without_a_verb_the_help_is_shown(capsys):
    assert run([]) == 2
    assert "Usage: strandscope" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["stats"], "Missing argument 'STRANDS'"),
        (["fly"], "No such command 'fly'"),
        (["stats", "a.npz", "--loud"], "--loud"),
        (["reconstruct", "lock", "-o", "x.npz", "--memory", "much"], "'much' is no amount of memory"),
        (["reconstruct", "lock", "-o", "x.npz", "--workers", "0"], "--workers"),
        (["reconstruct", "lock", "-o", "x.npz", "--preset", "bald"], "'bald'"),
        (["reconstruct", "lock", "-o", "x.npz", "--infill", "9", "--no-infill"], "exclude each other"),
        (["batch", "-o", "x"], "expected one or more"),
        (["batch", "lock", "-o", "x", "--infill", "9", "--no-infill"], "exclude each other"),
        (["overlay", "lock", "x.npz", "-o", "x.png", "--sweep", "1", "--angle", "15"], "exclude each other"),
        (["figures", "lock", "out", "--fiber", "3", "--height", "1"], "exclude each other"),
        (["figures", "lock", "out", "--at", "1,2"], "expected three"),
        (["import", "p", "-o", "x", "--angles", "0:340:15"], "no whole number of steps"),
        (["import", "p", "-o", "x", "--angles", "a,b"], "no list of numbers"),
        (["import", "p", "-o", "x", "--positions", "1:2:0"], "no list of numbers"),
        (["import", "p", "-o", "x", "--mosaic", "RGGB:9:1"], "does not describe a mosaic"),
        (["import", "p", "-o", "x", "--pitch-mm", "1", "--pixels-per-mm", "1"], "exclude each other"),
    ],
)
def test_wrong_use_is_one_line_and_exit_code_2(argv, said, capsys):
    assert run(argv) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert err.startswith("strandscope: ")
    assert said in err


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (StrandscopeError("x.npz: is bad;\nexpected good"), 1, "strandscope: x.npz: is bad; expected good\n"),
        (FileNotFoundError(2, "No such file or directory", "x.npz"), 1, "strandscope: x.npz: No such file or directory\n"),
        (OSError(28, "No space left on device", "x.npz"), 1, "strandscope: x.npz: the disk is full"),
        (OSError("odd"), 1, "strandscope: odd\n"),
        (MemoryError(), 1, "strandscope: there is not enough memory"),
        (KeyboardInterrupt(), 130, "strandscope: stopped\n"),
        (ZeroDivisionError("division by zero"), 1, "strandscope: an error in the program itself, ZeroDivisionError: division by zero"),
    ],
)
def test_whatever_goes_wrong_is_one_line(error, code, said, capsys):
    assert run(["go"], failing(error)) == code
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert err.startswith(said)


def test_debug_shows_where(capsys):
    assert run(["go", "--debug"], failing(ZeroDivisionError())) == 1
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("argv", [["go", "--progress", "json"], ["--progress", "json", "go"]])
def test_programs_read_one_event_a_line(argv, capsys):
    def work(session):
        for i in range(200):
            session.report("ridges", i, 200)
        session.report("ridges", 200, 200)
        session.report.show("for people only")
        session.report.done("out/strands.npz")

    assert run(argv, group_of(work)) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert events[0] == {"event": "progress", "stage": "ridges", "done": 0, "total": 200, "remaining_s": None}
    assert events[-2] | {"remaining_s": 0} == {"event": "progress", "stage": "ridges", "done": 200, "total": 200, "remaining_s": 0}
    assert events[-1] == {"event": "done", "output": "out/strands.npz"}
    assert len(events) < 50  # the rest came too soon after each other to be worth a line


def test_programs_read_errors_as_events_too(capsys):
    assert run(["go", "--progress", "json"], failing(StrandscopeError("bad"))) == 1
    out, err = capsys.readouterr()
    assert json.loads(out) == {"event": "error", "message": "bad"}
    assert err == "strandscope: bad\n"


@pytest.mark.parametrize("mode", ["auto", "rich", "none"])
def test_people_see_results_on_stdout_and_progress_on_stderr(mode, capsys):
    def work(session):
        session.report("growing", 1, 2)
        session.report("growing", 2, 2)
        session.report.show("42 curves")

    assert run(["go", "--progress", mode], group_of(work)) == 0
    out, err = capsys.readouterr()
    assert out == "42 curves\n"
    assert ("growing" in err) == (mode != "none")


@pytest.mark.parametrize("by", ["parent", "signal"])
def test_it_stops_tidily_when_its_parent_is_gone_or_asks(by, tmp_path):
    code = f"""
import sys, time
sys.path.insert(0, {os.path.dirname(__file__)!r})
from strandscope.core.cli import run
from strandscope.core.files import atomic
from test_cli import group_of
def work(session):
    with atomic({str(tmp_path / "half.txt")!r}) as part:
        part.write_text("half")
        print("ready", flush=True)
        time.sleep(60)
sys.exit(run(["go", "--stop-with-parent"], group_of(work)))
"""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], **pipes) as child:
        assert child.stdout.readline().strip() == b"ready"
        if by == "signal":
            child.send_signal(signal.SIGTERM)
            assert child.wait(20) == 130
        _, err = child.communicate(timeout=20)  # closes its standard input
    assert child.returncode == 130
    assert err.decode().strip() == "strandscope: stopped"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("text", "amount"), [("6GB", 6e9), ("800MB", 8e8), ("1.5 g", 1.5e9), ("4096", 4096), ("2GiB", 2e9)])
def test_amounts_of_memory(text, amount):
    assert cli.Memory().convert(text, None, None) == amount


@pytest.mark.parametrize(
    ("text", "numbers"),
    [("0:345:15", tuple(range(0, 360, 15))), ("1:0:-0.25", (1, 0.75, 0.5, 0.25, 0)), ("3,1,-2.5", (3, 1, -2.5)), ("24,", (24,)), ("24", 24)],
)
def test_lists_of_numbers(text, numbers):
    assert cli.Numbers(counts=True).convert(text, None, None) == pytest.approx(numbers)
