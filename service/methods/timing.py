"""Wall-clock time of a run by named section, printed as a tree at the end."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class Timing:
    """Seconds by name; ``with timing("learn"): ...`` adds to it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        """Seconds spent in each named section, in order of first use."""
        self._start = time.perf_counter()

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Count the time of a ``with`` block under ``name``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] += time.perf_counter() - start

    def tree(self) -> str:
        """A line per section with its seconds and its share of the time since this object was made."""
        total = time.perf_counter() - self._start
        lines = [f"total {total:9.1f} s"]
        lines += [f"  {name:<18}{spent:9.1f} s {100 * spent / total:5.1f} %" for name, spent in self.seconds.items()]
        other = total - sum(self.seconds.values())
        return "\n".join([*lines, f"  {'other':<18}{other:9.1f} s {100 * other / total:5.1f} %"])
