"""Programs that run for a short time are evaluated by NumPy instead of being compiled, which would take longer.

`instead_of_compilation()` replaces the function of JAX that compiles and runs a program.  A program is compiled all the
same if it is small, if NumPy cannot evaluate it, and as soon as its evaluations have taken as long as compilation would
have: the time is counted in operations, so that every machine does the same.
"""

import functools
from collections.abc import Iterator
from contextlib import contextmanager

import jax
import numpy as np
import pytest
from jax._src import pjit

from tests.numpy_evaluation import TooLong, Work, counted, interpreted, is_key

SMALL = 400  # equations of a program that is compiled at once
RATIO = 100.0  # operations of NumPy in the time in which XLA compiles one
FOREIGN = ("callback", "debug", "print", "infeed", "outfeed", "shard_map", "custom_partitioning")
LOOPS = ("scan", "while", "cond")


def within(equation) -> list:
    """The jaxprs among the parameters of an equation."""
    found = []
    for value in equation.params.values():
        found += [x for x in (value if isinstance(value, tuple) else (value,)) if hasattr(x, "eqns")]
    return found


def equations(jaxpr) -> Iterator:
    """All equations of a jaxpr and of those within it; a jaxpr that is called twice counts once."""
    seen, waiting = set(), [jaxpr]
    while waiting:
        one = waiting.pop()
        if id(one) not in seen:
            seen.add(id(one))
            for equation in one.eqns:
                yield equation
                waiting += within(equation)


def can_be_evaluated(jaxpr) -> bool:
    """Without effects and calls into Python; keys of random numbers within one turn of a loop only."""
    if jaxpr.effects or any(map(is_key, (*jaxpr.in_avals, *jaxpr.out_avals))):
        return False
    for equation in equations(jaxpr):
        name = equation.primitive.name
        if any(word in name for word in FOREIGN):
            return False
        if name in LOOPS and any(is_key(x.aval) for x in (*equation.invars, *equation.outvars)):
            return False
    return True


def least_operations(jaxpr) -> float:
    """Operations of one evaluation in which every `while` loop takes one turn."""
    known: dict[int, float] = {}

    def count(one):
        if id(one) not in known:
            known[id(one)] = sum(map(of_equation, one.eqns))
        return known[id(one)]

    def of_equation(equation):
        inner = [count(x) for x in within(equation)]
        if equation.primitive.name == "scan":
            return equation.params["length"] * sum(inner)
        if equation.primitive.name == "cond":
            return min(inner)
        return 1.0 + sum(inner)

    return count(jaxpr)


class _Tier:
    """What has been spent on the evaluations of one program; `compiled`: it is compiled from now on."""

    def __init__(self, jaxpr):
        self.jaxpr = jaxpr
        size = sum(1 for _ in equations(jaxpr))
        self.left = RATIO * size
        self.compiled = size < SMALL or least_operations(jaxpr) > self.left or not can_be_evaluated(jaxpr)


@contextmanager
def instead_of_compilation() -> Iterator[None]:
    """Evaluate by NumPy what is not worth its compilation, within the block."""
    compile_and_run, tiers = pjit._pjit_call_impl_python, {}

    @functools.wraps(compile_and_run)
    def run(*arguments, jaxpr, **settings):
        tier = tiers.get(id(jaxpr))
        if tier is None:
            tier = tiers[id(jaxpr)] = _Tier(jaxpr)
        if not tier.compiled:
            work = Work(tier.left)
            try:
                with counted(work), np.errstate(all="ignore"):
                    results = interpreted(jaxpr)([np.asarray(x) for x in arguments])
            except TooLong:
                tier.compiled = True
            else:
                tier.left -= work.done
                kinds = [x.aval.dtype for x in jaxpr.jaxpr.outvars]
                found = [np.asarray(x, dtype) for x, dtype in zip(results, kinds, strict=True)]
                return jax.device_put(found), None, None, []
        return compile_and_run(*arguments, jaxpr=jaxpr, **settings)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pjit, "_pjit_call_impl_python", run)
        yield
