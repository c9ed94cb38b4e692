"""Result of a reliability study: probabilities that limits are broken; prints itself.

Place in the pipeline: output of the reliability study, input of tables, pictures and files.
"""

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.labelled_data import (
    ESTIMATE,
    Arrays,
    Labelled,
    Parts,
    Table,
    column_name,
    limit_coordinates,
    named_dimension,
    text_array,
)
from rfem_jax.tolerancing.labelled_results import MetricResult
from rfem_jax.tolerancing.layout import show_error, show_number
from rfem_jax.tolerancing.sampling.statistics import Estimate


@dataclass(frozen=True, eq=False)
class LimitFailure:
    """How probable it is that one end of a limit is broken.

    metric, unit, side ("upper" or "lower"), limit and nominal (at the medians of all errors) [unit];
    status: "ok"; "not_reached" where neither searches nor samples found errors with which the limit fails; "uncertain"
    where the probability cannot be trusted, for the `reason` in words;
    beta: reliability index, the distance of the nearest design point in standard normal coordinates, negative where the
    nominal mechanism fails (infinite for a limit that is not reached, NaN where no search found a point);
    design_point: "converged", "not_converged" (it lies on the limit, and a nearer one may be beside it) or "none";
    first_order: probability by FORM, N(-beta_j) of all design points together (their number: points);
    probability: by the method "importance_sampling"; of an uncertain limit by "subset_simulation", with an interval
    that spans both; failed simulations count as broken limits;
    effective_samples: how many failing samples of equal weight tell as much, largest_weight: part of the probability
    that one sample is, of the importance sampling; subset_simulation: the probability by that, an independent check;
    errors {name: rad or m}: the most probable ones that break the limit, the nearest design point;
    shares {factor: part of beta^2}: direction cosines squared, summed over the errors of a factor.
    """

    metric: str
    unit: str
    side: str
    limit: float
    nominal: float
    status: str
    reason: str
    beta: float
    design_point: str
    first_order: float
    points: Float[np.ndarray, "p k"]
    probability: Estimate
    method: str
    effective_samples: float
    largest_weight: float
    subset_simulation: Estimate
    errors: dict[str, float]
    shares: dict[str, float]

    def remarks(self) -> list[str]:
        """What a reader has to know beside the numbers, a phrase each."""
        found = []
        if self.status == "not_reached":
            found.append("no errors were found that break the limit")
        if self.status == "uncertain":
            found.append(f"uncertain, because {self.reason}: take the interval as a hint, or more samples")
        if self.status != "not_reached" and self.design_point == "none":
            found.append("no most probable errors were found, as no search converged")
        if self.design_point == "not_converged":
            found.append(
                "the search of the most probable errors did not converge; take more rounds for beta and shares"
            )
        return found


