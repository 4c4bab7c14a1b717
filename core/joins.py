"""Curves that are one fiber, told by which of their ends are joined. End 2 c is the first point of curve c, 2 c + 1 its last."""

import numpy as np


def fibers_of(joins: np.ndarray, count: int) -> np.ndarray:
    """For each of ``count`` curves the number (count,) int64 of the fiber that it is a piece of; joins (J, 2): ends of one fiber."""
    fiber = np.arange(count)

    def root(curve):
        while fiber[curve] != curve:
            fiber[curve] = fiber[fiber[curve]]
            curve = fiber[curve]
        return curve

    for one, other in np.asarray(joins) // 2:
        a, b = sorted((root(one), root(other)))
        fiber[b] = a
    return np.unique([root(curve) for curve in range(count)], return_inverse=True)[1]
