"""The program that Blender starts beside itself for long work: `python worker.py VERB …`, or inside `blender -b --python`.

It loads this folder as the package ``strandscope``, under that name wherever it is installed, so that compiled kernels are
found again in their cache, and runs the command line. It is loaded when a pool of processes imports this file, too.
"""

import importlib.util
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent
NAME = "strandscope"


def load() -> None:
    """Make this folder importable as ``strandscope``, unless it is already."""
    if NAME in sys.modules:
        return
    spec = importlib.util.spec_from_file_location(NAME, ROOT / "__init__.py", submodule_search_locations=[str(ROOT)])
    package = importlib.util.module_from_spec(spec)
    sys.modules[NAME] = package
    spec.loader.exec_module(package)


def main() -> int:
    """Run the command line after ``--`` (in Blender) or all of it (in Python); returns its exit code."""
    arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    return importlib.import_module(f"{NAME}.addon.cli").run_all(arguments)


load()
if __name__ == "__main__":
    sys.exit(main())
