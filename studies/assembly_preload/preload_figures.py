"""Pictures of the preload study: over a revolution of the crank, each error at its worst, drive moment.

Units: crank angle deg; N and N m per deg or mm; colours and marks from `rfem_jax.report.drawings.style`.
"""

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from rfem_jax.report.drawings.pictures import write_pictures
from rfem_jax.report.drawings.style import SETTINGS, add_titles, line_style, panel_grid

AT_D = {"D.delta_x": "1 deg", "D.delta_z": "1 deg", "D.d_y": "1 mm"}
SMALL = 1e-3  # N, N m: below it an error counts as harmless


def write_figures(folder, study, joints, degrees, names, per_unit, tables) -> list[Path]:
    """Draw all pictures into `folder`; per_unit (angles, joints, 2, 3, errors) by `names`."""
    with rc_context(SETTINGS):
        figures = {
            "errors_of_joint_D": base_joint_figure(study, joints, degrees, names, per_unit),
            "moments_by_error": other_errors_figure(study, joints, degrees, names, per_unit),
            "largest_preload": peaks_figure(study, joints, tables["peaks"]),
            "drive_moment": drive_figure(study, tables["drive"]),
        }
    return write_pictures(folder, figures)


def sizes(per_unit, names, error, joint, load) -> np.ndarray:
    """Resultant over the revolution."""
    return np.linalg.norm(per_unit[:, joint, load, :, names.index(error)], axis=-1)


def closed(degrees, values):
    """A full revolution, with its start repeated at its end."""
    return np.append(degrees, degrees[0] + 360.0), np.append(values, values[0])


def angle_axis(axes) -> None:
    """Ticks of a revolution that starts with the crank up."""
    axes.set_xticks(np.arange(-90, 271, 90))
    axes.set_xlim(-90, 270)


def base_joint_figure(study, joints, degrees, names, per_unit) -> Figure:
    """Force along the hinge (alike in all joints) and moment in every joint, unit errors of D."""
    figure = Figure(figsize=(7.6, 8.6), layout="constrained")
    panels, legend = panel_grid(figure, 6)
    for k, (error, unit) in enumerate(AT_D.items()):
        style = {**line_style(k, len(degrees) + 1), "label": f"{error}, {unit}"}
        force = sizes(per_unit, names, error, joints.index("A"), 0)
        panels[0].plot(*closed(degrees, force), **style)
        for joint, axes in zip(joints, panels[1:5]):
            moment = sizes(per_unit, names, error, joints.index(joint), 1)
            axes.plot(*closed(degrees, moment), **style)
    for k, joint in enumerate(joints):
        moment = sizes(per_unit, names, "D.delta_x", joints.index(joint), 1)
        panels[5].plot(*closed(degrees, moment), label=joint, **line_style(k, len(degrees) + 1))
    panels[0].set_title("(a) resultant force, every joint", loc="left")
    panels[0].set_ylabel("force, N")
    for letter, joint, axes in zip("bcde", joints, panels[1:5]):
        axes.set_title(f"({letter}) resultant moment, joint {joint}", loc="left")
        axes.set_ylabel("moment, N m")
    panels[5].set_title("(f) moments by D.delta_x, 1 deg", loc="left")
    panels[5].set_ylabel("moment, N m")
    panels[5].legend(title="joint", ncols=2, loc=(0.42, 0.66))
    top = max(axes.get_ylim()[1] for axes in panels[1:])
    for axes in panels:
        angle_axis(axes)
        axes.set_ylim(0.0, axes.get_ylim()[1] if axes is panels[0] else top)
        axes.set_xlabel("crank angle, deg")
    legend(*panels[0].get_legend_handles_labels())
    add_titles(figure, "Assembly preload by unit errors of joint D over a revolution", study)
    return figure


