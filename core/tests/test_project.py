"""The lock holds what the project asks for, with hashes, and says nothing of where it was made."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def lock():
    path = ROOT / "requirements.lock"
    if not path.is_file():
        pytest.skip("not in a working copy")
    return path.read_text(encoding="utf-8")


def test_the_lock_pins_every_dependency_with_hashes(lock):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked = [re.match(r"[\w.-]+", line)[0].lower() for line in project["dependencies"] + project["optional-dependencies"]["dev"]]
    entries = dict(re.findall(r"^([\w.-]+)==([^\n]*(?:\n    [^\n]*)*)", lock, re.MULTILINE))
    assert set(asked) <= set(entries)
    for name, entry in entries.items():
        assert "--hash=sha256:" in entry, name


def test_the_lock_names_no_server(lock):
    assert not re.search(r"https?://|--index|--extra-index|--find-links|@ file", lock)
