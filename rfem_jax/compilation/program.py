"""Programs that are compiled once and kept: in place of `eqx.filter_jit` where the user enters the package.

Place in the pipeline: mechanics, simulation and tolerancing decorate with `Program` what is called from outside.

    call         structure and static values of the arguments make a `Call` of the arrays
    executable   in memory, on disk (`cache`, under a key of `keys`), or compiled and kept
    derivatives  and batches of a call are kept, too (`transformations`)

A second process that does the same traces nothing.  `jax.export` with JAX's own cache of compiled programs would
do at half a second more a program, by a package (flatbuffers) that JAX does not bring along.
"""

import functools

import equinox as eqx
import jax

from rfem_jax.compilation import keeping, keys, options
from rfem_jax.compilation.call import call_of, kind
from rfem_jax.compilation.executable import Place
from rfem_jax.compilation.transformations import bind, nothing_going_on, nothing_staged

options.settle()

# What decides how a function is traced, for programs in memory; the key of a kept one has all settings.
SETTINGS = (
    "jax_enable_x64", "jax_default_matmul_precision", "jax_numpy_rank_promotion", "jax_default_device",
    "jax_numpy_dtype_promotion", "jax_default_prng_impl", "jax_threefry_partitionable",
)  # fmt: skip
OPTIMISATIONS = "jax_disable_most_optimizations"
# With these JAX looks into what is computed, which a kept executable does not allow.
WATCHED = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs", "jax_check_tracer_leaks")
MOST = 64  # calls of one function in memory

_PLACE = Place()


class Program:
    """A pure function of pytrees whose compiled programs are kept for other processes.

    Arrays among the leaves of its arguments are inputs, all else is static, as in `eqx.filter_jit`, which it
    stands in for.  The function must be one of this package's modules.  `quick`: for a program that runs once in
    a process, compiled faster and running slower.
    """

    def __init__(self, function, quick: bool = False):
        functools.update_wrapper(self, function)
        self.function, self.quick = function, quick
        self._jitted = eqx.filter_jit(function)
        self._calls = {}

    def __call__(self, *args, **kwargs):
        if not (keeping.wanted() and nothing_staged()) or _watched():
            return self._jitted(*args, **kwargs)
        call, arrays = self._call_with(args, kwargs)
        if call is None:
            return self._jitted(*args, **kwargs)
        return _filled(call, call.run(arrays) if nothing_going_on() else bind(call, arrays))

    def ahead(self, *args, **kwargs):
        """Begin to compile or load, in the background, what a call with these arguments will need; arrays may be
        shapes (`jax.ShapeDtypeStruct`).  Returns what the call will, with shapes for arrays, or None where
        programs are not kept, and nothing was done."""
        if not (keeping.wanted() and nothing_going_on()) or _watched():
            return None
        call, arrays = self._call_with(args, kwargs)
        return None if call is None else _filled(call, call.ahead(arrays))

    def _call_with(self, args, kwargs):
        """The call (None: cannot be kept) and its arrays."""
        leaves, tree = jax.tree.flatten((args, kwargs))
        is_array = [eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct) for leaf in leaves]
        arrays = [leaf for leaf, is_one in zip(leaves, is_array) if is_one]
        static = tuple(_PLACE if is_one else leaf for leaf, is_one in zip(leaves, is_array))
        key = tree, static, tuple(map(type, static)), tuple(map(kind, arrays)), _settings()
        if key not in self._calls:
            self._calls[key] = self._call_of(tree, static)
            if len(self._calls) > MOST:
                del self._calls[next(iter(self._calls))]
        return self._calls[key], arrays

    def clear(self) -> None:
        """Forget the programs in memory."""
        self._calls.clear()

    def _call_of(self, tree, static):
        """None for a function that depends on what a key cannot know."""
        try:
            return call_of(self.function, tree, static, self.quick)
        except keys.NotDigestible as reason:
            keeping.note_unkept(self.__qualname__, str(reason))
            return None


def _filled(call, arrays):
    """What a call returns, with its arrays."""
    arrays = iter(arrays)
    return jax.tree.map(lambda x: next(arrays) if isinstance(x, Place) else x, call.facts)


def _watched() -> bool:
    return any(getattr(jax.config, name) for name in WATCHED)


def _settings():
    return (*(getattr(jax.config, name) for name in SETTINGS), jax.config.read(OPTIMISATIONS))
