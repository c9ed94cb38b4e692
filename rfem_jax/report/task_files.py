"""The files of tolerance studies: one JSON and one CSV or more for each task.

Place in the pipeline: after `tasks`; `files` says how a file appears whole. SI units (rad, m) and
the metrics' own units; JSON has no NaN, an open limit or a missing number is null. Nothing in a
file depends on how long a run took or how often it was interrupted.
"""

from dataclasses import asdict
from pathlib import Path

import numpy as np

from rfem_jax.report.output import write_csv, write_json
from rfem_jax.report.quantities import metric_units
from rfem_jax.report.summary import study_note


def _plain(value):
    """NumPy arrays and scalars of nested dicts and lists as Python's own."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.item() if isinstance(value, np.generic) else value


def write_task_json(path, study, name, result) -> Path:
    """Write one task's JSON: what was asked for (`task`, `tolerances`) and `result` (a dict)."""
    specified = study.tasks.tolerances
    content = {
        "title": study.title,
        "note": study_note(study) or None,
        "duration": study.duration,
        "method": asdict(study.method),
        "task": {"name": name, **asdict(getattr(study.tasks, name))},
        "tolerances": None if specified is None else asdict(specified),
        **result,
        "units": {"duration": "s", "error": "rad or m", **result.get("units", {})},
    }
    return write_json(path, _plain(content))


def write_sensitivity(folder, study, result, undamped) -> list[Path]:
    """Write sensitivity.json and sensitivity.csv (one row per metric and error, ranked)."""
    metrics = {}
    for m, metric in enumerate(result.metrics):
        rows = [row for row in result.rows() if row["metric"] == metric]
        one = {
            "value": result.value[m],
            "character": result.character[m],
            "gradient": dict(zip(result.names, result.gradient[m], strict=True)),
            "effects": {row["error"]: row["effect"] for row in rows},
        }
        if result.hessian is not None:
            pairs = result.principal_directions(metric)
            one["hessian"] = result.hessian[m]
            one["principal_directions"] = [{"eigenvalue": v, "direction": d} for v, d in pairs]
        if result.gradient_change is not None:
            change = dict(zip(result.names, result.gradient_change[m], strict=True))
            one["gradient_change_at_finer_step"] = change
            if result.hessian_change is not None:
                one["hessian_change_at_finer_step"] = result.hessian_change[m]
        metrics[metric] = one
    content = {
        "status": result.status,
        "derivative_residual": result.derivative_residual,
        "undamped": undamped,
        "mode": result.mode,
        "errors": list(result.names),
        "half_widths": dict(zip(result.names, result.scale, strict=True)),
        "metrics": metrics,
        "units": metric_units(result),
    }
    folder = Path(folder)
    return [
        write_task_json(folder / "sensitivity.json", study, "sensitivity", content),
        write_csv(folder / "sensitivity.csv", result.rows()),
    ]


def _estimate(estimate):
    return {"value": estimate.value, "low": estimate.low, "high": estimate.high}


def _statistics(result, metric):
    found = result.statistics[metric]
    one = {
        "mean": _estimate(found.mean),
        "std": _estimate(found.std),
        "quantiles": {f"{q:g}": _estimate(e) for q, e in found.quantiles.items()},
        "smallest": found.smallest,
        "largest": found.largest,
    }
    if metric in result.yields:
        one["limits"] = result.limits[metric]
        one["yield_of_good"] = _estimate(result.yields[metric].of_good)
        one["yield_of_all"] = _estimate(result.yields[metric].of_all)
    if result.sobol_indices is not None:
        indices = result.sobol_indices[metric]
        one["first_order_indices"] = {k: _estimate(v) for k, v in indices.first_order.items()}
        one["total_indices"] = {k: _estimate(v) for k, v in indices.total.items()}
    controlled = (result.controlled_means or {}).get(metric)
    if controlled is not None:
        one["controlled_mean"] = _estimate(controlled.mean)
        one["variance_reduction"] = controlled.variance_reduction
    return one


