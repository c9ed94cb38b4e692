"""The results: what was found of the errors and how sure it is; what could be known of them.

Place in the pipeline: conclusion -> **identification_result** -> terminal, files, page, notebooks.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.labelled_data import Arrays, Labelled, LabelledResult, Parts, Table, column_name, named_dimension
from rfem_jax.tolerancing.identification.correction_result import Correction, percent
from rfem_jax.tolerancing.identification.discretisation_check import Division
from rfem_jax.tolerancing.identification.experiments_compared import (
    Experiment,
    experiment_arrays,
    experiment_parts,
)
from rfem_jax.tolerancing.identification.fit_tests import SignalFit
from rfem_jax.tolerancing.identification.observability import Visibility, combination
from rfem_jax.tolerancing.identification.suspects import Suspect
from rfem_jax.tolerancing.layout import show_error, show_number

PARTS = 4  # of a combination in a table
# What a status means, the worst first.
STATUSES = {
    "failed": "no run from which to search succeeded: the mechanism does not work at any start; look at the prior "
    "and at what `rfem-jax run` says of it",
    "not_converged": "no search reached a minimum in the steps that were allowed; allow more `iterations`, and see "
    "that the steps of the method are small enough for smooth derivatives",
    "undetermined": "data and prior together leave a combination of the unknowns open; give it a prior, hold one of "
    "them `at` a value, or measure another signal",
    "misfit": "the model with the errors found does not explain the data: intervals mean nothing until the cause is "
    "found (an error that is no unknown, noise that is larger than given, outliers: see the signals)",
    "uncertain": "the posterior is not normal, and too few samples represent it: intervals are rough; take more "
    "`samples`",
    "coarse": "the model is divided too coarsely for these data: with more rfes, shorter steps or more saved times the "
    "errors found would move by more than half of a standard deviation (see below)",
    "ambiguous": "several different sets of errors explain the data; intervals are about the most probable one",
    "ok": "the model explains the data",
}


@dataclass(frozen=True, eq=False)
class ModeFound:
    """A set of errors that explains the data: errors (k,) [rad, m], Phi (17.4), its probability beside the others."""

    errors: Float[np.ndarray, " k"]
    cost: float
    probability: float


@dataclass(frozen=True, eq=False)
class Curve:
    """A signal as measured and as simulated: times (n,) [s], measured, before (with the prior's mean), after (with the
    estimate), (n,) [unit of its column]; experiment, its number from 1."""

    column: str
    experiment: int
    times: Float[np.ndarray, " n"]
    measured: Float[np.ndarray, " n"]
    before: Float[np.ndarray, " n"]
    after: Float[np.ndarray, " n"]


class _OfVisibility(LabelledResult):
    """What results say of what can be known."""

    visibility: Visibility | None

    def _visibility_parts(self, title: str) -> Parts:
        seen = self.visibility
        if seen is None:
            return []
        rows = [
            [show_number(s, 3), show_number(1.0 / np.sqrt(1.0 + s**2), 3), combination(seen.names, row, PARTS)]
            for s, row in zip(seen.singular, seen.directions, strict=True)
        ]
        worth = [
            [
                one.column, *(show_number(x, 3) for x in (one.gain, 100.0 * one.rest)), str(one.place),
                *(show_number(x, 3) for x in (one.gain_together, 100.0 * one.rest_together)),
            ]
            for one in seen.worth
        ]  # fmt: skip
        header = ["signal", "information nat", "variance left %", "choice", "with those before", "left %"]
        return [
            "", title,
            Table(["singular value", "deviation left", "combination in prior deviations"], rows, words=(2,)),
            *seen.sentences, "", "What each signal tells, alone and in the order of choice", Table(header, worth),
        ]  # fmt: skip

    def _visibility_arrays(self) -> tuple[dict[str, Labelled], dict[str, Any]]:
        seen = self.visibility
        if seen is None:
            return {}, {}
        worth = [(one.gain, one.rest, one.gain_together, one.rest_together) for one in seen.worth]
        table = np.array(worth).reshape(-1, 4)
        of_signal = ("candidate",)
        variables = {
            "singular_value": Labelled(("combination",), seen.singular, "1", "information of data beside the prior's"),
            "combination_part": Labelled(("combination", "error"), seen.directions, "1", "in prior deviations"),
            "information": Labelled(of_signal, table[:, 0], "nat", "of the signal alone"),
            "variance_left": Labelled(of_signal, table[:, 1], "1", "by the signal alone"),
            "information_together": Labelled(of_signal, table[:, 2], "nat", "with those chosen before it"),
            "variance_left_together": Labelled(of_signal, table[:, 3], "1", "with those chosen before it"),
        }
        return variables, {"candidate": [one.column for one in seen.worth]}


@dataclass(frozen=True, eq=False)
class Identifiability(_OfVisibility):
    """What signals can tell of errors before any is measured.

    names, error_units (k); prior_deviation (k,) [rad, m]; visibility: see `Visibility`; failed: points of the prior,
    of `points`, whose run failed; experiments: what each tells by its length, the one as given first.
    """

    names: tuple[str, ...]
    error_units: tuple[str, ...]
    prior_deviation: Float[np.ndarray, " k"]
    visibility: Visibility | None
    points: int
    failed: int
    experiments: tuple[Experiment, ...] = ()

    index = ("error",)

    @property
    def status(self) -> str:
        """ "ok", or "failed" where no run succeeded."""
        return "failed" if self.visibility is None else "ok"

    def rows(self) -> list[dict[str, Any]]:
        """A row per unknown: standard deviation before and after the measurement."""
        left = np.full(len(self.names), np.nan) if self.visibility is None else self.visibility.deviations
        return [
            {"error": name, "unit": unit, "prior_deviation": float(d), "expected_deviation": float(d * part)}
            for name, unit, d, part in zip(self.names, self.error_units, self.prior_deviation, left, strict=True)
        ]

    def arrays(self) -> Arrays:
        """Unknowns over `error`, combinations over `combination`, signals over `candidate`."""
        variables, coordinates = self._visibility_arrays()
        before = Labelled(("error",), self.prior_deviation, "", "before the measurement, in error_unit")
        after = [row["expected_deviation"] for row in self.rows()]
        variables |= {"prior_deviation": before}
        variables |= {"expected_deviation": Labelled(("error",), after, "", "after it, in error_unit")}
        coordinates |= named_dimension("error", self.names, self.error_units)
        further, places = experiment_arrays(self.experiments)
        return variables | further, coordinates | places, {"title": "Identifiability", "status": self.status}

    def parts(self) -> Parts:
        """Expected deviations, combinations, signals."""
        head = (
            f"Identifiability of {len(self.names)} unknowns: status {self.status}, mean over {self.points} points of "
        )
        head += f"the prior, {self.failed} failed"
        rows = [
            [row["error"], *(show_error(row[key], row["unit"], 3) for key in ("prior_deviation", "expected_deviation"))]
            for row in self.rows()
        ]
        table = Table(["error", "deviation before", "deviation after"], rows)
        seen = self._visibility_parts("What the signals can tell")
        return [head, table, *seen, *experiment_parts(self.experiments, self.names)]


@dataclass(frozen=True, eq=False)
class Identification(_OfVisibility):
    """The errors of a machine that was measured.

    names, error_units (k); estimate (k,) [rad, m], the most probable; deviation (k,), low, high (k,): standard
    deviation and interval of `confidence` [rad, m]; covariance (k, k); prior_mean, prior_deviation (k,), the latter
    infinite where the prior is flat; tolerances (k, 2), intervals, NaN without; beyond (k,): probability that an error
    is beyond its tolerance;
    status: see `message`; method of the intervals: "laplace" or "importance"; modes: `ModeFound`s, the estimate first;
    effective: number of effective samples, of `samples`; departure: of these from the normal approximation (17.8);
    sampled (N, k) [rad, m], weights (N,): samples of the posterior, none where there is no mode;
    prior_precision (k, k): zero where the prior is flat;
    signals: `SignalFit`s; curves: `Curve`s; visibility: at the estimate; remarks: further sentences; steps: of the
    longest search; converged: searches, of `starts`; suspects: where the model does not fit, what would explain it;
    divisions: how far the errors would move on a finer model, `Division`s, none where that was not checked;
    correction: what `correct` made of it, if a study asked for one.
    """

    names: tuple[str, ...]
    error_units: tuple[str, ...]
    estimate: Float[np.ndarray, " k"]
    deviation: Float[np.ndarray, " k"]
    low: Float[np.ndarray, " k"]
    high: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "k k"]
    prior_mean: Float[np.ndarray, " k"]
    prior_deviation: Float[np.ndarray, " k"]
    tolerances: Float[np.ndarray, "k 2"]
    beyond: Float[np.ndarray, " k"]
    confidence: float
    status: str
    method: str
    modes: tuple[ModeFound, ...]
    effective: float
    samples: int
    departure: float
    sampled: Float[np.ndarray, "N k"]
    weights: Float[np.ndarray, " N"]
    prior_precision: Float[np.ndarray, "k k"]
    signals: tuple[SignalFit, ...]
    curves: tuple[Curve, ...]
    visibility: Visibility | None
    remarks: tuple[str, ...]
    steps: int
    starts: int
    converged: int
    suspects: tuple[Suspect, ...] = ()
    divisions: tuple[Division, ...] = ()
    correction: Correction | None = None

    index = ("error",)

    @property
    def message(self) -> str:
        """The status in a sentence."""
        return STATUSES[self.status]

    @property
    def errors(self) -> dict[str, float]:
        """{error: estimate [rad or m]}, as `assembly_errors` takes them."""
        return dict(zip(self.names, map(float, self.estimate), strict=True))

    def rows(self) -> list[dict[str, Any]]:
        """A row per unknown; `unit` is that of all numbers but `beyond_tolerance`."""
        return [
            {
                "error": name, "unit": self.error_units[i], "estimate": float(self.estimate[i]),
                "deviation": float(self.deviation[i]), "low": float(self.low[i]), "high": float(self.high[i]),
                "prior_mean": float(self.prior_mean[i]), "prior_deviation": float(self.prior_deviation[i]),
                "tolerance_low": float(self.tolerances[i, 0]), "tolerance_high": float(self.tolerances[i, 1]),
                "beyond_tolerance": float(self.beyond[i]),
            }
            for i, name in enumerate(self.names)
        ]  # fmt: skip

    def arrays(self) -> Arrays:
        """Unknowns over `error`, modes over `mode`, signals over `signal`, combinations over `combination`; measured
        and simulated histories each over times of its own."""
        variables, coordinates = self._visibility_arrays()
        error, unit = ("error",), "in error_unit"
        variables |= {
            "estimate": Labelled(error, self.estimate, "", f"most probable, {unit}"),
            "deviation": Labelled(error, self.deviation, "", f"standard deviation, {unit}"),
            "low": Labelled(error, self.low, "", unit), "high": Labelled(error, self.high, "", unit),
            "covariance": Labelled(("error", "error_2"), self.covariance, "", unit),
            "beyond_tolerance": Labelled(error, self.beyond, "1", "probability to be beyond the tolerance"),
            "mode_error": Labelled(("mode", "error"), np.stack([one.errors for one in self.modes]), "", unit)
            if self.modes else Labelled((), None),
            "mode_probability": Labelled(("mode",), [one.probability for one in self.modes], "1")
            if self.modes else Labelled((), None),
            "noise": Labelled(("signal",), [one.noise for one in self.signals], "", "in the unit of the signal"),
            "chi_square_chance": Labelled(("signal",), [one.chi_square_chance for one in self.signals], "1"),
            "whiteness_chance": Labelled(("signal",), [one.whiteness_chance for one in self.signals], "1"),
        }  # fmt: skip
        for number, one in enumerate(self.curves, start=1):
            for what in ("measured", "before", "after"):
                variables[f"{what}_{number}"] = Labelled((f"time_{number}",), getattr(one, what), "", one.column)
            coordinates[f"time_{number}"] = Labelled((f"time_{number}",), one.times, "s")
        coordinates |= named_dimension("error", self.names, self.error_units)
        coordinates |= {"error_2": self.names, "signal": [f"{one.column}@{one.experiment}" for one in self.signals]}
        attributes = {"title": "Identification", "status": self.status, "intervals_by": self.method}
        return variables, coordinates, attributes | {"confidence": self.confidence, "effective": self.effective}

    def parts(self) -> Parts:
        """Errors with intervals, what the signals say of the model, other modes, what can be known."""
        head = f"Identification: status {self.status}: {self.message}"
        parts: list[str | Table] = [head, self._errors_table(), *self.remarks, "", self._signals_table()]
        doubts = [f"{one.column} (experiment {one.experiment}): {one.verdict}." for one in self.signals]
        parts += [one for one in doubts if not one.endswith(": fits.")]
        if len(self.modes) > 1:
            rows = [[show_number(one.probability, 3), *self._shown(one.errors)] for one in self.modes]
            parts += ["", "Sets of errors that explain the data", Table(["probability", *self.names], rows, words=())]
        parts += [] if self.correction is None else ["", *self.correction.parts()]
        return [*parts, *self._visibility_parts("What the signals tell, at the estimate")]

    def _shown(self, errors: Float[np.ndarray, " k"], digits: int = 4) -> list[str]:
        return [show_error(one, unit, digits) for one, unit in zip(errors, self.error_units, strict=True)]

    def _errors_table(self) -> Table:
        width = 0.5 * (self.tolerances[:, 1] - self.tolerances[:, 0])
        columns = [
            self._shown(x, d)
            for x, d in ((self.estimate, 4), (self.deviation, 2), (self.low, 4), (self.high, 4), (width, 4))
        ]
        beyond = [percent(one) for one in self.beyond]
        interval = f"{100.0 * self.confidence:g} % interval"
        header = ["error", "estimate", "deviation", f"{interval} from", "to", "tolerance +-", "beyond it"]
        return Table(header, [list(row) for row in zip(self.names, *columns, beyond, strict=True)])

    def _signals_table(self) -> Table:
        rows, several = [], any(one.experiment > 1 for one in self.signals)
        for one in self.signals:
            numbers = [
                one.noise,
                one.before,
                one.remainder,
                one.chi_square / one.freedom if one.freedom > 0 else np.nan,
            ]
            faults = [one.shift, one.offset, one.gain]
            name = f"{one.column} ({one.experiment})" if several else one.column
            white = show_number(one.whiteness_chance, 2)
            shown = [*(show_number(x, 3) for x in numbers), white, *(show_number(x, 3) if x else "-" for x in faults)]
            rows.append([name, str(one.samples), *shown])
        header = ["signal", "samples", "noise", "RMS before", "after", "chi^2 per freedom", "white by chance"]
        return Table([*header, "shift s", "offset", "gain"], rows)


def visibility_content(seen: Visibility | None) -> dict[str, Any] | None:
    """As a JSON file has it."""
    if seen is None:
        return None
    return {
        "singular_values": seen.singular, "directions": seen.directions, "deviations_left": seen.deviations,
        "symmetric": list(seen.symmetric), "signals": [asdict(one) for one in seen.worth],
        "sentences": list(seen.sentences),
    }  # fmt: skip


def curve_rows(curves: Sequence[Curve], units: dict[str, str]) -> list[dict[str, Any]]:
    """A row per sample of every signal, as a CSV file has it."""
    return [
        {
            "signal": one.column, "unit": units[one.column], "experiment": one.experiment,
            column_name("time", "s"): float(t), "measured": float(y), "before": float(b), "after": float(a),
        }
        for one in curves
        for t, y, b, a in zip(one.times, one.measured, one.before, one.after, strict=True)
    ]  # fmt: skip
