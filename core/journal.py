"""What long work has found so far, in a file that only grows, so that a run that was cut short goes on behind the last of it.

A line that tells what the work is made from, then records: length (8 bytes), checksum (4), and arrays by their names as .npz. A
record that is not whole, because the program or the machine ended while it was written, ends the journal; it is cut off.
"""

import io
import os
import struct
import time
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from .files import explain

HEAD = struct.Struct("<QI")  # bytes of a record, their CRC-32
EVERY_S = 2.0  # between two records of work that is noted piece by piece


class Unwritten:
    """The journal of those who keep none."""

    kept = due = False

    def next(self, _kind: str) -> Mapping | None:
        """The next record of the earlier run, if it is of this kind."""
        return None

    def ahead(self, _kind: str) -> bool:
        """Whether a record of this kind is still to come from the earlier run."""
        return False

    def write(self, kind: str, **arrays: np.ndarray) -> None:
        """Note arrays under their names."""

    def delete(self) -> None:
        """The work is done."""


class Journal(Unwritten):
    """A journal in a file, opened to be read from its beginning and then written on. One that was ``made_from`` something else is
    begun anew. Raises StrandscopeError where it cannot be written."""

    kept = True

    def __init__(self, path: Path, made_from: str):
        self.path, first = Path(path), f"strandscope journal of {made_from}\n".encode()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self.path, "r+b" if self.path.exists() else "w+b", buffering=0)  # noqa: SIM115
            if self._file.read(len(first)) != first:
                self._file.seek(0)
                self._file.truncate()
                self._append(first)
            self._at = self._file.tell()
            self._kinds = self._whole_records()
        except OSError as error:
            raise explain(error, self.path) from error
        self._written = time.monotonic()

    def __enter__(self):
        return self

    def __exit__(self, *_error) -> None:
        self._file.close()

    @property
    def due(self) -> bool:
        """Whether it is time to write down what was found since the last record."""
        return time.monotonic() - self._written > EVERY_S

    def next(self, kind: str) -> Mapping | None:
        if not self._kinds or self._kinds[0] != kind:
            return None
        self._kinds.pop(0)
        return _unpacked(self._read(self._at, move=True))

    def ahead(self, kind: str) -> bool:
        return kind in self._kinds

    def write(self, kind: str, **arrays: np.ndarray) -> None:
        """Note arrays under their names. What was not read of the earlier run is dropped."""
        packed = io.BytesIO()
        np.savez(packed, kind=np.array(kind), **arrays)
        record = packed.getvalue()
        try:
            if self._kinds:
                self._kinds.clear()
                self._file.truncate(self._at)
            self._file.seek(self._at)
            self._append(HEAD.pack(len(record), zlib.crc32(record)) + record)
            self._at = self._file.tell()
        except OSError as error:
            raise explain(error, self.path) from error
        self._written = time.monotonic()

    def delete(self) -> None:
        self._file.close()
        self.path.unlink(missing_ok=True)
        with suppress(OSError):
            self.path.parent.rmdir()  # where nothing else is left in it

    def _append(self, data: bytes) -> None:
        left = memoryview(data)
        while left:
            left = left[self._file.write(left) :]

    def _read(self, at: int, move: bool = False) -> bytes | None:
        """The record at a place, None if there is no whole one."""
        self._file.seek(at)
        head = self._bytes(HEAD.size)
        if len(head) < HEAD.size:
            return None
        size, checksum = HEAD.unpack(head)
        if not 0 < size <= os.fstat(self._file.fileno()).st_size - self._file.tell():
            return None
        record = self._bytes(size)
        if zlib.crc32(record) != checksum:
            return None
        if move:
            self._at = self._file.tell()
        return record

    def _bytes(self, size: int) -> bytes:
        """So many bytes from where the file stands, or what there is; the system may hand them out in parts."""
        parts = []
        while size > 0 and (part := self._file.read(size)):
            parts.append(part)
            size -= len(part)
        return b"".join(parts)

    def _whole_records(self) -> list[str]:
        """The kinds of all whole records; what comes after them is cut off."""
        kinds, at = [], self._at
        while (record := self._read(at)) is not None:
            kinds.append(str(_unpacked(record)["kind"]))
            at = self._file.tell()
        self._file.truncate(at)
        return kinds


def _unpacked(record: bytes) -> Mapping:
    with np.load(io.BytesIO(record), allow_pickle=False) as arrays:
        return dict(arrays)
