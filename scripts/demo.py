"""The whole path once, into demo/. Linux and macOS: ./scripts/demo; Windows: py -3.13 scripts/demo.py"""

from _env import ROOT, python, step

strandscope = (python(), "-P", "-m", "strandscope")
demo = ROOT / "demo"
capture, truth, strands = demo / "capture", demo / "capture" / "truth.npz", demo / "strands.npz"

step("1/7 Photographing a lock of known hair (simulated) …", *strandscope, "simulate", capture, "--style", "straight", "--scale", "small")
step("2/7 Finding the hairs in the photographs …", *strandscope, "reconstruct", capture, "-o", strands, "--preset", "straight")
step("3/7 Comparing them with the hairs that are there …", *strandscope, "score", strands, truth, "--json", demo / "score.json")
step("4/7 Counting and measuring …", *strandscope, "stats", strands, "--json", demo / "stats.json")
step("5/7 Drawing them back onto a photograph …", *strandscope, "overlay", capture, strands, "-o", demo / "overlay.png")
step("6/7 Making a Blender file …", *strandscope, "blend", strands, demo / "switch.blend", "--capture", capture)
step("7/7 Rendering it beside the photograph …", *strandscope, "turntable", capture, strands, demo / "turntable.png")
print(f"Done. Look at overlay.png and turntable.png in {demo}, and open switch.blend in Blender 5.2.")
