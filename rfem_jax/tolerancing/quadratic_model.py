"""The quadratic model of all metrics about a point: value, gradient, Hessian (theory (10.2)).

Place in the pipeline: what sensitivities report, where worst cases start, and what an allocation is
first solved on.

    f(x0 + e) ~ f + g.e + 1/2 e^T H e

Symbols: e (k,) errors [rad, m], f (m,) metrics [their units], g (m, k) [unit per rad or m],
H (m, k, k), S (k, k) covariance of the errors, t (k,) half-widths of the tolerances.

Modes. Forward mode pushes k tangents through the simulation (k^2 for the Hessian), reverse mode
pulls m cotangents back (k*m for the Hessian, forward over reverse). One cotangent costs about
`REVERSE_COST` tangents (a reverse pass runs the forward pass, stores it, and runs it back), so
"auto" takes forward mode while k <= REVERSE_COST * m. Both run in chunks of `batch` directions.

`expand` gives the exact Hessian, by a program of its own. `expand_by_differences` takes central
differences of exact gradients at two steps (theory (10.3): h and 2 h, extrapolated, an error of h^4), by the same
program that searches use, and states the error.
Source: Griewank, Walther, Evaluating Derivatives, 2nd ed. (2008), chapters 3 and 5; L. F.
Richardson, Phil. Trans. R. Soc. A 210 (1911) 307-357 (extrapolation).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfem_jax.compilation.program import Program
from rfem_jax.description.errors import InputError
from rfem_jax.tolerancing.evaluation import (
    check_known,
    map_chunks,
    require_float64,
    run_in_chunks,
    select_half_widths,
    split_errors,
    stack_metrics,
)
from rfem_jax.tolerancing.execution import default_lanes

MODES = ("auto", "forward", "reverse")
REVERSE_COST = 3
DIRECTIONS = 32  # tangents of one point at once
POINTS_WITH_TANGENTS = 4  # times the lanes: points x tangents at once
STEP = 0.01  # of a tolerance
SUMS = {"forward": 8, "reverse": 2}  # each one is two directions more in reverse mode


class QuadraticModel(eqx.Module):
    """Second-order expansion of m metrics in k errors (fields as in the module's docstring).

    `hessian` is None after an expansion of order 1; `asymmetry` (m,) is the largest |H - H^T|
    divided by the largest |H| before H was made symmetric: an estimate of the derivatives'
    rounding. `hessian_error` (m,) is the estimated error of a Hessian by differences relative to
    the largest |H|, both per tolerance; None where it is exact. `residual_changes`, `force_changes`
    (p, k): derivatives of p sums, with random signs, of the forces left over in the equations of motion and of
    the joint forces at all saved times; None where nothing is left over.
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

    def derivative_residual(self, half_widths) -> float | None:
        """Change of the forces left over in the equations relative to that of the joint forces (root mean
        squares over all instants and errors (k,), each by its half-width); an estimate, None without one."""
        if self.residual_changes is None:
            return None
        residual, force = (
            float(np.sqrt(np.sum((np.asarray(changes) * half_widths) ** 2)))
            for changes in (self.residual_changes, self.force_changes)
        )
        return residual / force if force != 0.0 else residual

    def __call__(self, deviation):
        """Values (m,) at point + deviation (k,)."""
        linear = self.value + self.gradient @ deviation
        if self.hessian is None:
            return linear
        return linear + 0.5 * jnp.einsum("mij,i,j->m", self.hessian, deviation, deviation)

    def mean(self, covariance):
        """Mean (m,) over errors of mean zero and covariance S (k, k): f + 1/2 tr(H S).

        Exact for a quadratic metric and any distribution (theory (9.6)).
        """
        if self.hessian is None:
            return self.value
        return self.value + 0.5 * jnp.einsum("mij,ji->m", self.hessian, covariance)

    def scaled(self, half_widths):
        """The same model in errors measured in their tolerances, e = t z: gradient g t, Hessian t
        H t."""
        t = jnp.asarray(half_widths)
        hessian = None if self.hessian is None else self.hessian * jnp.outer(t, t)[None]
        return eqx.tree_at(
            lambda q: (q.gradient, q.hessian),
            self,
            (self.gradient * t[None], hessian),
            is_leaf=lambda leaf: leaf is None,
        )


def choose_mode(mode, errors, metrics):
    """ "forward" or "reverse" for k errors and m metrics; `mode` may force it. Raises
    InputError."""
    if mode not in MODES:
        raise InputError(f"Argument `mode` must be one of {', '.join(MODES)}, but it is {mode!r}.")
    if mode != "auto":
        return mode
    return "forward" if errors <= REVERSE_COST * metrics else "reverse"


def differentiate(function, x, mode, batch):
    """Value, Jacobian (m, k) and status of `function(x) -> ((m,), status)`; traced."""
    if mode == "reverse":
        value, pull, status = jax.vjp(function, x, has_aux=True)
        cotangents = jnp.eye(value.shape[0], dtype=value.dtype)
        return value, map_chunks(lambda c: pull(c)[0], cotangents, batch), status

    def push(tangent):
        return jax.jvp(function, (x,), (tangent,), has_aux=True)

    value, jacobian, status = map_chunks(push, jnp.eye(x.shape[0], dtype=x.dtype), batch)
    return value[0], jacobian.T, status[0]


def differentiate_twice(function, x, mode, batch):
    """Value, Jacobian (m, k), Hessian (m, k, k) and status; traced.

    Forward mode over the first-order derivative in the chosen mode: memory of the outer chunk times
    the inner one stays at about `batch` directions.
    """
    inner = x.shape[0] if mode == "forward" else jax.eval_shape(function, x)[0].shape[0]
    outer_batch = max(1, batch // inner)

    def first(y):
        value, jacobian, status = differentiate(function, y, mode, batch)
        return jacobian, (value, status)

    def push(tangent):
        return jax.jvp(first, (x,), (tangent,), has_aux=True)

    directions = jnp.eye(x.shape[0], dtype=x.dtype)
    jacobian, hessian, (value, status) = map_chunks(push, directions, outer_batch)
    return value[0], jacobian[0], jnp.moveaxis(hessian, 0, 2), status[0]


def stack_checked(problem, names, base, x, count):
    """`stack_metrics` with 2 `count` values more: sums, with random signs, of the forces left over in the
    equations of motion, and of the joint forces.

    The mean of their squared derivatives is the sum of the squared derivatives of all these forces, so that a
    few directions, of either mode, tell how accurate the derivatives are.
    """
    errors = {**base, **{name: x[i] for i, name in enumerate(names)}}
    values, status, residual, forces = problem.with_residual(errors)
    key = jax.random.key(0)
    sums = [
        jnp.sum(jax.random.rademacher(key, (count, part.size), part.dtype) * part.reshape(1, -1), axis=1)
        for part in (residual, forces)
    ]
    return jnp.concatenate([jnp.stack([values[m.name] for m in problem.metrics]), *sums]), status


@Program
def _expand(problem, names, base, x, order, mode, batch):
    """Value, Jacobian, Hessian and its asymmetry, status, and the derivatives of the sums of `stack_checked`."""
    m, count = len(problem.metrics), SUMS[mode]
    checked = getattr(problem, "derivative_limit", None) is not None

    def function(y):
        if checked:
            return stack_checked(problem, names, base, y, count)
        return stack_metrics(problem, names, base, y)

    if order == 1:
        value, jacobian, status = differentiate(function, x, mode, batch)
        hessian = asymmetry = None
    else:
        value, jacobian, hessian, status = differentiate_twice(function, x, mode, batch)
        hessian = hessian[:m]
        transposed = jnp.swapaxes(hessian, 1, 2)
        largest = jnp.max(jnp.abs(hessian), axis=(1, 2))
        gap = jnp.max(jnp.abs(hessian - transposed), axis=(1, 2))
        asymmetry = jnp.where(largest > 0, gap / jnp.where(largest > 0, largest, 1.0), 0.0)
        hessian = 0.5 * (hessian + transposed)
    changes = (jacobian[m : m + count], jacobian[m + count :]) if checked else (None, None)
    return value[:m], jacobian[:m], hessian, asymmetry, status, changes


def expand(problem, at=None, names=None, *, order=2, mode="auto", batch=32):
    """Expand every metric of `problem` about a point to first or second order.

    Args: at mapping name -> error [rad, m] (None: the nominal point, zero); names the errors to
        differentiate by (None: all of problem.error_names); order 1 or 2; mode "auto", "forward" or
        "reverse"; batch directions pushed or pulled at once.
    Returns: QuadraticModel (hessian None for order 1); its `status` tells whether the point failed.
    Raises: InputError for unknown names, order or mode.
    """
    require_float64()
    names = tuple(problem.error_names if names is None else names)
    check_known(names, problem.error_names, "names")
    if not names:
        raise InputError("Argument `names` must name at least one error, but it is empty.")
    if order not in (1, 2):
        raise InputError(f"Argument `order` must be 1 or 2, but it is {order!r}.")
    metrics = tuple(metric.name for metric in problem.metrics)
    mode = choose_mode(mode, len(names), len(metrics))
    base, x = split_errors(problem, at, names)
    value, gradient, hessian, asymmetry, status, changes = _expand(
        problem, names, base, x, order, mode, int(batch)
    )
    return QuadraticModel(
        names, metrics, mode, x, value, gradient, hessian, asymmetry, jnp.asarray(status), None, *changes
    )


@Program
def _linearise(problem, names, base, points, weights, mode):
    """Values (w, m), slopes and status of points (w, k): Jacobians (w, m, k) in forward mode, in
    reverse mode the gradients (w, k) of weights (w, m) . metrics."""

    def function(x):
        return stack_metrics(problem, names, base, x)

    def one(x, weight):
        if mode == "reverse":
            value, pull, status = jax.vjp(function, x, has_aux=True)
            slopes = pull(weight)[0]
        else:
            value, slopes, status = differentiate(function, x, mode, DIRECTIONS)
        return jnp.where(status == 0, value, jnp.nan), slopes, status

    return jax.vmap(one)(points, weights)


def linearise_points(problem, names, base, points, *, metric=None, mode="auto", batch=256):
    """Values of all metrics and their slopes at many points, chunk by chunk (one program).

    Args: points (n, k) [rad, m]; metric None for the slopes of all metrics, or the index of one, or
        (n,) indices, one for each point; mode as everywhere ("auto" counts the metrics whose slopes
        are asked for); batch the most points at once (fewer where the device gains nothing).
    Returns: values (n, m), slopes (n, m, k) or with `metric` (n, k), and status (n,), NumPy; NaN
        values where the sample failed.
    """
    n, m, k = len(points), len(problem.metrics), len(names)
    mode = choose_mode(mode, k, m if metric is None else 1)
    points = np.asarray(points, dtype=np.float64).reshape(n, k)
    width = min(batch, default_lanes())
    if mode == "forward":
        width = max(1, min(width, POINTS_WITH_TANGENTS * default_lanes() // k))

    def run(points, weights):
        return run_in_chunks(
            lambda x, w: _linearise(problem, names, base, x, w, mode), width, points, weights
        )

    if mode == "forward":
        values, slopes, status = run(points, np.zeros((n, m)))
        return values, slopes if metric is None else slopes[np.arange(n), metric], status
    if metric is None:  # the program has one gradient per point: each point once per metric
        values, slopes, status = run(np.repeat(points, m, axis=0), np.tile(np.eye(m), (n, 1)))
        return values[::m], slopes.reshape(n, m, k), status[::m]
    return run(points, np.eye(m)[np.broadcast_to(metric, (n,))])


def expand_by_differences(problem, at, half_widths, *, mode="auto", batch=256):
    """Expand every metric of `problem` to second order, the Hessian by differences of gradients.

    Args: at mapping name -> error [rad, m] (None: the nominal point, zero); half_widths mapping
        name -> typical tolerance [rad, m] of every error to differentiate by, the unit of the
        steps; mode, batch as `linearise_points`.
    Returns: QuadraticModel with its `hessian_error`.
    Raises: InputError for unknown names or mode.
    """
    require_float64()
    names, t = select_half_widths(problem, half_widths, "half_widths")
    base, x = split_errors(problem, at, names)
    m, k = len(problem.metrics), len(names)
    mode = choose_mode(mode, k, m)
    offsets = np.concatenate([np.zeros((1, k)), *(s * np.eye(k) for s in (1, -1, 2, -2))])
    points = np.asarray(x) + STEP * offsets * t
    values, slopes, status = linearise_points(problem, names, base, points, mode=mode, batch=batch)
    slopes = slopes * t  # all per tolerance
    up, down, far_up, far_down = slopes[1:].reshape(4, k, m, k)
    with np.errstate(invalid="ignore"):  # failed points and cones: no derivative, no warning
        near, far = (up - down) / (2 * STEP), (far_up - far_down) / (4 * STEP)
        hessian = np.moveaxis((4 * near - far) / 3, 0, 2)
    hessian[~np.all(np.isfinite(slopes[0]), axis=1)] = np.nan
    largest = np.max(np.abs(hessian), axis=(1, 2))
    safe = np.where(largest > 0, largest, 1.0)
    transposed = np.swapaxes(hessian, 1, 2)
    asymmetry = np.max(np.abs(hessian - transposed), axis=(1, 2)) / safe
    # What extrapolation removed: the error of `near`, an upper bound of what is left; and rounding.
    rounding = 4 * np.finfo(float).eps / STEP * np.max(np.abs(slopes), axis=(0, 2))
    error = (np.max(np.abs(near - far), axis=(0, 2)) / 3 + rounding) / safe
    hessian = 0.5 * (hessian + transposed) / np.outer(t, t)
    arrays = map(jnp.asarray, (values[0], slopes[0] / t, hessian, asymmetry, status[0]))
    value, gradient, hessian, asymmetry, code = arrays
    metrics = tuple(metric.name for metric in problem.metrics)
    return QuadraticModel(
        names, metrics, mode, x, value, gradient, hessian, asymmetry, code, jnp.asarray(error)
    )
