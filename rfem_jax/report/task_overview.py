"""What a study's tasks say, in words and tables: part of the text of the command `check`.

Place in the pipeline: after `load_study`; computes nothing. Errors in degrees and millimetres, as
people state them; limits in units of their metrics.
"""

import math
from dataclasses import fields

from rfem_jax.report.overview import format_error
from rfem_jax.report.tables import format_table

_NAMES = {
    "sensitivity": "Sensitivity",
    "monte_carlo": "Monte Carlo",
    "worst_case": "Worst case",
    "allocation": "Allocation",
}


def tasks_text(study) -> str:
    """Tolerances and tasks of a study, "" where it declares none."""
    tasks = study.tasks
    if tasks.declared:
        # Takes seconds: only where there is something to show.
        from rfem_jax.tolerancing.layout import wrap_lines
    parts = [] if tasks.tolerances is None else [_tolerances_text(study)]
    for name in tasks.declared:
        task = getattr(tasks, name)
        lines = [_NAMES[name], f"  metrics: {', '.join(task.metrics)}"]
        lines += [f"  {label}: {text}" for label, text in _settings(study.mechanism, task)]
        parts.append(wrap_lines("\n".join(lines), indent=4))
    return "\n\n".join(parts)


def _tolerances_text(study):
    rows = []
    for one in study.tasks.tolerances.independent:
        unit = study.mechanism.error_unit(one.error)
        low, high = (format_error("", end, unit).removeprefix(" = ") for end in one.interval)
        shape = one.distribution.replace("_", " ")
        if one.deviations is not None:
            shape += f", {one.deviations:g} deviations in the half-width"
        rows.append([one.error, low, high, shape])
    for number, group in enumerate(study.tasks.tolerances.correlated, start=1):
        for error, width in group.half_widths.items():
            unit = study.mechanism.error_unit(error)
            low, high = (format_error("", end, unit).removeprefix(" = ") for end in (-width, width))
            rows.append([error, low, high, f"normal, correlated in group {number}"])
    return format_table(["tolerance", "from", "to", "distribution"], rows, words=(0, 3))


def _settings(mechanism, task):
    """(name, text) of everything a task states but its metrics."""
    for one in fields(task):
        value = getattr(task, one.name)
        if one.name == "metrics" or value is None or value == {} or value == ():
            continue
        if one.name == "limits":
            text = ", ".join(_limit(*item) for item in value.items())
        elif one.name == "at":
            pairs = [format_error(n, v, mechanism.error_unit(n)) for n, v in value.items()]
            text = ", ".join(pairs)
        elif one.name == "bounds":
            text = ", ".join(_bound(mechanism, *item) for item in value.items())
        elif one.name == "costs":
            text = ", ".join(_cost(mechanism, *item) for item in value.items())
        elif isinstance(value, dict):
            text = ", ".join(f"{key} {item}" for key, item in value.items())
        elif isinstance(value, tuple):
            text = ", ".join(f"{item:g}" for item in value)
        elif isinstance(value, bool):
            text = "yes" if value else "no"
        else:
            text = f"{value:g}" if isinstance(value, float) else str(value).replace("_", " ")
        yield one.name.replace("_", " "), text


def _limit(name, pair):
    low, high = pair
    if not math.isfinite(low):
        return f"{name} <= {high:g}"
    return f"{name} >= {low:g}" if not math.isfinite(high) else f"{low:g} <= {name} <= {high:g}"


def _bound(mechanism, name, pair):
    unit = mechanism.error_unit(name)
    low, high = (format_error("", end, unit).removeprefix(" = ") for end in pair)
    return f"{name} {low} to {high}"


def _cost(mechanism, name, cost):
    at = format_error("", cost.at, mechanism.error_unit(name)).removeprefix(" = ")
    fixed = f" + {cost.fixed:g}" if cost.fixed else ""
    return f"{name} {cost.model.replace('_', ' ')}, {cost.price:g} at {at}{fixed}"
