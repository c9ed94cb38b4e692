"""What results of tolerance studies hold, as labelled data, and their rows.

Place in the pipeline: the results inherit these. Units that change along a dimension are coordinates (`metric_unit`
along `metric`, `error_unit` along `error`); an estimate has the dimension `estimate`: value, low, high.
"""

from collections.abc import Mapping, Sequence
from dataclasses import astuple
from typing import Any

import numpy as np

from rfem_jax.description.metrics.catalogue import note_sentences
from rfem_jax.labelled_data import (
    ESTIMATE,
    Arrays,
    Labelled,
    LabelledResult,
    column_name,
    named_dimension,
    text_array,
)


class MetricResult(LabelledResult):
    """A result of metrics, with notes on those whose names alone would mislead."""

    @property
    def metric_names(self: Any) -> Sequence[str]:
        """The metrics that it tells of."""
        return self.metrics

    def notes(self) -> Sequence[str]:
        return note_sentences(self.metric_names)


class LabelledSensitivities(MetricResult):
    """Of `Sensitivities`."""

    index = ("metric", "error")

    def arrays(self: Any) -> Arrays:
        """Over `metric` and `error` (`error_2`: second index of a Hessian; `direction`: principal directions)."""
        metric, error, both = ("metric",), ("error",), ("metric", "error")
        square, directions = (*both, "error_2"), ("metric", "direction")
        per = "per tolerance, in metric_unit"
        variables = {
            "value": Labelled(metric, self.value, "", "value at the point, in metric_unit"),
            "gradient": Labelled(both, self.gradient, "", "gradient, metric_unit by error_unit"),
            "gradient_per_tolerance": Labelled(both, self.gradient_scaled, "", f"gradient {per}"),
            "hessian": Labelled(square, self.hessian, "", "Hessian, metric_unit by error_unit twice"),
            "hessian_per_tolerance": Labelled(square, self.hessian_scaled, "", f"Hessian {per}"),
            "effect": Labelled(both, self.effects, "", "largest change by an error alone, in metric_unit"),
            "vanishes_by_symmetry": Labelled(both, self.vanishing, "", "whether the gradient is zero by symmetry"),
            "root_derivative": Labelled(both, self.root_derivatives, "", "growth of the square root per tolerance"),
            "eigenvalue": Labelled(directions, self.eigenvalues, "", f"of the Hessian {per}"),
            "principal_direction": Labelled((*directions, "error"), self.directions, "", "in tolerances"),
            "gradient_change": Labelled(both, self.gradient_change, "", "at a finer step, relative to the effect"),
            "hessian_change": Labelled(
                metric, self.hessian_change, "", "at a finer step, relative to the largest entry"
            ),
            "tolerance": Labelled(error, self.scale, "", "half-width, in error_unit"),
            "at": Labelled(error, [self.at.get(name, 0.0) for name in self.names], "", "point, in error_unit"),
            "character": Labelled(metric, text_array(self.character), "", "of the metric"),
        }
        coordinates = named_dimension("metric", self.metrics, self.metric_units)
        coordinates |= named_dimension("error", self.names, self.error_units)
        if self.hessian is not None:
            coordinates["error_2"] = self.names
        attributes = {"title": "Sensitivities", "order": self.order, "derivatives_by": self.mode, "status": self.status}
        return variables, coordinates, attributes | {"derivative_residual": self.derivative_residual}


