"""The virtual environment that all scripts run in: made once from requirements.lock, repaired when it is not whole.

Standard library only. ``python()`` is the interpreter to run things with; ``step`` runs one thing.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
BIN = VENV / ("Scripts" if os.name == "nt" else "bin")
LOCK = ROOT / "requirements.lock"
STAMP = VENV / "complete.txt"  # written last; says what was installed, and where
PIP = ("-m", "pip", "--quiet", "--no-input", "--disable-pip-version-check")


def python() -> Path:
    """The Python of ``.venv``, which is complete afterwards. Ends the program with one line if that cannot be."""
    if sys.version_info[:2] != (3, 13):
        sys.exit(f"Strandscope needs Python 3.13; this is {sys.version.split()[0]}. On Windows: py -3.13 {sys.argv[0]}")
    inside = BIN / ("python.exe" if os.name == "nt" else "python")
    wanted = _stamp()
    found = STAMP.read_text(encoding="utf-8") if STAMP.is_file() and inside.exists() else ""
    if found == wanted:
        return inside
    here = found.endswith(f" {ROOT}\n")  # else there is nothing, a part of something, or programs that point elsewhere
    print("Installing the packages of requirements.lock into .venv, once (some 2 GB; minutes) …" if not here else "Updating .venv …", flush=True)
    if not here:
        shutil.rmtree(VENV, ignore_errors=True)
        _run([sys.executable, "-m", "venv", VENV], "the virtual environment .venv could not be made")
    STAMP.unlink(missing_ok=True)
    failed = "the packages could not be installed (see above); is the network there, and 2 GB of disk? Then run this again"
    _run([inside, *PIP, "install", "--require-hashes", "--only-binary=:all:", "-r", LOCK], failed)
    _run([inside, *PIP, "install", "--no-deps", "--no-build-isolation", "--no-index", "--editable", ROOT], failed)
    STAMP.write_text(wanted, encoding="utf-8")
    return inside


def tool(name: str) -> Path:
    """A program of the virtual environment."""
    return BIN / (f"{name}.exe" if os.name == "nt" else name)


def step(what: str, *command, quiet: bool = False) -> None:
    """Say what is done, do it from the repository's root, end the program with its exit code if it fails.

    quiet: the command's output is shown only if it fails.
    """
    started = time.monotonic()
    print(what, end=" " if quiet else "\n", flush=True)
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "encoding": "utf-8", "errors": "replace"} if quiet else {}
    result = _call(command, cwd=ROOT, **output)
    if quiet:
        print("failed" if result.returncode else "ok", f"({time.monotonic() - started:.0f} s)", flush=True)
    if result.returncode:
        print(result.stdout or "", end="", flush=True)
        sys.exit(result.returncode if result.returncode > 0 else 1)


def _stamp() -> str:
    """What an installation depends on: the lock, the packages and programs of the project, and where it is."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    installed = json.dumps([project["build-system"], project["project"], project["tool"]["setuptools"]])
    return f"{hashlib.sha256(LOCK.read_bytes() + installed.encode()).hexdigest()} {ROOT}\n"


def _environment() -> dict:
    """Ours, without what would lead Python to other packages."""
    return {k: v for k, v in os.environ.items() if k not in {"PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "VIRTUAL_ENV"}}


def _call(command, **options) -> subprocess.CompletedProcess:
    try:
        return subprocess.run([str(part) for part in command], env=_environment(), check=False, **options)
    except KeyboardInterrupt:
        sys.exit(130)


def _run(command: list, failed: str) -> None:
    if _call(command).returncode:
        sys.exit(f"Strandscope: {failed}.")
