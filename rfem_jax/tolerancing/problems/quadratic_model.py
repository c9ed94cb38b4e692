"""The quadratic model of all metrics about a point: value, gradient, Hessian (theory (10.2)).

Place in the pipeline: sensitivities report it, worst cases start from it, and an allocation is first solved on it.

    f(x0 + e) ~ f + g.e + 1/2 e^T H e

Symbols: e (k,) errors [rad, m], f (m,) metrics [their units], g (m, k) [unit per rad or m], H (m, k, k), S (k, k)
covariance of the errors, t (k,) half-widths of the tolerances.

`expand` gives the exact Hessian, by a program of its own. `expand_by_differences` takes central differences of exact
gradients at two steps (theory (10.3): h and 2 h, extrapolated, an error of h^4), by the same program that searches
use, and estimates their error.
Source: Griewank, Walther, Evaluating Derivatives, 2nd ed. (2008), chapters 3 and 5; L. F. Richardson, Phil. Trans. R.
Soc. A 210 (1911) 307-357 (extrapolation).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.tolerancing.checks import ErrorValues, check_variables
from rfem_jax.tolerancing.problems.evaluation import (
    select_half_widths,
    split_errors,
)
from rfem_jax.tolerancing.problems.kept_evaluations import remembered
from rfem_jax.tolerancing.problems.linearisation import (
    ValueVector,
    choose_mode,
    differentiate,
    differentiate_twice,
    linearise_points,
    push_directions,
)
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.problem import ImplicitProblem, Status, ToleranceProblem, of_any_step
from rfem_jax.tolerancing.problems.reproduction import require_reproduced
from rfem_jax.tolerancing.problems.sample_values import Base, stack_metrics
from rfem_jax.tolerancing.progress import ProgressBar, ProgressOption

STEP = 0.01  # of a tolerance
NO_EFFECT = 1e-9  # of the joint forces: what errors change less is rounding
SUMS = {"forward": 8, "reverse": 2}  # each one is two directions more in reverse mode


class QuadraticModel(eqx.Module):
    """Second-order expansion of m metrics in k errors (fields as in the module's docstring).

    `hessian` is None after an expansion of order 1. `asymmetry` (m,) is the largest |H - H^T| divided by the largest
    |H| before H was made symmetric: an estimate of the derivatives' rounding. `hessian_error` (m,) is the estimated
    error of a Hessian by differences relative to the largest |H|, both per tolerance; None where it is exact.
    `residual_changes`, `force_changes` (p, k): derivatives of p sums, with random signs, of the residual of the
    equations of motion and of the joint forces at all saved times; None for problems without a residual.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    metrics: tuple[str, ...] = eqx.field(static=True)
    mode: str = eqx.field(static=True)
    point: Float[Array, " k"]
    value: Float[Array, " m"]
    gradient: Float[Array, "m k"]
    hessian: Float[Array, "m k k"] | None
    asymmetry: Float[Array, " m"] | None
    status: Int[Array, ""]
    hessian_error: Float[Array, " m"] | None = None
    residual_changes: Float[Array, "p k"] | None = None
    force_changes: Float[Array, "p k"] | None = None
    force_sums: Float[Array, " p"] | None = None

    def derivative_residual(self, half_widths: Float[np.ndarray, " k"]) -> float | None:
        """Change of the residual of the equations of motion relative to that of the joint forces: root mean squares
        over all times and errors, each error by its half-width (k,). An estimate; None for problems without a
        residual. Forces that errors change by rounding only are not changed: the residual is relative to at least
        `NO_EFFECT` of the forces themselves."""
        if self.residual_changes is None or self.force_changes is None:
            return None
        residual, force = (
            float(np.sqrt(np.sum((np.asarray(changes) * half_widths) ** 2)))
            for changes in (self.residual_changes, self.force_changes)
        )
        least = 0.0 if self.force_sums is None else NO_EFFECT * float(np.sqrt(np.sum(np.asarray(self.force_sums) ** 2)))
        return residual / max(force, least) if max(force, least) > 0.0 else residual

    def __call__(self, deviation: Float[Array, " k"]) -> ValueVector:
        """Values (m,) at point + deviation."""
        linear = self.value + self.gradient @ deviation
        if self.hessian is None:
            return linear
        return linear + 0.5 * jnp.einsum("mij,i,j->m", self.hessian, deviation, deviation)

    def mean(self, covariance: Float[Array, "k k"]) -> ValueVector:
        """Mean (m,) over errors of mean zero and covariance S: f + 1/2 tr(H S).

        Exact for a quadratic metric and any distribution (theory (9.6)).
        """
        if self.hessian is None:
            return self.value
        return self.value + 0.5 * jnp.einsum("mij,ji->m", self.hessian, covariance)

    def scaled(self, half_widths: ArrayLike) -> "QuadraticModel":
        """The same model in errors z measured in half-widths t (k,), e = t z: gradient g t, Hessian t H t."""
        t = jnp.asarray(half_widths)
        hessian = None if self.hessian is None else self.hessian * jnp.outer(t, t)[None]
        return eqx.tree_at(
            lambda q: (q.gradient, q.hessian),
            self,
            (self.gradient * t[None], hessian),
            is_leaf=lambda leaf: leaf is None,
        )


def stack_checked(
    problem: ImplicitProblem, names: Sequence[str], base: Base, x: Float[Array, " k"], count: int
) -> tuple[tuple[ValueVector, Float[Array, " c"]], Status]:
    """`stack_metrics`, and c = 2 `count` values beside them: sums, with random signs, of the residual of the equations
    of motion and of the joint forces.

    The mean of their squared derivatives is the sum of the squared derivatives of all these forces, so that a few
    directions, of either mode, tell how accurate the derivatives are.
    """
    errors = {**base, **{name: x[i] for i, name in enumerate(names)}}
    values, status, residual, forces = problem.with_residual(errors)
    sums = [jnp.sum(_signs(count, part.size) * part.reshape(1, -1), axis=1) for part in (residual, forces)]
    return (jnp.stack([values[m.name] for m in problem.metrics]), jnp.concatenate(sums)), status


def _signs(count: int, size: int) -> Float[Array, "{count} {size}"]:
    """Signs +1 and -1 without a pattern, the same in every call: a bit of a hash of each one's number.

    XLA compiles it in a tenth of the time that JAX's generator takes.
    """
    mixed = jnp.arange(count * size, dtype=jnp.uint32)
    # The finaliser of MurmurHash3 (A. Appleby, public domain).
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35), (16, 1)):
        mixed = (mixed ^ (mixed >> jnp.uint32(shift))) * jnp.uint32(factor)
    return 1.0 - 2.0 * (mixed & jnp.uint32(1)).astype(jnp.float64).reshape(count, size)


