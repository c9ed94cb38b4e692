"""The interface of this package: problems, their metrics, and problems made of a JAX function.

Place in the pipeline: the simulator (`simulated_problem`) or a function in closed form (`FunctionProblem`) ->
**problem** -> all tolerance studies.

A problem is any object that satisfies the protocol `ToleranceProblem`:

    problem(errors) -> (values, status)   pure JAX: works under jit, vmap, jacfwd, grad and for Hessians
    problem.metrics                       tuple of `Metric`
    problem.error_names                   tuple of the names of the errors that it accepts
    problem.error_unit(name)              its SI unit: "rad" or "m", of a parameter also others
    problem.describe_status(code)         the meaning of a status code; 0 is "ok"

Symbols: errors {name: scalar} [rad or m], where a missing name means zero; values {metric name: scalar} in the units
of the metrics; status, scalar int32, 0 for a good sample.
"""

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, SupportsIndex, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from rfem_jax.compilation import keys
from rfem_jax.compilation.naming import Names, NotRenamable
from rfem_jax.description.basics.errors import InputError
from rfem_jax.tolerancing.checks import DIMENSIONS, check_distinct, check_known

Values = dict[str, Float[Array, "..."]]  # scalars; signals of an identification have an axis of times
Status = Int[Array, ""]


@dataclass(frozen=True)
class Metric:
    """One number that a problem returns: its name, unit, label for tables and plots, and symmetry.

        Metric("A.swing", "rad", "largest crank angle", function=lambda run: jnp.max(run.motion.angle))

    `even`: True if the value does not change when all out-of-plane errors of a planar mechanism change sign
    (theory (9.3)), None if unknown. `function`: Run -> scalar; the simulator needs it, a `FunctionProblem` does not.
    `records`: what the function reads of `run.recorded`, by the names of records; `description`: what it
    is, in a sentence; `by_name`: makes the metrics of the catalogue, of which it is one, of names.
    Raises: InputError for a name that is no word and a function that cannot be called.
    """

    name: str
    unit: str = ""
    label: str = ""
    even: bool | None = None
    function: Callable[[Any], ArrayLike] | None = field(default=None, kw_only=True)
    records: tuple[str, ...] = field(default=(), kw_only=True)
    description: str = field(default="", kw_only=True)
    by_name: Callable[[str], "Metric"] | None = field(default=None, kw_only=True, compare=False, repr=False)

    def __post_init__(self):
        if not isinstance(self.name, str) or not self.name:
            raise InputError(f"Argument `name` must be a word, but it is {self.name!r}; give the metric a name.")
        if self.function is not None:
            self._require_function()
        if not self.label:
            object.__setattr__(self, "label", self.name)

    def __call__(self, run: Any) -> ArrayLike:
        """The value of a run. Raises InputError for a metric without a function."""
        return self._require_function()(run)

    def renamed(self, names: Names) -> "Metric":
        """The same metric in a model with other names.

        Raises: NotRenamable for a function that may read results by their names.
        """
        if not self._is_digestible:
            raise NotRenamable(self.name)
        of_other = names.of(self.name)
        if of_other == self.name:
            return self
        if self.by_name is None:
            raise NotRenamable(self.name)
        return self.by_name(of_other)

    @functools.cached_property  # asked for in every call of a program
    def _is_digestible(self) -> bool:
        try:
            keys.digest_value(self)
        except keys.NotDigestible:
            return False
        return True

    # Pickled for other processes: functions without a name are not, and the catalogue makes its metrics of theirs.
    def __reduce_ex__(self, protocol: SupportsIndex) -> Any:
        return super().__reduce_ex__(protocol) if self.by_name is None else (self.by_name, (self.name,))

    def _require_function(self) -> Callable[[Any], ArrayLike]:
        if self.function is None or not callable(self.function):
            raise InputError(
                f"Argument `function` of metric {self.name!r} must be a function of a run, but is "
                f"{self.function!r}; give for example `lambda run: run.motion.angle[-1]`."
            )
        return self.function


@runtime_checkable
class ToleranceProblem(Protocol):
    """A function of named errors, in the form that all tolerance studies work on; see the module's docstring."""

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """Its metrics, in the order of all arrays."""
        ...

    @property
    def error_names(self) -> tuple[str, ...]:
        """Names of all errors that it accepts, in the order of all arrays."""
        ...

    def error_unit(self, name: str) -> str:
        """Unit of an error, "rad" or "m"."""
        ...

    def describe_status(self, code: int) -> str:
        """The meaning of a status code."""
        ...

    def __call__(self, errors: Mapping[str, ArrayLike]) -> tuple[Values, Status]:
        """Values {metric name: scalar} and status of one sample."""
        ...


