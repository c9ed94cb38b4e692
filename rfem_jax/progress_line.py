"""How far a long computation is, in one line.

On a terminal the line is rewritten every second, with the time that the stage takes and, where it is known, what
remains; elsewhere there are plain lines: for a stage that takes longer than a moment, then every quarter of it and
twice a minute.
"""

import shutil
import threading
import time

PATIENCE = 0.5  # s that a stage takes before it is worth a line of its own in a log
TICK = 1.0  # s
SILENCE = 30.0  # s in a log, at most
SURE = 0.02  # of a stage done before the remaining time can be told


class ProgressLine:
    """Context in which an instance is told what is being done: called with the name of a stage and, from time to time,
    the fraction of it that is done (0 to 1).

    **Arguments:** `stream` that is written to; `patience` [s].
    """

    def __init__(self, stream, patience: float = PATIENCE):
        self.stream, self.patience = stream, patience
        self.live = stream.isatty()
        self.stage, self.done, self.shown = None, None, True
        self.began = time.monotonic()
        self.first = (self.began, 0.0)
        self.printed = self.began
        self.width = 0
        # Stages are reported by the threads of a batch too, late or twice.
        self.lock = threading.RLock()
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._tick, daemon=True)

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.ended.set()
        self.thread.join()
        self.clear()

    def __call__(self, stage: str, done: float | None = None) -> None:
        """A stage begins, or a fraction `done` of it is."""
        with self.lock:
            if stage != self.stage:
                self.stage, self.done, self.shown = stage, None, False
                self.began = time.monotonic()
            if done is not None:
                if self.done is None:
                    self.first = (time.monotonic(), done)
                before, self.done = self.done or 0.0, max(min(done, 1.0), self.done or 0.0)
                if not self.live and int(4.0 * self.done) > int(4.0 * before):
                    self._print_line()
            if self.live:
                self._rewrite()

    def clear(self) -> None:
        """Take the line off the terminal."""
        with self.lock:
            if self.width:
                self._write("\r" + " " * self.width + "\r")
            self.width = 0

    def text(self) -> str:
        """The stage, its time, and what remains."""
        seconds = time.monotonic() - self.began
        if self.done is None:
            return f"{self.stage} ..." + (f" {seconds:.0f} s" if seconds >= TICK else "")
        # Counted from the first report: what went before was compilation, or is the work of an earlier run.
        started, first = self.first
        left = ""
        if self.done - first > SURE and self.done < 1.0:
            left = (time.monotonic() - started) * (1.0 - self.done) / (self.done - first)
            left = f", {left:.0f} s remaining"
        return f"{self.stage}: {int(100.0 * self.done):3d} % after {seconds:.1f} s{left}"

    def _tick(self):
        while not self.ended.wait(TICK if self.live else 0.2 * self.patience):
            with self.lock:
                if self.stage is None:
                    continue
                if self.live:
                    self._rewrite()
                    continue
                new = not self.shown and time.monotonic() - self.began >= self.patience
                if new or time.monotonic() - self.printed >= SILENCE:
                    self._print_line()

    def _rewrite(self):
        text = self.text()[: shutil.get_terminal_size().columns - 1]
        self._write(f"\r{text:<{self.width}}")
        self.width = len(text)

    def _print_line(self):
        self.shown, self.printed = True, time.monotonic()
        self._write(f"{self.text()}\n")

    def _write(self, text):
        self.stream.write(text)
        self.stream.flush()
