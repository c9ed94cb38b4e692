"""First derivatives of all metrics at many points, and the choice of their mode.

Place in the pipeline: evaluation -> **linearisation** -> the expansion to second order, and all searches.

Modes. Forward mode pushes k tangents through the simulation (k^2 for the Hessian); reverse mode pulls m cotangents
back (k*m for the Hessian, forward over reverse). One cotangent costs about `REVERSE_COST` tangents (a reverse pass
runs the forward pass, stores it, and runs it back), so "auto" takes forward mode while k <= REVERSE_COST * m. Both run
in chunks of `batch` directions.
Source: Griewank, Walther, Evaluating Derivatives, 2nd ed. (2008), chapters 3 and 5.

Symbols: x (k,) errors [rad, m], f (m,) metrics [their units].
"""

from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError
from rfem_jax.tolerancing.problems.evaluation import map_chunks, run_in_chunks
from rfem_jax.tolerancing.problems.problem import Status, ToleranceProblem, of_any_step
from rfem_jax.tolerancing.problems.sample_values import (
    Base,
    default_lanes,
    divided,
    local_mesh,
    on_devices,
    stack_metrics,
)

MODES = ("auto", "forward", "reverse")
REVERSE_COST = 3
DIRECTIONS = 32  # tangents of one point at once
POINTS_WITH_TANGENTS = 4  # times the lanes: points x tangents at once

ValueVector = Float[Array, " m"]
Jacobian = Float[Array, "m k"]
Function = Callable[[Float[Array, " k"]], tuple[ValueVector, Status]]
CheckedFunction = Callable[[Float[Array, " k"]], tuple[tuple[ValueVector, Float[Array, " c"]], Status]]


def choose_mode(mode: str, errors: int, metrics: int, problem: ToleranceProblem | None = None) -> str:
    """ "forward" or "reverse" for that many errors and metrics, unless `mode` is one of them already.

    Raises: InputError for an unknown mode, and for "reverse" with a problem that has none.
    """
    if mode not in MODES:
        raise InputError(f"Argument `mode` must be one of {', '.join(MODES)}, but it is {mode!r}.")
    reversible = getattr(problem, "reversible", True)
    if mode == "reverse" and not reversible:
        raise InputError(
            'Argument `mode` must be "forward" or "auto" with steps that are chosen on the way, but is "reverse"; take '
            "one of these, or a method with fixed steps (with joints with clearance `contact_tolerance = 0`)."
        )
    if mode != "auto":
        return mode
    if not reversible:
        return "forward"
    return "forward" if errors <= REVERSE_COST * metrics else "reverse"


def differentiate(
    function: Function, x: Float[Array, " k"], mode: str, batch: int
) -> tuple[ValueVector, Jacobian, Status]:
    """Value (m,), Jacobian (m, k) and status of `function(x) -> ((m,), status)`; traced."""
    if mode == "reverse":
        value, pull, status = jax.vjp(function, x, has_aux=True)
        cotangents = jnp.eye(value.shape[0], dtype=value.dtype)
        return value, map_chunks(lambda c: pull(c)[0], cotangents, batch), status
    value, jacobian, status = push_directions(function, x, jnp.eye(x.shape[0], dtype=x.dtype), batch)
    return value, jacobian.T, status


def push_directions(function, x, directions, batch):
    """Value (m,), derivatives (d, m) along directions (d, k), and status; traced. The value may be several arrays."""

    def push(tangent):
        return jax.jvp(function, (x,), (tangent,), has_aux=True)

    value, derivatives, status = map_chunks(push, directions, batch)
    return jax.tree.map(lambda x: x[0], value), derivatives, status[0]


