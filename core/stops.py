"""Why a fiber stopped growing at one of its ends."""

from enum import IntEnum


class Stop(IntEnum):
    """The values of ``stops`` in a strands file; 0 is unknown, as at the ends of infill."""

    LEFT_VOLUME = 1  # fewer than three cameras have the point in their field
    UNOBSERVED = 2  # fewer than three cameras saw the hair, longer than can be bridged
    TOO_LONG = 3  # the curve reached the longest length allowed

    @property
    def words(self) -> str:
        return self.name.lower().replace("_", " ")