@runtime_checkable
class ImplicitProblem(ToleranceProblem, Protocol):
    """A problem whose values come from equations that are solved to a residual: their derivatives can be checked.

    `derivative_limit`: the largest relative residual of the differentiated equations with which a derivative counts
    as converged; None where the equations are solved exactly.
    """

    @property
    def derivative_limit(self) -> float | None:
        """See the class."""
        ...

    def with_residual(
        self, errors: Mapping[str, ArrayLike]
    ) -> tuple[Values, Status, Float[Array, "times n"], Float[Array, "joints times 3"]]:
        """Values, status, residual of the equations of motion [N] and joint forces [N] at the saved times."""
        ...


class StrikingProblem(ToleranceProblem, Protocol):
    """A problem whose pins may strike their bushes; its derivatives count only as far as a finer step has the same.

    `strikes`: whether they may.
    """

    @property
    def strikes(self) -> bool:
        """See the class."""
        ...

    def refined(self) -> ToleranceProblem:
        """The same problem with half the step."""
        ...


def of_any_step(problem: ToleranceProblem, mode: str = "forward") -> ToleranceProblem:
    """The problem in the form that a program of values, or of derivatives of this mode, takes: simulations share one
    program for all steps of the method, but in reverse mode."""
    shared = getattr(problem, "of_any_step", None)
    return problem if shared is None or mode == "reverse" else shared()


class Watched(NamedTuple):
    """A problem in the form of its program of values; rows (m,): where its own metrics are among those of this form;
    checks {name: row}: numbers that tell with how much caution a good sample is to be read."""

    problem: ToleranceProblem
    rows: list[int]
    checks: dict[str, int]


def values_form(problem: ToleranceProblem) -> Watched:
    """As `of_any_step`, with the problem's `checks`, if it has any, beside the metrics."""
    with_checks = getattr(problem, "with_checks", None)
    whole, checks = (problem, ()) if with_checks is None else with_checks()
    names = [one.name for one in whole.metrics]
    rows = [names.index(one.name) for one in problem.metrics]
    return Watched(of_any_step(whole), rows, {name: names.index(name) for name in checks})


class FunctionProblem(eqx.Module):
    """A problem made of any JAX function of a dict of errors.

    Args:
        function: takes {name: scalar} with every one of error_names [rad or m] and returns {metric name: scalar},
            or the pair of it and a status (int, 0 = ok).
        error_names: names that it accepts, in order.
        metrics: `Metric`s or plain names.
        error_units: {name: "rad" or "m"}; "rad" for names that are missing.
        statuses: {code: meaning} for the codes that the function may return.
    Raises: InputError for repeated or unknown names, and for units other than rad and m.
    """

    function: Callable
    error_names: tuple[str, ...] = eqx.field(static=True)
    metrics: tuple[Metric, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    statuses: tuple[tuple[int, str], ...] = eqx.field(static=True)

    def __init__(
        self,
        function: Callable,
        error_names: str | Iterable[str],
        metrics: str | Metric | Iterable[str | Metric],
        *,
        error_units: Mapping[str, str] | None = None,
        statuses: Mapping[int, str] | None = None,
    ):
        self.function = function
        self.error_names = check_distinct(error_names, "error_names")
        metrics = (metrics,) if isinstance(metrics, (str, Metric)) else metrics
        self.metrics = tuple(Metric(m) if isinstance(m, str) else m for m in metrics)
        check_distinct((m.name for m in self.metrics), "metrics")
        error_units = dict(error_units or {})
        check_known(error_units, self.error_names, "error_units")
        for name, unit in error_units.items():
            if unit not in DIMENSIONS:
                raise InputError(
                    f"Argument `error_units` must give SI units, `rad` or `m` for errors, but `{name}` has {unit!r}; "
                    "convert the error."
                )
        self.units = tuple(error_units.get(name, "rad") for name in self.error_names)
        self.statuses = tuple((int(code), str(text)) for code, text in (statuses or {}).items())

    def __call__(self, errors: Mapping[str, ArrayLike]) -> tuple[Values, Status]:
        """Values {metric name: scalar float64} and status (scalar int32) of one sample."""
        check_known(errors, self.error_names, "errors")
        zero = jnp.zeros((), jnp.float64)
        complete = {name: jnp.asarray(errors.get(name, zero)) for name in self.error_names}
        returned = self.function(complete)
        values, status = returned if isinstance(returned, tuple) else (returned, 0)
        check_known((m.name for m in self.metrics), values, "metrics")
        values = {m.name: jnp.asarray(values[m.name], jnp.float64) for m in self.metrics}
        return values, jnp.asarray(status, jnp.int32)

    def error_unit(self, name: str) -> str:
        """Unit of an error, "rad" or "m". Raises InputError for an unknown name."""
        check_known((name,), self.error_names, "name")
        return self.units[self.error_names.index(name)]

    def describe_status(self, code: int) -> str:
        """The meaning of a status code, "ok" for 0."""
        return dict(self.statuses).get(int(code), "ok" if int(code) == 0 else f"status {int(code)}")
