"""Identifications: the errors of a machine that was measured, what signals tell, measured and simulated curves.

Place in the pipeline: `rfem_jax.description.tasks.identification` -> **identification** -> terminal, files and
pictures.
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rfem_jax.compilation.stages import on_stage
from rfem_jax.description.basics.errors import InputError, located
from rfem_jax.description.study_file.study import Study, load_study
from rfem_jax.description.tasks.identification import IdentificationTask, Sensor, unit_of_column
from rfem_jax.description.tolerances.error_catalogue import as_specified
from rfem_jax.mechanics.statics.designs import model_of_study
from rfem_jax.report.contents.annotations import Figure
from rfem_jax.report.contents.output import write_csv
from rfem_jax.report.drawings.style import CASE_COLOURS, MARKERS, add_titles, new_figure, panel_grid
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.tasks.decisions import (
    corrected,
    correction_content,
    correction_figure,
    posterior_figure,
    posterior_samples,
    production_content,
    production_figure,
    production_of,
)
from rfem_jax.report.tasks.task_report import GRADIENT, TaskReport, as_stage
from rfem_jax.tolerancing.identification.identification_result import (
    Curve,
    Identifiability,
    Identification,
    curve_rows,
    visibility_content,
)
from rfem_jax.tolerancing.identification.identification_study import identifiability, identify
from rfem_jax.tolerancing.identification.measurements import Data, machines_in
from rfem_jax.tolerancing.identification.production_result import Production
from rfem_jax.tolerancing.identification.signals import Signal, signal
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.simulated_problem import Problem
from rfem_jax.tolerancing.problems.static_problem import StaticProblem
from rfem_jax.tolerancing.progress import ProgressOption
from rfem_jax.tolerancing.refinement import refined, rfes_of
from rfem_jax.whole_files import write_text

SHOWN = 400  # samples of a curve on the page
MOST_PANELS = 8
USUAL_STEPS = 12  # of searches
Result = Identification | Identifiability | Production


class IdentificationReport(TaskReport[IdentificationTask, Result]):
    """Errors from measurements; without measurements what they could tell."""

    def run(self, folder: Path) -> Result:
        """The errors, of several machines their distribution, or without data what the signals can tell of them.

        Raises: InputError for data that cannot be used, and for a mechanism at rest.
        """
        task, study = self.task.with_unknowns(self.study.tasks.tolerances), self.study
        if study.statics is not None:
            raise InputError(
                "Task `identification` must be of a motion, but the study has a table [statics]; leave that out."
            )
        columns = list(dict.fromkeys((*task.signals, *task.candidates)))
        metrics = [signal(one) for one in columns]
        problem = study_problem.build_problem(study, metrics)
        specified = study.tasks.tolerances
        common: dict[str, Any] = {
            "tolerances": None if specified is None else Tolerances.of(specified), "unknowns": task.unknowns,
            "prior": task.prior, "bounds": task.bounds or None, "at": task.at, "time_shift": task.time_shift,
            "key": jax.random.key(task.seed),
        }  # fmt: skip
        if not task.data:
            on_stage("Finding what signals can tell")
            return identifiability(
                problem, {**task.signals, **task.candidates}, points=2 * task.starts,
                experiments=task.experiments, **common,
            )  # fmt: skip

        experiments = [(study, task.data, task.at), *self._measured()]
        problems = [problem, *(study_problem.build_problem(one, metrics) for one, _, _ in experiments[1:])]
        finer = [self._finer(one, metrics) for one, _, _ in experiments] if task.check_model else [None]
        common |= {"finer": None if None in finer else finer, "at": [at for *_, at in experiments]}
        further = [self._beside(data) for _, data, _ in experiments[1:]]

        def find(data: Data, progress: ProgressOption = False) -> Identification:
            return identify(
                problems, [data, *further], task.signals, candidates=task.candidates, loss=task.loss,
                confidence=task.confidence, starts=task.starts, iterations=task.iterations, samples=task.samples,
                check_model=task.check_model, progress=progress, **common,
            )  # fmt: skip

        with located("[identification]"):
            machines = machines_in(self.data_path, task.signals)
            if len(machines) > 1:
                return self._production(machines, find)
            found = find(self.data_path, as_stage(f"Searching {len(task.unknowns)} unknowns"))
            if task.correction is None:
                return found
            return replace(found, correction=corrected(study, task.correction, task.at, found))

    def _measured(self) -> list[tuple[Study, str, dict[str, float]]]:
        """Study, data and what is held fixed of the further experiments. Raises: InputError."""
        found = []
        for title, one in self.task.measured.items():
            with located(f"[identification.measured.{title}]"):
                study = load_study(self._beside(one.study)) if one.study else self.study
                if study.statics is not None or _things(study) != _things(self.study):
                    raise InputError(
                        "Argument `study` must be of a motion of the same mechanism, but has other links or joints, or "
                        "a table [statics]; change its drive, forces, simulation or numbers alone."
                    )
                found.append((study, one.data, self.task.at | one.changes))
        return found

    def _finer(self, study: Study, metrics: list[Signal]) -> Problem | StaticProblem | None:
        """The machine with twice as many sdes in its links; None of rigid links."""
        if not any(link.flexible for link in study.mechanism.links):
            return None
        study = study_problem.stable_when_refined(study, 2.0)
        model = model_of_study(study, rfes=refined(rfes_of(model_of_study(study)), 2.0))
        return study_problem.build_problem(study, metrics, model)

    def _production(self, machines: dict[str, Data], find: Callable[[Data], Identification]) -> Production:
        """What several machines say of production. Raises: InputError."""
        if self.task.measured:
            raise InputError(
                f"Argument `measured` must be of one machine, but the data have {len(machines)}; leave out the tables "
                "[identification.measured], or the rows of other machines."
            )
        if self.task.correction is not None:
            raise InputError(
                f"Argument `correction` must be of one machine, but the data have {len(machines)}; leave out the table "
                "[identification.correction], or the rows of other machines."
            )
        return production_of(machines, find, self.task.confidence)

    @property
    def data_path(self) -> Path:
        """The file with the measurements."""
        return self._beside(self.task.data)

    def _beside(self, path: str) -> Path:
        return (Path() if self.study.path is None else self.study.path.parent) / path

    def write(self, folder: Path, result: Result) -> list[Path]:
        """Write identification.json, identification.csv (one row per unknown; `unit` is that of all its numbers but
        probabilities) and identification_curves.csv (every sample: measured, simulated before and after)."""
        if isinstance(result, Production):
            return self._write_production(folder, result)
        units = dict(zip(result.names, result.error_units, strict=True))
        visibility = visibility_content(result.visibility)
        if isinstance(result, Identifiability):
            content = {"status": result.status, "errors": result.rows(), "visibility": visibility, "units": units}
            content["experiments"] = [asdict(one) for one in result.experiments]
            return self.write_both(folder, content, result.rows())
        content = {
            "status": result.status,
            "message": result.message,
            "errors": result.rows(),
            "estimate": result.errors,
            "deviation": dict(zip(result.names, map(float, result.deviation), strict=True)),
            "covariance": result.covariance,
            "confidence": result.confidence,
            "intervals_by": result.method,
            "modes": [asdict(one) for one in result.modes],
            "effective_samples": result.effective,
            "departure": result.departure,
            "signals": [asdict(one) for one in result.signals],
            "curves": [_thinned(one) for one in result.curves],
            "samples": posterior_samples(result),
            "correction": correction_content(result.correction),
            "visibility": visibility,
            "remarks": list(result.remarks),
            "suspects": [asdict(one) for one in result.suspects],
            "divisions": [asdict(one) | {"coarse": one.coarse} for one in result.divisions],
            "steps": result.steps,
            "converged": result.converged,
            "units": units,
        }
        columns = {one.column: unit_of_column(one.column) for one in result.curves}
        written = self.write_both(folder, content, result.rows())
        rows = {"curves": curve_rows(result.curves, columns)}
        rows["correction"] = [] if result.correction is None else result.correction.rows()
        return [*written, *(write_csv(folder / f"{self.name}_{of}.csv", some) for of, some in rows.items() if some)]

    def _write_production(self, folder: Path, result: Production) -> list[Path]:
        """Also identification_machines.csv, a row per machine, and identification_tolerances.toml."""
        written = self.write_both(folder, production_content(result), result.rows())
        written.append(write_csv(folder / f"{self.name}_machines.csv", result.machine_rows()))
        return [*written, write_text(folder / f"{self.name}_tolerances.toml", result.lines())]

    def succeeded(self, result: Result) -> bool:
        """Also where several sets of errors explain the data: all of them are told."""
        if result.status not in ("ok", "ambiguous"):
            return False
        correction = result.correction if isinstance(result, Identification) else None
        return correction is None or correction.status in ("ok", "no_gain")

    def simulations(self) -> list[str]:
        task = self.task
        if not task.data:
            every = f" of each of {1 + len(task.experiments)} experiments" if task.experiments else ""
            return [f"{2 * task.starts} with derivatives, at points of the prior{every}"]
        return [
            f"{task.starts} with derivatives in every step of the searches, of which there are usually about "
            f"{USUAL_STEPS}",
            f"{task.samples} that check the intervals",
            *(["some on finer links and with half the step"] if task.check_model else []),
            *self._of_correction(),
        ]

    def work(self) -> float:
        task = self.task
        steps = USUAL_STEPS if task.data else 2 * (1 + len(task.experiments))
        return GRADIENT * task.starts * steps + (task.samples if task.data else 0)

    def _of_correction(self) -> list[str]:
        asked = self.task.correction
        if asked is None:
            return []
        outcomes = len(asked.adjustments) + min(len(asked.adjustments), 2)
        return [
            f"{self.task.samples * outcomes} of machines before and after corrections, and up to "
            f"{asked.points * asked.steps * (outcomes - 1)} with derivatives to find these"
        ]

    def setting_text(self, name: str, value: Any) -> str:
        """Sensors in words."""
        if name in ("signals", "candidates"):
            return ", ".join(f"{column} {_sensor(one, unit_of_column(column))}" for column, one in value.items())
        if name == "experiments":
            changed = {key: ", ".join(f"{of} {x:+g} (SI)" for of, x in one.items()) for key, one in value.items()}
            return "; ".join(f"{key}: {words}" for key, words in changed.items())
        if name == "measured":
            return ", ".join(
                f"{key} ({one.data}{f' of {one.study}' if one.study else ''})" for key, one in value.items()
            )
        if name == "bounds":
            return ", ".join(f"{error} {low:g} to {high:g} (SI)" for error, (low, high) in value.items())
        if name == "correction":
            return f"{value.metric} by {', '.join(value.adjustments)}"
        return value if name == "data" else super().setting_text(name, value)

    def draw(self, result: Result) -> dict[str, Figure]:
        if isinstance(result, Production):
            return {"production": production_figure(self.study, result)} if result.machines else {}
        if isinstance(result, Identifiability):
            return {"lengths": lengths_figure(self.study, result)} if result.status == "ok" else {}
        if not result.curves:
            return {}
        figures = {"curves": curves_figure(self.study, result), "errors": errors_figure(self.study, result)}
        if len(result.weights):
            figures["posterior"] = posterior_figure(self.study, result)
        if result.correction is not None and result.correction.status != "failed":
            figures["correction"] = correction_figure(self.study, result.correction)
        return figures


def _things(study: Study) -> tuple[set[str], set[str]]:
    """Names of links and joints."""
    return {one.name for one in study.mechanism.links}, {one.name for one in study.mechanism.joints}


def _sensor(one: Sensor, unit: str) -> str:
    said = "noise to be estimated" if one.noise is None else f"noise {one.noise:g} {unit}"
    said += f", offset {one.offset:g} {unit}" if one.offset else ""
    said += f", {one.filter} of {one.filter_time:g} s" if one.filter else ""
    return f"({said}{f', gain {one.gain:g}' if one.gain else ''})"


def _thinned(curve: Curve) -> dict[str, Any]:
    """A curve as the page shows it: at most `SHOWN` samples, evenly chosen."""
    rows = np.unique(np.linspace(0, len(curve.times) - 1, SHOWN).round().astype(int))
    arrays = {name: getattr(curve, name)[rows] for name in ("times", "measured", "before", "after")}
    return {"column": curve.column, "unit": unit_of_column(curve.column), "experiment": curve.experiment, **arrays}


def lengths_figure(study: Study, result: Identifiability) -> Figure:
    """How the expected standard deviations fall with the time that is measured, in each experiment."""
    shown = result.experiments[:MOST_PANELS]
    lowest = float(np.nanmin([np.nanmin(one.deviations) for one in shown if np.isfinite(one.gain).any()]))
    figure = new_figure(8.4, 2.9 * ((len(shown) + 1) // 2) + 1.6)
    panels, add_shared_legend = panel_grid(figure, len(shown), columns=min(2, len(shown)))
    for one, axes in zip(shown, panels, strict=True):
        for i, name in enumerate(result.names):
            marker, colour = MARKERS[i % len(MARKERS)], CASE_COLOURS[i % len(CASE_COLOURS)]
            axes.plot(one.lengths, one.deviations[:, i], marker=marker, color=colour, ms=3.5, label=name)
        axes.set_title(one.name, loc="left")
        axes.set_xlabel("measured time, s")
        axes.set_ylabel("deviation left")
        axes.set_yscale("log")
        axes.set_ylim(0.7 * lowest, 1.2)
    add_shared_legend(*panels[0].get_legend_handles_labels())
    add_titles(figure, "Expected deviations after the measurement, of those before it", study)
    return figure


def curves_figure(study: Study, result: Identification) -> Figure:
    """Every signal over time: measured, simulated with the prior's mean, and with the errors found."""
    shown = result.curves[:MOST_PANELS]
    figure = new_figure(8.4, 2.6 * len(shown) + 1.4)
    panels, add_shared_legend = panel_grid(figure, len(shown), columns=1)
    for curve, axes in zip(shown, panels, strict=True):
        axes.plot(
            curve.times, curve.measured, MARKERS[0], ms=2.2, color="#8A8A8A", markeredgewidth=0.0, label="measured"
        )
        axes.plot(curve.times, curve.before, "--", color=CASE_COLOURS[2], linewidth=1.2, label="simulated before")
        axes.plot(curve.times, curve.after, "-", color=CASE_COLOURS[1], linewidth=1.2, label="with the errors found")
        axes.set_xlabel("time, s")
        number = f", experiment {curve.experiment}" if result.curves[-1].experiment > 1 else ""
        axes.set_title(f"{curve.column}{number}", loc="left")
        axes.set_ylabel(unit_of_column(curve.column))
    add_shared_legend(*panels[0].get_legend_handles_labels())
    add_titles(figure, f"Measured and simulated signals ({result.status.replace('_', ' ')})", study)
    return figure


