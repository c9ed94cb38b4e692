"""Progress of a long study: a bar with rate and remaining time.

Place in the pipeline: used by all studies that count samples or directions. Shown with tqdm if it is installed, else
as one line on standard error at most every `EVERY` seconds; or told to a `function(done, total)`, as that by which
commands show a stage (`report.tasks.task_report.as_stage`).
"""

import sys
import time
from collections.abc import Callable
from types import TracebackType

EVERY = 5.0  # s

ProgressOption = bool | Callable[[int, int], object]


class ProgressBar:
    """Context that counts samples, or another `unit`: `advance(count)`.

    Args: progress False, True, or a function of (done, total); total number; done, the number of those that are there
        already and do not count for the rate; unit, a word for one of them.
    """

    def __init__(self, progress: ProgressOption, total: int, done: int = 0, unit: str = "sample"):
        self.total, self.done, self.first = total, done, done
        self.unit = unit
        self.started = self.shown = time.monotonic()
        self.call = progress if callable(progress) else None
        self.plain, self.bar = False, None
        if progress and self.call is None:
            try:
                from tqdm import tqdm
            except ImportError:
                self.plain = True
            else:
                self.bar = tqdm(total=total, initial=done, unit=unit)

    def __enter__(self) -> "ProgressBar":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.bar is not None:
            self.bar.close()

    def advance(self, count: int) -> None:
        """`count` more are done."""
        self.done += count
        if self.call is not None:
            self.call(self.done, self.total)
        elif self.bar is not None:
            self.bar.update(count)
        elif self.plain:
            now = time.monotonic()
            if now - self.shown >= EVERY or self.done >= self.total:
                self.shown = now
                print(self._line(now), file=sys.stderr, flush=True)

    def _line(self, now):
        rate = (self.done - self.first) / max(now - self.started, 1e-9)
        remaining = (self.total - self.done) / max(rate, 1e-9)
        return f"{self.done} of {self.total} {self.unit}s, {rate:.3g} {self.unit}s/s, {remaining:.0f} s remaining"
