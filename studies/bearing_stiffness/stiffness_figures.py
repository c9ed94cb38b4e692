"""Pictures of the study of bearing stiffness: preload over the stiffness, and which stiffness counts.

Units: stiffness across the axis in N/m; N and N m; colours and marks from `rfem_jax.report.drawings.style`.
"""

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from rfem_jax.report.drawings.pictures import write_pictures
from rfem_jax.report.drawings.style import BAR_COLOURS, SETTINGS, add_titles, bar_style, line_style, panel_grid

RANGES = (("rubber\nbushings", 1e5, 1e7), ("plain and rolling\nbearings", 1e7, 1e9))
CURVES = {"rigid": "rigid links", "flexible": "flexible links", "series": "rigid and ideal in series"}
SHOWN = (("A", "force", "N"), ("A", "moment", "Nm"), ("D", "moment", "Nm"))


def write_figures(folder, study, joints, tables) -> list[Path]:
    """Draw both pictures into `folder`."""
    with rc_context(SETTINGS):
        figures = {
            "preload_over_stiffness": sweep_figure(study, tables),
            "stiffness_that_counts": direction_figure(study, joints, tables["directions"]),
        }
    return write_pictures(folder, figures)


def title_of(joint: str, load: str) -> str:
    """What a panel shows: out of plane all joints have one force."""
    return "resultant force, every joint" if load == "force" else f"resultant moment, joint {joint}"


def sweep_figure(study, tables) -> Figure:
    """Preload over the stiffness with rigid and flexible links, and the distance from ideal joints."""
    figure = Figure(figsize=(7.6, 7.4), layout="constrained")
    panels, legend = panel_grid(figure, 4)
    for letter, axes, (joint, load, unit) in zip("abc", panels, SHOWN):
        column = f"{joint}_{load}_{unit}"
        for k, (links, label) in enumerate(CURVES.items()):
            rows = [row for row in tables["sweep"] if row["links"] == links]
            x, y = (np.array([row[name] for row in rows]) for name in ("radial_N_per_m", column))
            axes.loglog(x, y, label=label, **line_style(k, len(rows)))
        ideal = tables["ideal"][0][column]
        axes.axhline(ideal, color="#595959", linewidth=1.0, linestyle=(0, (8, 3)), label="flexible links, ideal joints")
        axes.set_ylim(ideal * 1e-3, ideal * 1e2)
        axes.set_ylabel(f"{load}, {unit.replace('Nm', 'N m')}")
        axes.set_title(f"({letter}) {title_of(joint, load)}", loc="left")
    for k, (joint, load, _) in enumerate(SHOWN):
        rows = [row for row in tables["distance"] if (row["joint"], row["load"]) == (joint, load)]
        x, y = (np.array([row[name] for row in rows]) for name in ("radial_N_per_m", "distance"))
        label = "force" if load == "force" else f"{load}, {joint}"
        panels[3].loglog(x, y, label=label, **line_style(k + 3, len(rows)))
    panels[3].loglog(x[-1] / np.array([1e3, 1.0]), y[-1] * np.array([3e2, 0.3]), color="#595959", linewidth=0.9)
    panels[3].annotate("1/k", (x[-1] / 30.0, y[-1] * 7.0), color="#595959", ha="right", va="top")
    panels[3].set_title("(d) flexible links: distance from ideal joints", loc="left")
    panels[3].set_ylabel("relative distance")
    panels[3].legend(loc="lower left")
    for axes in panels:
        low, high = x[0], x[-1]
        axes.set_xlim(low, high)
        for (_, first, last), colour in zip(RANGES, BAR_COLOURS[1:]):
            axes.axvspan(max(first, low), min(last, high), color=colour, alpha=0.25, linewidth=0)
        axes.set_xlabel("stiffness across the axis, N/m")
    for name, first, last in RANGES:
        middle = np.sqrt(max(first, x[0]) * last)
        top = panels[0].get_ylim()[1]
        panels[0].annotate(name, (middle, 0.7 * top), ha="center", va="top", fontsize=7.5)
    legend(*panels[0].get_legend_handles_labels())
    add_titles(figure, "Preload of a misaligned four-bar over the stiffness of its bearings", study)
    return figure


def direction_figure(study, joints, rows) -> Figure:
    """Logarithmic derivatives of loads by each stiffness, rigid and flexible links."""
    figure = Figure(figsize=(7.6, 4.6), layout="constrained")
    springs = list(dict.fromkeys(row["spring"] for row in rows))
    place = np.arange(len(springs))[::-1]
    for letter, axes, links in zip("ab", figure.subplots(1, 2, sharey=True, sharex=True), ("rigid", "flexible")):
        found = {row["spring"]: row for row in rows if row["links"] == links}
        for k, (joint, load, _) in enumerate(SHOWN):
            label = "force" if load == "force" else f"{load}, {joint}"
            values = [found[spring][f"{joint}_{load}"] for spring in springs]
            axes.barh(place + 0.27 * (1 - k), values, height=0.25, label=label, **bar_style(k))
        axes.set_yticks(place, springs)
        axes.axvline(0.0, color="black", linewidth=0.8)
        axes.set_title(f"({letter}) {links} links", loc="left")
        axes.set_xlabel("change in per cent by 1 %")
    figure.axes[1].legend(loc="lower right")
    add_titles(figure, "Which stiffness the preload follows", study)
    return figure
