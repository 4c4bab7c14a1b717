"""``strandscope …`` and ``python -m strandscope …``."""

import sys

from .addon.cli import run_all


def main() -> None:
    sys.exit(run_all(sys.argv[1:]))


if __name__ == "__main__":
    main()
