"""What a capture survives. Linux and macOS: ./scripts/rig_faults [FOLDER] …; Windows: py -3.13 scripts/rig_faults.py [FOLDER] …"""

import sys
from pathlib import Path

from _env import ROOT, python, step

given = sys.argv[1:]
folder = Path(given.pop(0)).resolve() if given and not given[0].startswith("-") else ROOT / "rig_faults"
step(f"Injecting faults into virtual captures in {folder} …", python(), "-P", "-m", "strandscope.core.rig_faults", folder, *given)