@dataclass(frozen=True, eq=False)
class ReliabilityResult(MetricResult):
    """Result of a reliability study.

    names, error_units (k) of the errors; limits, one `LimitFailure` for every finite end; any_limit: probability that
    at least one is broken; samples of the importance sampling, and how many of them failed as simulations;
    confidence of all intervals; searches per limit.
    """

    names: tuple[str, ...]
    error_units: tuple[str, ...]
    limits: tuple[LimitFailure, ...]
    any_limit: Estimate
    samples: int
    failed: int
    confidence: float
    searches: int
    simulations: int

    @property
    def status(self) -> str:
        """ "ok" if every limit has an answer (also that it is not reached), "uncertain" where one cannot be trusted."""
        if not all(np.isfinite(one.nominal) for one in self.limits):
            return "failed"
        return "uncertain" if any(one.status == "uncertain" for one in self.limits) else "ok"

    index = ("metric", "side")

    @property
    def metric_names(self) -> tuple[str, ...]:
        return tuple(one.metric for one in self.limits)

    def rows(self) -> list[dict[str, Any]]:
        """A row per limit; `unit` is that of `limit` and `nominal`."""
        columns = {n: column_name(n, unit) for n, unit in zip(self.names, self.error_units, strict=True)}
        out = []
        for one in self.limits:
            row: dict[str, Any] = {"metric": one.metric, "side": one.side, "unit": one.unit or "1"}
            row |= {"limit": one.limit, "nominal": one.nominal, "status": one.status, "beta": one.beta}
            row |= {"first_order_probability": one.first_order, "probability": one.probability.value}
            row |= {"probability_low": one.probability.low, "probability_high": one.probability.high}
            row |= {"method": one.method, "effective_samples": one.effective_samples}
            row |= {"largest_weight": one.largest_weight, "subset_simulation": one.subset_simulation.value}
            row |= {"design_point": one.design_point, "reason": one.reason}
            out.append(row | {columns[name]: one.errors.get(name, float("nan")) for name in self.names})
        return out

    def arrays(self) -> Arrays:
        """Limits over `limit_number`, probabilities with their intervals over `estimate`, errors over `error`."""
        each, of_limit, interval = self.limits, ("limit_number",), ("limit_number", "estimate")
        errors = np.reshape([[one.errors.get(name, np.nan) for name in self.names] for one in each], (len(each), -1))
        variables = {
            "limit": Labelled(of_limit, [one.limit for one in each], "", "in limit_unit"),
            "nominal": Labelled(of_limit, [one.nominal for one in each], "", "of the metric, in limit_unit"),
            "status": Labelled(of_limit, text_array(one.status for one in each), "", "of the probability"),
            "method": Labelled(of_limit, text_array(one.method for one in each), "", "that the probability is by"),
            "beta": Labelled(of_limit, [one.beta for one in each], "1", "reliability index"),
            "first_order": Labelled(of_limit, [one.first_order for one in each], "1", "probability by FORM"),
            "probability": Labelled(
                interval, [astuple(one.probability) for one in each], "1", "that a limit is broken"
            ),
            "subset_simulation": Labelled(
                interval, [astuple(one.subset_simulation) for one in each], "1", "the probability by subset simulation"
            ),
            "any_limit": Labelled(("estimate",), astuple(self.any_limit), "1", "probability that any limit is broken"),
            "error_value": Labelled((*of_limit, "error"), errors, "", "most probable errors that break it, error_unit"),
        }
        coordinates = named_dimension("error", self.names, self.error_units) | limit_coordinates(each)
        attributes = {"title": "Reliability", "status": self.status, "samples": self.samples, "failed": self.failed}
        return variables, coordinates | {"estimate": ESTIMATE}, attributes | {"confidence": self.confidence}

    def parts(self) -> Parts:
        """The probabilities, at which errors limits break, and the yield."""
        head = f"Reliability: {self.samples} samples where limits fail, {self.failed} of them failed simulations; "
        head += f"intervals of {100 * self.confidence:g} % confidence"
        table = [
            [
                f"{one.metric} {'<=' if one.side == 'upper' else '>='} {show_number(one.limit)} {one.unit}".rstrip(),
                show_number(one.beta, 4),
                show_number(one.first_order, 3),
                _short(one.probability) + (" uncertain" if one.status == "uncertain" else ""),
                show_number(one.subset_simulation.value, 2),
            ]
            for one in self.limits
        ]
        table.append(["any limit", "", "", _short(self.any_limit), ""])
        header = ["limit", "beta", "FORM", "probability that it is broken", "check"]
        parts: list[str | Table] = [head, Table(header, table)]
        unit = dict(zip(self.names, self.error_units, strict=True))
        for one in self.limits:
            texts = one.remarks()
            if one.errors:
                worst = ", ".join(f"{name} {show_error(e, unit[name], 4)}" for name, e in one.errors.items())
                shares = ", ".join(f"{name} {100 * part:.3g} %" for name, part in one.shares.items())
                texts = [f"breaks most probably at {worst}; shares {shares}", *texts]
            parts += [f"{one.metric} ({one.side}): {text}" for text in texts]
        return [*parts, f"Yield of all limits: {1.0 - self.any_limit.value:.9g}"]


def _short(estimate: Estimate) -> str:
    return f"{estimate.value:.3g} [{estimate.low:.3g}, {estimate.high:.3g}]"
