"""Files: written so that a reader sees the whole of one or nothing of it, and TOML read with errors in words."""

import errno
import hashlib
import os
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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


def toml_tables(path: Path, holding: str) -> dict:
    """What a TOML file holds. Raises StrandscopeError for one that is not there, told what was expected in it, or that is not TOML."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise StrandscopeError(f"{path}: not found; expected a TOML file with {holding}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise StrandscopeError(f"{path}: not valid TOML: {error}") from error


def sha256(path: Path) -> str:
    """The SHA-256 of a file's bytes, as 64 hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync_folder(folder: Path) -> None:
    """Have the names of a folder's files on the disk, so that a power cut does not take back a renaming. Windows does so by itself."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def only_one(path: Path, busy: str) -> Iterator[None]:
    """Hold the lock file ``path`` while inside; raises StrandscopeError with the words ``busy`` where another process holds it.

    The system lets go of it when the process ends, however it ends.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise explain(error, path) from error
    try:
        for _ in range(3):  # who asks ``is_held`` holds it for a moment
            if _lock(handle):
                break
            time.sleep(0.05)
        else:
            raise StrandscopeError(busy)
        yield
    finally:
        os.close(handle)


def is_held(path: Path) -> bool:
    """Whether a living process holds the lock file ``path``."""
    try:
        handle = os.open(path, os.O_RDWR)
    except OSError:
        return False
    try:
        return not _lock(handle)
    finally:
        os.close(handle)


def _lock(handle: int) -> bool:
    with suppress(OSError):
        if os.name == "posix":
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        return True
    return False


def explain(error: OSError, path: Path) -> StrandscopeError:
    """The error of the operating system for ``path`` in words."""
    cut_short = error.errno is None and "requested and" in str(error)  # how numpy tells that a write ended early
    if cut_short or error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return StrandscopeError(f"{path}: the disk is full; nothing was written there, free some space and run again")
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return StrandscopeError(f"{path}: cannot be written here ({error.strerror}); choose a folder of your own")
    return StrandscopeError(f"{path}: {error.strerror or error}")
