"""How far a simulation is, in one line.

Place in the pipeline: `run_cases` and validation -> **progress line** -> the person who waits.
"""

import time


class Progress:
    """How far a simulation is, on `stream`: one line that is rewritten, or four in a log file.

    An instance is the callable `progress` of `run_cases`: it takes the fraction done (0 to 1).
    """

    def __init__(self, label, stream):
        self.label, self.stream = label, stream
        self.live = stream.isatty()
        self.started = time.perf_counter()
        self.percent = 0
        self._write(f"{label}: compiling ...")

    def __call__(self, fraction):
        percent = int(100.0 * min(max(float(fraction), 0.0), 1.0))
        step = 1 if self.live else 25
        # Reports come from the threads of a batch, late or twice.
        if percent // step <= self.percent // step:
            return
        self.percent = percent
        seconds = time.perf_counter() - self.started
        self._write(f"{self.label}: {percent:3d} % after {seconds:.1f} s")

    def close(self):
        """End the line, so that what is printed next starts on its own."""
        if self.live:
            self.stream.write("\n")

    def _write(self, text):
        self.stream.write(f"\r{text:<60}" if self.live else f"{text}\n")
        self.stream.flush()
