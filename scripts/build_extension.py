"""The Blender extension as a zip in dist/. Linux and macOS: ./scripts/build_extension; Windows: py -3.13 scripts/build_extension.py

The wheels are those of requirements.lock, by hash, unmodified from the package index, kept in build/wheels. numpy is left
out: Blender has its own, and another would take its place for all extensions. The manifest in the repository lists no
wheels, since Blender wants every listed one to be there; a copy of it gets them, next to a copy of what ships.
"""

import argparse
import fnmatch
import hashlib
import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path

from _env import LOCK, PIP, ROOT, VENV, python, step

BUILD, DIST = ROOT / "build", ROOT / "dist"
MANIFEST = "blender_manifest.toml"
BLENDERS_OWN = {"numpy"}


@dataclass(frozen=True)
class Target:
    """A platform as Blender and as the package index call it, and the Pythons of the Blenders there."""

    tags: tuple[str, ...]
    pythons: tuple[str, ...]
    marker: dict  # what a requirement may ask about


TARGETS = {
    "linux-x64": Target(
        tags=(*(f"manylinux_2_{n}_x86_64" for n in range(28, 16, -1)), "manylinux2014_x86_64"),
        pythons=("3.13", "3.14"),  # blender.org's Blender, and that of Debian
        marker={"sys_platform": "linux", "platform_system": "Linux", "platform_machine": "x86_64", "os_name": "posix"},
    ),
    "windows-x64": Target(
        tags=("win_amd64",),
        pythons=("3.13",),
        marker={"sys_platform": "win32", "platform_system": "Windows", "platform_machine": "AMD64", "os_name": "nt"},
    ),
    "macos-arm64": Target(
        tags=("macosx_14_0_arm64",),
        pythons=("3.13",),
        marker={"sys_platform": "darwin", "platform_system": "Darwin", "platform_machine": "arm64", "os_name": "posix"},
    ),
}
HERE = {"Linux": "linux-x64", "Windows": "windows-x64", "Darwin": "macos-arm64"}


def main() -> None:
    parser = argparse.ArgumentParser(description="Build the Blender extension with its wheels, as a zip in dist/.")
    parser.add_argument("--platform", choices=[*TARGETS, "all"], default=HERE[platform.system()], help="default: this machine's")
    parser.add_argument("--without-wheels", action="store_true", help="a small zip for tests of installing; it cannot reconstruct")
    parser.add_argument("--output-dir", type=Path, default=DIST, help="default: dist")
    args = parser.parse_args()
    if Path(sys.prefix).resolve() != VENV.resolve():
        sys.exit(subprocess.run([python(), Path(__file__), *sys.argv[1:]], check=False).returncode)
    for name in TARGETS if args.platform == "all" else [args.platform]:
        build(name, args.output_dir.resolve(), args.without_wheels)


