"""Progress of a long study that counts samples or directions.

Place in the pipeline: used by all studies that count. Shown as a line on standard error (`rfem_jax.progress_line`), or
told to a `function(done, total)`, as that by which commands show a stage (`report.tasks.task_report.as_stage`).
"""

import sys
from collections.abc import Callable
from contextlib import ExitStack

from rfem_jax.progress_line import ProgressLine

ProgressOption = bool | Callable[[int, int], object]


class ProgressBar(ExitStack):
    """Context that counts samples, or another `unit`: `advance(count)`.

    Args: progress False, True, or a function of (done, total); total number; done, the number of those that are there
        already and do not count for the remaining time; unit, a word for one of them.
    """

    def __init__(self, progress: ProgressOption, total: int, done: int = 0, unit: str = "sample"):
        super().__init__()
        self.progress, self.total, self.done, self.stage = progress, total, done, f"{total} {unit}s"
        self.tell: Callable[[int, int], object] | None = progress if callable(progress) else None

    def __enter__(self) -> "ProgressBar":
        if self.tell is None and self.progress:
            line = self.enter_context(ProgressLine(sys.stderr))
            self.tell = lambda done, total: line(self.stage, done / total if done else None)
            self.tell(self.done, self.total)
        return self

    def advance(self, count: int) -> None:
        """`count` more are done."""
        self.done += count
        if self.tell is not None:
            self.tell(self.done, self.total)
