"""Natural frequencies of the cases of a study: computed, printed, written and drawn.

Place in the pipeline: study, model -> `simulation.vibrations.modes` -> **modes_report** -> files.
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.compilation.program import Program
from rfem_jax.description.parameters.deviations import deviation_unit
from rfem_jax.description.study_file.study import Study
from rfem_jax.labelled_data import column_name
from rfem_jax.mechanics.dynamics.centre_lines import link_lines
from rfem_jax.mechanics.model.errors import Deviations, deviations, sum_of
from rfem_jax.mechanics.model.model import Coordinates, Model
from rfem_jax.mechanics.model.orientations import moved
from rfem_jax.mechanics.model.status import STATUS
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.designs import designed
from rfem_jax.report.analyses.analysis import error_names, errors_of_cases, write_analysis
from rfem_jax.report.contents.annotations import Figure
from rfem_jax.report.contents.output import write_csv
from rfem_jax.report.contents.summary import in_legend, marked
from rfem_jax.report.contents.tables import format_table, title_text
from rfem_jax.report.drawings.pictures import drawn, write_pictures
from rfem_jax.report.drawings.style import add_titles, new_figure
from rfem_jax.simulation.vibrations.modes import REPEATED, NaturalModes, natural_frequencies

AMPLITUDE = 0.1  # of a drawn mode, over the size of the mechanism
ROUNDING = 1e-12  # of a frequency, in its derivative by the unit of an error
SHOWN_UNIT = {"rad": (np.pi / 180.0, "deg"), "m": (1e-3, "mm")}


class ModesResult(NamedTuple):
    """Modes of all cases (first axis), and derivatives (cases, modes, errors) [Hz by the errors' units] of the
    frequencies by the errors `names`, NaN of repeated ones."""

    modes: NaturalModes
    names: tuple[str, ...]
    units: tuple[str, ...]
    derivatives: Float[np.ndarray, "cases modes errors"]


class Shapes(NamedTuple):
    """Points [m] of the links of the first case by their names, at rest (modes, points, 3), the same in all modes, and
    their displacements in every mode, of an arbitrary size."""

    lines: dict[str, Float[np.ndarray, "modes points 3"]]
    moves: dict[str, Float[np.ndarray, "modes points 3"]]


def compute_modes(study: Study, model: Model, count: int, locked: bool) -> ModesResult:
    """Modes of all cases of a study, and derivatives of their frequencies."""
    names = error_names(study)
    modes, derivatives = _of_cases(model, errors_of_cases(study, model), names, count, locked)
    modes = jax.tree.map(np.asarray, modes)
    derivatives = np.where((modes.repeated > 0)[..., None], np.nan, np.asarray(derivatives))
    units = tuple(deviation_unit(study.mechanism, name) for name in names)
    return ModesResult(modes, names, units, derivatives)


@partial(Program, nameless=True)
def _of_cases(
    model: Model, errors: Deviations, names: tuple[str, ...], count: int, locked: bool
) -> tuple[NaturalModes, Float[Array, "cases modes errors"]]:
    def one(errors):
        def frequencies(values):
            more = deviations(model, dict(zip(names, values, strict=True)))
            modes = natural_frequencies(model, sum_of(errors, more), count=count, locked=locked)
            return modes.frequency, modes

        zeros = jnp.zeros(len(names))
        if not names:
            frequency, modes = frequencies(zeros)
            return modes, jnp.zeros((frequency.shape[0], 0))
        derivatives, modes = jax.jacfwd(frequencies, has_aux=True)(zeros)
        return modes, derivatives

    return jax.vmap(one)(errors)


def modes_text(study: Study, result: ModesResult) -> str:
    """Tables of frequencies, and of their derivatives in the first case."""
    modes, found = result.modes, statuses(result)
    cases = [marked(case.name, status) for case, status in zip(study.cases, found, strict=True)]
    rows = []
    for m in range(modes.frequency.shape[1]):
        frequencies = [f"{value:.6g}" for value in modes.frequency[:, m]]
        rows.append([str(m + 1), *frequencies, f"{modes.damping[0, m]:.3g}", _remark(modes, m)])
    header = ["mode", *(f"{name}, Hz" for name in cases), "damping ratio", "remark"]
    parts = [title_text(study), "Natural frequencies\n" + format_table(header, rows, (0, len(header) - 1))]
    parts += [_derivatives_text(result, c, name) for c, name in enumerate(cases) if result.names]
    if modes.repeated.any():
        parts.append(
            f"A frequency is repeated where its square is within {REPEATED:g} of another one: its derivative does not "
            "exist (-)."
        )
    if modes.asymmetry.max() > 1e-6:
        parts.append("Forces that have no potential act: the symmetric part of the stiffness was taken.")
    failed = [code for code in modes.status.tolist() if code]
    if failed:
        messages = dict.fromkeys(STATUS[code].message for code in failed)
        parts.append("\n".join(f"* {message}" for message in messages))
    return "\n\n".join(parts)


def _derivatives_text(result: ModesResult, c: int, case: str) -> str:
    """Table of the derivatives in one case."""
    frequency, rows = result.modes.frequency[c], []
    for e, (name, si) in enumerate(zip(result.names, result.units, strict=True)):
        size, unit = SHOWN_UNIT.get(si, (1.0, si))
        derivatives = result.derivatives[c, :, e] * size
        # Symmetry makes many of them zero, up to rounding.
        derivatives = np.where(np.abs(derivatives) < ROUNDING * frequency, 0.0, derivatives)
        rows.append([name, unit, *("-" if np.isnan(value) else f"{value:.4g}" for value in derivatives)])
    header = ["error", "per", *(f"mode {m + 1}, Hz" for m in range(len(frequency)))]
    return f"Derivatives of the frequencies of case {case}\n" + format_table(header, rows, (0, 1))


def _remark(modes: NaturalModes, m: int) -> str:
    if (lowest := float(modes.square[:, m].min())) < 0.0:
        return f"unstable (a factor of e in {(-lowest) ** -0.5:.3g} s), or a free motion"
    return "repeated" if modes.repeated[:, m].any() else ""


def statuses(result: ModesResult) -> list[str]:
    """Status of every case."""
    return [STATUS[int(code)].name for code in result.modes.status]


def write_modes(folder: Path, study: Study, result: ModesResult, shapes: Shapes) -> list[Path]:
    """Write modes.json, with the shapes of the first case, and modes.csv."""
    modes, rows, cases = result.modes, [], {}
    for c, case in enumerate(study.cases):
        listed = []
        for m, square in enumerate(modes.square[c]):
            derivatives = {name: float(result.derivatives[c, m, e]) for e, name in enumerate(result.names)}
            one = {
                "frequency": float(modes.frequency[c, m]),
                "damping_ratio": float(modes.damping[c, m]),
                "repeated": bool(modes.repeated[c, m]),
                "stable": None if np.isnan(square) else bool(square >= 0.0),
            }
            listed.append({**one, "derivatives": derivatives})
            row: dict[str, Any] = {"case": case.name, "mode": m + 1, "frequency_Hz": one["frequency"]}
            row |= {key: one[key] for key in ("damping_ratio", "repeated", "stable")}
            columns = (
                column_name(f"by_{name}_Hz", unit) for name, unit in zip(result.names, result.units, strict=True)
            )
            rows.append(row | dict(zip(columns, derivatives.values(), strict=True)))
        cases[case.name] = {"status": statuses(result)[c], "modes": listed}
    units = {"frequency": "Hz", "derivatives": "Hz/rad or Hz/m", "damping_ratio": "1"}
    content = {"cases": cases, "units": units, "shapes": _shapes_content(study, shapes)}
    written = write_analysis(folder / "modes.json", study, "modes", content)
    return [written, write_csv(folder / "modes.csv", rows)]


def _shapes_content(study: Study, shapes: Shapes) -> dict[str, Any]:
    """Shapes as modes.json has them: points [m], moves over the largest one of their mode."""
    largest = np.max([np.abs(move).max(axis=(1, 2)) for move in shapes.moves.values()], axis=0)
    moves = {name: move / np.maximum(largest, 1e-300)[:, None, None] for name, move in shapes.moves.items()}
    links = {
        name: {"points": np.round(line[0], 7).tolist(), "moves": np.round(moves[name], 4).tolist()}
        for name, line in shapes.lines.items()
    }
    return {"case": study.cases[0].name, "links": links}


def draw_modes(folder: Path, study: Study, result: ModesResult, shapes: Shapes) -> list[Path]:
    """Draw the modes of the first case; the picture's path."""
    return drawn(lambda: write_pictures(folder, {"modes": modes_figure(study, result, shapes)}))


def mode_shapes(study: Study, model: Model, result: ModesResult) -> Shapes:
    """The shapes of the modes of the first case."""
    first = jax.tree.map(lambda x: jnp.asarray(x[0]), result.modes)
    errors = jax.tree.map(lambda x: x[0], errors_of_cases(study, model))
    return Shapes(*jax.tree.map(np.asarray, _shapes(model, errors, first)))


@partial(Program, nameless=True)
def _shapes(model: Model, errors: Deviations, modes: NaturalModes):
    """Lines of the links at the equilibrium, and their displacements in every mode."""
    made = designed(model, None, errors)
    model, actual = made.model, apply_errors(made.model, made.errors)

    def lines(change):
        return link_lines(model, actual, moved(model.topology, modes.position, change))

    zeros = jax.tree.map(lambda x: jnp.zeros_like(x[0]), Coordinates(modes.joints, modes.elastic))
    return jax.vmap(lambda shape: jax.jvp(lines, (zeros,), (shape,)))(Coordinates(modes.joints, modes.elastic))


def modes_figure(study: Study, result: ModesResult, shapes: Shapes) -> Figure:
    """The modes of the first case: links at rest and at both ends of their swing, from the side or from above."""
    lines, moves = shapes
    count = result.modes.frequency.shape[1]
    columns = min(count, 3)
    figure = new_figure(7.6, 0.8 + 2.4 * -(-count // columns))
    panels = np.atleast_1d(figure.subplots(-(-count // columns), columns)).reshape(-1)
    for m, axes in enumerate(panels):
        if m >= count:
            axes.set_axis_off()
            continue
        at = {name: line[m] for name, line in lines.items()}
        shape = {name: move[m] for name, move in moves.items()}
        every, moved_by = np.concatenate([*at.values()]), np.concatenate([*shape.values()])
        above = np.abs(moved_by[:, 1]).max() > np.abs(moved_by[:, [0, 2]]).max()
        pick = [0, 1] if above else [0, 2]
        factor = AMPLITUDE * np.ptp(every, axis=0).max() / max(np.abs(moved_by).max(), 1e-300)
        for sign, style in ((0.0, "-"), (1.0, "--"), (-1.0, ":")):
            for name, line in at.items():
                points = line + sign * factor * shape[name]
                colour = "#000000" if sign == 0.0 else "#D55E00"
                axes.plot(points[:, pick[0]], points[:, pick[1]], style, color=colour, linewidth=1.6 - 0.6 * abs(sign))
        view = "from above (x, y)" if above else "from the side (x, z)"
        axes.set_title(f"mode {m + 1}: {result.modes.frequency[0, m]:.5g} Hz\n{view}, m", loc="left", fontsize=8.5)
        axes.set_aspect("equal", adjustable="datalim")
        axes.tick_params(labelsize=7)
    case = in_legend(study.cases[0].name, statuses(result)[0])
    add_titles(figure, f"Natural modes of case {case} (amplitude arbitrary)", study)
    return figure
