"""What the command `validate` does: compute the published benchmarks, print the table, write files.

Place in the pipeline: called by `commands.validate`; `validation` computes, `validation_tables` and
`validation_figures` show.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from rfem_jax.report.drawings.pictures import drawn
from rfem_jax.report.terminal.messages import remark, show
from rfem_jax.report.validation.validation_tables import (
    benchmark_text,
    verdict_text,
    write_validation,
)
from rfem_jax.validation.catalogue import chosen, compute
from rfem_jax.validation.lines import Benchmark, Line, Picture


class Stopped(KeyboardInterrupt):
    """The validation was interrupted: number of benchmarks that are done and written, names of the others."""

    def __init__(self, done: int, left: list[str]):
        super().__init__()
        self.done, self.left = done, left


def validate(
    names: Sequence[str] | None, full: bool, folder: Path | None, announce: Callable[..., None]
) -> tuple[list[Line], list[Path]]:
    """Compute the chosen benchmarks, print each as soon as it is there, write everything.

    Arguments: names of benchmarks (None: all); full: the lines that take long too; folder for the
    files (None: none); announce: called with what is computed and the fraction of it that is done.
    Returns: all lines, and the files written.
    Raises: InputError for an unknown name; OSError for files that cannot be written; Stopped.
    """
    started = time.perf_counter()
    benchmarks = chosen(names)
    lines: list[Line] = []
    pictures: list[Picture] = []
    numbers = {one.name: i for i, one in enumerate(benchmarks, 1)}

    def watched(benchmark: Benchmark) -> Callable[[float], None]:
        stage = f"{numbers[benchmark.name]} of {len(benchmarks)}, {benchmark.title}"
        announce(stage)
        return partial(announce, stage)

    done = 0

    def write(seconds: float) -> list[Path]:
        if folder is None or not lines:
            return []
        settings = {"benchmarks": [one.name for one in benchmarks[:done]], "full": full, "seconds": seconds}
        return write_validation(folder, lines, settings)

    try:
        for benchmark, outcome in compute(benchmarks, full, watched):
            title = benchmark.title[0].upper() + benchmark.title[1:]
            show(benchmark_text(title, outcome.lines), end="\n\n")
            lines += outcome.lines
            pictures += outcome.pictures
            done += 1
    except KeyboardInterrupt:
        write(time.perf_counter() - started)
        raise Stopped(done, [one.name for one in benchmarks[done:]]) from None
    show(verdict_text(lines))
    seconds = time.perf_counter() - started
    remark(f"Validation done after {seconds:.0f} s.")
    written = write(seconds)
    return lines, written if folder is None else written + drawn(lambda: _draw(folder, pictures))


def _draw(folder: Path, pictures: list[Picture]) -> list[Path]:
    from rfem_jax.report.validation.validation_figures import write_validation_figures

    return write_validation_figures(folder, pictures)
