"""Metrics at named points: from names and tolerances to arrays, and many points in chunks.

Place in the pipeline: the door between a `problem(errors) -> (values, status)` and the studies that
differentiate (sensitivities, worst cases, allocation). They work with vectors x (k,) of the errors
they vary, in [rad] and [m] as the problem's names say; all other errors stay at `base`.

Compiling a simulation takes far longer than running it: for each problem and set of errors all
studies share one program for values and one for values with slopes (`quadratic_model`), each of one
shape. Points come to them in chunks from the host, the last chunk filled up.

Symbols: k errors, m metrics, n points; x (k,) errors; t (k,) half-widths of the tolerances [as x];
status 0 is a good sample, any other integer a failure (its values are not used).
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.compilation.program import Program
from rfem_jax.description.errors import InputError, suggestion
from rfem_jax.tolerancing.execution import default_lanes


def require_float64():
    """Refuse to work in single precision. Raises InputError."""
    if not jax.config.jax_enable_x64:
        raise InputError(
            "Argument `jax_enable_x64` must be on, but JAX works in 32 bits; "
            'put jax.config.update("jax_enable_x64", True) before the first array.'
        )


def check_known(names, known, what):
    """Raise InputError for the first of `names` that is not in `known`, with the nearest one."""
    for name in names:
        if name not in known:
            raise InputError(
                f"Argument `{what}` must name what the problem has, but `{name}` is not known; "
                f"{suggestion(name, known)}"
            )


def select_half_widths(problem, tolerances, what="tolerances"):
    """Names and half-widths of a `Tolerances` collection or of a mapping name -> half-width.

    Returns (names tuple (k), half_widths (k,) NumPy [rad or m]). Raises InputError for unknown
    names and for half-widths that are not positive and finite.
    """
    widths = tolerances.half_widths() if hasattr(tolerances, "half_widths") else tolerances
    if not isinstance(widths, Mapping) or not widths:
        raise InputError(
            f"Argument `{what}` must be a Tolerances collection or a mapping from names of "
            f"errors to "
            f"half-widths, but it is {widths!r}."
        )
    check_known(widths, problem.error_names, what)
    values = np.array([float(width) for width in widths.values()])
    for name, value in zip(widths, values, strict=True):
        if not (np.isfinite(value) and value > 0):
            raise InputError(
                f"Argument `{what}` must have positive half-widths, but `{name}` has {value}; "
                "leave out an error that does not vary."
            )
    return tuple(widths), values


def split_errors(problem, errors, names, what="at"):
    """A point as (base, x): the errors held fixed (dict of scalars) and the vector (k,) of
    `names`."""
    errors = dict(errors or {})
    check_known(errors, problem.error_names, what)
    point = jnp.array([float(errors.get(name, 0.0)) for name in names], dtype=jnp.float64)
    base = {n: jnp.asarray(v, jnp.float64) for n, v in errors.items() if n not in names}
    return base, point


def metric_index(problem, metric, what="metric"):
    """Position of a metric, given by its name or as the object. Raises InputError."""
    names = tuple(m.name for m in problem.metrics)
    name = getattr(metric, "name", metric)
    check_known((name,), names, what)
    return names.index(name)


def stack_metrics(problem, names, base, x):
    """Values (m,) of all metrics and the status at one point x (k,); traced."""
    errors = {**base, **{name: x[i] for i, name in enumerate(names)}}
    values, status = problem(errors)
    return jnp.stack([jnp.asarray(values[m.name]) for m in problem.metrics]), status


def map_chunks(function, rows, batch):
    """`function` of every row of `rows` (n, ...), vectorised over chunks of `batch` rows; traced.

    A whole number of chunks runs in one loop (the last filled up with its first row), so the
    program is compiled for one chunk and its memory does not grow with n.
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


def run_in_chunks(program, width, *rows):
    """`program` of arrays with n rows each, `width` rows at a time, from the host.

    Args: program takes arrays of `width` rows and returns a tuple of arrays with as many.
    Returns: the tuple of its results (NumPy) for all n rows.
    """
    parts = []
    for first in range(0, len(rows[0]), width):
        chunk = [np.asarray(array)[first : first + width] for array in rows]
        used = len(chunk[0])
        filled = [np.concatenate([c, np.repeat(c[:1], width - used, axis=0)]) for c in chunk]
        results = program(*map(jnp.asarray, filled))
        parts.append([np.asarray(result)[:used] for result in results])
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


@Program
def _evaluate_chunk(problem, names, base, points):
    return jax.vmap(lambda x: stack_metrics(problem, names, base, x))(points)


def evaluate_points(problem, names, base, points, batch=256):
    """All metrics at many points, chunk by chunk from the host (one compiled program).

    Args: points (n, k) [rad, m]; batch the most points at once (fewer where the device gains
        nothing by more).
    Returns: values (n, m) NumPy, NaN where the sample failed or is not finite; status (n,) int32.
    """
    points = np.asarray(points, dtype=np.float64)
    values, statuses = run_in_chunks(
        lambda chunk: _evaluate_chunk(problem, names, base, chunk), min(batch, default_lanes()),
        points,
    )  # fmt: skip
    return np.where((statuses == 0)[:, None], values, np.nan), statuses


def describe_status(problem, status):
    """The problem's own word for a status code, "ok" for 0."""
    if int(status) == 0:
        return "ok"
    describe = getattr(problem, "describe_status", None)
    return describe(int(status)) if describe else f"status {int(status)}"
