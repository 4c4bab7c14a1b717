"""The logbook of a capture: what was done, a line of JSON each, only ever written behind the last, and on the disk before work goes on.

Each line numbers itself and ends with a checksum (CRC-32 of what stands before it). A last line that is not whole, because the
program or the machine ended while it was written, is cut off; a damaged one in the middle stays, counts as not written, and is told.
"""

import json
import os
import threading
import zlib
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from ..files import explain, sync_folder

_MARK = b', "crc": "'


class Logbook:
    """A logbook in a file, made where there is none. ``records`` are the whole ones, in order; ``damaged`` the numbers of lines
    (from 1) that are not. Raises StrandscopeError where it cannot be written."""

    def __init__(self, path: Path):
        self.path = Path(path)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self.path, "ab", buffering=0)  # noqa: SIM115
            data = self.path.read_bytes()
            whole = data.rfind(b"\n") + 1
            self.records, self.damaged = read(data)
            if whole < len(data):
                self._file.truncate(whole)
            sync_folder(self.path.parent)
        except OSError as error:
            raise explain(error, self.path) from error
        self._torn, self._lock = False, threading.Lock()
        self._end, self._number = whole, max([len(self.records), *(record["n"] for record in self.records)])

    def __enter__(self):
        return self

    def __exit__(self, *_error) -> None:
        self._file.close()

    def write(self, what: str, **fields) -> dict:
        """Add a record with the time, and have it on the disk. Raises StrandscopeError where it cannot be; then nothing was added."""
        with self._lock:
            return self._write(what, fields)

    def _write(self, what: str, fields: dict) -> dict:
        record = {"n": self._number + 1, "time": datetime.now(UTC).isoformat(timespec="milliseconds"), "what": what, **fields}
        left = memoryview(b"\n" * self._torn + _line(record))  # a line that could not be taken back ends first
        try:
            while left:
                left = left[self._file.write(left) :]
            os.fsync(self._file.fileno())
        except OSError as error:
            self._torn = True
            with suppress(OSError):
                self._file.truncate(self._end)
                self._torn = False
            raise explain(error, self.path) from error
        self._torn = False
        self._end, self._number = self._file.tell(), record["n"]
        self.records.append(record)
        return record


def read(data: bytes) -> tuple[list[dict], list[int]]:
    """The whole records of a logbook's bytes, and the numbers of its damaged lines, from 1; what follows the last line end is no line."""
    records, damaged = [], []
    for number, line in enumerate(data.split(b"\n")[:-1], start=1):
        record = _record(line)
        if record is None:
            damaged.append(number)
        else:
            records.append(record)
    return records, damaged


def _line(record: dict) -> bytes:
    text = json.dumps(record).encode()[:-1]
    return text + _MARK + f'{zlib.crc32(text):08x}"}}\n'.encode()


def _record(line: bytes) -> dict | None:
    text, mark, tail = line.rpartition(_MARK)
    if not mark or tail != f'{zlib.crc32(text):08x}"}}'.encode():
        return None
    return json.loads(text + b"}")
