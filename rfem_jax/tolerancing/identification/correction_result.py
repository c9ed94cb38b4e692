"""The result of a correction: what a metric is before and after adjustments, as a distribution over the posterior.

Place in the pipeline: correction -> **correction_result** -> Identification, terminal, files, page, notebooks.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.labelled_data import Arrays, Labelled, LabelledResult, Parts, Table, named_dimension
from rfem_jax.tolerancing.layout import show_error, show_number

AS_IT_IS, TOGETHER = "as it is", "all together"
# What a status means, the worst first.
STATUSES = {
    "failed": "no run of the machine as it is succeeded: nothing can be said of corrections",
    "doubtful": "what was found of the errors, or runs after the correction, are in doubt: do not rely on what is "
    "promised until the status of the identification is ok and runs succeed",
    "not_converged": "the search ended before the best amounts were found: what is promised holds for the amounts that "
    "are told, and others may be better; allow more `steps`",
    "no_gain": "no adjustment within its bounds makes the metric less",
    "ok": "the best adjustment makes the metric less",
}


@dataclass(frozen=True, eq=False)
class Outcome:
    """A machine after adjustments, as far as it is known.

    name: of the adjustment, "as it is" or "all together"; amounts (a,) [rad, m] of all adjustments; values (N,) of the
    metric for the samples of the posterior, NaN where a run failed; mean, deviation; low, high: interval of the
    confidence; reached: the quantile that was asked for; less: probability that the metric is less than as it is;
    failed: probability that the machine does not work; broken {metric: probability that its limit is broken};
    beyond (k,): probability that an error is beyond its tolerance, NaN without one; any_beyond: that one of them is;
    converged: whether the search of the amounts did.
    """

    name: str
    amounts: Float[np.ndarray, " a"]
    values: Float[np.ndarray, " N"]
    mean: float
    deviation: float
    low: float
    high: float
    reached: float
    less: float
    failed: float
    broken: dict[str, float]
    beyond: Float[np.ndarray, " k"]
    any_beyond: float
    converged: bool


@dataclass(frozen=True, eq=False)
class Correction(LabelledResult):
    """Which adjustment reduces a metric most, given what is known of the errors.

    metric, unit; adjustments, error_units (a); bounds (a, 2) [rad, m] of the amounts; names (k) of the errors that were
    identified; outcomes: as it is, each adjustment alone, and all together where there are several; weights (N,) of the
    samples; confidence of the intervals; quantile: the part of the probability that `reached` is not exceeded with;
    status: see `message`.
    """

    metric: str
    unit: str
    adjustments: tuple[str, ...]
    error_units: tuple[str, ...]
    bounds: Float[np.ndarray, "a 2"]
    names: tuple[str, ...]
    outcomes: tuple[Outcome, ...]
    weights: Float[np.ndarray, " N"]
    confidence: float
    quantile: float
    status: str

    index = ("correction",)

    @property
    def message(self) -> str:
        """The status in a sentence."""
        return STATUSES[self.status]

    @property
    def before(self) -> Outcome:
        """The machine as it is."""
        return self.outcomes[0]

    @property
    def best(self) -> Outcome:
        """The single adjustment after which the metric is expected to be least."""
        alone = self.outcomes[1 : 1 + len(self.adjustments)]
        return min(alone, key=lambda one: one.mean if np.isfinite(one.mean) else np.inf, default=self.before)

    @property
    def together(self) -> Outcome:
        """All adjustments at once; the only one where there is one."""
        return self.outcomes[-1]

    def amounts(self, outcome: Outcome) -> dict[str, float]:
        """{adjustment: amount [rad or m]} of those that are made."""
        pairs = zip(self.adjustments, outcome.amounts, strict=True)
        return {name: float(amount) for name, amount in pairs if amount != 0.0}

    def rows(self) -> list[dict[str, Any]]:
        """A row per correction; amounts in rad or m, the metric in its unit."""
        return [
            {
                "correction": one.name,
                **{f"amount_{name}": float(u) for name, u in zip(self.adjustments, one.amounts, strict=True)},
                "mean": one.mean, "deviation": one.deviation, "low": one.low, "high": one.high,
                "quantile": one.reached, "less": one.less, "failed": one.failed,
                **{f"broken_{name}": part for name, part in one.broken.items()}, "tolerance_violated": one.any_beyond,
            }
            for one in self.outcomes
        ]  # fmt: skip

    def arrays(self) -> Arrays:
        """Corrections over `correction`, adjustments over `adjustment`, samples of the posterior over `sample`."""
        of = ("correction",)
        variables = {
            name: Labelled(of, [getattr(one, key) for one in self.outcomes], unit, words)
            for name, key, unit, words in (
                ("mean", "mean", self.unit, f"expected {self.metric}"),
                ("deviation", "deviation", self.unit, "standard deviation"),
                ("low", "low", self.unit, "interval from"), ("high", "high", self.unit, "interval to"),
                ("quantile", "reached", self.unit, f"quantile {self.quantile:g}"),
                ("less", "less", "1", "probability of less than as it is"),
                ("failed", "failed", "1", "probability that the machine does not work"),
                ("tolerance_violated", "any_beyond", "1", "probability that an error is beyond its tolerance"),
            )
        }  # fmt: skip
        variables["amount"] = Labelled(
            (*of, "adjustment"), np.stack([one.amounts for one in self.outcomes]), "", "in adjustment_unit"
        )
        variables["value"] = Labelled(
            (*of, "sample"), np.stack([one.values for one in self.outcomes]), self.unit, self.metric
        )
        variables["weight"] = Labelled(("sample",), self.weights, "1", "of a sample of the posterior")
        variables["beyond_tolerance"] = Labelled(
            (*of, "error"), np.stack([one.beyond for one in self.outcomes]), "1", "probability"
        )
        coordinates = named_dimension("adjustment", self.adjustments, self.error_units)
        coordinates |= {"correction": [one.name for one in self.outcomes], "error": self.names}
        return variables, coordinates, {"title": "Correction", "status": self.status, "metric": self.metric}

    def parts(self) -> Parts:
        """What every adjustment does, and the best one in a sentence."""
        interval, unit = f"{100.0 * self.confidence:g} % interval", f" {self.unit}" if self.unit else ""
        limits = tuple(self.before.broken)
        header = ["correction", *self.adjustments, f"{self.metric}{unit}", f"{interval} from", "to"]
        header += [
            f"{100.0 * self.quantile:g} % below",
            "less",
            *(f"{name} broken" for name in limits),
            "beyond tolerance",
        ]
        rows = [
            [
                one.name,
                *(show_error(u, e, 3) if u else "-" for u, e in zip(one.amounts, self.error_units, strict=True)),
                *(show_number(x, 4) for x in (one.mean, one.low, one.high, one.reached)),
                "-" if one is self.before else percent(one.less),
                *(percent(one.broken[name]) for name in limits), percent(one.any_beyond),
            ]
            for one in self.outcomes
        ]  # fmt: skip
        return [f"Correction: status {self.status}: {self.message}", Table(header, rows), *self.sentences()]

    def sentences(self) -> list[str]:
        """The best adjustment, and all together where that is better, with what is promised of them."""
        if self.status in ("failed", "no_gain"):
            return []
        words = ["The best single adjustment", "All together"]
        chosen = [self.best] if self.together.name != TOGETHER else [self.best, self.together]
        return [f"{say}: {self._promise(one)}" for say, one in zip(words[: len(chosen)], chosen, strict=True)]

    def _promise(self, one: Outcome) -> str:
        moves = ", ".join(
            f"{name} by {show_error(amount, unit, 3)}"
            for name, amount, unit in zip(self.adjustments, one.amounts, self.error_units, strict=True)
            if amount
        )
        was, unit = self.before, f" {self.unit}" if self.unit else ""
        said = f"{moves or 'nothing'}, and {self.metric} is expected to be {one.mean:.4g}{unit} ({one.low:.4g} to "
        said += f"{one.high:.4g}) in the place of {was.mean:.4g} ({was.low:.4g} to {was.high:.4g})."
        return said if not one.failed else f"{said} With a probability of {percent(one.failed)} it does not work."


def percent(part: float) -> str:
    """A probability for a table; "-" where it does not exist."""
    if not np.isfinite(part):
        return "-"
    return "< 0.001 %" if part < 1e-5 else f"{100.0 * part:.3g} %"
