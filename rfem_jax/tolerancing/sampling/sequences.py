"""Points of the unit cube: scrambled Sobol' or pseudo-random, and the design for Sobol' indices.

Place in the pipeline: the random numbers of the Monte Carlo study; distributions map them to errors.

The point of a sample depends on the key and on the sample's own index alone: not on the number of samples, on the
batch, on devices or processes. Sobol' points come from `NETS` nets that are scrambled independently of each other;
sample i is point i // NETS of net i modulo NETS. Points of one net depend on each other, different nets do not, and
the spread of the nets tells how far a statistic can be trusted. More nets give a surer interval, fewer a smaller
error; 8 is the usual compromise.

The design for Sobol' indices of k factors has n (k + 2) points in blocks of n: A, B, and for each factor i the points
of A with the coordinates of factor i taken from B. A and B are random samples of the errors, which the statistics of
the study use; the other blocks are not.

Symbols: n samples, d coordinates, k factors (a single error, or a correlated group).
Source: A. B. Owen, Scrambling Sobol' and Niederreiter-Xing points, J. Complexity 14 (1998) 466-489 (in SciPy);
P. L'Ecuyer, C. Lemieux, Recent advances in randomized quasi-Monte Carlo methods, in: Modeling Uncertainty (2002)
419-474 (independent replicates); A. Saltelli et al., Variance based sensitivity analysis of model output, Comput.
Phys. Commun. 181 (2010) 259-270 (design).
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, UInt32
from scipy.stats import qmc

from rfem_jax.description.basics.errors import InputError, require_choice

SAMPLINGS = ("sobol", "pseudo_random")
SOBOL_BITS = 52
NETS = 8

RandomKey = Key[Array, ""] | UInt32[Array, "2"]  # typed or raw


def unit_points(key: RandomKey, n: int, dimension: int, sampling: str) -> Float[np.ndarray, "n dimension"]:
    """Points strictly inside the unit cube.

    Args: key, a JAX random key; n points of `dimension` coordinates; sampling "sobol" (scrambled; best with n a power
        of 2, 64 or more) or "pseudo_random". Raises: InputError for another key or sampling.
    """
    require_choice(sampling, SAMPLINGS, "sampling")
    if sampling == "sobol":
        each = -(-n // NETS)
        nets = [_net(np.random.default_rng([*key_words(key), j]), each, dimension) for j in range(NETS)]
        points = np.stack(nets, axis=1).reshape(each * NETS, dimension)[:n]
        return points + 2.0 ** -(SOBOL_BITS + 1)  # centres of the cells: never 0, never 1
    keys = jax.vmap(lambda i: jax.random.fold_in(_typed(key), i))(jnp.arange(n))
    draw = jax.vmap(lambda k: jax.random.uniform(k, (dimension,), jnp.float64))
    return np.asarray(draw(keys)) + 2.0**-53


def _net(generator, n, dimension):
    """The first n points of one scrambled Sobol' sequence."""
    engine = qmc.Sobol(dimension, scramble=True, bits=SOBOL_BITS, rng=generator)
    # The first n of 2^m points: the same ones, without SciPy's warning for other n.
    return engine.random_base2(max(n - 1, 0).bit_length())[:n]


def net_of_samples(n: int, sampling: str, blocks: int = 1) -> Int[np.ndarray, " samples"] | None:
    """Net (n * blocks,) that each sample belongs to; None where samples are independent.

    Args: blocks of n samples, one after the other, that share nets (A and B of a design: 2).
    """
    require_choice(sampling, SAMPLINGS, "sampling")
    return np.tile(np.arange(n) % NETS, blocks) if sampling == "sobol" else None


def design_points(
    key: RandomKey, n: int, factors: Sequence[Sequence[str]], sampling: str
) -> Float[np.ndarray, "samples d"]:
    """Points (n (k + 2), d) for Sobol' indices of k `factors` (tuples of names), in the blocks of the module's
    docstring."""
    sizes = [len(factor) for factor in factors]
    d = sum(sizes)
    both = unit_points(key, n, 2 * d, sampling)
    a, b = both[:, :d], both[:, d:]
    blocks, first = [a, b], 0
    for size in sizes:
        mixed = a.copy()
        mixed[:, first : first + size] = b[:, first : first + size]
        blocks.append(mixed)
        first += size
    return np.concatenate(blocks)


def key_words(key: RandomKey) -> list[int]:
    """The key as a list of integers (for a seed and for a manifest). Raises InputError."""
    return [int(word) for word in np.asarray(jax.random.key_data(_typed(key))).ravel()]


def _typed(key):
    """`key` as a typed JAX key; raw uint32 keys pass too. Raises InputError."""
    dtype = getattr(key, "dtype", None)
    if dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key) and not key.shape:
        return key
    if dtype == np.uint32 and key.shape == (2,):
        return jax.random.wrap_key_data(jnp.asarray(key))
    raise InputError(f"Argument `key` must be one JAX random key, but it is {key!r}; write jax.random.key(7).")
