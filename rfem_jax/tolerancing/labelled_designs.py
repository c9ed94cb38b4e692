"""Answers of `allocate` and `optimise` as labelled data: xarray Datasets, pandas tables, HTML for notebooks.

Place in the pipeline: beside labelled_results, with its dimensions; `Allocation` and `DesignOptimum` inherit these
methods.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from rfem_jax import rich_text
from rfem_jax.labelled_data import DataFrame, Dataset, Labelled, dataset, frame
from rfem_jax.tolerancing.labelled_results import named_dimension

Labels = tuple[dict[str, Labelled], dict[str, Any], dict[str, Any]]  # variables, coordinates, attributes


class LabelledSolution:
    """Of `Solution`."""

    def to_xarray(self: Any) -> Dataset:
        """An `xarray.Dataset`: tolerances over `error`, limits over `limit_number`; of an allocation costs over
        `round`; of an optimum dimensions over `design`, terms of the objective over `term`, solutions on the way over
        `solution`. Raises: ModuleNotFoundError without the extra `xarray`."""
        variables, coordinates, attributes = self._own_labels()
        names, of_limit = tuple(self.tolerances), ("limit_number",)
        variables["tolerance"] = Labelled(("error",), list(self.tolerances.values()), "", "half-width, in error_unit")
        for name in self.limit_numbers:
            words = f"{name.replace('_', ' ')}, {'per' if name == 'shadow_price' else 'in'} limit_unit"
            variables[name] = Labelled(of_limit, [getattr(one, name) for one in self.limits], "", words)
        ends = np.reshape([one.verified_interval for one in self.limits], (-1, 2))
        variables["verified_interval"] = Labelled((*of_limit, "end"), ends, "", "in limit_unit")
        coordinates |= named_dimension(names, [self.units[name] for name in names], "error")
        coordinates["end"] = ("low", "high")
        for name in ("metric", "side", "unit"):
            values = _words(getattr(one, name) or "1" for one in self.limits)
            coordinates["limit_unit" if name == "unit" else name] = Labelled(of_limit, values)
        attributes |= {"criterion": self.criterion, "status": self.status, "message": self.message}
        return dataset(variables, coordinates, attributes | {"failed": self.failed})

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
        """What was found as a `pandas.DataFrame`, or with `limits` the limits. Raises: ModuleNotFoundError without the
        extra `xarray`."""
        index = [name for name in ("error", "name", "kind") if name in self.rows()[0]]
        return frame(self.limit_rows(), ["metric", "side"]) if limits else frame(self.rows(), index)

    def _repr_html_(self: Any) -> str:
        found = []
        for row in self.rows():
            name, *_ = row.values()
            shown = {key: value for key, value in row.items() if key != "unit"}
            numbers = {key: value for key, value in shown.items() if isinstance(value, float)}
            found.append(shown | {key: "-" if np.isnan(x) else self._show(name, x) for key, x in numbers.items()})
        words = [place for place, key in enumerate(found[0]) if key in ("error", "name", "kind", "at_bound")]
        keys = ("metric", "side", "unit", *self.limit_numbers)
        limits = [[one[name] for name in keys] for one in self.limit_rows()]
        return rich_text.document(
            self._head(),
            rich_text.paragraph(self.message),
            rich_text.table([key.replace("_", " ") for key in found[0]], [[*row.values()] for row in found], words),
            rich_text.table([name.replace("_", " ") for name in keys], limits, (0, 1, 2)),
        )

    def _width_bound(self: Any, name: str) -> str:
        """The bound that holds a tolerance, "" if none does."""
        label = f"tolerance of {name}" if name in getattr(self, "designs", ()) else name
        return self.at_bounds.get(label, "")


class LabelledAllocation(LabelledSolution):
    """Of `Allocation`."""

    def _own_labels(self: Any) -> Labels:
        bounds = _words(map(self._width_bound, self.tolerances))
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

    def _own_labels(self: Any) -> Labels:
        designs, errors, terms = tuple(self.designs), tuple(self.tolerances), tuple(self.terms)
        asked: dict[str, tuple[tuple[str, ...], Any, str, str]] = {
            "design_value": (("design",), list(self.designs.values()), "", "dimension found, in design_unit"),
            "initial_value": (("design",), [self.initial[n] for n in designs], "", "before, in design_unit"),
            "design_at_bound": (("design",), _words(self.at_bounds.get(n, "") for n in designs), "", "if any"),
            "tolerance_at_bound": (("error",), _words(map(self._width_bound, errors)), "", "if any"),
            "term_value": (("term",), list(self.terms.values()), "", "of the objective, in term_unit"),
            "weight": (("term",), [self.weights.get(name, 0.0) for name in terms], "", "in the objective"),
            "objective": ((), self.objective, "1", "weighted sum of the terms"),
            "kkt_residual": ((), self.kkt_residual, "1", "of the objective at the start"),
            "verified_yield": ((), self.verified_yield, "1", "fraction of fresh samples within all limits"),
            "yield_interval": (("end",), list(self.yield_interval), "1", "of the verified yield"),
        }
        variables = {name: Labelled(*entry) for name, entry in asked.items()}
        variables |= self._history("objective", "solution", "weighted sum of the terms")
        coordinates = named_dimension(designs, [self.units[name] for name in designs], "design")
        coordinates |= named_dimension(terms, [self.term_units[name] for name in terms], "term")
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


def _words(words: Iterable[str]) -> np.ndarray:
    return np.array(list(words), dtype=np.str_)
