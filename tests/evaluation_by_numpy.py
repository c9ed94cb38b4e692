"""Programs that run for a short time are evaluated by NumPy instead of being compiled, which would take longer.

`instead_of_compilation()` replaces the function of JAX that compiles and runs a program, also one of a single operation
outside of `jit`.  A program is compiled all the same if NumPy cannot evaluate it, and as soon as its evaluations have
taken as long as compilation would have: the time is counted in operations, so that every machine does the same.
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
from jax._src.array import ArrayImpl

from tests.numpy_evaluation import TooLong, Work, counted, has_rule, interpreted, is_key, without_idle

# In operations of NumPy: the time in which XLA compiles any program, and in which it compiles an operation more; that
# of the call of a program that is evaluated.
ANY, RATIO, CALL = 10_000.0, 200.0, 50.0
SMALL = 400  # equations of a program that is compiled if NumPy has no rule for one of them
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
    `while` loop takes one turn; whether NumPy can evaluate it, and whether it has rules for all that is in it."""

    size: int
    least: float
    possible: bool
    by_rules: bool


_SUMMARIES: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()


def summary(jaxpr) -> _Summary:
    """Of a jaxpr, closed or not; NumPy calls no Python, and keeps keys of random numbers for one turn of a loop."""
    inner = getattr(jaxpr, "jaxpr", jaxpr)
    found = _SUMMARIES.get(inner)
    if found is None:
        size, least, possible, by_rules = 0, 0.0, not inner.effects, True
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
            by_rules = by_rules and has_rule(name) and all(x.by_rules for x in parts)
        found = _SUMMARIES[inner] = _Summary(size, least, possible, by_rules)
    return found


class _Tier:
    """What has been spent on the evaluations of one program; `compiled`: it is compiled from now on."""

    def __init__(self, jaxpr):
        self.jaxpr, self.program = jaxpr, None
        size, least, possible, by_rules = summary(jaxpr)
        has_keys = any(map(is_key, (*jaxpr.in_avals, *jaxpr.out_avals)))
        self.left = ANY + RATIO * size
        # What has no rule is a program of its own when its turn comes.
        self.compiled = least > self.left or not possible or has_keys or not (by_rules or size >= SMALL)


def _on_chosen_devices(arguments) -> bool:
    return any(isinstance(x, jax.Array) and x.committed for x in arguments)


def _of_jax(results, avals) -> list[jax.Array]:
    """Results of an evaluation as the compiled program's."""
    found = jax.device_put([np.asarray(x, aval.dtype) for x, aval in zip(results, avals, strict=True)])
    weak = [aval.weak_type for aval in avals]
    return [ArrayImpl(aval, x.sharding, [x], committed=False) if w else x for aval, x, w in zip(avals, found, weak)]


@contextmanager
def instead_of_compilation() -> Iterator[None]:
    """Evaluate by NumPy what is not worth its compilation, within the block."""
    compile_and_run, tiers = pjit._pjit_call_impl_python, {}

    @functools.wraps(compile_and_run)
    def run(*arguments, jaxpr, **settings):
        tier = tiers.get(id(jaxpr))
        if tier is None:
            tier = tiers[id(jaxpr)] = _Tier(jaxpr)
        if not tier.compiled and not _on_chosen_devices(arguments):
            work = Work(tier.left)
            tier.program = tier.program or without_idle(jaxpr)
            try:
                with counted(work), np.errstate(all="ignore"):
                    results = interpreted(tier.program)([np.asarray(x) for x in arguments])
            except TooLong:
                tier.compiled = True
            else:
                tier.left -= work.done + CALL
                return _of_jax(results, jaxpr.out_avals), None, None, []
        return compile_and_run(*arguments, jaxpr=jaxpr, **settings)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pjit, "_pjit_call_impl_python", run)
        yield
