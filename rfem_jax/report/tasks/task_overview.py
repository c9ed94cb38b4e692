"""What a study's tasks say, in words and tables: part of the text of the command `check`.

Place in the pipeline: after `load_study`; computes nothing. Errors in degrees and millimetres, as
users write them; limits in units of their metrics.
"""

from rfem_jax.description.parameters.deviations import deviation_unit
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tolerances.tolerances import SpecifiedTolerances
from rfem_jax.report.contents.overview import format_error
from rfem_jax.report.contents.tables import format_table
from rfem_jax.task_kinds import task_kinds
from rfem_jax.text_layout import wrap_lines


def tasks_text(study: Study) -> str:
    """Tolerances and tasks of a study, "" where it declares none."""
    tasks = study.tasks
    parts = [] if tasks.tolerances is None else [_tolerances_text(study, tasks.tolerances)]
    if tasks.declared:
        # Takes seconds: only where there is something to show.
        from rfem_jax.report.tasks.catalogue import report_on

        for name, task in tasks.asked.items():
            metrics = getattr(task, "metrics", ())
            lines = [task_kinds()[name].title or name, *([f"  metrics: {', '.join(metrics)}"] if metrics else [])]
            lines += [f"  {label}: {text}" for label, text in report_on(study, name).settings()]
            parts.append(wrap_lines("\n".join(lines), indent=4))
    return "\n\n".join(parts)


def _tolerances_text(study: Study, tolerances: SpecifiedTolerances) -> str:
    rows = []
    for one in tolerances.independent:
        unit = deviation_unit(study.mechanism, one.error)
        low, high = (format_error("", end, unit).removeprefix(" = ") for end in one.interval)
        shape = one.distribution.replace("_", " ")
        if one.deviations is not None:
            shape += f", {one.deviations:g} deviations in the half-width"
        if one.cpk is not None:
            shape += f", cpk {one.cpk:g} at the {one.side or 'upper'} limit"
        rows.append([one.error, low, high, shape])
    for number, group in enumerate(tolerances.correlated, start=1):
        for error, width in group.half_widths.items():
            unit = deviation_unit(study.mechanism, error)
            low, high = (format_error("", end, unit).removeprefix(" = ") for end in (-width, width))
            rows.append([error, low, high, f"normal, correlated in group {number}"])
    for zone in tolerances.zones:
        for error, width in zone.half_widths().items():
            unit = study.mechanism.error_unit(error)
            low, high = (format_error("", end, unit).removeprefix(" = ") for end in (-width, width))
            rows.append([error, low, high, f"zone {zone.name}, {zone.zone} of {1e3 * zone.diameter:g} mm"])
    return format_table(["tolerance", "from", "to", "distribution"], rows, words=(0, 3))
