"""The table of accuracy. Linux and macOS: ./scripts/accuracy [FOLDER] …; Windows: py -3.13 scripts/accuracy.py [FOLDER] …"""

import sys
from pathlib import Path

from _env import ROOT, python, step

given = sys.argv[1:]
folder = Path(given.pop(0)).resolve() if given and not given[0].startswith("-") else ROOT / "accuracy"
step(f"Measuring on simulated locks in {folder} …", python(), "-P", "-m", "strandscope", "accuracy", folder, *given)
