"""How long work tells what it is doing: a callback handed in, called often, cheap."""

from typing import Protocol


class Progress(Protocol):
    """``progress(stage, done, total)``: ``done`` of ``total`` units of ``stage`` are finished. May raise to cancel."""

    def __call__(self, stage: str, done: float, total: float) -> None: ...


def silent(stage: str, done: float, total: float) -> None:
    """The callback of those who do not listen."""