def write_monte_carlo(folder, study, result) -> list[Path]:
    """Write monte_carlo.json and monte_carlo.csv (one row per sample: status, errors, metrics)."""
    together = result.joint_yield
    content = {
        "samples": result.samples,
        "good": result.good,
        "failures": result.failures,
        "confidence": result.confidence,
        "sampling": result.sampling,
        "metrics": {metric: _statistics(result, metric) for metric in result.metrics},
        "joint_yield_of_good": None if together is None else _estimate(together.of_good),
        "joint_yield_of_all": None if together is None else _estimate(together.of_all),
        "control_note": result.control_note,
        "units": metric_units(result),
    }
    errors = [f"{n}_{u}" for n, u in zip(result.names, result.error_units, strict=True)]
    rows = []
    for index in range(result.samples):
        row = {"sample": index, "status": int(result.status[index])}
        row |= dict(zip(errors, result.errors[index], strict=True))
        row |= dict(zip(result.metrics, result.values[index], strict=True))
        rows.append(row)
    folder = Path(folder)
    return [
        write_task_json(folder / "monte_carlo.json", study, "monte_carlo", content),
        write_csv(folder / "monte_carlo.csv", rows),
    ]


def write_worst_case(folder, study, results) -> list[Path]:
    """Write worst_case.json and worst_case.csv (per metric: found, corners, quadratic, nominal)."""
    metrics, rows = {}, []
    for name, one in results.items():
        corners = None
        if one.corners is not None:
            corners = {key: getattr(one.corners, key) for key in ("count", "failed", "value")}
            corners |= {"errors": one.corners.errors, "values": one.corners.values}
        metrics[name] = {
            key: getattr(one, key)
            for key in (
                *("status", "value", "errors", "found_by", "maximisers", "nominal", "slopes"),
                *("kkt_residual", "active", "evaluations", "failed", "quadratic_value"),
                *("quadratic_errors", "quadratic_bound", "hessian_error", "region", "sense"),
            )
        } | {"corners": corners}
        kinds = [("found", one.value, one.errors)]
        if one.corners is not None:
            kinds.append(("best_corner", one.corners.value, one.corners.errors))
        kinds.append(("quadratic_model", one.quadratic_value, one.quadratic_errors))
        kinds.append(("nominal", one.nominal, {}))
        for kind, value, errors in kinds:
            row = {"metric": name, "unit": one.unit, "kind": kind, "value": value}
            rows.append(row | {error: errors.get(error, float("nan")) for error in one.names})
    units = {name: one.unit or "1" for name, one in results.items()}
    folder = Path(folder)
    content = {"metrics": metrics, "units": units}
    return [
        write_task_json(folder / "worst_case.json", study, "worst_case", content),
        write_csv(folder / "worst_case.csv", rows),
    ]


def _allocation(one):
    keys = ("criterion", "status", "message", "tolerances", "cost", "at_bounds", "level")
    keys += ("predicted_yield", "verified_yield", "yield_interval", "verified_by", "history")
    found = {key: getattr(one, key) for key in (*keys, "failed", "hessian_error")}
    return found | {"limits": [asdict(check) for check in one.limits]}


def write_allocation(folder, study, found) -> list[Path]:
    """Write allocation.json, allocation.csv (tolerances before and after) and, with scaled limits,
    allocation_front.csv (cost, limits and tolerances of each)."""
    answer, folder = found.answer, Path(folder)
    content = {
        **_allocation(answer),
        "before": {"tolerances": found.before, "cost": found.cost_before},
        "front": [{"scale": scale, **_allocation(one)} for scale, one in found.front.items()],
        "units": {**answer.units, **{check.metric: check.unit for check in answer.limits}},
    }
    rows = [
        {
            "error": name,
            "unit": answer.units[name],
            "before": found.before.get(name, float("nan")),
            "after": after,
            "smallest": study.tasks.allocation.bounds[name][0],
            "largest": study.tasks.allocation.bounds[name][1],
            "at_bound": answer.at_bounds.get(name, ""),
        }
        for name, after in answer.tolerances.items()
    ]
    written = [
        write_task_json(folder / "allocation.json", study, "allocation", content),
        write_csv(folder / "allocation.csv", rows),
    ]
    if len(found.front) > 1:
        rows = []
        for scale, one in found.front.items():
            row = {"scale": scale, "status": one.status, "cost": one.cost}
            for check in one.limits:
                row[f"{check.metric}_{check.side}_limit"] = check.limit
                row[f"{check.metric}_{check.side}_verified"] = check.verified
            rows.append(row | one.tolerances)
        written.append(write_csv(folder / "allocation_front.csv", rows))
    return written
