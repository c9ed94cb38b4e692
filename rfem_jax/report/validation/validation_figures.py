"""Pictures of the validation as PNG files: our curves, the references as markers.

Place in the pipeline: after `validation`; called by the command `rfem-jax validate`. Needs
matplotlib (the extra `plots`).
"""

from pathlib import Path

from matplotlib import rc_context

from rfem_jax.report.contents.annotations import Figure
from rfem_jax.report.drawings.pictures import write_pictures
from rfem_jax.report.drawings.style import CASE_COLOURS, LINE_STYLES, MARKERS, SETTINGS, new_figure
from rfem_jax.validation.lines import Picture


def validation_figure(picture: Picture) -> Figure:
    """One panel; a curve and the reference that follows it share a colour."""
    figure = new_figure(7.2, 4.6)
    axes = figure.add_subplot()
    number = -1
    for curve in picture.curves:
        number += not curve.reference
        colour = CASE_COLOURS[number % len(CASE_COLOURS)]
        if curve.reference:
            marker = MARKERS[number % len(MARKERS)]
            axes.plot(curve.x, curve.y, marker, color=colour, fillstyle="none", label=curve.label)
        else:
            style = LINE_STYLES[number % len(LINE_STYLES)]
            axes.plot(curve.x, curve.y, color=colour, linestyle=style, label=curve.label)
    axes.set_title(picture.title, loc="left")
    axes.set_xlabel(picture.x_label)
    axes.set_ylabel(picture.y_label)
    axes.legend(fontsize=8)
    return figure


def write_validation_figures(folder: str | Path, pictures: list[Picture]) -> list[Path]:
    """Draw all pictures into `folder`; returns their paths."""
    with rc_context(SETTINGS):
        figures = {one.name: validation_figure(one) for one in pictures}
    return write_pictures(folder, figures)
