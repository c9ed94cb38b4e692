"""Pictures of the convergence study: how many rfes, which step, and what else changes the loads.

Units: relative errors; steps s; CPU seconds of one case; derivatives N^2/deg and (N m)^2/deg.
"""

from functools import partial
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from rfem_jax import Study
from rfem_jax.report.drawings.pictures import write_pictures
from rfem_jax.report.drawings.style import SETTINGS, add_titles, bar_style, line_style, panel_grid

LOADED = ("P2", "P5")  # cases whose errors load the joints
NAMES = {
    "rms_force": "RMS force",
    "rms_moment": "RMS moment",
    "max_axial_force": "largest axial force",
    "max_normal_force": "largest normal force",
    "preload_force": "preload force",
    "preload_moment": "preload moment",
}


def write_figures(folder: Path, study: Study, tables: dict[str, list[dict]]) -> list[Path]:
    """Draw a picture for every table into `folder`."""
    drawn = {
        "rfes": rfes_figure,
        "steps": steps_figure,
        "elements": partial(difference_figure, heading="Geometrically exact against linear spring-damping elements"),
        "crank": partial(difference_figure, heading="Flexible against rigid crank (5 rfes a link)"),
        "damping": damping_figure,
    }
    with rc_context(SETTINGS):
        figures = {name: drawn[name](study, rows) for name, rows in tables.items()}
    return write_pictures(folder, figures)


def every_point(index, points) -> dict:
    """A line style with a mark at every point."""
    return {**line_style(index, points), "markevery": 1}


def accuracy_lines(axes) -> None:
    """Lines at 1 % and 0.1 %."""
    for level, text in ((1e-2, "1 %"), (1e-3, "0.1 %")):
        axes.axhline(level, color="#808080", linewidth=0.9, linestyle=":")
        axes.annotate(
            text,
            (0.01, level),
            xycoords=("axes fraction", "data"),
            ha="left",
            va="bottom",
            fontsize=8,
            color="#606060",
        )


