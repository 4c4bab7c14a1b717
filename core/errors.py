"""Errors that a user can act on. Each is one line: the file, the place in it, what was found and what was expected."""


class StrandscopeError(Exception):
    """Something outside the program is wrong; the message says what, where, and what was expected."""


class CaptureError(StrandscopeError):
    """A capture, or a photograph of one, is not as section "A capture" of the file format says."""


class StrandsError(StrandscopeError):
    """A strands or truth file is damaged or holds values that no hair has."""
