"""Picture of the comparison: what every answer costs, in mass and in tolerances.

Units: the objective's own, mass by its weight.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib import rc_context

from rfem_jax import Study
from rfem_jax.report.drawings.pictures import write_pictures
from rfem_jax.report.drawings.style import CASE_COLOURS, SETTINGS, add_titles, new_figure


def write_figure(folder: Path, study: Study, rows: Sequence[Mapping[str, Any]]) -> list[Path]:
    """Draw `cost_of_every_way.png` into `folder`: a bar for every way that keeps the limits."""
    with rc_context(SETTINGS):
        figure = new_figure(7.2, 0.5 * len(rows) + 1.8)
        axes = figure.subplots()
        for place, row in enumerate(reversed(rows)):
            mass = row["objective"] - row["cost"]
            good = row["status"] == "ok"
            shade = 1.0 if good else 0.3
            axes.barh(place, mass, color=CASE_COLOURS[0], alpha=shade, label="mass" if place == 0 else None)
            axes.barh(
                place, row["cost"], left=mass, color=CASE_COLOURS[1], alpha=shade,
                label="tolerances" if place == 0 else None,
            )  # fmt: skip
            text = f" {row['objective']:.3g}" + ("" if good else f" ({row['status'].replace('_', ' ')})")
            axes.text(row["objective"], place, text, va="center")
        axes.set_yticks(range(len(rows)), [row["way"] for row in reversed(rows)])
        axes.set_xlabel("cost of mass and of tolerances")
        axes.margins(x=0.35)
        axes.grid(visible=False, axis="y")
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
        add_titles(figure, "What dimensions and tolerances cost, found in several ways", study)
    return write_pictures(folder, {"cost_of_every_way": figure})
