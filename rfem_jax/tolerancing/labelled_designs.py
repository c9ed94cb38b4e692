"""Results of optimisations of a design as labelled data: xarray Datasets, pandas tables, HTML for notebooks.

Place in the pipeline: beside labelled_results, with its dimensions; `DesignOptimum` inherits these methods.
"""

from typing import Any

import numpy as np

from rfem_jax import rich_text
from rfem_jax.labelled_data import DataFrame, Dataset, Labelled, dataset, frame
from rfem_jax.tolerancing.labelled_results import named_dimension

LIMIT_NUMBERS = ("limit", "nominal", "predicted", "verified", "margin", "shadow_price")


class LabelledDesignOptimum:
    """Of `DesignOptimum`."""

    def to_xarray(self: Any) -> Dataset:
        """An `xarray.Dataset`: dimensions over `design`, tolerances over `error`, terms of the objective over `term`,
        limits over `limit_number`, solutions on the way over `solution`. Raises: ModuleNotFoundError without the extra
        `xarray`."""
        designs, errors, terms = tuple(self.designs), tuple(self.tolerances), tuple(self.terms)
        history = np.reshape(np.asarray(self.history, dtype=float), (-1, 2))
        asked: dict[str, tuple[tuple[str, ...], Any, str, str]] = {
            "design_value": (("design",), list(self.designs.values()), "", "dimension found, in design_unit"),
            "initial_value": (("design",), [self.initial[n] for n in designs], "", "before, in design_unit"),
            "design_at_bound": (("design",), _words(self.at_bounds.get(n, "") for n in designs), "", "if any"),
            "tolerance": (("error",), list(self.tolerances.values()), "", "half-width, in error_unit"),
            "tolerance_at_bound": (("error",), _words(map(self._width_bound, errors)), "", "if any"),
            "term_value": (("term",), list(self.terms.values()), "", "of the objective, in term_unit"),
            "weight": (("term",), [self.weights.get(name, 0.0) for name in terms], "", "in the objective"),
            "objective": ((), self.objective, "1", "weighted sum of the terms"),
            "kkt_residual": ((), self.kkt_residual, "1", "of the objective at the start"),
            "verified_yield": ((), self.verified_yield, "1", "fraction of fresh samples within all limits"),
            "objective_of_solution": (("solution",), history[:, 0], "1", "weighted sum of the terms"),
            "violation_of_solution": (("solution",), history[:, 1], "1", "largest normalised limit"),
        }
        of_limit = ("limit_number",)
        for name in LIMIT_NUMBERS:
            words = "of the objective by limit_unit" if name == "shadow_price" else "in limit_unit"
            asked[name] = (of_limit, [getattr(one, name) for one in self.limits], "", words)
        ends = np.reshape([one.verified_interval for one in self.limits], (-1, 2))
        asked["verified_interval"] = ((*of_limit, "end"), ends, "", "in limit_unit")
        asked["yield_interval"] = (("end",), list(self.yield_interval), "1", "of the verified yield")
        variables = {name: Labelled(*entry) for name, entry in asked.items()}
        coordinates = named_dimension(designs, [self.units[name] for name in designs], "design") | {
            "end": ("low", "high")
        }
        coordinates |= named_dimension(errors, [self.units[name] for name in errors], "error")
        coordinates |= named_dimension(terms, [self.term_units[name] for name in terms], "term")
        for name in ("metric", "side", "unit"):
            values = _words(getattr(one, name) or "1" for one in self.limits)
            coordinates["limit_unit" if name == "unit" else name] = Labelled(of_limit, values)
        attributes = {"title": "Optimum", "criterion": self.criterion, "status": self.status, "message": self.message}
        attributes |= {"verified_by": self.verified_by, "simulations": self.simulations, "failed": self.failed}
        return dataset(variables, coordinates, attributes)

    def rows(self: Any) -> list[dict[str, Any]]:
        """A row per dimension and per tolerance: its value in `unit`, that before (NaN for tolerances), the bound that
        holds it."""
        rows = [
            {"name": name, "kind": "dimension", "unit": self.units[name] or "1", "value": value}
            | {"before": self.initial[name], "at_bound": self.at_bounds.get(name, "")}
            for name, value in self.designs.items()
        ]
        rows += [
            {"name": name, "kind": "tolerance", "unit": self.units[name] or "1", "value": width}
            | {"before": np.nan, "at_bound": self._width_bound(name)}
            for name, width in self.tolerances.items()
        ]
        return rows

    def limit_rows(self: Any) -> list[dict[str, Any]]:
        """A row per limit, numbers in `unit`."""
        return [
            {"metric": one.metric, "side": one.side, "unit": one.unit or "1"}
            | {name: getattr(one, name) for name in LIMIT_NUMBERS}
            | dict(zip(("verified_low", "verified_high"), one.verified_interval, strict=True))
            for one in self.limits
        ]

    def to_pandas(self: Any, limits: bool = False) -> DataFrame:
        """Dimensions and tolerances as a `pandas.DataFrame`, or with `limits` the limits. Raises: ModuleNotFoundError
        without the extra `xarray`."""
        return frame(self.limit_rows(), ["metric", "side"]) if limits else frame(self.rows(), ["name", "kind"])

    def _repr_html_(self: Any) -> str:
        found = []
        for row in self.rows():
            numbers = ["-" if np.isnan(row[key]) else self._show(row["name"], row[key]) for key in ("value", "before")]
            found.append([row["name"], row["kind"], *numbers, row["at_bound"]])
        shown = ("metric", "side", "unit", *LIMIT_NUMBERS)
        limits = [[one[name] for name in shown] for one in self.limit_rows()]
        title = f"Optimum ({self.criterion.replace('_', ' ')}): status {self.status}, objective {self.objective:.6g}"
        return rich_text.document(
            title,
            rich_text.paragraph(self.message),
            rich_text.table(["name", "kind", "value", "before", "bound"], found, (0, 1, 4)),
            rich_text.table([name.replace("_", " ") for name in shown], limits, (0, 1, 2)),
        )

    def _width_bound(self: Any, name: str) -> str:
        label = f"tolerance of {name}" if name in self.designs else name
        return self.at_bounds.get(label, "")


def _words(words: Any) -> np.ndarray:
    return np.array(list(words), dtype=np.str_)