def errors_figure(study: Study, result: Identification) -> Figure:
    """Every error with its interval, in standard deviations of the prior, beside its tolerance."""
    k = len(result.names)
    scale = np.where(np.isfinite(result.prior_deviation), result.prior_deviation, 1.0)
    known = np.isfinite(result.tolerances[:, 0])
    scale = np.where(np.isfinite(result.prior_deviation) | ~known, scale, 0.5 * np.ptp(result.tolerances, axis=1))
    figure = new_figure(7.6, 0.55 * k + 2.0)
    axes = figure.subplots()
    places = np.arange(k)
    for i in np.flatnonzero(known):
        low, high = (result.tolerances[i] - result.prior_mean[i]) / scale[i]
        axes.barh(places[i], high - low, 0.62, left=low, color="#E4E4E4", label="tolerance" if i == 0 else None)
    middle = (result.estimate - result.prior_mean) / scale
    ends = np.abs(np.stack([result.low - result.estimate, result.high - result.estimate]) / scale)
    axes.errorbar(
        middle, places, xerr=np.where(np.isfinite(ends), ends, 0.0), fmt=MARKERS[0], color=CASE_COLOURS[1], capsize=4,
        label=f"estimate, {100 * result.confidence:g} % interval",
    )  # fmt: skip
    for one in result.modes[1:]:
        axes.plot((one.errors - result.prior_mean) / scale, places, MARKERS[2], color=CASE_COLOURS[2], ms=5.0)
    labels = []
    for name, value, unit in zip(result.names, result.estimate, result.error_units, strict=True):
        specified, factor = as_specified(unit)
        labels.append(f"{name}\n{factor * value:.4g} {specified}")
    axes.set_yticks(places, labels)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("error, in standard deviations of what was known before")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False)
    heading = "Errors found" + ("; triangles: other sets that explain the data" if len(result.modes) > 1 else "")
    add_titles(figure, heading, study)
    return figure
