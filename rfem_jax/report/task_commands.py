"""What the commands `sensitivity`, `monte-carlo`, `worst-case` and `allocate` do.

Place in the pipeline: called by `command_line`; each task is computed (`tasks`), printed, written
(`task_files`) and drawn (`task_figures`).

A result is good unless its status says otherwise; a Monte Carlo study with failed samples is good
as long as any sample is (failed samples are counted, and part of the result).
"""

import time
from pathlib import Path

import jax
import numpy as np

from rfem_jax.compilation.stages import on_stage
from rfem_jax.description.errors import InputError
from rfem_jax.report import task_files, tasks
from rfem_jax.report.progress_line import say, show
from rfem_jax.report.summary import PLOTS_HINT
from rfem_jax.report.tables import title_text
from rfem_jax.tolerancing.layout import align_columns, wrap_lines

UNDAMPED = (
    "No flexible link has damping: derivatives of mean-square and RMS forces are dominated by the "
    "phase of\nundamped 1-20 kHz vibrations and may even have the wrong sign (those of moments "
    "stay smooth).\nState a small damping of the material for a study of derivatives."
)


def require_task(study, name) -> None:
    """Raise InputError if the study does not declare the task `name`."""
    if getattr(study.tasks, name) is None:
        declared = ", ".join(f"[{one}]" for one in study.tasks.declared) or "none"
        raise InputError(
            f"Argument `STUDY.toml` must have a table [{name}] for this command, but its tasks are "
            f"{declared}; add the table."
        )


def do_task(study, name, folder) -> tuple[bool, list[Path]]:
    """Compute, print, write and draw one declared task.

    Returns: whether the result is good, and the files written (none but by process 0 of several).
    Raises: InputError; OSError for files that cannot be written.
    """
    require_task(study, name)
    started = time.perf_counter()
    good, written = _ACTIONS[name](study, Path(folder))
    say(f"{_words(name).capitalize()} done after {time.perf_counter() - started:.1f} s.")
    return good, written


def _words(name):
    return name.replace("_", " ")


def _show(study, text):
    show(f"{title_text(study)}\n\n{text}", end="\n\n")


def _draw(folder, study, name, *results):
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        show(PLOTS_HINT)
        return []
    on_stage("Drawing pictures")
    from rfem_jax.report.task_figures import write_task_figures

    return write_task_figures(folder, study, name, *results)


def _do_sensitivity(study, folder):
    task = study.tasks.sensitivity
    twice = " (twice: with the finer step too)" if task.half_step else ""
    stage = f"Differentiating {len(task.metrics)} metrics to order {task.order}{twice}"
    on_stage(stage)
    result, undamped = tasks.run_sensitivity(study, progress=lambda done, total: on_stage(stage, done / total))
    _show(study, sensitivity_text(result, undamped))
    written = task_files.write_sensitivity(folder, study, result, undamped)
    return result.status == "ok", written + _draw(folder, study, "sensitivity", result)


def sensitivity_text(result, undamped) -> str:
    """Tables, principal directions, change with the step, and what damping means for them."""
    parts = [str(result)]
    if result.hessian is not None and len(result.names) > 1:
        lines = []
        for metric in result.metrics:
            value, direction = result.principal_directions(metric)[0]
            # Number and name stay together where a line is broken.
            words = ", ".join(f"{part:+.2f}\0{name}" for name, part in direction.items())
            text = f"{metric}: 1/2 eigenvalue {0.5 * value:.5g}, direction {words}"
            lines.append(wrap_lines(text, indent=4).replace("\0", " "))
        head = "Combination of errors (in tolerances) that raises each metric most: the first "
        head += "principal direction"
        parts.append("\n".join([head, *lines]))
    if result.gradient_change is not None:
        header = ["metric", "largest change of a gradient", "change of the Hessian"]
        changes = [np.nan] * len(result.metrics)
        if result.hessian_change is not None:
            changes = result.hessian_change
        rows = [
            [metric, f"{np.max(gradient):.1e}", f"{change:.1e}" if change == change else "-"]
            for metric, gradient, change in zip(result.metrics, result.gradient_change, changes, strict=True)
        ]
        head = "Change with the finer step (of each error's effect, of the largest |H|)"
        parts.append(f"{head}\n{align_columns(header, rows)}")
    return "\n\n".join([*parts, *([UNDAMPED] if undamped else [])])


def _do_monte_carlo(study, folder):
    task = study.tasks.monte_carlo
    stage = (
        f"Sampling {task.n} mechanisms on {jax.local_device_count()} devices"
        f" of {jax.process_count()} process{'es' if jax.process_count() > 1 else ''}"
    )
    on_stage(stage)
    result = tasks.run_monte_carlo(
        study, folder / "monte_carlo", progress=lambda done, total: on_stage(stage, done / total)
    )
    good = result.good > 0
    if jax.process_index() != 0:
        show(f"Process {jax.process_index()} computed {result.chunks_computed} chunks.")
        return good, []
    _show(study, str(result))
    written = task_files.write_monte_carlo(folder, study, result)
    return good, written + _draw(folder, study, "monte_carlo", result)


def _do_worst_case(study, folder):
    results = tasks.run_worst_case(study, report=on_stage)
    _show(study, "\n\n".join(str(one) for one in results.values()))
    good = all(one.status == "ok" for one in results.values())
    written = task_files.write_worst_case(folder, study, results)
    return good, written + _draw(folder, study, "worst_case", results)


def _do_allocation(study, folder):
    found = tasks.run_allocation(study, report=on_stage)
    _show(study, allocation_text(found))
    written = task_files.write_allocation(folder, study, found)
    return found.answer.status == "ok", written + _draw(folder, study, "allocation", found)


def allocation_text(found) -> str:
    """The answer, its cost beside that of the study's own tolerances, and the scaled limits."""
    parts = [str(found.answer)]
    if np.isfinite(found.cost_before):
        parts.append(f"The study's own tolerances cost {found.cost_before:.6g}.")
    if len(found.front) > 1:
        rows = [
            [f"{scale:g}", one.status, f"{one.cost:.5g}", *(f"{c.limit:.5g}" for c in one.limits)]
            for scale, one in found.front.items()
        ]
        header = ["scale of limits", "status", "cost", *(c.metric for c in found.answer.limits)]
        parts.append(f"Cost against limits\n{align_columns(header, rows)}")
    return "\n\n".join(parts)


_ACTIONS = {
    "sensitivity": _do_sensitivity,
    "monte_carlo": _do_monte_carlo,
    "worst_case": _do_worst_case,
    "allocation": _do_allocation,
}
