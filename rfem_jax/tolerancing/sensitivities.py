"""Sensitivities: how much each error, and which combination of errors, changes each metric.

Place in the pipeline: after a problem (errors -> metrics); its result feeds tables and heat maps.

    effect_i = |g_i| t_i + 1/2 |H_ii| t_i^2       largest change of the quadratic model when error i
                                                  alone goes to either end of its tolerance

Symbols: g gradient [metric unit per rad or m], H Hessian, t half-widths of the tolerances [rad, m], f value of the
metric, z = e/t errors in tolerances.

Symmetry (theory (9.3), (9.5)). At the nominal point the resultant loads of a planar mechanism are even in the
out-of-plane errors: their gradients vanish and only the Hessian shows an effect. A mean square that is itself zero
there is f = 1/2 e^T H e. Its square root (an RMS moment) has a kink: no derivative, but a one-sided derivative
sqrt(1/2 e^T H e) along every direction e. Whether a gradient is zero by symmetry is judged against the Hessian times
the tolerances, as a derivative has no scale of its own. The principal directions are the eigenvectors of the scaled
Hessian t H t, the combinations of errors with the largest effect (theory (10.4)).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.tolerances.error_catalogue import as_specified
from rfem_jax.labelled_data import Parts, Table, text_of
from rfem_jax.tolerancing.checks import ErrorValues, check_known
from rfem_jax.tolerancing.contributions import VarianceShares, variance_shares
from rfem_jax.tolerancing.labelled_results import LabelledSensitivities
from rfem_jax.tolerancing.layout import show_error, show_number, without_rounding
from rfem_jax.tolerancing.problems.evaluation import describe_status, read_point, select_half_widths
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.problem import Metric, ToleranceProblem
from rfem_jax.tolerancing.problems.quadratic_model import (
    QuadraticModel,
    expand_point,
    plan_expansion,
)
from rfem_jax.tolerancing.problems.reproduction import REPRODUCED, changes_by_step, changes_that_count, may_strike
from rfem_jax.tolerancing.progress import ProgressBar, ProgressOption

NO_VALUE = "no_value"
NOT_CONVERGED = "derivative_not_converged"
NOT_REPRODUCED = "derivative_not_reproduced"
ROUNDING = 1e-12  # gradient and Hessian of an error below this part of the largest ones: of no effect
VANISHING = 1e-6  # gradient below this part of (Hessian x tolerances): zero by symmetry
ZERO_VALUE = 1e-9  # value below this part of (1/2 tolerances x Hessian x tolerances): zero

CLOSEST = 8  # errors of a table


@dataclass(frozen=True, eq=False)
class Sensitivities(LabelledSensitivities):
    """Derivatives of m metrics by k errors; NaN where there is no derivative.

    names, error_units (k); metrics, metric_units, labels (m); at {name: value} of the point [rad, m]; scale (k,)
    half-widths t (ones when `scaled` is False); order 1 or 2; mode "forward" or "reverse"; status "ok" or the
    problem's word for the failure, "no_value" where a metric is no number, as that of an instant which the run does not
    reach, or "derivative_not_reproduced" where pins may strike their bushes and the refined problem has other
    derivatives;
    value (m,), gradient (m, k), hessian (m, k, k) or None: per unit;
    gradient_scaled (m, k), hessian_scaled (m, k, k) or None: per tolerance, in the metric's unit;
    effects (m, k): largest change by each error alone [metric unit], the heat map;
    vanishing (m, k): True where the gradient is zero by symmetry though the error has an effect;
    character (m,): "slope" (a gradient), "even" (all gradients vanish), "mixed" (some do), "kink" (even and zero at
        the point, positive semidefinite Hessian: the square root has no derivative), "flat" (no error has an effect),
        "none" (the derivatives do not exist or are not finite: differentiate the square); at order 1, where only the
        symmetry that the metric declares is known, "slope" or "even";
    eigenvalues (m, k) [metric unit], directions (m, k, k): of the scaled Hessian, largest magnitude first; each row of
        `directions` is a unit vector of errors in tolerances; None at order 1;
    root_derivatives (m, k): sqrt(H_ii/2) t_i at a kink, the growth of the square root per tolerance; NaN elsewhere;
    asymmetry (m,): |H - H^T| / |H|, rounding of the Hessian; None at order 1;
    gradient_change (m, k), hessian_change (m,): difference to the `refined` problem relative to the effect of each
        error and to the largest |H|; None without one;
    derivative_residual: residual of the differentiated equations relative to the change of the joint forces, an
        estimate (None for a problem without a residual); above the problem's limit the status is
        "derivative_not_converged";
    shares: what each error contributes to the variance of the metrics, by the quadratic model; None where `scale` was
        no Tolerances collection, or not all of its errors were asked for.
    """

    names: tuple[str, ...]
    error_units: tuple[str, ...]
    metrics: tuple[str, ...]
    metric_units: tuple[str, ...]
    labels: tuple[str, ...]
    at: dict[str, float]
    scale: Float[np.ndarray, " k"]
    scaled: bool
    order: int
    mode: str
    status: str
    value: Float[np.ndarray, " m"]
    gradient: Float[np.ndarray, "m k"]
    hessian: Float[np.ndarray, "m k k"] | None
    gradient_scaled: Float[np.ndarray, "m k"]
    hessian_scaled: Float[np.ndarray, "m k k"] | None
    effects: Float[np.ndarray, "m k"]
    vanishing: Bool[np.ndarray, "m k"]
    character: tuple[str, ...]
    eigenvalues: Float[np.ndarray, "m k"] | None
    directions: Float[np.ndarray, "m k k"] | None
    root_derivatives: Float[np.ndarray, "m k"]
    asymmetry: Float[np.ndarray, " m"] | None
    gradient_change: Float[np.ndarray, "m k"] | None = field(default=None)
    hessian_change: Float[np.ndarray, " m"] | None = field(default=None)
    derivative_residual: float | None = field(default=None)
    shares: VarianceShares | None = field(default=None)

    def _row(self, metric: str | Metric) -> int:
        name = metric.name if isinstance(metric, Metric) else metric
        check_known((name,), self.metrics, "metric")
        return self.metrics.index(name)

    def ranking(self, metric: str | Metric) -> list[tuple[str, float]]:
        """[(error, effect [metric unit])], largest first."""
        effects = self.effects[self._row(metric)]
        return [(self.names[i], float(effects[i])) for i in np.argsort(-effects, kind="stable")]

    def principal_directions(self, metric: str | Metric) -> list[tuple[float, dict[str, float]]]:
        """[(eigenvalue [metric unit], {error: component in tolerances})], largest |eigenvalue| first."""
        if self.eigenvalues is None or self.directions is None:
            raise InputError("Argument `order` must be 2 for principal directions, but it was 1.")
        i = self._row(metric)
        pairs = zip(self.eigenvalues[i], self.directions[i], strict=True)
        return [(float(value), dict(zip(self.names, map(float, row), strict=True))) for value, row in pairs]

    def root_derivative(self, metric: str | Metric, direction: Mapping[str, float]) -> float:
        """One-sided derivative of the square root of a metric with a kink along `direction` {error: rad or m}:
        sqrt(1/2 e^T H e)."""
        i = self._row(metric)
        if self.character[i] != "kink" or self.hessian is None:
            raise InputError(
                f"Argument `metric` must be a mean square that is zero at the point, but "
                f"`{self.metrics[i]}` is of character `{self.character[i]}`; use its gradient."
            )
        check_known(direction, self.names, "direction")
        e = np.array([float(direction.get(name, 0.0)) for name in self.names])
        return float(np.sqrt(max(0.5 * e @ self.hessian[i] @ e, 0.0)))

    def rows(self) -> list[dict[str, Any]]:
        """One flat dict per metric and error, ranked within the metric, for CSV and JSON.

        `unit` is that of all numbers of the row but `gradient` and `curvature`, which have theirs ("1" without one).
        """
        out = []
        for m, metric in enumerate(self.metrics):
            unit = self.metric_units[m] or "1"
            for rank, i in enumerate(np.argsort(-self.effects[m], kind="stable"), start=1):
                row = {"metric": metric, "error": self.names[i], "rank": rank}
                row |= {"character": self.character[m], "unit": unit, "value": float(self.value[m])}
                row |= {"gradient": float(self.gradient[m, i]), "gradient_unit": f"{unit}/{self.error_units[i]}"}
                row |= {"gradient_per_tolerance": float(self.gradient_scaled[m, i])}
                if self.hessian is not None and self.hessian_scaled is not None:
                    row |= {"curvature": float(self.hessian[m, i, i])}
                    row |= {"curvature_unit": f"{unit}/{self.error_units[i]}^2"}
                    row |= {"curvature_per_tolerance": float(self.hessian_scaled[m, i, i])}
                row |= {"effect": float(self.effects[m, i])}
                row |= {"vanishes_by_symmetry": bool(self.vanishing[m, i])}
                out.append(row | self._shares_of(m, self.names[i]))
        return out

    def _shares_of(self, m, name) -> dict[str, Any]:
        """Columns with the contributions of an error, or of the group that it belongs to."""
        if self.shares is None:
            return {}
        i = self.shares.of_error(name)
        found: dict[str, Any] = {"factor": "+".join(self.shares.factors[i])}
        for word, parts in (
            ("linear", self.shares.linear), ("first_order", self.shares.first_order), ("total", self.shares.total),
        ):  # fmt: skip
            found[f"variance_{word}_percent"] = 100.0 * float(parts[m, i])
        return found

    def shares_table(self) -> str:
        """Contributions to the variance of every metric in percent as text, "" where there are none."""
        return "" if self.shares is None else text_of(self._shares(self.shares))

    def _shares(self, shares: VarianceShares) -> Parts:
        rows = []
        for m, metric in enumerate(self.metrics):
            order = np.argsort(-np.nan_to_num(shares.total[m], nan=-1.0), kind="stable")
            for i in order:
                parts = (shares.linear, shares.first_order, shares.total)
                numbers = [show_number(100.0 * part[m, i], 4, scale=100.0) for part in parts]
                rows.append([metric, "+".join(shares.factors[i]), *numbers])
        header = ["metric", "error", "linear", "first order", "total"]
        without = [name for name, parts in zip(self.metrics, shares.linear, strict=True) if np.isnan(parts).all()]
        tail = [f"No first-order effect on {', '.join(without)}: all gradients vanish."] if without else []
        head = "Contributions to the variance in percent (quadratic model)"
        return [head, Table(header, rows), *tail]

    def table(self, metric: str | Metric | None = None, top: int = CLOSEST) -> str:
        """Ranking table as text, of one metric or of all; the `top` errors of each."""
        chosen = range(len(self.metrics)) if metric is None else (self._row(metric),)
        return "\n\n".join(text_of(self._block(m, top)) for m in chosen)

    def _block(self, m: int, top: int = CLOSEST) -> Parts:
        unit, size = self.metric_units[m], float(np.max(self.effects[m]))
        value = 0.0 if self.character[m] == "kink" else self.value[m]  # what is left of it is rounding
        head = f"{self.labels[m]} [{unit}] = {show_number(value, scale=size)}"
        head += _REMARKS[self.character[m]]
        per = "per tolerance" if self.scaled else "per unit"
        header = ["error", "tolerance", "gradient per deg, mm", f"gradient {per}"]
        header += [] if self.hessian is None else [f"1/2 H_ii {per}"]
        header += ["effect"]
        header += [f"root {per}"] if self.character[m] == "kink" else []
        rows = []
        for i in np.argsort(-self.effects[m], kind="stable")[:top]:
            specified, factor = as_specified(self.error_units[i])
            width = show_error(self.scale[i], self.error_units[i]) if self.scaled else f"- {specified}"
            scaled = 0.0 if self.vanishing[m, i] else self.gradient_scaled[m, i]
            scaled = without_rounding(scaled, size)
            gradient = show_number(self.gradient[m, i] / factor) if scaled else "0"
            gradient += " (symmetry)" if self.vanishing[m, i] else ""
            row = [self.names[i], width, gradient, show_number(scaled)]
            if self.hessian_scaled is not None:
                row.append(show_number(0.5 * self.hessian_scaled[m, i, i], scale=size))
            row += [show_number(self.effects[m, i], scale=size)]
            row += [show_number(self.root_derivatives[m, i])] if self.character[m] == "kink" else []
            rows.append(row)
        left_out = len(self.names) - len(rows)
        tail = [f"({left_out} more errors with smaller effects)"] if left_out > 0 else []
        return [head, Table(header, rows), *tail]

    def parts(self) -> Parts:
        """Ranking tables of all metrics, and what else the derivatives say."""
        head = f"Sensitivities of order {self.order} in {self.mode} mode, status {self.status}"
        if not self.scaled:
            head += "; no tolerances given: the ranking compares unlike units"
        if self.derivative_residual is not None:
            head += (
                f"\nresidual of the differentiated equations: {self.derivative_residual:.1e} of the change of "
                "the joint forces"
            )
        if self.status == NO_VALUE:
            lacking = [name for name, value in zip(self.metrics, self.value, strict=True) if np.isnan(value)]
            head += f"\nThe run has no value of {', '.join(lacking)}: it does not reach what the name says"
        if self.status == NOT_CONVERGED:
            head += "; too large: take a smaller tolerance or step of the method"
        if self.status == NOT_REPRODUCED:
            head += (
                "\nA finer step changes derivatives by more than a tenth: they go through impacts, after a\nfew of "
                "which motion is chaotic, and mean nothing; take statistics of a batch (monte-carlo), or a shorter time"
            )
        blocks = [self._block(m) for m in range(len(self.metrics))]
        if self.eigenvalues is not None and len(self.names) > 1:
            blocks.append(self._first_directions())
        if self.shares is not None:
            blocks.append(self._shares(self.shares))
        if self.gradient_change is not None:
            blocks.append(self._changes(self.gradient_change))
        return [head, *(part for block in blocks for part in ("", *block))]

    def _first_directions(self) -> Parts:
        """The first principal direction of every metric."""
        rows = []
        for metric in self.metrics:
            value, direction = self.principal_directions(metric)[0]
            rows.append([metric, f"{0.5 * value:.5g}", *(f"{part:+.2f}" for part in direction.values())])
        head = "Combination of errors (in tolerances) that raises each metric most: the first principal direction"
        return [head, Table(["metric", "1/2 eigenvalue", *self.names], rows)]

    def _changes(self, gradients: Float[np.ndarray, "m k"]) -> Parts:
        """How far derivatives change with a finer step."""
        hessians = [np.nan] * len(self.metrics) if self.hessian_change is None else self.hessian_change
        rows = [
            [metric, f"{np.max(gradient):.1e}", f"{change:.1e}" if change == change else "-"]
            for metric, gradient, change in zip(self.metrics, gradients, hessians, strict=True)
        ]
        head = "Change with the finer step (of each error's effect, of the largest |H|)"
        return [head, Table(["metric", "largest change of a gradient", "change of the Hessian"], rows)]


_REMARKS = {
    "slope": "",
    "even": "; even in the errors at this point: the gradient vanishes, use the Hessian",
    "mixed": "; even in some errors: their derivatives vanish, use the Hessian",
    "kink": "; zero and even at this point: its square root has a kink, with a one-sided derivative in every direction",
    "flat": "; no error has an effect",
    "none": "; no finite derivative here (a root has a kink at zero: take its mean square)",
}


def sensitivity(
    problem: ToleranceProblem,
    at: ErrorValues | None = None,
    order: int = 2,
    scale: Tolerances | ErrorValues | None = None,
    mode: str = "auto",
    *,
    names: Sequence[str] | None = None,
    batch: int = 32,
    refined: ToleranceProblem | None = None,
    progress: ProgressOption = False,
) -> Sensitivities:
    """First and second derivatives of every metric of `problem` with respect to every named error.

    Args: at {error: value}, None for the nominal point; order 1 or 2; scale, a Tolerances collection or {error:
        half-width}, the unit each error is measured in (it has no other: its nominal value is zero); values and
        half-widths in rad or m, or strings with a unit; mode "auto", "forward" or "reverse" (quadratic_model.py
        explains "auto"); names of the errors (default: those of `scale`, else all); batch, directions at once;
        refined, the same problem with a finer step, which shows how far the derivatives can be trusted; progress True
        for a bar, or a function of (done, total) directions, counted twice with `refined`.
    Returns: Sensitivities. A point that failed is reported by its `status`.
    Raises: InputError for unknown names, order or mode.
    """
    if scale is None:
        names = tuple(problem.error_names if names is None else names)
        widths = np.ones(len(names))
    else:
        known, values = select_half_widths(problem, scale, "scale")
        names = known if names is None else tuple(names)
        check_known(names, known, "names")
        widths = np.array([values[known.index(name)] for name in names])
    problems = (problem,) if refined is None else (problem, refined)
    how = plan_expansion(problems, names, order, mode, batch)
    with ProgressBar(progress, len(problems) * len(how.names), unit="direction") as bar:
        model, *finer = [expand_point(one, at, how, bar.advance) for one in problems]
    point = read_point(problem, at)
    found = _report(problem, model, finer[0] if finer else None, widths, point, scale is not None, order)
    if isinstance(scale, Tolerances) and how.names == scale.names:
        found = replace(found, shares=variance_shares(model, scale))
    return found


def _report(
    problem: ToleranceProblem,
    model: QuadraticModel,
    finer: QuadraticModel | None,
    widths: np.ndarray,
    at: dict[str, float],
    scaled: bool,
    order: int,
) -> Sensitivities:
    value, gradient, hessian = _where_valued(model)
    g = gradient * widths
    h = None if hessian is None else hessian * np.outer(widths, widths)
    effects = np.abs(g) + 0.5 * np.abs(_diagonal(g, h))
    character, vanishing = _classify(problem, value, g, h)
    eigenvalues, directions = (None, None) if h is None else _principal(h)
    kinks = np.array([word == "kink" for word in character])
    root = np.where(kinks[:, None], np.sqrt(0.5 * np.maximum(_diagonal(g, h), 0.0)), np.nan)
    gradient_change, hessian_change = changes_by_step(finer, widths, g, h, effects)
    status = describe_status(problem, model.status)
    if status == "ok" and np.isnan(value).any():
        status = NO_VALUE
    residual, limit = model.derivative_residual(widths), getattr(problem, "derivative_limit", None)
    # NaN has not converged either.
    if status == "ok" and residual is not None and limit is not None and not residual <= limit:
        status = NOT_CONVERGED
    if status == "ok" and gradient_change is not None and may_strike(problem):
        changes = changes_that_count(character, gradient_change, hessian_change, h, effects, value)
        status = NOT_REPRODUCED if (changes > REPRODUCED).any() else "ok"
    return Sensitivities(
        names=model.names,
        error_units=tuple(problem.error_unit(name) for name in model.names),
        metrics=model.metrics,
        metric_units=tuple(metric.unit for metric in problem.metrics),
        labels=tuple(metric.label for metric in problem.metrics),
        at=at,
        scale=widths,
        scaled=scaled,
        order=order,
        mode=model.mode,
        status=status,
        value=value,
        gradient=gradient,
        hessian=hessian,
        gradient_scaled=g,
        hessian_scaled=h,
        effects=effects,
        vanishing=vanishing,
        character=character,
        eigenvalues=eigenvalues,
        directions=directions,
        root_derivatives=root,
        asymmetry=None if model.asymmetry is None else np.asarray(model.asymmetry),
        gradient_change=gradient_change,
        hessian_change=hessian_change,
        derivative_residual=residual,
    )


def _where_valued(model: QuadraticModel) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Values (m,), gradients (m, k), Hessians (m, k, k): what has no value has no derivatives, for they would be zero,
    those of the branch with a number."""
    value, gradient = np.asarray(model.value), np.asarray(model.gradient)
    lacking = np.isnan(value)
    gradient = np.where(lacking[:, None], np.nan, gradient)
    if model.hessian is None:
        return value, gradient, None
    return value, gradient, np.where(lacking[:, None, None], np.nan, np.asarray(model.hessian))


