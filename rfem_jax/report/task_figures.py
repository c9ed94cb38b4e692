"""Pictures of tolerance studies as PNG files.

Place in the pipeline: after `tasks`; `sensitivity_figures`, `scatter_figures` and `search_figures`
draw, this module names the files. Needs matplotlib (the extra `plots`). Errors in deg and mm, as
people state them; metrics in their own units.
"""

from pathlib import Path

from matplotlib import rc_context

from rfem_jax.report.output import write_pictures
from rfem_jax.report.scatter_figures import histogram_figure, scatter_matrix_figure
from rfem_jax.report.search_figures import front_figure, tolerances_figure, worst_case_figure
from rfem_jax.report.sensitivity_figures import heat_map_figure, tornado_figure
from rfem_jax.report.style import SETTINGS


def draw_task_figures(study, name, result) -> dict:
    """All pictures of one task, {file name without ending: figure}; result as `tasks` gives it."""
    with rc_context(SETTINGS):
        if name == "sensitivity":
            figures = {"heat_map": heat_map_figure(study, result)}
            figures["tornado"] = tornado_figure(study, result)
        elif name == "monte_carlo":
            figures = {"histograms": histogram_figure(study, result)}
            figures["scatter_matrix"] = scatter_matrix_figure(study, result)
        elif name == "worst_case":
            figures = {"corners": worst_case_figure(study, result)}
        else:
            figures = {"tolerances": tolerances_figure(study, result)}
            if len(result.front) > 1:
                figures["front"] = front_figure(study, result)
    return {f"{name}_{what}": figure for what, figure in figures.items()}


def write_task_figures(folder, study, name, result) -> list[Path]:
    """Draw all pictures of one task into `folder` as PNG; returns their paths."""
    return write_pictures(folder, draw_task_figures(study, name, result))
