"""Jobs: children that work, fail, crash, hang, and those whose parent is gone. The children are small programs of the tests."""

import os
import subprocess
import sys
import textwrap
import time

import pytest

from strandscope.addon import jobs

WORKS = """
import json, sys
print("noise from a library")
for done in range(4):
    print(json.dumps({"event": "progress", "stage": "growing", "done": done, "total": 4, "remaining_s": 4 - done}), flush=True)
print("complaint", file=sys.stderr)
print(json.dumps({"event": "done", "output": "strands.npz"}), flush=True)
"""
FAILS = """
import json, sys
print(json.dumps({"event": "error", "message": "x.dng: the photograph is missing"}))
sys.exit(1)
"""
CRASHES = """
import json, os
print(json.dumps({"event": "progress", "stage": "growing", "done": 1, "total": 4, "remaining_s": None}), flush=True)
os.abort()
"""
IGNORES_REQUESTS = """
import signal, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print('{"event": "progress", "stage": "hanging", "done": 0, "total": 1}', flush=True)
while True:
    time.sleep(1)
"""


def job(tmp_path, program: str) -> jobs.Job:
    return jobs.Job(jobs.Command("Work", (), tmp_path / "log" / "work.log"), [sys.executable, "-c", program])


def test_work_that_succeeds(tmp_path):
    work = job(tmp_path, WORKS)
    assert str(work.wait().output) == "strands.npz"
    assert (work.stage, work.fraction, work.remaining_s) == ("growing", 0.75, 1)
    log = (tmp_path / "log" / "work.log").read_text()
    assert "noise" in log
    assert "complaint" in log
    assert "event" not in log


def test_work_that_fails_says_why(tmp_path):
    result = job(tmp_path, FAILS).wait()
    assert (result.output, result.error) == (None, "x.dng: the photograph is missing")


def test_work_that_crashes_is_told_in_words(tmp_path):
    result = job(tmp_path, CRASHES).wait()
    assert result.output is None
    assert "Work ended unexpectedly while growing" in result.error
    assert str(tmp_path / "log" / "work.log") in result.error


def test_work_that_says_nothing_has_failed(tmp_path):
    assert "unexpectedly" in job(tmp_path, "pass").wait().error


def test_work_that_ignores_a_request_is_ended(tmp_path):
    work = job(tmp_path, IGNORES_REQUESTS)
    while work.stage != "hanging":
        work.poll()
    work.stop()
    assert work.wait() == jobs.Result()
    assert work._process.returncode is not None


def test_work_does_not_outlive_its_parent(tmp_path):
    """The parent starts a job as the extension does, and is gone without a word."""
    child = "from strandscope.core.terminal import stop_with_parent; import time; stop_with_parent(); print('ready', flush=True); time.sleep(600)"
    parent = f"""
    import os, sys, time
    from pathlib import Path
    from strandscope.addon import jobs
    work = jobs.Job(jobs.Command("Work", (), Path({str(tmp_path / "work.log")!r})), [sys.executable, "-c", {child!r}])
    while "ready" not in Path({str(tmp_path / "work.log")!r}).read_text():
        time.sleep(0.05)
        sys.stdout.flush()
        if work.poll():
            os._exit(1)
    print(work._process.pid, flush=True)
    os._exit(0)
    """
    said = subprocess.run([sys.executable, "-c", textwrap.dedent(parent)], capture_output=True, text=True, check=True, timeout=60)
    pid = int(said.stdout.split()[-1])
    for _ in range(200):
        if not alive(pid):
            return
        time.sleep(0.1)
    pytest.fail("the child is still there")


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    try:  # nobody may have asked for its exit code
        with open(f"/proc/{pid}/stat", encoding="utf-8") as stat:
            return stat.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return True


def test_the_worker_runs_the_command_line(tmp_path, strands_file):
    """The real child, under the name that compiled kernels are cached by, from a folder that is not on the path."""
    command = jobs.Command("Work", ("stats", str(strands_file), "--json", str(tmp_path / "stats.json")), tmp_path / "work.log")
    result = jobs.Job(command).wait()
    assert (result.error, result.output) == (None, tmp_path / "stats.json")


def test_the_worker_reports_errors(tmp_path):
    result = jobs.Job(jobs.Command("Work", ("stats", str(tmp_path / "none.npz")), tmp_path / "work.log")).wait()
    assert "none.npz: not found" in result.error


def test_a_job_that_cannot_start_says_so(tmp_path):
    with pytest.raises(Exception, match="no_such_program"):
        jobs.Job(jobs.Command("Work", (), tmp_path / "work.log"), [str(tmp_path / "no_such_program")])
