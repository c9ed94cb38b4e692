"""Metrics at named points: from names and tolerances to arrays, and many points in chunks.

Place in the pipeline: the door between a `problem(errors) -> (values, status)` and the studies that
differentiate (sensitivities, worst cases, allocation). They work with vectors x (k,) of the errors
they vary, in [rad] and [m] as the problem's names say; all other errors stay at `base`.

Symbols: k errors, m metrics, n points; x (k,) errors; t (k,) half-widths of the tolerances [as x];
status 0 is a good sample, any other integer a failure (its values are not used).
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.description.errors import InputError, suggestion


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


@eqx.filter_jit
def _evaluate_chunk(problem, names, base, points):
    return jax.vmap(lambda x: stack_metrics(problem, names, base, x))(points)


def evaluate_points(problem, names, base, points, batch=256):
    """All metrics at many points, chunk by chunk from the host (one compiled program).

    Args: points (n, k) [rad, m]; batch points run at once.
    Returns: values (n, m) NumPy, NaN where the sample failed or is not finite; status (n,) int32.
    """
    points = np.asarray(points, dtype=np.float64)
    # Few sizes of chunks, so that few programs are compiled.
    batch = min(batch, 1 << max(4, (len(points) - 1).bit_length()))
    values, statuses = [], []
    for first in range(0, len(points), batch):
        chunk = points[first : first + batch]
        used = len(chunk)
        chunk = np.concatenate([chunk, np.repeat(chunk[:1], batch - used, axis=0)])
        value, status = _evaluate_chunk(problem, names, base, jnp.asarray(chunk))
        values.append(np.asarray(value)[:used])
        statuses.append(np.asarray(status)[:used])
    values, statuses = np.concatenate(values), np.concatenate(statuses)
    return np.where((statuses == 0)[:, None], values, np.nan), statuses


def describe_status(problem, status):
    """The problem's own word for a status code, "ok" for 0."""
    if int(status) == 0:
        return "ok"
    describe = getattr(problem, "describe_status", None)
    return describe(int(status)) if describe else f"status {int(status)}"
