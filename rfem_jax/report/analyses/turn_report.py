"""The kinetostatic turn of the cases of a study: computed, printed, written and drawn.

Place in the pipeline: study, model -> `simulation.rest.turn` -> **turn_report** -> files.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.compilation.program import Program
from rfem_jax.description.metrics.catalogue import records_for
from rfem_jax.description.metrics.shaking_metrics import RECORD
from rfem_jax.description.study_file.study import Study
from rfem_jax.labelled_data import text_of
from rfem_jax.mechanics.forces.bush_contacts import CLOSED, CONTACT_NAMES, carrying
from rfem_jax.mechanics.model.errors import Deviations
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.planar_loops import model_reactions_text
from rfem_jax.report.analyses.analysis import errors_of_cases, write_analysis
from rfem_jax.report.contents.annotations import Figure
from rfem_jax.report.contents.files import contact_columns, coupling_load_columns
from rfem_jax.report.contents.output import write_csv
from rfem_jax.report.contents.summary import in_legend, joint_names, marked
from rfem_jax.report.contents.tables import format_table, title_text
from rfem_jax.report.drawings.pictures import drawn, write_pictures
from rfem_jax.report.drawings.style import add_titles, line_style, new_figure
from rfem_jax.simulation.outcome.remarks import linear_remark
from rfem_jax.simulation.rest.labelled_turn import LabelledTurn
from rfem_jax.simulation.rest.poses import ClosedPose
from rfem_jax.simulation.rest.turn import Turn, closed_poses, turn_over
from rfem_jax.text_layout import wrap_lines


def compute_turn(study: Study, model: Model, positions: Float[np.ndarray, " positions"], axes: str = "joint") -> Turn:
    """The turn of all cases, which are the first axis, with what shakes the base if a metric of the study is of that;
    `axes`: as of `kinetostatic_turn`."""
    if model.shaking_point is None and RECORD in records_for(study.metrics):
        model = replace(model, shaking_point=jnp.zeros(3))
    poses = closed_poses(model, positions)
    return jax.tree.map(np.asarray, _of_cases(model, errors_of_cases(study, model), poses, axes))


@partial(Program, nameless=True)
def _of_cases(model: Model, errors: Deviations, poses: ClosedPose, axes: str) -> Turn:
    return jax.vmap(lambda one: turn_over(model, one, poses, axes))(errors)


def labelled(study: Study, turn: Turn) -> LabelledTurn:
    """The turn of all cases as labelled data."""
    return LabelledTurn(tuple(case.name for case in study.cases), turn, tuple(joint_names(study)))


def _contacts(turn: Turn, c: int) -> dict[str, Any]:
    """Of the joints with clearance in one case, over its assembled positions: largest penetration [m] and contact force
    [N], where they are, the shares of positions at which contacts carry, and at which none does: the pin floats."""
    good, found = turn.status[c] == 0, {}
    for name, one in turn.contacts.items():
        depth, force, position = one.penetration[c][good], one.normal_force[c][good], turn.position[c][good]
        if not len(depth):
            found[name] = None
            continue
        closed = depth > CLOSED
        at = {what: int(values.max(axis=1).argmax()) for what, values in (("depth", depth), ("force", force))}
        found[name] = {
            "largest_penetration": float(depth.max()), "largest_penetration_at": float(position[at["depth"]]),
            "largest_contact_force": float(force.max()), "largest_contact_force_at": float(position[at["force"]]),
            "carrying_share": dict(zip(CONTACT_NAMES, np.mean(closed, axis=0).tolist(), strict=True)),
            "floating_share": float(np.mean(~closed.any(axis=1))),
        }  # fmt: skip
    return found


def _contacts_text(turn: Turn, c: int, scale: float, unit: str) -> str:
    """A table of `_contacts`, and the pins that float."""
    rows, floating = [], []
    for name, one in _contacts(turn, c).items():
        if one is None:
            continue
        shares = [f"{100.0 * share:.0f} %" for share in (*one["carrying_share"].values(), one["floating_share"])]
        deepest, pressed = one["largest_penetration"], one["largest_contact_force"]
        places = [f"{scale * one[f'largest_{what}_at']:.5g}" for what in ("penetration", "contact_force")]
        rows.append([name, *shares, f"{1e6 * deepest:.5g}", places[0], f"{pressed:.5g}", places[1]])
        if one["floating_share"] > 0.0:
            floating.append(name)
    if not rows:
        return ""
    header = ["clearance", *CONTACT_NAMES, "none", "penetration, um", f"at, {unit}", "contact force, N", f"at, {unit}"]
    text = f"\n\nShares of positions at which contacts carry, and the largest:\n{format_table(header, rows)}"
    if floating:
        text += f"\nThe pin floats, held by nothing but its weak spring, at positions of: {', '.join(floating)}."
    return text


def _curves(study: Study, turn: Turn, c: int) -> dict[str, Any]:
    """Position, holding moment or force, resultants, places and stresses of one case at all positions, NaN (null) where
    it was not assembled."""
    good = np.where(turn.status[c] == 0, 1.0, np.nan)

    def sizes(load):
        names = joint_names(study)
        return {name: (np.linalg.norm(getattr(turn.loads[name], load)[c], axis=-1) * good).tolist() for name in names}

    def components(vectors):
        return {axis: (values * good).tolist() for axis, values in zip("xyz", vectors[c].T, strict=True)}

    found = {
        "position": turn.position[c].tolist(), "holding": (turn.holding[c] * good).tolist(),
        "force": sizes("force"), "moment": sizes("moment"),
        "stress": {name: (np.abs(values[c]) * good).tolist() for name, values in turn.stress.items()},
        "place": {name: components(places) for name, places in turn.places.items()},
        "angles": {name: components(values) for name, values in labelled(study, turn).angles.items()},
    }  # fmt: skip
    if turn.shaking is not None:
        found |= {f"{RECORD}_{load}": components(getattr(turn.shaking, load)) for load in ("force", "moment")}
    return found


def turn_text(study: Study, model: Model, turn: Turn) -> str:
    """Tables of the largest loads of every case."""
    unit = "m" if turn.slides else "deg"
    scale = 1.0 if turn.slides else 180.0 / np.pi
    parts, found = [title_text(study)], labelled(study, turn)
    for c, case in enumerate(study.cases):
        name = marked(case.name, found.statuses()[c])
        text = f"Case {name}: largest loads of the mechanism held still\n{text_of(found.parts_of(c))}"
        text += _contacts_text(turn, c, scale, unit)
        if remark := linear_remark(_linear_error(turn, c)):
            text += f"\nOver this range {remark}"
        parts.append(text)
    if sentence := model_reactions_text(model):
        parts.append(wrap_lines(sentence))
    return "\n\n".join(parts)


def _linear_error(turn: Turn, case: int) -> float:
    """Largest estimated error of linear elements over the positions of a case."""
    errors = np.zeros(0) if turn.linear_error is None else turn.linear_error[case][turn.status[case] == 0]
    return float(np.max(errors, initial=0.0))


def write_turn(folder: Path, study: Study, model: Model, turn: Turn) -> list[Path]:
    """Write turn.json (largest loads, resultants and places over the positions) and turn.csv (all positions), both with
    the contacts of joints with clearance; in turn.csv loads of couplings, too."""
    found, (unit, force) = labelled(study, turn), ("m", "N") if turn.slides else ("rad", "N m")
    rows, cases, more = found.rows(), {}, []
    for c, case in enumerate(study.cases):
        cases[case.name] = {"status": found.statuses()[c], **found.peaks(c), "curves": _curves(study, turn, c)}
        cases[case.name]["linear_error"] = _linear_error(turn, c)
        if turn.contacts:
            cases[case.name]["contacts"] = _contacts(turn, c)
        states = jax.tree.map(lambda values, c=c: values[c], turn.contacts)
        columns = contact_columns(states)
        for coupling in study.mechanism.couplings:
            columns |= coupling_load_columns(coupling, np.asarray(turn.couplings[coupling.name][c]))
        for i in range(turn.position.shape[1]):
            carry = {
                f"{name}_carrying": "+".join(carrying(one.penetration[i])) or "none" for name, one in states.items()
            }
            more.append(carry | {name: float(values[i]) for name, values in columns.items()})
    for row in rows:
        row.pop("number")
    rows = [row | columns for row, columns in zip(rows, more, strict=True)]
    units = {
        "max_force": "N", "max_moment": "N m", "max_stress": "Pa", "max_force_at": unit, "max_moment_at": unit,
        "max_stress_at": unit, "holding": force,
    }  # fmt: skip
    if turn.contacts:
        units |= {"largest_penetration": "m", "largest_penetration_at": unit, "largest_contact_force": "N",
                  "largest_contact_force_at": unit, "carrying_share": "1", "floating_share": "1"}  # fmt: skip
    written = write_analysis(folder / "turn.json", study, "turn", {"cases": cases, "units": units})
    return [written, write_csv(folder / "turn.csv", rows)]


def draw_turn(folder: Path, study: Study, model: Model, turn: Turn) -> list[Path]:
    """Draw the loads over the positions; the picture's path."""
    return drawn(lambda: write_pictures(folder, {"turn": turn_figure(study, model, turn)}))


