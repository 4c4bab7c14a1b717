"""Writing files so that a reader sees the whole of one or nothing of it."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import StrandscopeError


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` with the same ending; on success it becomes ``path``, else it is removed.

    Raises StrandscopeError where the disk is full or the folder cannot be written.
    """
    path = Path(path)
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        with open(part, "rb") as written:
            os.fsync(written.fileno())
        os.replace(part, path)
    except OSError as error:
        raise explain(error, path) from error
    finally:
        part.unlink(missing_ok=True)


def explain(error: OSError, path: Path) -> StrandscopeError:
    """The error of the operating system for ``path`` in words."""
    cut_short = error.errno is None and "requested and" in str(error)  # how numpy tells that a write ended early
    if cut_short or error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return StrandscopeError(f"{path}: the disk is full; nothing was written there, free some space and run again")
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return StrandscopeError(f"{path}: cannot be written here ({error.strerror}); choose a folder of your own")
    return StrandscopeError(f"{path}: {error.strerror or error}")