def other_errors_figure(study, joints, degrees, names, per_unit) -> Figure:
    """Moments in A and D by tilts of every joint, one panel a joint with the error."""
    figure = Figure(figsize=(7.6, 8.6), layout="constrained")
    panels, legend = panel_grid(figure, 6)
    groups = [(f"tilt of the seat of {joint}", [f"{joint}.delta_x", f"{joint}.delta_z"]) for joint in joints]
    groups.append(("crooked pin of C", ["C.pin_tilt_x", "C.pin_tilt_z"]))
    groups.append(("twisted link", ["coupler.twist", "rocker.twist"]))
    for letter, axes, (_title, errors) in zip("abcdef", panels, groups):
        shown = [(error, joint) for error in errors for joint in "AD"]
        for k, (error, joint) in enumerate(shown):
            moment = sizes(per_unit, names, error, joints.index(joint), 1)
            which = ("first error named", "second error named")[errors.index(error)]
            axes.plot(
                *closed(degrees, moment),
                **line_style(k, len(degrees) + 1),
                label=f"moment in {joint}, {which}",
            )
        axes.set_title(f"({letter}) {errors[0]}, {errors[1]}", loc="left")
        axes.set_ylabel("moment, N m per deg")
        axes.set_xlabel("crank angle, deg")
        angle_axis(axes)
        axes.set_ylim(bottom=0.0)
    handles, labels = panels[0].get_legend_handles_labels()
    legend(handles, [label.replace(", ", ",\n") for label in labels])
    add_titles(figure, "Assembly preload: moments in A and D by one degree of other errors", study)
    return figure


def peaks_figure(study, joints, rows) -> Figure:
    """Largest resultants over the revolution as numbers on colours, of errors that cause any."""
    rows = [row for row in rows if max(row[f"{j}_force_N"] for j in joints) > SMALL * 100]
    rows = sorted(rows, key=lambda row: (row["per"], row["error"]))
    figure = Figure(figsize=(7.6, 1.9 + 0.21 * len(rows)), layout="constrained")
    for axes, load, unit, title in zip(
        figure.subplots(1, 2, sharey=True),
        ("force", "moment"),
        ("N", "Nm"),
        ("(a) force, N", "(b) moment, N m"),
    ):
        values = np.array([[row[f"{j}_{load}_{unit}"] for j in joints] for row in rows])
        shown = np.maximum(values, values.max() * 1e-3)
        scale = LogNorm(shown.max() / 100, shown.max())
        axes.imshow(shown, aspect="auto", cmap="Blues", norm=scale)
        for (i, j), value in np.ndenumerate(values):
            dark = value > shown.max() / 4
            axes.text(
                j,
                i,
                f"{value:.3g}" if value > SMALL else "0",
                ha="center",
                va="center",
                fontsize=7.5,
                color="white" if dark else "black",
            )
        axes.set_xticks(range(len(joints)), joints)
        axes.set_yticks(range(len(rows)), [f"{row['error']}, 1 {row['per']}" for row in rows])
        axes.tick_params(length=0)
        axes.grid(visible=False)
        axes.set_xlabel("joint")
        axes.set_title(title, loc="left")
    add_titles(figure, "Largest assembly preload over a revolution, per unit error", study)
    return figure


def drive_figure(study, rows) -> Figure:
    """Moment that holds the crank: of the perfect mechanism, and what unit errors add."""
    figure = Figure(figsize=(7.2, 6.4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    for axes, cases in ((upper, ["perfect"]), (lower, [*AT_D, "B.delta_x", "coupler.twist"])):
        for k, case in enumerate(cases):
            found = [row for row in rows if row["case"] == case]
            degrees = np.array([row["crank_angle_deg"] for row in found])
            moment = np.array([row["moment_Nm"] for row in found])
            unit = AT_D.get(case, "1 deg")
            axes.plot(
                *closed(degrees, moment),
                **line_style(k, len(degrees) + 1),
                label=case if case == "perfect" else f"{case}, {unit}",
            )
        axes.set_ylabel("moment, N m")
        angle_axis(axes)
    upper.set_title("(a) perfect mechanism: its weight", loc="left")
    lower.set_title("(b) added by a unit error", loc="left")
    lower.legend(ncols=2, fontsize=8)
    lower.set_xlabel("crank angle, deg")
    add_titles(figure, "Moment that holds the crank still", study)
    return figure
