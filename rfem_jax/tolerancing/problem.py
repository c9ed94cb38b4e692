"""Problems in closed form: any JAX function of named errors, in the form that all studies work on.

Place in the pipeline: the door of this room. A problem is any object with

    problem(errors) -> (values, status)   pure JAX: works under jit, vmap, jacfwd, grad, Hessian
    problem.metrics                       tuple of objects with .name, .unit, .label, .even
    problem.error_names                   tuple of the names of errors that it accepts
    problem.error_unit(name)              "rad" or "m"
    problem.describe_status(code)         what a status code says; 0 is "ok"

`errors` {name: scalar} [rad or m], missing names mean zero; `values` {metric name: scalar};
`status` scalar int32, 0 for a good sample. The simulator is one such problem, `FunctionProblem`
makes one of a function. `even` is True where a metric does not change when the out-of-plane errors
change sign (mirror symmetry), None where nothing is known.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp

from rfem_jax.description.errors import InputError
from rfem_jax.tolerancing.evaluation import check_known

UNITS = ("rad", "m")


@dataclass(frozen=True)
class Metric:
    """One number that a problem returns: name, unit, label for tables and plots, symmetry."""

    name: str
    unit: str = ""
    label: str = ""
    even: bool | None = None

    def __post_init__(self):
        if not isinstance(self.name, str) or not self.name:
            raise InputError(f"Argument `name` must be a word, but it is {self.name!r}; give the metric a name.")
        if not self.label:
            object.__setattr__(self, "label", self.name)


class FunctionProblem(eqx.Module):
    """A problem made of any JAX function of a dict of errors.

    Args:
        function: takes {name: scalar} with every one of error_names [rad or m] and returns
            {metric name: scalar}, or the pair of it and a status (int, 0 = ok).
        error_names: names that it accepts, in order.
        metrics: Metric objects or plain names.
        error_units: {name: "rad" or "m"}; "rad" where it says nothing.
        statuses: {code: what it means} for the codes that the function may return.
    Raises: InputError for repeated or unknown names, and for units other than rad and m.
    """

    function: Callable
    error_names: tuple[str, ...] = eqx.field(static=True)
    metrics: tuple[Metric, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    statuses: tuple[tuple[int, str], ...] = eqx.field(static=True)

    def __init__(self, function, error_names, metrics, *, error_units=None, statuses=None):
        self.function = function
        self.error_names = _distinct(error_names, "error_names")
        metrics = (metrics,) if isinstance(metrics, (str, Metric)) else metrics
        self.metrics = tuple(Metric(m) if isinstance(m, str) else m for m in metrics)
        _distinct((m.name for m in self.metrics), "metrics")
        error_units = dict(error_units or {})
        check_known(error_units, self.error_names, "error_units")
        for name, unit in error_units.items():
            if unit not in UNITS:
                raise InputError(
                    f"Argument `error_units` must give `rad` or `m`, but `{name}` has {unit!r}; "
                    "convert the error to SI units."
                )
        self.units = tuple(error_units.get(name, "rad") for name in self.error_names)
        self.statuses = tuple((int(code), str(text)) for code, text in (statuses or {}).items())

    def __call__(self, errors: Mapping):
        """Values {metric name: scalar float64} and status (scalar int32) of one sample."""
        check_known(errors, self.error_names, "errors")
        zero = jnp.zeros((), jnp.float64)
        complete = {name: jnp.asarray(errors.get(name, zero)) for name in self.error_names}
        returned = self.function(complete)
        values, status = returned if isinstance(returned, tuple) else (returned, 0)
        check_known((m.name for m in self.metrics), values, "metrics")
        values = {m.name: jnp.asarray(values[m.name], jnp.float64) for m in self.metrics}
        return values, jnp.asarray(status, jnp.int32)

    def error_unit(self, name):
        """Unit of an error, "rad" or "m". Raises InputError for an unknown name."""
        check_known((name,), self.error_names, "name")
        return self.units[self.error_names.index(name)]

    def describe_status(self, code):
        """What a status code says, "ok" for 0."""
        return dict(self.statuses).get(int(code), "ok" if int(code) == 0 else f"status {int(code)}")


def _distinct(names, what):
    """`names` as a tuple of strings, at least one, none twice. Raises InputError."""
    names = (names,) if isinstance(names, str) else tuple(names)
    if not names:
        raise InputError(f"Argument `{what}` must hold at least one name, but it is empty.")
    twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
    if twice is not None:
        raise InputError(f"Argument `{what}` must not repeat a name, but `{twice}` occurs twice; rename one.")
    return names
