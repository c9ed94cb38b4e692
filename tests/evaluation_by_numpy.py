"""Programs that run for a short time are evaluated by NumPy instead of being compiled, which would take longer.

`instead_of_compilation()` replaces the function of JAX that compiles and runs a program.  A program is compiled all the
same if it is small, if NumPy cannot evaluate it, and as soon as its evaluations have taken as long as compilation would
have: the time is counted in operations, so that every machine does the same.
"""

import functools
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import jax
import numpy as np
import pytest
from jax._src import pjit

from tests.numpy_evaluation import TooLong, Work, counted, interpreted, is_key, without_idle

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


class _Summary(NamedTuple):
    """Of a jaxpr with what it calls: equations as XLA is given them; operations of one evaluation in which every
    `while` loop takes one turn; whether NumPy can evaluate it."""

    size: int
    least: float
    possible: bool


_SUMMARIES: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()


def summary(jaxpr) -> _Summary:
    """Of a jaxpr, closed or not; NumPy calls no Python, and keeps keys of random numbers for one turn of a loop."""
    inner = getattr(jaxpr, "jaxpr", jaxpr)
    found = _SUMMARIES.get(inner)
    if found is None:
        size, least, possible = 0, 0.0, not inner.effects
        for equation in inner.eqns:
            name, parts = equation.primitive.name, [summary(x) for x in within(equation)]
            size += 1 + sum(x.size for x in parts)
            operations = [x.least for x in parts]
            if name == "scan":
                least += equation.params["length"] * sum(operations)
            else:
                least += min(operations) if name == "cond" else 1.0 + sum(operations)
            keys = name in LOOPS and any(is_key(x.aval) for x in (*equation.invars, *equation.outvars))
            foreign = any(word in name for word in FOREIGN)
            possible = possible and not foreign and not keys and all(x.possible for x in parts)
        found = _SUMMARIES[inner] = _Summary(size, least, possible)
    return found


class _Tier:
    """What has been spent on the evaluations of one program; `compiled`: it is compiled from now on."""

    def __init__(self, jaxpr):
        self.jaxpr, self.program = jaxpr, None
        size, least, possible = summary(jaxpr)
        possible = possible and not any(map(is_key, (*jaxpr.in_avals, *jaxpr.out_avals)))
        self.left = RATIO * size
        self.compiled = size < SMALL or least > self.left or not possible


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
            tier.program = tier.program or without_idle(jaxpr)
            try:
                with counted(work), np.errstate(all="ignore"):
                    results = interpreted(tier.program)([np.asarray(x) for x in arguments])
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