class LabelledMonteCarlo(MetricResult):
    """Of `MonteCarloResult`."""

    index = ("sample",)

    def arrays(self: Any) -> Arrays:
        """All samples over `sample`, statistics over `metric` with their intervals over `estimate`."""
        metric, of_metric, found = ("metric",), ("metric", "estimate"), [self.statistics[one] for one in self.metrics]
        fractions = list(found[0].quantiles)
        number = Labelled(("sample",), np.arange(len(self.status)), "1", "number of the sample")
        coordinates = {"sample": number, "estimate": ESTIMATE, "quantile": Labelled(("quantile",), fractions, "1")}
        coordinates |= named_dimension("metric", self.metrics, self.metric_units)
        coordinates |= named_dimension("error", self.names, self.error_units)
        quantiles = [[astuple(one.quantiles[q]) for q in fractions] for one in found]
        limits = np.array([self.limits.get(name, (-np.inf, np.inf)) for name in self.metrics], dtype=float)
        unit = "in metric_unit"
        variables = {
            "error_value": Labelled(("sample", "error"), self.errors, "", "errors of the samples, in error_unit"),
            "value": Labelled(("sample", "metric"), self.values, "", f"metrics of the samples, {unit}; NaN: it failed"),
            "status": Labelled(("sample",), self.status, "", "0: good"),
            "mean": Labelled(of_metric, [astuple(one.mean) for one in found], "", f"mean, {unit}"),
            "std": Labelled(of_metric, [astuple(one.std) for one in found], "", f"standard deviation, {unit}"),
            "quantiles": Labelled(("metric", "quantile", "estimate"), quantiles, "", f"quantiles, {unit}"),
            "smallest": Labelled(metric, [one.smallest for one in found], "", f"smallest sample, {unit}"),
            "largest": Labelled(metric, [one.largest for one in found], "", f"largest sample, {unit}"),
            "lower_limit": Labelled(metric, limits[:, 0], "", unit),
            "upper_limit": Labelled(metric, limits[:, 1], "", unit),
        }
        variables |= self._yields() | self._indices(coordinates)
        attributes = {"title": "Monte Carlo study", "samples": self.samples, "good": self.good}
        attributes |= {"confidence": self.confidence, "sampling": self.sampling}
        attributes["failures"] = ", ".join(f"{count} {cause}" for cause, count in self.failures.items())
        return variables, coordinates, attributes

    def _yields(self: Any) -> dict[str, Labelled]:
        none = (np.nan,) * 3
        variables = {}
        for which in ("of_good", "of_all") if self.yields else ():
            by_metric = [astuple(getattr(self.yields[m], which)) if m in self.yields else none for m in self.metrics]
            words = f"fraction within the limits, {which.replace('_', ' ')} samples"
            variables[f"yield_{which}"] = Labelled(("metric", "estimate"), by_metric, "1", words)
            together = astuple(getattr(self.joint_yield, which))
            variables[f"joint_yield_{which}"] = Labelled(("estimate",), together, "1", f"{words}, all limits together")
        return variables

    def _indices(self: Any, coordinates: dict[str, Any]) -> dict[str, Labelled]:
        variables = {}
        if self.sobol_indices is not None:
            found = [self.sobol_indices[name] for name in self.metrics]
            factors = list(found[0].total)
            coordinates["factor"] = factors
            for which, words in (("first_order", "first-order Sobol' index"), ("total", "total Sobol' index")):
                values = [[astuple(getattr(one, which)[factor]) for factor in factors] for one in found]
                variables[f"{which}_index"] = Labelled(("metric", "factor", "estimate"), values, "1", words)
        if self.controlled_means:
            known = [self.controlled_means.get(name) for name in self.metrics]
            means = [(np.nan,) * 3 if one is None else astuple(one.mean) for one in known]
            words = "mean with a control variate, in metric_unit"
            variables["controlled_mean"] = Labelled(("metric", "estimate"), means, "", words)
        return variables

    def rows(self: Any) -> list[dict[str, Any]]:
        """One row per sample: its number, status, errors [rad, m] and metrics, {column with unit: value}."""
        errors = [column_name(*named) for named in zip(self.names, self.error_units, strict=True)]
        metrics = [column_name(*named) for named in zip(self.metrics, self.metric_units, strict=True)]
        rows: list[dict[str, Any]] = []
        for index in range(self.samples):
            row = {"sample": index, "status": int(self.status[index])}
            row |= dict(zip(errors, self.errors[index], strict=True))
            row |= dict(zip(metrics, self.values[index], strict=True))
            rows.append(row)
        return rows


class LabelledWorstCase(MetricResult):
    """Of `WorstCase`."""

    index = ("metric", "kind")

    @property
    def metric_names(self: Any) -> Sequence[str]:
        return (self.metric,)

    def arrays(self: Any) -> Arrays:
        """The worst errors over `error`, searches over `search`, corners over `corner`."""
        unit = self.unit or "1"
        rows = [[one.get(name, np.nan) for name in self.names] for one in self.maximisers]
        searches = ("search", "error")
        variables = {
            "value": Labelled((), self.value, unit, f"{self.sense} of {self.metric}"),
            "nominal": Labelled((), self.nominal, unit, "at the centre"),
            "quadratic_value": Labelled((), self.quadratic_value, unit, "of the quadratic model"),
            "quadratic_bound": Labelled((), self.quadratic_bound, unit, "bound of the quadratic model"),
            "worst_error": _by_error(self, self.errors, "errors at the worst point, in error_unit"),
            "quadratic_error": _by_error(self, self.quadratic_errors, "errors of the quadratic model, in error_unit"),
            "slope": Labelled(("error",), [self.slopes.get(n, np.nan) for n in self.names], unit, "per tolerance"),
            "start": Labelled(searches, np.reshape(self.starts, (-1, len(self.names))), "1", "in tolerances"),
            "end": Labelled(searches, np.reshape(self.ends, (-1, len(self.names))), "1", "in tolerances"),
            "end_value": Labelled(("search",), self.end_values, unit, "metric at the end of a search"),
            "residual": Labelled(("search",), self.residuals, "1", "KKT residual at the end of a search"),
        }
        if rows:
            variables["maximiser"] = Labelled(("maximiser_number", "error"), rows, "", "tied worst points")
        if self.corners is not None:
            variables["corner_value"] = Labelled(("corner",), self.corners.values, unit, "metric at a corner")
        attributes = {"title": f"Worst case of {self.metric}", "status": self.status, "region": self.region}
        attributes |= {"found_by": self.found_by, "failed": self.failed, "kkt_residual": float(self.kkt_residual)}
        return variables, named_dimension("error", self.names, self.error_units), attributes

    def rows(self: Any) -> list[dict[str, Any]]:
        """The point found, the best corner, the quadratic model's and the centre; `unit` is that of `value`."""
        columns = {n: column_name(n, unit) for n, unit in zip(self.names, self.error_units, strict=True)}
        kinds = [("found", self.value, self.errors)]
        if self.corners is not None:
            kinds.append(("best_corner", self.corners.value, self.corners.errors))
        kinds += [("quadratic_model", self.quadratic_value, self.quadratic_errors), ("nominal", self.nominal, {})]
        return [
            {"metric": self.metric, "unit": self.unit or "1", "kind": kind, "value": value}
            | {columns[error]: errors.get(error, float("nan")) for error in self.names}
            for kind, value, errors in kinds
        ]


def _by_error(result: Any, errors: Mapping[str, float], words: str) -> Labelled:
    return Labelled(("error",), [errors.get(name, np.nan) for name in result.names], "", words)
