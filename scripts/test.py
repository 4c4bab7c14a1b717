"""All checks and tests of the project. Arguments go to pytest. Linux and macOS: ./scripts/test; Windows: py -3.13 scripts/test.py"""

import sys

from _env import python, step, tool

inside = python()
step("Style …", inside, "-m", "ruff", "check", "--quiet", ".", quiet=True)
step("Format …", inside, "-m", "ruff", "format", "--check", "--quiet", ".", quiet=True)
step("Imports flow one way …", tool("lint-imports"), "--no-logo", quiet=True)
step("Tests …", inside, "-m", "pytest", *sys.argv[1:])
