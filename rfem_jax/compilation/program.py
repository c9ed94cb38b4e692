"""Functions whose compiled programs are kept for other processes: `Program`, used like `eqx.filter_jit`.

Place in the pipeline: executable, keys, keeping, naming -> **program** -> mechanics, simulation and tolerancing, which
decorate their entry functions with it.

Structure and static values of the arguments make a function of their arrays, and its executable is in memory, on disk
(`cache`, under a key of `keys`), or compiled and kept.  A second process that does the same traces nothing.  Within a
transformation of JAX a program is the function itself, under `jax.jit`.
"""

import functools
import threading
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from rfem_jax.compilation import keeping, keys
from rfem_jax.compilation.executable import Executable, Place, WithinTransformation, compiled, unpack
from rfem_jax.compilation.naming import NotRenamable, in_words, names_in

# Settings on which tracing depends, for programs in memory; the key of a kept program has all settings.
SETTINGS = (
    "jax_enable_x64", "jax_default_matmul_precision", "jax_numpy_rank_promotion", "jax_default_device",
    "jax_numpy_dtype_promotion", "jax_default_prng_impl", "jax_threefry_partitionable",
)  # fmt: skip
OPTIMISATIONS = "jax_disable_most_optimizations"
# With these JAX inspects the computation, which a kept program does not allow.
WATCHED = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs", "jax_check_tracer_leaks")
# Functions of arrays of one program in memory.  Each may take some hundred memory maps, of which Linux allows 65530 in
# a process.
MOST = 16

_PLACE = Place()
_making = threading.RLock()
_programs: weakref.WeakSet["Program"] = weakref.WeakSet()


def forget_programs() -> None:
    """Forget all compiled programs in memory; with `jax.clear_caches()` their memory is free."""
    for program in _programs:
        program.clear()


class Program:
    """A pure function of pytrees whose compiled programs are kept for other processes.

    Arrays among the leaves of its arguments are inputs, everything else is static, as in `eqx.filter_jit`.

    **Arguments:** `function`: of one of this package's modules; `nameless`: names of things among the arguments are no
    part of it (`naming`).
    """

    def __init__(self, function: Callable, nameless: bool = False):
        functools.update_wrapper(self, function)
        self.function, self.nameless = function, nameless
        self._jitted = eqx.filter_jit(function)
        self._of_arrays: dict[tuple, _OfArrays] = {}
        _programs.add(self)
        self._by_names: set = set()  # structures of arguments with something that knows things by their names

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if _watched() or any(isinstance(x, Tracer) for x in jax.tree.leaves((args, kwargs))):
            return self._within(args, kwargs)
        names = names_in(args) if self.nameless else None
        if names is None or jax.tree.structure((args, kwargs)) in self._by_names:
            return self._called(args, kwargs)
        try:
            return names.back.renamed(self._called(*names.arguments(args, kwargs)))
        except NotRenamable:
            return self._called(args, kwargs)
        except Exception as error:
            if not in_words(error):
                raise
        result = self._called(args, kwargs)  # which says what is wrong by the names, or depends on them
        self._by_names.add(jax.tree.structure((args, kwargs)))
        return result

    def _within(self, args, kwargs) -> Any:
        """The result within another program."""
        return self._jitted(*args, **kwargs)

    def _called(self, args, kwargs) -> Any:
        leaves, tree = jax.tree.flatten((args, kwargs))
        arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        static = tuple(_PLACE if eqx.is_array(leaf) else leaf for leaf in leaves)
        key = tree, static, tuple(map(type, static)), _settings()
        if key not in self._of_arrays:
            self._of_arrays[key] = _OfArrays(self.function, tree, static)
            if len(self._of_arrays) > MOST:
                del self._of_arrays[next(iter(self._of_arrays))]
        try:
            return self._of_arrays[key](arrays)
        except WithinTransformation:
            return self._within(args, kwargs)

    def clear(self) -> None:
        """Forget the programs in memory."""
        self._of_arrays.clear()


class _OfArrays:
    """A function as one of the arrays among its arguments.

    **Arguments:** `tree`, `static`: structure and leaves of (arguments, keyword arguments), with a `Place` for each
    array.
    """

    def __init__(self, function: Callable, tree: Any, static: Sequence):
        self.function, self.tree, self.static = function, tree, static
        self._executables: dict[tuple, Executable] = {}
        self.name: tuple | None = None  # of what it computes, for the key; None: not known, so that it is not kept
        try:
            self.name = keys.canonical(function), keys.canonical(jax.tree.unflatten(tree, static))
        except keys.NotDigestible as reason:
            keeping.note_unkept(function.__qualname__, str(reason))

    def __call__(self, arrays: Sequence[ArrayLike]) -> Any:
        kinds = tuple(map(_kind, arrays))
        if kinds not in self._executables:
            with _making:
                if kinds not in self._executables:
                    self._executables[kinds] = self._made(kinds, arrays)
        return self._executables[kinds](arrays)

    def _made(self, kinds: tuple, arrays: Sequence[ArrayLike]) -> Executable:
        """The executable for arrays of these kinds: read from disk, or compiled and kept."""
        if self.name is None or not keeping.wanted():
            return self._compiled(arrays, kept=False)
        key = keys.digest_named((self.name, kinds))
        try:
            content = keeping.read(key)
            if content is not None:
                executable = unpack(content).loaded()
                keeping.statistics.loaded += 1
                return executable
        except Exception:  # damaged, or written by another version of something that is not in the key
            keeping.forget(key)
        executable = self._compiled(arrays, kept=True)
        self._keep(key, executable)
        return executable

    def _compiled(self, arrays: Sequence[ArrayLike], kept: bool) -> Executable:
        returned: list[Any] = []

        def flat(*arrays):
            left = iter(arrays)
            leaves = [next(left) if isinstance(leaf, Place) else leaf for leaf in self.static]
            args, kwargs = jax.tree.unflatten(self.tree, leaves)
            results, tree = jax.tree.flatten(self.function(*args, **kwargs))
            returned[:] = [jax.tree.unflatten(tree, [Place() if eqx.is_array(x) else x for x in results])]
            return [x for x in results if eqx.is_array(x)]

        flat.__name__ = flat.__qualname__ = self.function.__name__
        executable = compiled(flat, arrays, returned, kept)
        keeping.statistics.traced += 1
        return executable

    def _keep(self, key: str, made: Executable) -> None:
        try:
            content = made.dump()
        except Exception as reason:  # a program with a callback into Python, say
            keeping.note_unkept(self.function.__qualname__, str(reason))
            return
        if keys.read_sources() == keys.hash_sources() and keeping.write(key, content):
            keeping.statistics.written += 1


def _kind(array: ArrayLike) -> tuple:
    """Shape, dtype, whether the type is weak, and the sharding of an array if it was chosen.

    Not JAX's abstract value, which newer versions compare by identity.
    """
    aval = jax.typeof(array)
    chosen = array.sharding if isinstance(array, Array) and array.committed else None
    return aval.shape, aval.dtype, aval.weak_type, chosen


def _watched() -> bool:
    return any(getattr(jax.config, name) for name in WATCHED)


def _settings():
    return (*(getattr(jax.config, name) for name in SETTINGS), jax.config.read(OPTIMISATIONS))
