"""What answers of `allocate` and `optimise` hold, as labelled data, and their rows.

Place in the pipeline: beside labelled_results, with its dimensions; `Allocation` and `DesignOptimum` inherit these.
"""

import abc
from collections.abc import Sequence
from typing import Any

import numpy as np

from rfem_jax.labelled_data import (
    Arrays,
    DataFrame,
    Labelled,
    frame,
    limit_coordinates,
    named_dimension,
    text_array,
)
from rfem_jax.tolerancing.labelled_results import MetricResult


class LabelledSolution(MetricResult):
    """Of `Solution`."""

    @property
    def metric_names(self: Any) -> Sequence[str]:
        return (*(one.metric for one in self.limits), *getattr(self, "terms", ()))

    @abc.abstractmethod
    def own_arrays(self: Any) -> Arrays:
        """What this kind of answer has beside tolerances and limits."""

    def arrays(self: Any) -> Arrays:
        """Tolerances over `error`, limits over `limit_number`; of an allocation costs over `round`; of an optimum
        dimensions over `design`, terms of the objective over `term`, solutions on the way over `solution`."""
        variables, coordinates, attributes = self.own_arrays()
        names, of_limit = tuple(self.tolerances), ("limit_number",)
        variables["tolerance"] = Labelled(("error",), list(self.tolerances.values()), "", "half-width, in error_unit")
        for name in self.limit_numbers:
            words = f"{name.replace('_', ' ')}, {'per' if name == 'shadow_price' else 'in'} limit_unit"
            variables[name] = Labelled(of_limit, [getattr(one, name) for one in self.limits], "", words)
        ends = np.reshape([one.verified_interval for one in self.limits], (-1, 2))
        variables["verified_interval"] = Labelled((*of_limit, "end"), ends, "", "in limit_unit")
        coordinates |= named_dimension("error", names, [self.units[name] for name in names])
        coordinates |= {"end": ("low", "high"), **limit_coordinates(self.limits)}
        attributes |= {"criterion": self.criterion, "status": self.status, "message": self.message}
        return variables, coordinates, attributes | {"failed": self.failed}

    def _history(self: Any, what: str, step: str, words: str) -> dict[str, Labelled]:
        history = np.reshape(np.asarray(self.history, dtype=float), (-1, 2))
        return {
            f"{what}_of_{step}": Labelled((step,), history[:, 0], "1", words),
            f"violation_of_{step}": Labelled((step,), history[:, 1], "1", "largest normalised limit"),
        }

    def limit_rows(self: Any) -> list[dict[str, Any]]:
        """A row per limit, numbers in `unit`."""
        return [
            {"metric": one.metric, "side": one.side, "unit": one.unit or "1"}
            | {name: getattr(one, name) for name in self.limit_numbers}
            | dict(zip(("verified_low", "verified_high"), one.verified_interval, strict=True))
            for one in self.limits
        ]

    def to_pandas(self: Any, limits: bool = False) -> DataFrame:
        """What was found as a `pandas.DataFrame`, or with `limits` the limits."""
        return frame(self.limit_rows(), ("metric", "side")) if limits else super().to_pandas()

    def _width_bound(self: Any, name: str) -> str:
        """The bound that holds a tolerance, "" if none does."""
        label = f"tolerance of {name}" if name in getattr(self, "designs", ()) else name
        return self.at_bounds.get(label, "")


class LabelledAllocation(LabelledSolution):
    """Of `Allocation`."""

    index = ("error",)

    def own_arrays(self: Any) -> Arrays:
        bounds = text_array(map(self._width_bound, self.tolerances))
        variables = {
            "at_bound": Labelled(("error",), bounds, "", "the bound that holds it"),
            "cost": Labelled((), self.cost, "1", "in the currency of the study"),
        }
        variables |= self._history("cost", "round", "in the currency of the study")
        return variables, {}, {"title": "Allocation", "verified_yield": float(self.verified_yield)}

    def rows(self: Any) -> list[dict[str, Any]]:
        """A row per error or zone: its size in `unit`, and the bound that holds it."""
        return [
            {"error": name, "unit": self.units[name], "tolerance": width, "at_bound": self._width_bound(name)}
            for name, width in self.tolerances.items()
        ]


class LabelledOptimum(LabelledSolution):
    """Of `DesignOptimum`."""

    index = ("name", "kind")

    def own_arrays(self: Any) -> Arrays:
        designs, errors, terms = tuple(self.designs), tuple(self.tolerances), tuple(self.terms)
        of_design, of_error, of_term = ("design",), ("error",), ("term",)
        before, bounds = [self.initial[name] for name in designs], [self.at_bounds.get(name, "") for name in designs]
        weights = [self.weights.get(name, 0.0) for name in terms]
        variables = {
            "design_value": Labelled(of_design, list(self.designs.values()), "", "dimension found, in design_unit"),
            "initial_value": Labelled(of_design, before, "", "before, in design_unit"),
            "design_at_bound": Labelled(of_design, text_array(bounds), "", "if any"),
            "tolerance_at_bound": Labelled(of_error, text_array(map(self._width_bound, errors)), "", "if any"),
            "term_value": Labelled(of_term, list(self.terms.values()), "", "of the objective, in term_unit"),
            "weight": Labelled(of_term, weights, "", "in the objective"),
            "objective": Labelled((), self.objective, "1", "weighted sum of the terms"),
            "kkt_residual": Labelled((), self.kkt_residual, "1", "of the objective at the start"),
            "verified_yield": Labelled((), self.verified_yield, "1", "fraction of fresh samples within all limits"),
            "yield_interval": Labelled(("end",), list(self.yield_interval), "1", "of the verified yield"),
        }
        variables |= self._history("objective", "solution", "weighted sum of the terms")
        coordinates = named_dimension("design", designs, [self.units[name] for name in designs])
        coordinates |= named_dimension("term", terms, [self.term_units[name] for name in terms])
        attributes = {"title": "Optimum", "verified_by": self.verified_by, "simulations": self.simulations}
        return variables, coordinates, attributes

    def rows(self: Any) -> list[dict[str, Any]]:
        """A row per dimension and per tolerance: its value in `unit`, that before (NaN for tolerances), the bound that
        holds it."""
        bounds = {name: self.at_bounds.get(name, "") for name in self.designs}
        rows = [(name, "dimension", x, self.initial[name], bounds[name]) for name, x in self.designs.items()]
        rows += [(name, "tolerance", t, np.nan, self._width_bound(name)) for name, t in self.tolerances.items()]
        return [
            {"name": name, "kind": kind, "unit": self.units[name] or "1", "value": value}
            | {"before": before, "at_bound": bound}
            for name, kind, value, before, bound in rows
        ]
