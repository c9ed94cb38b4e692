"""How pictures are drawn and written: by this process, and by another one beside it.

Place in the pipeline: figures -> **pictures** -> PNG files.

matplotlib holds Python's lock while it draws, so that threads gain nothing.  A command that has much to draw starts
another process early (`draw_beside`), which has imported matplotlib when the figures are there:

    first figures --> drawn here, compressed in a thread
    last figures ---> pickled --> drawn and compressed by the other process (this file, run as a program)

Without it, and where it fails, everything is drawn here.
"""

import atexit
import importlib.util
import os
import pickle
import signal
import subprocess
import sys
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import UInt8

from rfem_jax.compilation.stages import on_stage
from rfem_jax.report.contents.annotations import Figure
from rfem_jax.report.terminal.messages import note
from rfem_jax.whole_files import replacing

Pixels = UInt8[np.ndarray, "height width 4"]
Waiting = deque[tuple[str, Figure]]


PLOTS_HINT = 'No pictures were drawn: matplotlib is not installed (pip install "rfem_jax[plots]").'


def drawn(write: Callable[[], list[Path]]) -> list[Path]:
    """The files of pictures that `write` draws and writes; none where matplotlib is missing, which is said."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        note(PLOTS_HINT)
        return []
    on_stage("Drawing pictures")
    return write()


def write_pictures(folder: str | Path, figures: Mapping[str, Figure]) -> list[Path]:
    """Write {name: figure} into `folder` as PNG (200 dpi), each into a file of its own where upper and lower case count
    as equal, too; returns their paths. Raises: OSError."""
    from matplotlib import rc_context

    from rfem_jax.report.drawings.style import SETTINGS

    paths, waiting = _paths(Path(folder), figures), deque(figures.items())
    with rc_context(SETTINGS), ThreadPoolExecutor(2) as pool:
        try:
            beside = pool.submit(_draw_last, waiting, paths, SETTINGS)
            # A picture is compressed while the next one is drawn.
            written = [
                pool.submit(_write_picture, paths[name], _drawn(figure), figure.dpi)
                for name, figure in _first_ones(waiting)
            ]
            for name, figure in beside.result():
                _write_picture(paths[name], _drawn(figure), figure.dpi)
        finally:
            waiting.clear()
    for one in written:
        one.result()
    return list(paths.values())


def _paths(folder: Path, names: Iterable[str]) -> dict[str, Path]:
    """{name: file}; the second of joints "a" and "A", say, has a number."""
    found: dict[str, Path] = {}
    for name in names:
        taken = {one.name.lower() for one in found.values()}
        numbered = (f"{name}{number}.png" for number in ("", *(f"_{i}" for i in range(2, len(taken) + 2))))
        found[name] = folder / next(one for one in numbered if one.lower() not in taken)
    return found


def draw_beside() -> None:
    """Start the other process, unless it would gain nothing or cannot be started."""
    global _other
    if _other is None and (os.cpu_count() or 1) > 1 and importlib.util.find_spec("matplotlib") is not None:
        with suppress(OSError):
            _other = _OtherProcess()


class _OtherProcess:
    """Draws one figure after the other, and ends with this process."""

    def __init__(self):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, env=environment,
        )  # fmt: skip
        atexit.register(self.end)

    def draw(self, path: Path, figure: Figure, settings: Mapping[Any, Any]) -> bool:
        """Whether it has written the picture. Raises: OSError as writing it here would."""
        to, back = self.process.stdin, self.process.stdout
        assert to is not None and back is not None
        try:
            to.write(pickle.dumps((path.absolute(), figure, dict(settings))))
            to.flush()
            problem = pickle.load(back)
        except Exception:  # the process is gone, or the figure has parts that cannot be sent
            return False
        if isinstance(problem, OSError):
            raise problem
        return problem is None

    def end(self) -> None:
        """End it, without waiting for what it may still import: `draw` returns when a picture is written."""
        with suppress(OSError, KeyboardInterrupt):
            self.process.kill()
            self.process.communicate()


_other: _OtherProcess | None = None


def _first_ones(waiting: Waiting) -> Iterator[tuple[str, Figure]]:
    """Takes figures from the front, until none is left."""
    with suppress(IndexError):
        while True:
            yield waiting.popleft()


def _draw_last(waiting: Waiting, paths: Mapping[str, Path], settings: Mapping[Any, Any]) -> list[tuple[str, Figure]]:
    """Takes figures from the end, for the other process; returns what it could not draw."""
    with suppress(IndexError):
        while _other is not None:
            name, figure = waiting.pop()
            if not _other.draw(paths[name], figure, settings):
                return [(name, figure)]
    return []


def _drawn(figure: Figure) -> Pixels:
    """The pixels that `Figure.savefig` writes, with the layout found once: it draws a figure twice for it."""
    from matplotlib import rcParams
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set_dpi(rcParams["savefig.dpi"])
    figure.set_facecolor(rcParams["savefig.facecolor"])
    canvas = FigureCanvasAgg(figure)
    with warnings.catch_warnings():
        # Characters of titles and names that the font lacks are drawn as boxes.
        warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from font")
        if (engine := figure.get_layout_engine()) is not None:
            engine.execute(figure)
            figure.set_layout_engine("none")
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def _write_picture(path: Path, pixels: Pixels, dpi: float) -> None:
    """Write a PNG file, without a channel that is opaque everywhere; zlib's usual level would take five times as long
    for files a fifth smaller."""
    from PIL import Image

    with replacing(path) as temporary:
        opaque = Image.fromarray(pixels).convert("RGB")
        opaque.save(temporary, format="png", dpi=(dpi, dpi), compress_level=1)


def _draw_for_another(orders: BinaryIO, answers: BinaryIO) -> None:
    """Draw what comes, until nothing does; answers None for each picture, or what went wrong."""
    import matplotlib.backends.backend_agg
    import matplotlib.figure
    import PIL.Image  # noqa: F401  # while there is nothing to do yet

    while True:
        try:
            path, figure, settings = pickle.load(orders)
        except EOFError:
            return
        problem = None
        try:
            with matplotlib.rc_context(settings):
                _write_picture(path, _drawn(figure), figure.dpi)
        except Exception as raised:
            problem = raised if isinstance(raised, OSError) else repr(raised)
        answers.write(pickle.dumps(problem))
        answers.flush()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the command that is interrupted ends this process
    _draw_for_another(sys.stdin.buffer, sys.stdout.buffer)
