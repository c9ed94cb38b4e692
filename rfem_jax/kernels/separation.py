"""What depends on some operands of a jaxpr, apart from the rest.

Place in the pipeline: entries, emission -> **separation** -> transformations.

`jax.linearize` does as much for any function, by tracing the derivative of every operation once more: a jaxpr that has
the derivative already is separated by a look at its equations.
"""

from collections.abc import Callable, Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal

from rfem_jax.kernels.emission import called_program
from rfem_jax.kernels.entries import needed

OPENED = frozenset(["jit", "pjit", "closed_call"])  # calls that are their content
DIVISIBLE = frozenset(["scan", "cond", "checkpoint", "remat", "remat2"])  # by `jax.linearize`, into two of the kind


class NotSeparable(Exception):
    """A loop or a branch has a part that could be carried out before, and one that depends on the other operands."""


class _Later:
    """A value that is not known yet."""


def separated(program: ClosedJaxpr, fixed: Sequence[Any]) -> Callable[..., list[Any]]:
    """Carry out what depends on the first operands alone.

    **Arguments:** `program`; `fixed`: its first operands.

    **Returns:** its results as a function of the other operands, in which nothing else is left to be done.

    **Raises:** NotSeparable for a loop or a branch that depends on both.
    """
    left = [_Later() for _ in program.jaxpr.invars[len(fixed) :]]
    steps: list[tuple[JaxprEqn, list[Any], list[Any]]] = []
    results = _run(program, [*fixed, *left], steps)

    def function(*others: Any) -> list[Any]:
        found: dict[Any, Any] = dict(zip(left, others, strict=True))

        def value(x: Any) -> Any:
            return found[x] if isinstance(x, _Later) else x

        for equation, operands, outcome in steps:
            found.update(zip(outcome, _carried_out(equation, [*map(value, operands)])))
        return [*map(value, results)]

    return function


def _run(program: ClosedJaxpr, operands: list[Any], steps: list) -> list[Any]:
    """The results of a jaxpr; what is to be done later is noted in `steps`."""
    jaxpr = program.jaxpr
    values: dict[Any, Any] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*program.consts, *operands], strict=True))

    def read(variable: Any) -> Any:
        return variable.val if isinstance(variable, Literal) else values[variable]

    for equation in needed(jaxpr):
        given = [*map(read, equation.invars)]
        if not any(isinstance(x, _Later) for x in given):
            found = _carried_out(equation, given)
        elif equation.primitive.name in OPENED:
            found = _run(called_program(equation.params), given, steps)
        elif equation.primitive.name in DIVISIBLE:
            raise NotSeparable
        else:
            found = [_Later() for _ in equation.outvars]
            steps.append((equation, given, found))
        values.update(zip(equation.outvars, found))
    return [*map(read, jaxpr.outvars)]


def _carried_out(equation: JaxprEqn, operands: list[Any]) -> Sequence[Any]:
    primitive = equation.primitive
    results = primitive.bind(*operands, **primitive.get_bind_params(equation.params))
    return results if primitive.multiple_results else [results]
