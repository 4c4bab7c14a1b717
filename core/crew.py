"""Who does to many seeds or curves what is the same for each: the threads of this process, or those of a cluster (``cluster.py``)."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from .features import USED, Index


class Threads:
    """Threads that look at one index together. Which observations are used up is changed here alone, between two maps."""

    ahead = 1  # batches of seeds that it pays to grow before it is known whether one of them changes what the next see

    def __init__(self, index: Index, count: int = 1):
        self.index, self.pool = index, ThreadPoolExecutor(count)

    def __enter__(self):
        return self

    def __exit__(self, *_error) -> None:
        self.pool.shutdown(cancel_futures=True)

    def each(self, function: Callable, items: Sequence, *arguments) -> list:
        """function(index, item, *arguments) of every item, in order. A function of a module, so that it can run elsewhere."""
        return self.here(lambda item: function(self.index, item, *arguments), items)

    def here(self, function: Callable, items: Sequence) -> list:
        """function(item) of every item, in order, in this process."""
        return list(self.pool.map(function, items))

    def free(self) -> None:
        """No observation is used up."""
        self.index.strength[:] &= USED - 1

    def use(self, numbers: np.ndarray) -> None:
        """Observations (n,) are used up."""
        self.index.strength[numbers] |= USED
