"""What ships: packed, validated, installed, enabled and disabled in Blender, without its wheels (build_extension does it with them)."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def package(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, ROOT / "scripts" / "build_extension.py", "--without-wheels", "--output-dir", out]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    return next(out.glob("strandscope-*.zip"))


def test_installs_enables_and_enables_again(package):
    assert package.is_file()  # build_extension tried it out


def test_ships_what_it_needs_and_no_more(package):
    names = zipfile.ZipFile(package).namelist()
    for needed in ("__init__.py", "__main__.py", "worker.py", "LICENSE", "addon/operators/work.py", "core/cli.py", "blender_manifest.toml"):
        assert needed in names
    for unwanted in ("tests/", "demo/", "scripts/", ".git", ".venv", "pyc", "numpy"):
        assert not [name for name in names if unwanted in name]


def test_plain_python_says_how_to_get_blender(strands_file, tmp_path):
    """Without bpy, the verbs that need it are there and say what to do, in a line."""
    program = f"""
import importlib.util, sys
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: None if name == "bpy" else found(name, *rest)
from strandscope.addon.cli import run_all
sys.exit(run_all(["blend", {str(strands_file)!r}, {str(tmp_path / "x.blend")!r}]))
"""
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert said.returncode == 1
    assert "pip install" in said.stderr
    assert len(said.stderr.splitlines()) == 1
