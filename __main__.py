"""``strandscope …`` and ``python -m strandscope …``."""

import sys

from .core.cli import run


def main() -> None:
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
