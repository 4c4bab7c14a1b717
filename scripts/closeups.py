"""Close-ups of infills beside the truth, with Blender for Python:

.venv/bin/python -P scripts/closeups.py OUT.png [--tilt DEG] [--section MM] --row TITLE TRUTH.npz PAPER.npz OURS.npz [--row …]
"""

import argparse
from pathlib import Path

from strandscope.addon.closeup import CloseupParams, Row, render_closeups

parser = argparse.ArgumentParser(description="Renders captured curves, the paper's infill, ours, and the truth side by side.")
parser.add_argument("out", type=Path)
parser.add_argument("--row", nargs=4, action="append", required=True, metavar=("TITLE", "TRUTH", "PAPER", "OURS"))
parser.add_argument("--section", type=float, metavar="MM", help="a slab of this thickness, from above")
parser.add_argument("--tilt", type=float, metavar="DEG", help="0 from the front, 90 from above; a section is seen from above")
parser.add_argument("--field", type=float, nargs=2, default=(6.0, 4.6), metavar=("MM", "MM"), help="width and height of what is seen")
parser.add_argument("--width", type=int, default=410, metavar="PX")
parser.add_argument("--samples", type=int, default=36)
given = parser.parse_args()
rows = [Row(title, Path(truth), Path(paper), Path(ours)) for title, truth, paper, ours in given.row]
tilt = given.tilt if given.tilt is not None else 90.0 if given.section else 0.0
params = CloseupParams(*given.field, given.width, given.samples, tilt_deg=tilt, slab_mm=given.section)
print(render_closeups(rows, given.out, params, lambda stage, done, total: print(f"{stage} {done}/{total}", flush=True)))
