"""Functions for programs that are small enough to be compiled in a test.

In a file of their own, so that processes that the tests start find them under the same name.
"""

from contextlib import contextmanager
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec

from rfem_jax.compilation import keeping, keys
from rfem_jax.compilation.program import Program
from rfem_jax.kernels import kernel


class Oscillator(eqx.Module):
    """Numbers are inputs, the number of steps is static."""

    rate: jax.Array
    count: jax.Array
    steps: int = eqx.field(static=True)


class Swing(NamedTuple):
    path: jax.Array
    end: dict
    steps: int


def swing(oscillator, x, *, scale=1.0):
    """A loop, whole numbers, a value that does not depend on x, and one that is no array."""

    def step(x, _):
        return jnp.sin(oscillator.rate * x) + x[0], jnp.sum(x**2)

    end, path = jax.lax.scan(step, x, None, length=oscillator.steps)
    ends = {"end": scale * end, "count": oscillator.count + 1, "twice": 2.0 * oscillator.rate}
    return Swing(path, ends, oscillator.steps)


def solve(matrix, x):
    """By LAPACK."""
    return jnp.linalg.solve(matrix, x)


def spread(x, mesh):
    """Each device works on its own rows."""
    over = PartitionSpec("rows")
    return jax.shard_map(lambda x: jnp.cumsum(x, axis=0), mesh=mesh, in_specs=over, out_specs=over)(x)


@kernel
def folded(x, rate):
    """A kernel of its own."""
    return jnp.sin(rate * x) + jnp.exp(-x) @ jnp.arange(3.0) / (1.0 + x**2)


def shaken(oscillator, x, *, shift=0.0):
    """A kernel in a loop of XLA's."""

    def step(x, _):
        x = folded(x, oscillator.rate) + shift
        return x, jnp.sum(x)

    return jax.lax.scan(step, x, None, length=oscillator.steps)


def stirred(oscillator, x):
    """The same kernel in another program."""
    return folded(x, oscillator.rate)


swing_kept, solve_kept, spread_kept = Program(swing), Program(solve), Program(spread)
shaken_kept, stirred_kept = Program(shaken), Program(stirred)


def oscillator(rate=0.7, steps=3):
    return Oscillator(jnp.asarray(rate), jnp.arange(2), steps)


def forget():
    """Empty the memory, as in the next process."""
    for program in (swing_kept, solve_kept, spread_kept, shaken_kept, stirred_kept):
        program.clear()


@contextmanager
def covered(folder):
    """Programs of this file are kept in `folder`, as those of the package are."""
    before = keys.COVERED, keeping.statistics, keeping._choice
    keys.COVERED, keeping.statistics = keys.COVERED | {__name__.split(".")[0]}, keeping.Statistics()
    keeping.keep_programs(folder)
    forget()
    try:
        yield keeping.statistics
    finally:
        keys.COVERED, keeping.statistics, keeping._choice = before
        forget()