def _sums(problem, mode) -> int:
    """Number of sums of `stack_checked`, 0 for a problem without a residual."""
    return SUMS[mode] if getattr(problem, "derivative_limit", None) is not None else 0


def _differentiate(problem, names, base, x, directions, order, mode, batch):
    """Values, first derivatives, second derivatives along directions (d, k), status.

    First derivatives are the Jacobian, but of order 1 in forward mode those along the directions (d, m); second ones
    (d, m, k) or None.
    """
    count = _sums(problem, mode)

    def checked(y):
        if count:
            return stack_checked(problem, names, base, y, count)
        values, status = stack_metrics(problem, names, base, y)
        return (values, jnp.zeros(0)), status

    def function(y):
        values, status = checked(y)
        return jnp.concatenate(values), status

    if order == 2:
        return differentiate_twice(checked, x, directions, mode, batch)
    if mode == "forward":
        value, first, status = push_directions(function, x, directions, batch)
    else:
        value, first, status = differentiate(function, x, mode, batch)
    return value, first, None, status


_differentiate_along = Program(_differentiate, nameless=True)


class Expansion(NamedTuple):
    """How problems are expanded: by which errors, to which order, in which mode, with how many directions at once."""

    names: tuple[str, ...]
    order: int
    mode: str
    batch: int