def turn_figure(study: Study, model: Model, turn: Turn) -> Figure:
    """Resultant force and moment of every joint, holding moment and stresses over the drive's position, a column of
    panels a quantity with the joints as curves, a row a case; forces of contacts where joints have clearance."""
    scale, unit = (1.0, "m") if turn.slides else (180.0 / np.pi, "deg")
    count = len(study.cases)
    columns = 4 if turn.contacts else 3
    figure = new_figure(3.2 * columns, 0.9 + 2.5 * count)
    panels = np.asarray(figure.subplots(count, columns, squeeze=False, sharex=True))
    names = joint_names(study)
    for c, case in enumerate(study.cases):
        x = scale * turn.position[c]
        good = np.where(turn.status[c] == 0, 1.0, np.nan)
        for axes, load, label in ((panels[c, 0], "force", "force, N"), (panels[c, 1], "moment", "moment, N m")):
            for k, name in enumerate(names):
                size = np.linalg.norm(getattr(turn.loads[name], load)[c], axis=-1)
                axes.plot(x, size * good, label=name, **line_style(k, len(x)))
            axes.set_ylabel(label)
        panels[c, 0].set_title(f"case {in_legend(case.name, labelled(study, turn).statuses()[c])}", loc="left")
        panels[c, 2].plot(x, turn.holding[c] * good, **line_style(0, len(x)))
        panels[c, 2].set_ylabel("holding force, N" if turn.slides else "holding moment, N m")
        curves = [(name, k) for name in turn.contacts for k in range(len(CONTACT_NAMES))]
        for number, (name, k) in enumerate(curves):
            force = turn.contacts[name].normal_force[c, :, k]
            panels[c, 3].plot(x, force * good, label=f"{name} {CONTACT_NAMES[k]}", **line_style(number, len(x)))
        if curves:
            panels[c, 3].set_ylabel("contact force, N")
            panels[c, 3].legend(fontsize=7.5, frameon=False)
    panels[0, 2].legend(
        *panels[0, 0].get_legend_handles_labels(), title="joint", fontsize=7.5, ncols=4, frameon=False,
        loc="lower right", bbox_to_anchor=(1.0, 1.0),
    )  # fmt: skip
    for axes in panels[-1]:
        axes.set_xlabel(f"position of {model.topology.drive_labels[0]}, {unit}")
    add_titles(figure, "Mechanism held still over the range of its drive: resultant loads of all joints", study)
    return figure
