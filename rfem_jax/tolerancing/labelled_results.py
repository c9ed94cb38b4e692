"""Results of tolerance studies as labelled data: xarray Datasets, pandas tables, HTML for notebooks.

Place in the pipeline: the results inherit these methods. Units that change along a dimension are coordinates
(`metric_unit` along `metric`, `error_unit` along `error`); an estimate has the dimension `estimate`: value, low, high.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rfem_jax import rich_text
from rfem_jax.labelled_data import ESTIMATE, DataFrame, Dataset, Labelled, column_name, dataset, frame
from rfem_jax.tolerancing.layout import show_error

CLOSEST = 8  # errors of a table in a notebook


def named_dimension(names: Sequence[str], units: Sequence[str], dimension: str) -> dict[str, Any]:
    """Coordinates of a dimension: its names and their units."""
    written = np.array([unit or "1" for unit in units], dtype=np.str_)
    return {dimension: tuple(names), f"{dimension}_unit": Labelled((dimension,), written)}


class LabelledSensitivities:
    """Of `Sensitivities`."""

    def to_xarray(self: Any) -> Dataset:
        """An `xarray.Dataset` over `metric` and `error` (`error_2`: second index of a Hessian; `direction`: principal
        directions). Raises: ModuleNotFoundError without the extra `xarray`."""
        both = ("metric", "error")
        square = (*both, "error_2")
        asked: dict[str, tuple[tuple[str, ...], Any, str]] = {
            "value": (("metric",), self.value, "value at the point, in metric_unit"),
            "gradient": (both, self.gradient, "gradient, metric_unit by error_unit"),
            "gradient_per_tolerance": (both, self.gradient_scaled, "gradient per tolerance, in metric_unit"),
            "hessian": (square, self.hessian, "Hessian, metric_unit by error_unit twice"),
            "hessian_per_tolerance": (square, self.hessian_scaled, "Hessian per tolerance, in metric_unit"),
            "effect": (both, self.effects, "largest change by an error alone, in metric_unit"),
            "vanishes_by_symmetry": (both, self.vanishing, "whether the gradient is zero by symmetry"),
            "root_derivative": (both, self.root_derivatives, "growth of the square root per tolerance"),
            "eigenvalue": (("metric", "direction"), self.eigenvalues, "of the Hessian per tolerance, in metric_unit"),
            "principal_direction": (("metric", "direction", "error"), self.directions, "in tolerances"),
            "gradient_change": (both, self.gradient_change, "at a finer step, relative to the effect"),
            "hessian_change": (("metric",), self.hessian_change, "at a finer step, relative to the largest entry"),
        }
        variables = {name: Labelled(dims, x, "", words) for name, (dims, x, words) in asked.items() if x is not None}
        variables["tolerance"] = Labelled(("error",), self.scale, "", "half-width, in error_unit")
        variables["at"] = Labelled(("error",), [self.at.get(n, 0.0) for n in self.names], "", "point, in error_unit")
        variables["character"] = Labelled(("metric",), np.array(self.character, dtype=np.str_), "", "of the metric")
        coordinates = named_dimension(self.metrics, self.metric_units, "metric") | named_dimension(
            self.names, self.error_units, "error"
        )
        if self.hessian is not None:
            coordinates["error_2"] = self.names
        attributes = {"title": "Sensitivities", "order": self.order, "derivatives_by": self.mode, "status": self.status}
        if self.derivative_residual is not None:
            attributes["derivative_residual"] = self.derivative_residual
        return dataset(variables, coordinates, attributes)

    def to_pandas(self: Any) -> DataFrame:
        """The ranked rows as a `pandas.DataFrame` by metric and error. Raises: ModuleNotFoundError without the extra
        `xarray`."""
        return frame(self.rows(), ["metric", "error"])

    def _repr_html_(self: Any) -> str:
        header = ["metric", "error", "tolerance", "effect", "gradient per tolerance", "unit"]
        rows = []
        for m, metric in enumerate(self.metrics):
            for i in np.argsort(-self.effects[m], kind="stable")[:CLOSEST]:
                width = show_error(self.scale[i], self.error_units[i]) if self.scaled else "-"
                numbers = float(self.effects[m, i]), float(self.gradient_scaled[m, i])
                rows.append([metric, self.names[i], width, *numbers, self.metric_units[m] or "1"])
        title = f"Sensitivities of order {self.order}, status {self.status}"
        return rich_text.document(title, rich_text.table(header, rows, (0, 1, 5)))


class LabelledMonteCarlo:
    """Of `MonteCarloResult`."""

    def to_xarray(self: Any) -> Dataset:
        """An `xarray.Dataset`: all samples over `sample`, statistics over `metric` with their intervals over
        `estimate`. Raises: ModuleNotFoundError without the extra `xarray`."""
        of_metric = ("metric", "estimate")
        found = [self.statistics[name] for name in self.metrics]
        fractions = list(found[0].quantiles)
        number = Labelled(("sample",), np.arange(len(self.status)), "1", "number of the sample")
        coordinates = {"sample": number, "estimate": ESTIMATE, "quantile": Labelled(("quantile",), fractions, "1")}
        coordinates |= named_dimension(self.metrics, self.metric_units, "metric") | named_dimension(
            self.names, self.error_units, "error"
        )
        quantiles = [[_ends(one.quantiles[q]) for q in fractions] for one in found]
        limits = np.array([self.limits.get(name, (-np.inf, np.inf)) for name in self.metrics], dtype=float)
        asked: dict[str, tuple[tuple[str, ...], Any, str]] = {
            "error_value": (("sample", "error"), self.errors, "errors of the samples, in error_unit"),
            "value": (("sample", "metric"), self.values, "metrics of the samples, in metric_unit; NaN: it failed"),
            "status": (("sample",), self.status, "0: good"),
            "mean": (of_metric, [_ends(one.mean) for one in found], "mean, in metric_unit"),
            "std": (of_metric, [_ends(one.std) for one in found], "standard deviation, in metric_unit"),
            "quantiles": (("metric", "quantile", "estimate"), quantiles, "quantiles, in metric_unit"),
            "smallest": (("metric",), [one.smallest for one in found], "smallest sample, in metric_unit"),
            "largest": (("metric",), [one.largest for one in found], "largest sample, in metric_unit"),
            "lower_limit": (("metric",), limits[:, 0], "in metric_unit"),
            "upper_limit": (("metric",), limits[:, 1], "in metric_unit"),
        }
        variables = {name: Labelled(dims, values, "", words) for name, (dims, values, words) in asked.items()}
        variables |= self._yields() | self._indices(coordinates)
        attributes = {"title": "Monte Carlo study", "samples": self.samples, "good": self.good}
        attributes |= {"confidence": self.confidence, "sampling": self.sampling}
        attributes["failures"] = ", ".join(f"{count} {cause}" for cause, count in self.failures.items())
        return dataset(variables, coordinates, attributes)

    def _yields(self: Any) -> dict[str, Labelled]:
        none = (np.nan,) * 3
        variables = {}
        for which in ("of_good", "of_all") if self.yields else ():
            by_metric = [_ends(getattr(self.yields[m], which)) if m in self.yields else none for m in self.metrics]
            words = f"fraction within the limits, {which.replace('_', ' ')} samples"
            variables[f"yield_{which}"] = Labelled(("metric", "estimate"), by_metric, "1", words)
            together = _ends(getattr(self.joint_yield, which))
            variables[f"joint_yield_{which}"] = Labelled(("estimate",), together, "1", f"{words}, all limits together")
        return variables

    def _indices(self: Any, coordinates: dict[str, Any]) -> dict[str, Labelled]:
        variables = {}
        if self.sobol_indices is not None:
            found = [self.sobol_indices[name] for name in self.metrics]
            factors = list(found[0].total)
            coordinates["factor"] = factors
            for which, words in (("first_order", "first-order Sobol' index"), ("total", "total Sobol' index")):
                values = [[_ends(getattr(one, which)[factor]) for factor in factors] for one in found]
                variables[f"{which}_index"] = Labelled(("metric", "factor", "estimate"), values, "1", words)
        if self.controlled_means:
            known = [self.controlled_means.get(name) for name in self.metrics]
            means = [(np.nan,) * 3 if one is None else _ends(one.mean) for one in known]
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

    def to_pandas(self: Any) -> DataFrame:
        """The samples as a `pandas.DataFrame`. Raises: ModuleNotFoundError without the extra `xarray`."""
        return frame(self.rows(), ["sample"])

    def _repr_html_(self: Any) -> str:
        fractions = list(next(iter(self.statistics.values())).quantiles)
        header = ["metric", "unit", "mean", "std", *(f"{100 * q:g} %" for q in fractions), "yield of all"]
        rows = []
        for (name, found), unit in zip(self.statistics.items(), self.metric_units, strict=True):
            within = str(self.yields[name].of_all) if name in self.yields else None
            numbers = (found.mean, found.std, *(found.quantiles[q] for q in fractions))
            rows.append([name, unit or "1", *map(str, numbers), within])
        title = f"Monte Carlo: {self.samples} samples, {self.samples - self.good} failed"
        note = f"Intervals of {100 * self.confidence:g} % confidence."
        return rich_text.document(title, rich_text.table(header, rows, (0, 1)), rich_text.paragraph(note))


class LabelledWorstCase:
    """Of `WorstCase`."""

    def to_xarray(self: Any) -> Dataset:
        """An `xarray.Dataset`: the worst errors over `error`, searches over `search`, corners over `corner`. Raises:
        ModuleNotFoundError without the extra `xarray`."""
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
        return dataset(variables, named_dimension(self.names, self.error_units, "error"), attributes)

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

    def to_pandas(self: Any) -> DataFrame:
        """These rows as a `pandas.DataFrame`. Raises: ModuleNotFoundError without the extra `xarray`."""
        return frame(self.rows(), ["metric", "kind"])

    def _repr_html_(self: Any) -> str:
        unit = dict(zip(self.names, self.error_units, strict=True))
        rows = [
            [name, show_error(value, unit[name]), self.active.get(name, ""), float(self.slopes[name])]
            for name, value in self.errors.items()
        ]
        word = "Largest" if self.sense == "max" else "Smallest"
        title = f"{word} {self.metric} over the {self.region}: {self.value:.6g} {self.unit} (status {self.status})"
        header = ["error", "value", "bound", f"gradient per tolerance, {self.unit or 1}"]
        note = f"Nominal {self.nominal:.6g}, quadratic model {self.quadratic_value:.6g} {self.unit}."
        return rich_text.document(title, rich_text.table(header, rows, (0, 2)), rich_text.paragraph(note))


def _ends(estimate: Any) -> tuple[float, float, float]:
    return estimate.value, estimate.low, estimate.high


def _by_error(result: Any, errors: Mapping[str, float], words: str) -> Labelled:
    return Labelled(("error",), [errors.get(name, np.nan) for name in result.names], "", words)