def build(name: str, dist: Path, without_wheels: bool) -> None:
    """Stage what ships, with the wheels of a platform, let Blender's own tool pack and validate it, and try it out here."""
    version = manifest()["version"]
    stage = BUILD / "extension" / (name + "-without-wheels" * without_wheels)
    shutil.rmtree(stage, ignore_errors=True)
    excluded = [pattern.strip("/") for pattern in manifest()["build"]["paths_exclude_pattern"]]
    shutil.copytree(ROOT, stage, ignore=lambda _, names: [n for n in names if any(fnmatch.fnmatch(n, p) for p in excluded)])
    wheels = [] if without_wheels else fetch(name)
    for wheel in wheels:
        link(wheel, stage / "wheels" / wheel.name)
    text = (ROOT / MANIFEST).read_text(encoding="utf-8")
    text = re.sub(r"^platforms = .*$", f'platforms = ["{name}"]', text, flags=re.MULTILINE)
    listed = "".join(f'  "./wheels/{file}",\n' for file in sorted({wheel.name for wheel in wheels}))
    text = text.replace("\n[permissions]", f"\nwheels = [\n{listed}]\n\n[permissions]" if wheels else "\n[permissions]", 1)
    (stage / MANIFEST).write_text(text, encoding="utf-8")
    out = dist / f"strandscope-{version}-{name.replace('-', '_')}.zip"
    dist.mkdir(parents=True, exist_ok=True)
    blender = Path(importlib.metadata.distribution("bpy").locate_file("bpy"))
    scripts = next(blender.glob("*/scripts"))
    tool = (sys.executable, scripts / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py")
    tags = f"--valid-tags={scripts / 'modules' / '_bpy_internal' / 'extensions' / 'tags.py'}"
    step(f"Packing {out.name} …", *tool, "build", tags, "--source-dir", stage, "--output-filepath", out, quiet=True)
    step("Asking Blender's validator …", *tool, "validate", tags, out, quiet=True)
    shutil.rmtree(stage)
    if name == HERE[platform.system()]:
        with tempfile.TemporaryDirectory() as resources:
            environment = os.environ | {"BLENDER_USER_RESOURCES": resources}
            check = [sys.executable, ROOT / "scripts" / "check_extension.py", out]
            print("Installing, enabling, disabling, enabling it in Blender …", end=" ", flush=True)
            result = subprocess.run(check, env=environment, check=False, capture_output=True, text=True, encoding="utf-8", errors="replace")
        print("failed" if result.returncode else "ok", flush=True)
        if result.returncode:
            sys.exit(result.stdout + result.stderr)
    print(f"{out} ({out.stat().st_size / 1e6:.0f} MB, {len({wheel.name for wheel in wheels})} wheels)", flush=True)


def manifest() -> dict:
    """The repository's manifest."""
    return tomllib.loads((ROOT / MANIFEST).read_text(encoding="utf-8"))


def fetch(name: str) -> list[Path]:
    """Download the wheels of a platform, for each Python there; those of the same lock that are there already are kept."""
    target, locked, wheels = TARGETS[name], pinned(), []
    for version in target.pythons:
        wanted = sorted(needed(target.marker | {"python_version": version, "python_full_version": f"{version}.0"}))
        text = "".join(locked[package] + "\n" for package in wanted)
        folder = BUILD / "wheels" / f"{name}-cp{version.replace('.', '')}"
        stamp, content = folder / "complete.txt", hashlib.sha256(text.encode()).hexdigest()
        if not stamp.is_file() or stamp.read_text(encoding="utf-8") != content:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            (folder / "requirements.txt").write_text(text, encoding="utf-8")
            tags = [part for tag in target.tags for part in ("--platform", tag)]
            pip = (sys.executable, *PIP, "download", "--require-hashes", "--no-deps", "--only-binary=:all:", "--implementation", "cp")
            where = ("--python-version", version, *tags, "--dest", folder, "-r", folder / "requirements.txt")
            step(f"Downloading {len(wanted)} wheels for {name}, Python {version} …", *pip, *where, quiet=True)
            stamp.write_text(content, encoding="utf-8")
        wheels += sorted(folder.glob("*.whl"))
    return wheels


def pinned() -> dict[str, str]:
    """Package -> its line of the lock, `name==version --hash=… …`."""
    entries = {}
    for entry in re.split(r"\n(?=\S)", LOCK.read_text(encoding="utf-8")):
        match = re.match(r"([a-z0-9.-]+)==([^\s;]+)", entry)
        if match:
            entries[match[1]] = " ".join([match[0], *re.findall(r"--hash=\S+", entry)])
    return entries


def needed(marker: dict) -> set[str]:
    """The packages that the project needs at run time, and those that they need, but for Blender's own."""
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found, open_ends = set(), list(project["dependencies"])
    while open_ends:
        requirement = Requirement(open_ends.pop())
        name = canonicalize_name(requirement.name)
        applies = requirement.marker is None or requirement.marker.evaluate(marker | {"extra": ""})
        if name in found | BLENDERS_OWN or not applies:
            continue
        found.add(name)
        try:
            open_ends += importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:  # of another platform (colorama); such have needs of none
            continue
    return found


def link(source: Path, target: Path) -> None:
    """The same file at another place, without a copy where the disk can."""
    target.parent.mkdir(exist_ok=True)
    if not target.exists():
        try:
            target.hardlink_to(source)
        except OSError:
            shutil.copy2(source, target)


if __name__ == "__main__":
    main()
