"""Pictures of a study as PNG files, after the paper's Figs. 7 to 12 and two more.

Place in the pipeline: after `summary`; needs matplotlib (the extra `plots`), which draws without
a screen and whose global settings stay as they are. Times s, angles rad, forces N, moments N m,
energies J, lengths m; force components in the joint's frame H (y along a hinge, x along a guide).
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.study_file.study import Study
from rfem_jax.report.contents.annotations import Figure, Run, Summaries
from rfem_jax.report.contents.driven_motions_report import drive_quantities, has_driven_joint
from rfem_jax.report.contents.summary import in_legend, joint_names, reference_case, status_of, total_energy
from rfem_jax.report.drawings.contact_figures import orbit_figures
from rfem_jax.report.drawings.pictures import write_pictures
from rfem_jax.report.drawings.shapes import assembly_figure
from rfem_jax.report.drawings.style import SETTINGS, add_legend, add_titles, bar_style, line_style, new_figure
from rfem_jax.simulation.outcome.quantities import (
    MAX_AXIAL_FORCE,
    MAX_NORMAL_FORCE,
    PRELOAD_FORCE,
    PRELOAD_MOMENT,
    RMS_FORCE,
    RMS_MOMENT,
    Quantity,
)

MOST_BASE_JOINTS = 3
ROUNDING = 1e-6  # of the largest component: drawn as zero, as the moment about a hinge is that Newton's method leaves


class History(NamedTuple):
    """A curve of one case, and its name in the legend."""

    times: Float[np.ndarray, " times"]
    values: Float[np.ndarray, " times"]
    label: str


Histories = dict[str, History]


def history_figure(study: Study, histories: Histories, heading: str, label: str) -> Figure:
    """Curves of one quantity for all cases, and below them their differences from a reference.

    Arguments: histories, {case: its history}; heading, what is shown; label, the
    axis name with its unit. The reference is the case without errors (else the first).
    """
    reference = reference_case(study)
    others = [case for case in histories if case != reference]
    panels = 2 if others else 1
    figure = new_figure(7.2, 3.4 + 2.2 * (panels - 1))
    heights = [1.6, 1.0][:panels]
    axes = figure.subplots(panels, 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for index, (case, (times, values, name)) in enumerate(histories.items()):
        axes[0].plot(times, values, label=name, **line_style(index, len(times)))
        base_times, base, _ = histories[reference]
        if case != reference:
            # Adaptive runs save at times of their own.
            difference = values - np.interp(times, base_times, base)
            axes[1].plot(times, difference, **line_style(index, len(times)))
    axes[0].set_ylabel(label)
    add_legend(axes[0])
    if others:
        _name, unit = label.rsplit(",", 1)
        axes[1].set_ylabel(f"difference\nfrom {reference},{unit}")
    axes[-1].set_xlabel("time, s")
    add_titles(figure, heading, study)
    return figure


def component_figure(
    study: Study, runs: Mapping[str, Run], summaries: Summaries, joint: str, quantity: Quantity
) -> Figure:
    """Components of the force or the moment in `joint` without and with errors (the paper's Fig. 12).

    Arguments: quantity, RMS_FORCE or RMS_MOMENT. Shows the reference case, the case with the largest RMS in the joint
    and the last one.
    """
    load = quantity.name.removeprefix("rms_")
    reference = reference_case(study)
    others = [case.name for case in study.cases if case.name != reference]
    sizes = {case: summaries[case]["joints"][joint][quantity.name] for case in others}
    shown = [reference]
    if others:
        worst = max(others, key=lambda case: np.nan_to_num(sizes[case], nan=-1.0))
        shown += [case for case in others if case in (worst, others[-1])]
    figure = new_figure(7.2, 7.2)
    axes = figure.subplots(3, 1, sharex=True)
    order = [case.name for case in study.cases]
    loads = {case: np.asarray(getattr(runs[case].loads[joint], load)) for case in shown}
    largest = max(np.max(np.abs(values), initial=0.0, where=np.isfinite(values)) for values in loads.values())
    for case, values in loads.items():
        times = np.asarray(runs[case].times)
        name = in_legend(case, summaries[case]["status"])
        label = f"{name}, {'with' if any(summaries[case]['errors'].values()) else 'no'} errors"
        values = np.where(np.abs(values) < ROUNDING * largest, 0.0, values)
        for axis in range(3):
            style = line_style(order.index(case), len(times))
            axes[axis].plot(times, values[:, axis], label=label, **{**style, "linewidth": 0.9})
    for axis, name in zip(axes, _component_titles(study.mechanism.joint(joint).kind, load), strict=True):
        axis.set_title(name, loc="left")
        axis.set_ylabel(f"{load}, {quantity.unit}")
    add_legend(axes[0])
    axes[-1].set_xlabel("time, s")
    frame = f"{_AXIS_NAMES.get(study.mechanism.joint(joint).kind, 'joint')} frame"
    add_titles(figure, f"{load.capitalize()} in joint {joint}, {frame}, on the child link", study)
    return figure


_AXIS_NAMES = {"revolute": "hinge", "prismatic": "guide"}


def _component_titles(kind: str, load: str) -> list[str]:
    """Titles of the x, y and z component of the force or the moment in a joint."""
    axis, name = KINDS[kind].axis, _AXIS_NAMES.get(kind, "axis")
    titles = []
    for i, (number, letter) in enumerate(zip("abc", "xyz", strict=True)):
        words = f"({number}) about {letter}" if load == "moment" else f"({number}) {letter}"
        along = f", the {name}" if load == "moment" else f", along the {name}"
        titles.append(words if axis is None else words + (along if i == axis else f", across the {name}"))
    return titles


def shown_joints(study: Study, summaries: Summaries) -> list[str]:
    """Joints whose histories are drawn: those of the base (three at most), and the one with the largest RMS force and
    the one with the largest RMS moment of all cases."""
    names = [joint.name for joint in study.mechanism.joints if joint.parent == "base"][:MOST_BASE_JOINTS]
    for quantity in (RMS_FORCE, RMS_MOMENT):
        sizes = {
            name: max(np.nan_to_num(one["joints"][name][quantity.name], nan=-1.0) for one in summaries.values())
            for name in joint_names(study)
        }
        names.append(max(sizes, key=lambda name: sizes[name]))
    return list(dict.fromkeys(names))


def _load_figures(study: Study, runs: Mapping[str, Run], summaries: Summaries) -> dict[str, Figure]:
    """Forces and moments of some joints, a picture each; the first of the base is called so."""
    figures = {}
    for number, joint in enumerate(shown_joints(study, summaries)):
        name = "base_joint" if number == 0 else f"joint_{joint}"
        # A joint that turns about any axis has no moment.
        ball = KINDS[study.mechanism.joint(joint).kind].ball
        for quantity in (RMS_FORCE,) if ball else (RMS_FORCE, RMS_MOMENT):
            load = quantity.name.removeprefix("rms_")
            figures[f"{name}_{load}"] = component_figure(study, runs, summaries, joint, quantity)
    return figures


def bars_figure(
    study: Study,
    summaries: Summaries,
    panels: Sequence[tuple[Quantity, str]],
    heading: str,
    names: Sequence[str] | None = None,
) -> Figure:
    """Grouped bars, one panel per quantity: joints side by side, one bar per case.

    Arguments: panels, two or more (quantity, title); a list of components is shown by its
    resultant; names, the joints (all, if left out). A value that does not exist is marked "n/a".
    """
    names, cases = joint_names(study) if names is None else names, list(summaries)
    width = 0.84 / len(cases)
    wide = min(max(7.2, 0.17 * len(cases) * len(names) + 2.0), 24.0)
    figure = new_figure(wide, 2.9 * len(panels) + 0.9)
    all_axes = figure.subplots(len(panels), 1, squeeze=False)[:, 0]
    for letter, axes, (quantity, title) in zip("abcdef", all_axes, panels, strict=False):
        for index, case in enumerate(cases):
            joints = summaries[case]["joints"]
            values = np.array([np.linalg.norm(joints[name][quantity.name]) for name in names])
            places = np.arange(len(names)) + (index - (len(cases) - 1) / 2) * width
            heights = np.where(np.isfinite(values), values, 0.0)
            label = in_legend(case, summaries[case]["status"])
            axes.bar(places, heights, width, label=label, **bar_style(index))
            for place in places[~np.isfinite(values)]:
                axes.text(place, 0.0, " n/a", rotation=90, ha="center", va="bottom", fontsize=7)
        axes.set_xticks(np.arange(len(names)), names)
        axes.tick_params(axis="x", length=0)
        axes.grid(visible=False, axis="x")
        axes.set_xlabel("joint")
        kind = quantity.name.rsplit("_", 1)[-1]
        axes.set_ylabel(f"{kind}, {quantity.unit}")
        axes.set_title(f"({letter}) {title}", loc="left")
    add_legend(all_axes[0])
    add_titles(figure, heading, study)
    return figure


def _histories(study: Study, runs: Mapping[str, Run], values: Callable[[Run], Any]) -> Histories:
    shown = {case.name: runs[case.name] for case in study.cases}
    return {
        name: History(np.asarray(run.times), np.asarray(values(run)), in_legend(name, status_of(run)))
        for name, run in shown.items()
    }


def _motion_figures(study: Study, runs: Mapping[str, Run]) -> dict[str, Figure]:
    """Angle and rate of the driven joint (none without a drive); of several drives, or one on a translation, position,
    rate and force of each; and where the other joints of the base are that have one coordinate: the motion that comes
    out."""
    figures = _drive_figures(study, runs)
    driven = {one.joint for one in study.drives}
    outputs = [
        joint
        for joint in study.mechanism.tree_joints
        if joint.parent == "base" and joint.name not in driven and len(KINDS[joint.kind].freedoms) == 1
    ]
    for joint in outputs[:MOST_BASE_JOINTS]:
        what, unit = ("angle", "rad") if KINDS[joint.kind].angles else ("displacement", "m")
        values = _histories(
            study, runs, lambda run, joint=joint, what=what: getattr(run.motion, f"{what}s")[joint.name]
        )
        heading = f"{what.capitalize()} of joint {joint.name} ({joint.child})"
        figures[f"{what}_{joint.name}"] = history_figure(study, values, heading, f"{what}, {unit}")
    return figures


def _drive_figures(study: Study, runs: Mapping[str, Run]) -> dict[str, Figure]:
    if not has_driven_joint(study):
        return {
            one.name: history_figure(
                study,
                _histories(study, runs, one.values),
                f"{one.quantity.label.capitalize()} of {one.label}",
                one.quantity.title,
            )
            for one in drive_quantities(study)
        }
    joint = study.drives[0].joint
    of_joint = f"of joint {joint} ({study.mechanism.joint(joint).child})"
    angles = _histories(study, runs, lambda run: run.motion.angle)
    rates = _histories(study, runs, lambda run: run.motion.rate)
    return {
        "angle": history_figure(study, angles, f"Angle {of_joint}", "angle, rad"),
        "rate": history_figure(study, rates, f"Rate {of_joint}", "rate, rad/s"),
    }


def draw_figures(study: Study, runs: Mapping[str, Run], summaries: Summaries) -> dict[str, Figure]:
    """All pictures of a study, {file name without ending: figure}.

    Arguments: study as loaded; runs, {case: run of NumPy arrays}; summaries from
    `rfem_jax.report.contents.summary.summarise`.
    """
    with rc_context(SETTINGS):
        figures = _motion_figures(study, runs)
        figures["energy"] = history_figure(
            study,
            _histories(study, runs, total_energy),
            "Total mechanical energy (kinetic + elastic + gravity)",
            "energy, J",
        )
        preloads = ((PRELOAD_FORCE, "Preload force"), (PRELOAD_MOMENT, "Preload moment"))
        beside = "weight, springs, forces" if study.mechanism.forces else "weight"
        heading = f"Preload in the joints at the start ({beside} and holding moment included)"
        figures["preload"] = bars_figure(study, summaries, preloads, heading)
        with_axis = [joint.name for joint in study.mechanism.joints if KINDS[joint.kind].axis is not None]
        maxima = ((MAX_AXIAL_FORCE, "Maximum axial force"),)
        maxima += ((MAX_NORMAL_FORCE, "Maximum normal force"),)
        if with_axis:
            heading = "Maximum forces in the joints, along and across their axes"
            figures["maximum_forces"] = bars_figure(study, summaries, maxima, heading, with_axis)
        means = ((RMS_FORCE, "RMS resultant force"), (RMS_MOMENT, "RMS resultant moment"))
        figures["rms_loads"] = bars_figure(study, summaries, means, "Root mean square of the loads in the joints")
        figures |= _load_figures(study, runs, summaries)
        figures |= orbit_figures(study, runs)
        figures["assembly"] = assembly_figure(study, runs)
    return figures


def write_figures(folder: str | Path, study: Study, runs: Mapping[str, Run], summaries: Summaries) -> list[Path]:
    """Draw all pictures and write them into `folder` as PNG (200 dpi); returns their paths."""
    return write_pictures(folder, draw_figures(study, runs, summaries))