def differentiate_twice(
    function: CheckedFunction, x: Float[Array, " k"], directions: Float[Array, "d k"], mode: str, batch: int
) -> tuple[ValueVector, Jacobian, Float[Array, "d m k"], Status]:
    """Value (m + c,), Jacobian (m + c, k), derivatives (d, m, k) of its first m rows along directions, and status, of
    `function(x) -> (((m,), (c,)), status)`; traced.

    Forward mode over the first derivative in the chosen mode.  What only the c other values depend on is not
    differentiated twice: they are a part of their own.
    """

    def first(y):
        if mode == "reverse":
            values, pull, status = jax.vjp(function, y, has_aux=True)
            zeros = [jnp.zeros_like(value) for value in values]
            jacobians = [
                map_chunks(lambda c: pull((*zeros[:i], c, *zeros[i + 1 :]))[0], jnp.eye(len(value)), batch)
                if len(value)
                else jnp.zeros((0, len(y)))
                for i, value in enumerate(values)
            ]
        else:
            values, derivatives, status = push_directions(function, y, jnp.eye(len(y)), batch)
            jacobians = [derivative.T for derivative in derivatives]
        return jacobians[0], (values, jacobians[1], status)

    def push(tangent):
        return jax.jvp(first, (x,), (tangent,), has_aux=True)

    jacobian, change, (values, others, status) = jax.vmap(push)(directions)
    return jnp.concatenate(values, axis=1)[0], jnp.concatenate([jacobian[0], others[0]]), change, status[0]


@partial(Program, nameless=True)
def _linearise(problem, names, base, points, weights, mode, mesh):
    """Values (w, m), derivatives and status of points (w, k): Jacobians (w, m, k) in forward mode, in reverse mode the
    gradients (w, k) of weights (w, m) . metrics; divided among the devices of a mesh."""

    def of_rows(given, points, weights):
        problem, base = given

        def function(x):
            return stack_metrics(problem, names, base, x)

        def one(x, weight):
            if mode == "reverse":
                value, pull, status = jax.vjp(function, x, has_aux=True)
                derivatives = pull(weight)[0]
            else:
                value, derivatives, status = differentiate(function, x, mode, DIRECTIONS)
            return jnp.where(status == 0, value, jnp.nan), derivatives, status

        return jax.vmap(one)(points, weights)

    return on_devices(mesh, of_rows, (problem, base), points, weights)


def linearise_points(
    problem: ToleranceProblem,
    names: Sequence[str],
    base: Base,
    points: Float[np.ndarray, "n k"] | Sequence[Sequence[float]],
    *,
    metric: int | Int[np.ndarray, " n"] | None = None,
    mode: str = "auto",
    batch: int = 256,
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n m k"] | Float[np.ndarray, "n k"], Int[np.ndarray, " n"]]:
    """Values of all metrics and their derivatives at many points, chunk by chunk (one program).

    Args: names (k), base as `split_errors` gives them; points (n, k) [rad, m]; metric None for the derivatives of all
        metrics, or the index of one, or (n,) indices, one for each point; mode as everywhere ("auto" counts the
        metrics whose derivatives are asked for); batch, the most points at once on each device (fewer where it gains
        nothing).
    Returns: values (n, m), NaN where the sample failed; Jacobians (n, m, k), or with `metric` gradients (n, k);
        status (n,).
    """
    n, m, k = len(points), len(problem.metrics), len(names)
    mode = choose_mode(mode, k, m if metric is None else 1, problem)
    points = np.asarray(points, dtype=np.float64).reshape(n, k)
    width = min(batch, default_lanes())
    if mode == "forward":
        width = max(1, min(width, POINTS_WITH_TANGENTS * default_lanes() // k))

    shared, mesh = of_any_step(problem, mode), local_mesh()

    def program(*of_points):
        return _linearise(shared, names, base, *(divided(mesh, one) for one in of_points), mode, mesh)

    def run(points, weights):
        of = problem, ("derivatives", tuple(names), base, mode)
        return run_in_chunks(program, width * mesh.size, points, weights, of=of)

    if mode == "forward":
        values, jacobians, status = run(points, np.zeros((n, m)))
        return values, jacobians if metric is None else jacobians[np.arange(n), metric], status
    picked = np.eye(m)  # weights that pick a metric
    if metric is None:  # the program has one gradient per point: each point once per metric
        values, gradients, status = run(np.repeat(points, m, axis=0), np.tile(picked, (n, 1)))
        return values[::m], gradients.reshape(n, m, k), status[::m]
    values, gradients, status = run(points, picked[np.broadcast_to(metric, (n,))])
    return values, gradients, status
