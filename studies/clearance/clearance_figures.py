"""Pictures of the clearance study: loads of all joints over the clearance, their scatter over tolerances, motion.

Units: clearance um; N and N m; colours and marks from `rfem_jax.report.drawings.style`.
"""

from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

from rfem_jax.report.drawings.pictures import write_pictures
from rfem_jax.report.drawings.style import SETTINGS, add_titles, line_style

PANELS = (("force", "N", "N"), ("moment", "Nm", "N m"))


def write_figures(folder: Path, study, joints, tables) -> list[Path]:
    """Draw both pictures into `folder`."""
    with rc_context(SETTINGS):
        figures = {
            "loads_over_clearance": sweep_figure(study, joints, tables["sweep"]),
            "scatter_over_clearance": batch_figure(study, tables["batch"]),
        }
    return write_pictures(folder, figures)


def sweep_figure(study, joints, rows) -> Figure:
    """Force and moment of every joint for one set of errors."""
    figure = Figure(figsize=(7.6, 3.8), layout="constrained")
    clearances = [row["radial_um"] for row in rows]
    for axes, (load, unit, shown) in zip(figure.subplots(1, 2), PANELS, strict=True):
        for k, joint in enumerate(joints):
            values = [row[f"{joint}_{load}_{unit}"] for row in rows]
            axes.plot(clearances, values, label=joint, **line_style(k, len(rows)))
        axes.set_xlabel("radial clearance of D, um")
        axes.set_ylabel(f"preload {load}, {shown}")
        axes.legend(title="joint")
    add_titles(figure, "What play takes from the preload: errors of case P5", study)
    return figure


def batch_figure(study, rows) -> Figure:
    """Mean and 95 % load of joint D over its clearance, and how many ends of the pin carry."""
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    panels = figure.subplots(1, 3)
    clearances = [row["radial_um"] for row in rows]
    for axes, (load, unit, shown) in zip(panels, PANELS, strict=False):
        for k, (column, name) in enumerate((("mean", "mean"), ("95_percent", "95 % quantile"))):
            values = [row[f"D_{load}_{column}_{unit}"] for row in rows]
            axes.plot(clearances, values, label=name, **line_style(k, len(rows)))
        axes.set_ylabel(f"{load} in D, {shown}")
        axes.legend()
    for k, count in enumerate(("none", "one", "both")):
        values = [100.0 * row[f"share_{k}_ends"] for row in rows]
        panels[2].plot(clearances, values, label=f"{count}", **line_style(k, len(rows)))
    panels[2].set_ylabel("share of the pins, %")
    panels[2].legend(title="ends that carry")
    for axes in panels:
        axes.set_xlabel("radial clearance, um")
    add_titles(figure, "Errors within their tolerances: load of joint D over its clearance", study)
    return figure


def write_motion(folder: Path, study, rows) -> list[Path]:
    """Draw what joint D carries in motion over its clearance into `folder`."""
    with rc_context(SETTINGS):
        figure = Figure(figsize=(7.6, 3.6), layout="constrained")
        clearances = [row["radial_um"] for row in rows]
        panels = (("rms_force_N", "RMS force in D, N"), ("largest_force_N", "largest force in D, N"))
        for axes, (column, label) in zip(figure.subplots(1, 2), panels, strict=True):
            for k, (kind, name) in enumerate((("mean", "mean"), ("95_percent", "95 % quantile"))):
                values = [row[f"{kind}_{column}"] for row in rows]
                axes.plot(clearances, values, label=name, **line_style(k, len(rows)))
            axes.set_xlabel("radial clearance, um")
            axes.set_ylabel(label)
            axes.set_ylim(bottom=0.0)
            axes.legend()
        add_titles(figure, "Too little play preloads joint D, too much lets its pin strike", study)
    return write_pictures(folder, {"motion_over_clearance": figure})