def plan_expansion(
    problems: Sequence[ToleranceProblem], names: Sequence[str] | None, order: int, mode: str, batch: int
) -> Expansion:
    """How to expand the first problem and others like it, once each, with the arguments of `expand`. Raises
    InputError."""
    require_float64()
    problem = problems[0]
    # Without names all that have derivatives.
    names = tuple(getattr(problem, "variable_names", problem.error_names) if names is None else names)
    check_variables(names, problem, "names")
    if not names:
        raise InputError("Argument `names` must name at least one error, but it is empty.")
    if order not in (1, 2):
        raise InputError(f"Argument `order` must be 1 or 2, but it is {order!r}.")
    mode = choose_mode(mode, len(names), len(problem.metrics), problem)
    return Expansion(names, order, mode, int(batch))


def _cotangents(problem, mode) -> int:
    return len(problem.metrics) + 2 * _sums(problem, mode)


def _directions_at_once(problem, how: Expansion) -> int:
    """Directions per call of the program: about `batch` tangents or cotangents in memory."""
    k = len(how.names)
    if how.order == 1:
        return min(how.batch, k) if how.mode == "forward" else k
    inner = k if how.mode == "forward" else _cotangents(problem, how.mode)
    return min(max(1, how.batch // inner), k)


def expand_point(
    problem: ToleranceProblem, at: ErrorValues | None, how: Expansion, advance: Callable[[int], object]
) -> QuadraticModel:
    """As `expand`, which checks the arguments; `advance(count)` is called when `count` more directions are done."""
    names, order, mode, batch = how
    m, k = len(problem.metrics), len(names)
    base, x = split_errors(problem, at, names)
    width, shared = _directions_at_once(problem, how), of_any_step(problem, mode)
    parts = []
    for start in range(0, k, width):
        directions = np.eye(k)[start : start + width]
        used = len(directions)
        directions = np.concatenate([directions, np.repeat(directions[:1], width - used, axis=0)])
        settings = order, mode, batch

        def compute():
            found = _differentiate_along(shared, names, base, x, _numbers(directions), *settings)
            return jax.device_get(found)

        parts.append(remembered(problem, ("directions", names, base, x, directions, *settings), compute))
        advance(used)
    (value, jacobian, _, status), count = parts[0], _sums(problem, mode)
    hessian = asymmetry = residual_changes = force_changes = force_sums = None
    if order == 2:
        along = np.concatenate([second for _, _, second, _ in parts])[:k]
        hessian, asymmetry = map(_numbers, _symmetric(np.moveaxis(along, 0, 2)[:m]))
    elif mode == "forward":
        jacobian = np.concatenate([first for _, first, _, _ in parts])[:k].T
    if count:
        residual_changes, force_changes = _numbers(jacobian[m : m + count]), _numbers(jacobian[m + count :])
        force_sums = _numbers(value[m + count :])
    return QuadraticModel(
        names=names,
        metrics=tuple(metric.name for metric in problem.metrics),
        mode=mode,
        point=x,
        value=_numbers(value[:m]),
        gradient=_numbers(jacobian[:m]),
        hessian=hessian,
        asymmetry=asymmetry,
        status=jnp.asarray(status, np.asarray(status).dtype),
        residual_changes=residual_changes,
        force_changes=force_changes,
        force_sums=force_sums,
    )


def _numbers(array: np.ndarray) -> Float[Array, "..."]:
    """The array as one of JAX's, for which nothing is compiled where its type is said."""
    return jnp.asarray(array, jnp.float64)


def _symmetric(hessian):
    """Symmetric part of Hessians (m, k, k), and the largest |H - H^T| divided by the largest |H| (m,)."""
    transposed = np.swapaxes(hessian, 1, 2)
    largest = np.max(np.abs(hessian), axis=(1, 2))
    with np.errstate(invalid="ignore"):  # derivatives that do not exist
        gap = np.max(np.abs(hessian - transposed), axis=(1, 2))
        return 0.5 * (hessian + transposed), gap / np.where(largest > 0, largest, 1.0)


def expand(
    problem: ToleranceProblem,
    at: ErrorValues | None = None,
    names: Sequence[str] | None = None,
    *,
    order: int = 2,
    mode: str = "auto",
    batch: int = 32,
    progress: ProgressOption = False,
) -> QuadraticModel:
    """Expand every metric of `problem` about a point to first or second order.

    Args: at {error: number in rad or m, or string with a unit}, None for the nominal point, zero; names of the errors
        to differentiate by (None: all of problem.error_names); order 1 or 2; mode "auto", "forward" or "reverse";
        batch, directions pushed or pulled at once; progress True for a bar, or a function of (done, total) directions.
    Returns: QuadraticModel (hessian None for order 1); its `status` tells whether the point failed.
    Raises: InputError for unknown names, order or mode.
    """
    how = plan_expansion((problem,), names, order, mode, batch)
    with ProgressBar(progress, len(how.names), unit="direction") as bar:
        return expand_point(problem, at, how, bar.advance)


def expand_by_differences(
    problem: ToleranceProblem,
    at: ErrorValues | None,
    half_widths: Tolerances | ErrorValues,
    *,
    mode: str = "auto",
    batch: int = 256,
) -> QuadraticModel:
    """Expand every metric of `problem` to second order, the Hessian by differences of gradients.

    Args: at {error: value}, None for the nominal point, zero; half_widths, a Tolerances collection or {error: typical
        tolerance} of every error to differentiate by, the unit of the steps (values in rad or m, or strings with a
        unit); mode, batch as `linearise_points`.
    Returns: QuadraticModel with its `hessian_error`.
    Raises: InputError for unknown names or mode, and for derivatives through impacts that a finer step does not
        reproduce.
    """
    require_float64()
    names, t = select_half_widths(problem, half_widths, "half_widths")
    base, x = split_errors(problem, at, names)
    m, k = len(problem.metrics), len(names)
    mode = choose_mode(mode, k, m, problem)
    require_reproduced(problem, names, base, np.asarray(x), t, mode=mode, batch=batch)
    offsets = np.concatenate([np.zeros((1, k)), *(s * np.eye(k) for s in (1, -1, 2, -2))])
    points = np.asarray(x) + STEP * offsets * t
    values, jacobians, status = linearise_points(problem, names, base, points, mode=mode, batch=batch)
    jacobians = jacobians * t  # per tolerance
    hessian, error = _extrapolate(jacobians, m, k)
    hessian, asymmetry = _symmetric(hessian)
    arrays = (values[0], jacobians[0] / t, hessian / np.outer(t, t), asymmetry, status[0], error)
    metrics = tuple(metric.name for metric in problem.metrics)
    return QuadraticModel(names, metrics, mode, x, *map(jnp.asarray, arrays))


def _extrapolate(jacobians, m, k):
    """Hessians (m, k, k) from Jacobians (1 + 4k, m, k) at the points of `expand_by_differences`, all per tolerance, and
    their estimated error relative to the largest |H| (m,)."""
    up, down, far_up, far_down = jacobians[1:].reshape(4, k, m, k)
    with np.errstate(invalid="ignore"):  # failed points and kinks: no derivative, no warning
        near, far = (up - down) / (2 * STEP), (far_up - far_down) / (4 * STEP)
        hessian = np.moveaxis((4 * near - far) / 3, 0, 2)
    hessian[~np.all(np.isfinite(jacobians[0]), axis=1)] = np.nan
    largest = np.max(np.abs(hessian), axis=(1, 2))
    safe = np.where(largest > 0, largest, 1.0)
    # Extrapolation removes the error of `near`, an upper bound of the remaining one; rounding is added.
    rounding = 4 * np.finfo(float).eps / STEP * np.max(np.abs(jacobians), axis=(0, 2))
    error = (np.max(np.abs(near - far), axis=(0, 2)) / 3 + rounding) / safe
    return hessian, error
