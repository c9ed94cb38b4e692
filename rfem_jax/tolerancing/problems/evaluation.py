"""Metrics at given points: from names and tolerances to arrays, and many points in chunks.

Place in the pipeline: between a problem(errors) -> (values, status) and the studies that differentiate it
(sensitivities, worst cases, allocation). These work with vectors x (k,) of the errors they vary, in rad and m; all
other errors have the fixed values `base`.

Compiling a simulation takes far longer than running it. For each problem and set of errors all studies therefore
share one program for values and one for values with derivatives (`quadratic_model`), each of one shape and with the
metrics of all tasks of a study. The host passes points to them in chunks and fills up the last one.

Symbols: k errors, m metrics, n points; x (k,) errors; t (k,) half-widths of the tolerances [as x]; status 0 is a good
sample, any other integer a failure (its values are not used).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from rfem_jax.description.basics.errors import InputError
from rfem_jax.kernels import expecting
from rfem_jax.tolerancing.checks import ErrorValues, check_known, check_variables, error_value
from rfem_jax.tolerancing.problems.kept_evaluations import remembered
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.problem import Metric, ToleranceProblem, values_form
from rfem_jax.tolerancing.problems.sample_values import (
    Base,
    default_lanes,
    divided,
    evaluate_lanes,
    local_mesh,
)


def select_half_widths(
    problem: ToleranceProblem, tolerances: Tolerances | ErrorValues, what: str = "tolerances"
) -> tuple[tuple[str, ...], Float[np.ndarray, " k"]]:
    """Names (k) and half-widths (k,) [rad or m] of a `Tolerances` collection, or of a mapping from names to
    half-widths (numbers in rad or m, or strings with a unit).

    Args: what, name of the argument that holds them.
    Raises: InputError for unknown names and for half-widths that are not positive and finite.
    """
    widths = tolerances.half_widths() if isinstance(tolerances, Tolerances) else tolerances
    if not isinstance(widths, Mapping) or not widths:
        raise InputError(
            f"Argument `{what}` must be a Tolerances collection or a mapping from names of errors to half-widths, "
            f"but it is {widths!r}."
        )
    check_variables(widths, problem, what)
    if isinstance(tolerances, Tolerances):
        tolerances.require_units(problem)
    values = np.array(
        [error_value(width, problem.error_unit(name), f"`{name}` of `{what}`") for name, width in widths.items()]
    )
    for name, value in zip(widths, values, strict=True):
        if not (np.isfinite(value) and value > 0):
            raise InputError(
                f"Argument `{what}` must have positive half-widths, but `{name}` has {value}; "
                "leave out an error that does not vary."
            )
    return tuple(widths), values


def read_point(problem: ToleranceProblem, errors: ErrorValues | None, what: str = "at") -> dict[str, float]:
    """A point {error: number in rad or m, or string with a unit} as numbers. Raises InputError."""
    errors = dict(errors or {})
    check_known(errors, problem.error_names, what)
    return {n: error_value(v, problem.error_unit(n), f"`{n}` of `{what}`") for n, v in errors.items()}


def split_errors(
    problem: ToleranceProblem, errors: ErrorValues | None, names: Sequence[str], what: str = "at"
) -> tuple[Base, Float[Array, " k"]]:
    """A point as the errors held fixed (dict of scalars) and the vector (k,) of the errors `names`.

    Args: errors, the point as `read_point` takes it; missing names are zero.
    Raises: InputError for unknown names.
    """
    values = read_point(problem, errors, what)
    point = jnp.array([values.get(name, 0.0) for name in names], dtype=jnp.float64)
    base = {n: jnp.asarray(v, jnp.float64) for n, v in values.items() if n not in names}
    return base, point


def metric_index(problem: ToleranceProblem, metric: str | Metric, what: str = "metric") -> int:
    """Position of a metric, given by its name or as the object. Raises InputError."""
    names = tuple(m.name for m in problem.metrics)
    name = metric.name if isinstance(metric, Metric) else metric
    check_known((name,), names, what)
    return names.index(name)


def map_chunks(function: Callable[[Array], Any], rows: Shaped[Array, "n ..."], batch: int) -> Any:
    """`function` of every row of `rows`, vectorised over chunks of `batch` rows; traced.

    All chunks run in one loop (the last one is filled up with the first row), so that the program is compiled for one
    chunk and its memory does not grow with n.
    Returns: the pytree of the function's results with a leading axis of n.
    """
    count = rows.shape[0]
    batch = min(batch, count)
    chunks = -(-count // batch)
    if chunks == 1:
        return jax.vmap(function)(rows)
    fill = jnp.broadcast_to(rows[:1], (chunks * batch - count, *rows.shape[1:]))
    padded = jnp.concatenate([rows, fill]).reshape(chunks, batch, *rows.shape[1:])
    out = jax.lax.map(jax.vmap(function), padded)
    return jax.tree.map(lambda a: a.reshape(chunks * batch, *a.shape[2:])[:count], out)


def run_in_chunks(
    program: Callable[..., tuple[Array, ...]],
    width: int,
    *rows: Shaped[np.ndarray, "n ..."],
    of: tuple[ToleranceProblem, Any] | None,
    advance: Callable[[int], object] = lambda count: None,
) -> tuple[np.ndarray, ...]:
    """Run a program on arrays of n rows, `width` rows at a time, from the host; the last chunk is filled up.

    Args: program takes arrays of `width` rows and returns a tuple of arrays with as many; of, its problem and what else
        its results depend on beside the rows (`kept_evaluations.remembered`), None for what is kept elsewhere;
        advance(count) is called when so many more rows are done.
    Returns: the program's results for all n rows.
    """
    parts = []
    with expecting(-(-len(rows[0]) // width)):
        for first in range(0, len(rows[0]), width):
            chunk = [np.asarray(array)[first : first + width] for array in rows]
            used = len(chunk[0])
            filled = [np.concatenate([c, np.repeat(c[:1], width - used, axis=0)]) for c in chunk]

            def compute(filled=filled):
                return program(*(jnp.asarray(x, x.dtype) for x in filled))

            results = compute() if of is None else remembered(of[0], (of[1], *filled), compute)
            parts.append([np.asarray(result)[:used] for result in results])
            advance(used)
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def evaluate_points(
    problem: ToleranceProblem,
    names: Sequence[str],
    base: Base,
    points: Float[np.ndarray, "n k"] | Sequence[Sequence[float]],
    batch: int = 256,
    advance: Callable[[int], object] = lambda count: None,
) -> tuple[Float[np.ndarray, "n m"], Int[np.ndarray, " n"]]:
    """All metrics at many points, chunk by chunk from the host (one compiled program).

    Args: names (k) of the errors that vary and base, the others, as `split_errors` gives them; points (n, k) [rad, m];
        batch, the most points at once on each device (fewer where it gains nothing by more); advance, as of
        `run_in_chunks`.
    Returns: values (n, m), NaN where the sample failed, and status (n,).
    """
    points, (shared, rows, _), mesh = np.asarray(points, dtype=np.float64), values_form(problem), local_mesh()
    values, statuses = run_in_chunks(
        lambda chunk: evaluate_lanes(shared, names, base, divided(mesh, chunk), mesh),
        min(batch, default_lanes()) * mesh.size, points, of=(problem, ("values", tuple(names), base)),
        advance=advance,
    )  # fmt: skip
    return np.where((statuses == 0)[:, None], values[:, rows], np.nan), statuses


def describe_status(problem: ToleranceProblem, status: int | Int[Array, ""] | np.integer) -> str:
    """The problem's own word for a status code, "ok" for 0."""
    if int(status) == 0:
        return "ok"
    describe = getattr(problem, "describe_status", None)
    return describe(int(status)) if describe else f"status {int(status)}"
