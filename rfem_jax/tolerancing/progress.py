"""Progress of a long study: a bar with rate and remaining time.

Place in the pipeline: used by the Monte Carlo study. With tqdm when it is installed, else one line
on standard error at most every `EVERY` seconds; or the user's own `function(done, total)`.
"""

import sys
import time

EVERY = 5.0  # s


class Progress:
    """Context that counts samples: `advance(count)`.

    Args: progress False, True, or a function of (done, total); total samples; done those already
        there, which do not count for the rate.
    """

    def __init__(self, progress, total, done=0):
        self.total, self.done, self.first = total, done, done
        self.started = self.shown = time.monotonic()
        self.call = progress if callable(progress) else None
        self.plain, self.bar = False, None
        if progress and self.call is None:
            try:
                from tqdm import tqdm
            except ImportError:
                self.plain = True
            else:
                self.bar = tqdm(total=total, initial=done, unit="sample")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.bar is not None:
            self.bar.close()

    def advance(self, count):
        """`count` more samples are done."""
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
        return f"{self.done} of {self.total} samples, {rate:.3g} samples/s, {remaining:.0f} s remaining"