def rfes_figure(study, rows) -> Figure:
    """Error of RMS loads against the number of elements, and its price."""
    figure = Figure(figsize=(7.6, 4.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    curves = (("P1", "rms_force"), *((c, n) for c in LOADED for n in ("rms_force", "rms_moment")))
    for k, (case, name) in enumerate(curves):
        found = [row for row in rows if (row["case"], row["metric"]) == (case, name)]
        sdes = [row["sdes"] for row in found]
        errors = [row["largest_relative_error"] for row in found]
        left.loglog(sdes, errors, label=f"{case} {NAMES[name]}", **every_point(k, len(sdes)))
    high = left.get_ylim()[1]
    second_order = 0.5 * high / (np.array(sdes) / sdes[0]) ** 2
    left.loglog(sdes, second_order, color="#909090", linewidth=2.5, alpha=0.6, label="second order")
    accuracy_lines(left)
    left.set_title("(a) error of RMS loads", loc="left")
    left.set_ylabel("relative error, largest of all joints")
    seconds = [row["cpu_s_per_case"] for row in found]
    right.semilogx(sdes, seconds, **every_point(0, len(sdes)))
    right.set_ylim(bottom=0.0)
    right.set_title("(b) cost, one step size", loc="left")
    right.set_ylabel("CPU time of one case, s")
    for axes in (left, right):
        axes.set_xticks(sdes, [str(m) for m in sdes])
        axes.minorticks_off()
        axes.set_xlabel("sdes a flexible link (rfes - 1)")
    left.legend(fontsize=7.5, loc=(0.5, 0.21))
    add_titles(figure, "How many rfes a link needs", study)
    return figure


def steps_figure(study, rows) -> Figure:
    """Error against step, and against cost: the price of an accuracy."""
    figure = Figure(figsize=(7.6, 8.2), layout="constrained")
    panels, legend = panel_grid(figure, 4)
    rows = [row for row in rows if row["largest_relative_error"] is not None]
    methods = list(dict.fromkeys(row["method"] for row in rows))
    groups = (("rms_force", "rms_moment"), ("max_axial_force", "max_normal_force"))
    for line, (names, title) in enumerate(zip(groups, ("RMS loads", "largest forces"))):
        for k, method in enumerate(methods):
            own = [row for row in rows if row["method"] == method and row["case"] in LOADED]
            steps = sorted({row["step_s"] for row in own})
            found = [[row for row in own if row["step_s"] == step] for step in steps]
            errors = [max(row["largest_relative_error"] for row in part if row["metric"] in names) for part in found]
            seconds = [part[0]["cpu_s_per_case"] for part in found]
            style = {**every_point(k, len(steps)), "label": method}
            panels[2 * line].loglog(steps, errors, **style)
            panels[2 * line + 1].loglog(seconds, errors, **style)
        for letter, axes in zip("abcd"[2 * line :], panels[2 * line :][:2]):
            axes.set_title(f"({letter}) {title}", loc="left")
            axes.set_ylabel("relative error, largest of all joints")
            accuracy_lines(axes)
        panels[2 * line].set_xlabel("step, s")
        panels[2 * line + 1].set_xlabel("CPU time of one case, s")
    legend(*panels[0].get_legend_handles_labels())
    add_titles(figure, "Which step, and what it costs (P2 and P5, 5 rfes a link, 0.5 s)", study)
    return figure


def difference_figure(study, rows, heading) -> Figure:
    """Relative difference of two variants, by quantity and joint, in per cent."""
    figure = Figure(figsize=(7.6, 7.4), layout="constrained")
    panels, legend = panel_grid(figure, len(NAMES))
    cases = list(dict.fromkeys(row["case"] for row in rows))
    joints = list(dict.fromkeys(row["joint"] for row in rows))
    width = 0.8 / len(cases)
    for letter, (name, title), axes in zip("abcdef", NAMES.items(), panels):
        for k, case in enumerate(cases):
            values = [row["relative_difference"] for row in rows if row["case"] == case and row["metric"] == name]
            heights = [100.0 * (value or 0.0) for value in values]
            places = np.arange(len(joints)) + (k - (len(cases) - 1) / 2) * width
            axes.bar(places, heights, width, label=case, **bar_style(k))
        axes.axhline(0.0, color="black", linewidth=0.7)
        axes.set_xticks(range(len(joints)), [f"joint {joint}" for joint in joints])
        axes.tick_params(axis="x", length=0)
        axes.grid(visible=False, axis="x")
        axes.set_ylabel("difference, %")
        axes.set_title(f"({letter}) {title}", loc="left")
    legend(*panels[0].get_legend_handles_labels())
    add_titles(figure, heading, study)
    return figure


def damping_figure(study, rows) -> Figure:
    """Loads and derivatives of P2 in joint A against damping, methods and steps side by side."""
    figure = Figure(figsize=(7.6, 7.4), layout="constrained")
    panels, legend = panel_grid(figure, 4)
    dampings = sorted({row["damping_s"] for row in rows})
    runs = list(dict.fromkeys((row["method"], row["step_s"]) for row in rows))
    kinds = (("force", "N", "N^2"), ("moment", "N m", "(N m)^2"))
    for column, (load, unit, square) in enumerate(kinds):
        for k, (method, step) in enumerate(runs):
            own = [
                row
                for row in rows
                if (row["method"], row["step_s"]) == (method, step) and row["load"] == load and row["joint"] == "A"
            ]
            # Side by side, so that equal values all show.
            places = [dampings.index(row["damping_s"]) + 0.12 * (k - 1.5) for row in own]
            style = {**every_point(k, len(own)), "linestyle": "none", "markersize": 7.0}
            label = f"{method}, {step:.3g} s"
            panels[column].plot(places, [row["rms"] for row in own], label=label, **style)
            derivatives = [row["derivative_of_square"] for row in own]
            panels[2 + column].plot(places, derivatives, label=label, **style)
        panels[column].set_title(f"({'ab'[column]}) RMS {load} in A", loc="left")
        panels[column].set_ylabel(f"{load}, {unit}")
        panels[2 + column].set_title(f"({'cd'[column]}) derivative of its square by D.delta_x", loc="left")
        panels[2 + column].set_ylabel(f"derivative, {square} per deg")
    for axes in panels:
        axes.set_xticks(range(len(dampings)), [f"{damping:g}" for damping in dampings])
        axes.set_xlabel("damping, s")
        axes.grid(visible=False, axis="x")
    handles, labels = panels[0].get_legend_handles_labels()
    legend(handles, [label.replace(", ", ",\n") for label in labels])
    add_titles(figure, "Effect of damping on loads and derivatives (P2)", study)
    return figure
