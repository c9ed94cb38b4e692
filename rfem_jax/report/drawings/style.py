"""How pictures look: colours, line styles, markers and hatches that survive print.

Place in the pipeline: used by `figures`. A case is told apart by colour *and* line style *and*
marker (bars: colour and hatch), so that pictures read in black and white and for the
colour-blind. Colours: M. Okabe, K. Ito, "Color universal design" (2008).
"""

import textwrap
from collections.abc import Callable, Sequence
from typing import Any, Literal

from rfem_jax.description.study_file.study import Study
from rfem_jax.report.contents.annotations import Axes, Figure
from rfem_jax.report.contents.summary import study_note

CASE_COLOURS = ("#000000", "#D55E00", "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9")
LINE_STYLES = (
    *("-", "--", "-.", (0, (1, 1.2))),
    *((0, (6, 1.5, 1, 1.5, 1, 1.5)), (0, (9, 3)), (0, (3, 1, 3, 1, 1, 1))),
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
HATCHES = ("", "////", "....", "xxxx", "\\\\\\\\", "oo", "++")
BAR_COLOURS = ("#4D4D4D", "#F3B48B", "#8CBFE0", "#FBE3A6", "#8AD3BD", "#E8C5D8", "#CFE8F7")

SETTINGS: dict[Any, Any] = {
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.labelsize": 10,
    "figure.titlesize": 12,
    "legend.fontsize": 9,
    "legend.framealpha": 0.9,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#D9D9D9",
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "hatch.linewidth": 0.7,
    "savefig.dpi": 200,
    "savefig.facecolor": "white",
}


def new_figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    """An empty figure of this size [inches], whose parts are laid out automatically (None: by hand)."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout=layout)


def line_style(index: int, points: int) -> dict[str, Any]:
    """Arguments of `Axes.plot` for case number `index` and a curve of `points` points.

    Markers are sparse and start at another place for each case, so that curves that lie on each
    other all show.
    """
    kind = index % len(CASE_COLOURS)
    every = max(points // 8, 1)
    first = (every * (2 * kind + 1)) // (2 * len(CASE_COLOURS))
    return {
        "color": CASE_COLOURS[kind],
        # After one round of colours the line styles shift, so that pairs do not repeat.
        "linestyle": LINE_STYLES[(index + index // len(CASE_COLOURS)) % len(LINE_STYLES)],
        "marker": MARKERS[kind],
        "markevery": (min(first, points - 1), every),
        "markersize": 4.5,
        "markerfacecolor": "white",
        "linewidth": 1.3,
    }


def bar_style(index: int) -> dict[str, Any]:
    """Arguments of `Axes.bar` for case number `index`."""
    kind = index % len(BAR_COLOURS)
    return {
        "color": BAR_COLOURS[kind],
        "hatch": HATCHES[(index + index // len(HATCHES)) % len(HATCHES)],
        "edgecolor": "black",
        "linewidth": 0.6,
    }


def add_legend(axes: Axes) -> None:
    """Put the legend of the cases above the axes (and their title), where no curve runs."""
    _, labels = axes.get_legend_handles_labels()
    # About 12 characters fit into an inch; the sample and the gaps take as much as nine.
    figure: Any = axes.figure  # a figure, not a part of one
    columns = int(12 * figure.get_figwidth() / (9 + max(map(len, labels))))
    axes.legend(
        title="case",
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=min(max(columns, 1), len(labels)),
        borderaxespad=2.0 if axes.get_title(loc="left") else 0.3,
        frameon=False,
        handlelength=3,
        columnspacing=1.5,
    )


def add_titles(figure: Figure, heading: str, study: Study) -> None:
    """Put `heading` and the study's title above the figure, the study's note below it."""
    width = figure.get_figwidth()
    lines = textwrap.wrap(heading, int(11 * width)) + textwrap.wrap(study.title, int(11 * width))
    figure.suptitle("\n".join(lines), parse_math=False)  # a user's $ is a dollar
    note = textwrap.fill(study_note(study), int(15 * width))
    if note:
        figure.supxlabel(note, fontsize=7.5, color="#404040", parse_math=False)


def panel_grid(
    figure: Figure, count: int, columns: int = 2
) -> tuple[list[Axes], Callable[[Sequence[Any], Sequence[str]], None]]:
    """Axes of `count` panels in `columns` columns, and a line below them for a shared legend.

    Returns (list of axes, function that draws the legend from handles and labels).
    """
    columns = min(columns, count)
    lines = -(-count // columns)
    grid = figure.add_gridspec(lines + 1, columns, height_ratios=[1.0] * lines + [0.04 * lines])
    panels = [figure.add_subplot(grid[i // columns, i % columns]) for i in range(count)]
    below = figure.add_subplot(grid[lines, :])
    below.set_axis_off()

    def add_shared_legend(handles: Sequence[Any], labels: Sequence[str]) -> None:
        below.legend(handles, labels, loc="center", ncols=len(labels), frameon=False)

    return panels, add_shared_legend
