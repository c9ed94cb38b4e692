"""Programs that run for a short time are evaluated by NumPy instead of being compiled, which would take longer.

`instead_of_compilation()` replaces the function of JAX that compiles and runs a program, also one of a single operation
outside of `jit`.  A program is compiled all the same if NumPy cannot evaluate it, and as soon as its evaluations have
taken as long as compilation would have: the time is counted in operations, so that every machine does the same.  A loop
that is not within another one is compiled by itself, since most of a program stands outside of its longest loop.
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
from jax._src.interpreters.pxla import batched_device_put
from jax.sharding import NamedSharding, PartitionSpec, SingleDeviceSharding

from tests.numpy_evaluation import (
    SIMPLE,
    Loop,
    TooLong,
    Work,
    cost,
    counted,
    has_rule,
    interpreted,
    is_key,
    without_idle,
)

# In operations of NumPy: the time in which XLA compiles any program, and in which it compiles an operation more; that
# of the call of a program that is evaluated.  Loops have a ratio of their own, for tests of which all are long.
ANY, RATIO, RATIO_OF_LOOPS, CALL = 10_000.0, 100.0, 100.0, 50.0
SMALL = 400  # equations of a program that is compiled if NumPy has no rule for one of them
FOREIGN = ("io_callback", "debug", "print", "infeed", "outfeed", "custom_partitioning")
CONTROL = ("scan", "while", "cond")


def within(equation) -> list:
    """The jaxprs among the parameters of an equation."""
    found = []
    for value in equation.params.values():
        found += [x for x in (value if isinstance(value, tuple) else (value,)) if hasattr(x, "eqns")]
    return found


class _Summary(NamedTuple):
    """Of a jaxpr with what it calls: equations as XLA is given them; operations of one evaluation in which every
    `while` loop takes one turn, and those outside of loops; whether NumPy can evaluate it, and whether it has rules for
    all that is in it."""

    size: int
    least: float
    outside: float
    possible: bool
    by_rules: bool


_SUMMARIES: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()


def summary(jaxpr) -> _Summary:
    """Of a jaxpr, closed or not; NumPy has no effects, and keeps keys of random numbers for one turn of a loop."""
    inner = getattr(jaxpr, "jaxpr", jaxpr)
    found = _SUMMARIES.get(inner)
    if found is None:
        size, least, outside, possible, by_rules = 0, 0.0, 0.0, not inner.effects, True
        for equation in inner.eqns:
            name = equation.primitive.name
            if name in SIMPLE:
                size, least, outside = size + 1, least + 1.0, outside + 1.0
                continue
            parts = [summary(x) for x in within(equation)]
            size += 1 + sum(x.size for x in parts)
            least += _least(equation, [x.least for x in parts])
            outside += 1.0 if name in ("scan", "while") else _least(equation, [x.outside for x in parts])
            keys = name in CONTROL and any(is_key(x.aval) for x in (*equation.invars, *equation.outvars))
            foreign = any(word in name for word in FOREIGN) or (
                name == "shard_map" and equation.params["mesh"].size > 1
            )
            possible = possible and not foreign and not keys and all(x.possible for x in parts)
            by_rules = by_rules and has_rule(name) and all(x.by_rules for x in parts)
        found = _SUMMARIES[inner] = _Summary(size, least, outside, possible, by_rules)
    return found


def _least(equation, of_parts: list[float]) -> float:
    """Operations of an equation, of which its parts take so many."""
    name = equation.primitive.name
    if name == "scan":
        return equation.params["length"] * sum(of_parts)
    return min(of_parts) if name == "cond" else cost(name) + sum(of_parts)


class _Tier:
    """What has been spent on the evaluations of one program, but for its loops; `compiled`: it is compiled from now
    on."""

    def __init__(self, jaxpr):
        self.jaxpr, self.program, self.loops = jaxpr, None, {}
        size, _, outside, possible, by_rules = summary(jaxpr)
        has_keys = any(map(is_key, (*jaxpr.in_avals, *jaxpr.out_avals)))
        self.left = ANY + RATIO * size
        # What has no rule is a program of its own when its turn comes.
        self.compiled = outside > self.left or not possible or has_keys or not (by_rules or size >= SMALL)

    def loop_of(self, equation) -> Loop:
        """What is known of one of the outermost loops."""
        found = self.loops.get(id(equation))
        if found is None:
            parts = [summary(x) for x in within(equation)]
            left = ANY + (RATIO_OF_LOOPS * sum(x.size for x in parts) if all(x.by_rules for x in parts) else 0.0)
            least = _least(equation, [x.least for x in parts])
            found = self.loops[id(equation)] = Loop(equation, left if least <= left else 0.0)
        return found


def _chosen(arguments) -> set:
    """Meshes of devices that were chosen for arguments, None for other choices."""
    placed = [x.sharding for x in arguments if isinstance(x, jax.Array) and x.committed]
    return {sharding.mesh if isinstance(sharding, NamedSharding) else None for sharding in placed}


def _of_jax(results, avals, chosen: set) -> list[jax.Array]:
    """Results of an evaluation as the compiled program's."""
    found = [np.asarray(x, aval.dtype) for x, aval in zip(results, avals, strict=True)]
    if chosen:
        return jax.device_put(found, NamedSharding(*chosen, PartitionSpec()))
    device = jax.devices()[0]
    sharding = SingleDeviceSharding(device)
    # `jax.device_put` takes longer, but knows derivatives by integers.
    return [
        jax.device_put(x)
        if aval.dtype == jax.dtypes.float0
        else batched_device_put(aval, sharding, [x], [device], False)
        for aval, x in zip(avals, found, strict=True)
    ]


@contextmanager
def instead_of_compilation() -> Iterator[None]:
    """Evaluate by NumPy what is not worth its compilation, within the block."""
    compile_and_run, tiers = pjit._pjit_call_impl_python, {}

    @functools.wraps(compile_and_run)
    def run(*arguments, jaxpr, **settings):
        tier = tiers.get(id(jaxpr))
        if tier is None:
            tier = tiers[id(jaxpr)] = _Tier(jaxpr)
        chosen = _chosen(arguments)
        if not tier.compiled and all(mesh is not None and mesh.size == 1 for mesh in chosen):
            work = Work(tier.left, tier.loop_of)
            tier.program = tier.program or without_idle(jaxpr)
            try:
                with counted(work), np.errstate(all="ignore"):
                    results = interpreted(tier.program)([np.asarray(x) for x in arguments])
            except TooLong:
                tier.compiled = True
            else:
                tier.left -= work.done + CALL
                return _of_jax(results, jaxpr.out_avals, chosen), None, None, []
        return compile_and_run(*arguments, jaxpr=jaxpr, **settings)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pjit, "_pjit_call_impl_python", run)
        yield