def _diagonal(g, h):
    """Diagonals (m, k) of Hessians (m, k, k); zero at order 1, where h is None."""
    return np.zeros_like(g) if h is None else np.diagonal(h, axis1=1, axis2=2)


def _classify(problem, value, g, h) -> tuple[tuple[str, ...], np.ndarray]:
    """The character of each metric and where gradients vanish; g, h per tolerance."""
    words, vanishing = [], np.zeros(g.shape, dtype=bool)
    for m, metric in enumerate(problem.metrics):
        if not np.all(np.isfinite(g[m])) or (h is not None and not np.all(np.isfinite(h[m]))):
            words.append("none")
        elif h is None:
            even = metric.even and np.max(np.abs(g[m])) <= VANISHING * max(abs(value[m]), 1e-300)
            vanishing[m] = even
            words.append("even" if even else "slope")
        else:
            influence, gradient = np.sum(np.abs(h[m]), axis=1), np.abs(g[m])
            without = np.maximum(influence, gradient) <= ROUNDING * max(np.max(influence), np.max(gradient))
            influence = np.where(without, 0.0, influence)
            small = without | (gradient <= VANISHING * influence)
            vanishing[m] = small & (influence > 0)
            words.append(_character(value[m], h[m], small, influence))
    return tuple(words), vanishing


def _character(value, h, small, influence) -> str:
    if not np.all(small):
        return "mixed" if np.any(small & (influence > 0)) else "slope"
    if not np.any(influence > 0):
        return "flat"
    eigenvalues = np.linalg.eigvalsh(h)
    definite = eigenvalues[0] >= -VANISHING * eigenvalues[-1]
    zero = abs(value) <= ZERO_VALUE * 0.5 * np.sum(np.abs(h))
    return "kink" if zero and definite else "even"


def _principal(h) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (m, k) by size and eigenvectors (m, k, k) as rows, largest component positive."""
    values = np.full(h.shape[:2], np.nan)
    rows = np.full(h.shape, np.nan)
    for m in range(len(h)):
        if not np.all(np.isfinite(h[m])):
            continue
        value, columns = np.linalg.eigh(h[m])
        order = np.argsort(-np.abs(value), kind="stable")
        vectors = columns[:, order].T
        largest = np.take_along_axis(vectors, np.argmax(np.abs(vectors), axis=1)[:, None], axis=1)
        values[m], rows[m] = value[order], vectors * np.sign(largest)
    return values, rows
