"""Functions whose compiled programs are kept for other processes: `Program`, used like `eqx.filter_jit`.

Place in the pipeline: mechanics, simulation and tolerancing decorate their entry functions with `Program`.

    call         structure and static values of the arguments make a `Call` of the arrays
    executable   in memory, on disk (`cache`, under a key of `keys`), or compiled and kept
    derivatives  and batches of a call are programs, too (`transformations`)

A second process that does the same traces nothing.  `jax.export` with JAX's own cache of compiled programs would do
so, too, but take half a second more a program, and a package (flatbuffers) that JAX does not require.  Where nothing is
kept, programs are made in the same way; those with a function of the user are made in every process, and JAX makes
their derivatives.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from rfem_jax.compilation import options
from rfem_jax.compilation.call import call_of, kind
from rfem_jax.compilation.executable import Place
from rfem_jax.compilation.naming import NotRenamable, in_words, names_in
from rfem_jax.compilation.tracing_context import same_context
from rfem_jax.compilation.transformations import Transformable, bind, no_staging, no_transformation
from rfem_jax.stack_room import with_room

options.settle()

# Settings on which tracing depends, for programs in memory; the key of a kept program has all settings.
SETTINGS = (
    "jax_enable_x64", "jax_default_matmul_precision", "jax_numpy_rank_promotion", "jax_default_device",
    "jax_numpy_dtype_promotion", "jax_default_prng_impl", "jax_threefry_partitionable",
)  # fmt: skip
OPTIMISATIONS = "jax_disable_most_optimizations"
# With these JAX inspects the computation, which a kept program does not allow.
WATCHED = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs", "jax_check_tracer_leaks")
MOST = 64  # calls of one function in memory

_PLACE = Place()


class Program:
    """A pure function of pytrees whose compiled programs are kept for other processes.

    Arrays among the leaves of its arguments are inputs, everything else is static, as in `eqx.filter_jit`.

    **Arguments:** `function`: of one of this package's modules; `quick`: compile faster, run slower, for a program
    that runs once in a process; `nameless`: names of things among the arguments are no part of it (`naming`).
    """

    def __init__(self, function: Callable, quick: bool = False, nameless: bool = False):
        functools.update_wrapper(self, function)
        options.note_function(function.__name__)
        self.function, self.quick, self.nameless = function, quick, nameless
        self._jitted = eqx.filter_jit(function)
        self._calls: dict[tuple, Transformable] = {}

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if not no_staging() or _watched():
            return self._plainly(args, kwargs)
        return self._namelessly(self._called, args, kwargs)

    def _namelessly(self, act: Callable[[tuple, dict], Any], args, kwargs) -> Any:
        """What `act` does with the arguments, without the names of things in these."""
        names = names_in(args) if self.nameless else None
        if names is None:
            return act(args, kwargs)
        try:
            return names.back.renamed(act(*names.arguments(args, kwargs)))
        except NotRenamable:
            return act(args, kwargs)
        except Exception as error:
            if not in_words(error):
                raise
        return act(args, kwargs)  # which says what is wrong by the names

    def _called(self, args, kwargs) -> Any:
        call, arrays = self._call_with(args, kwargs)
        if no_transformation():
            return _filled(call, call.run(arrays))
        # What a function of the user depends on may be transformed, too.
        return self._plainly(args, kwargs) if call.name is None else _filled(call, bind(call, arrays))

    @with_room
    def _plainly(self, args, kwargs) -> Any:
        """The result without a program of its own, as within another one."""
        options.own_options_hold()
        with same_context():
            return self._jitted(*args, **kwargs)

    def ahead(self, *args: Any, **kwargs: Any) -> Any:
        """Start to compile or load, in the background, what a call with these arguments will need.

        **Arguments:** those of the call; arrays may be given as `jax.ShapeDtypeStruct`.

        **Returns:** the result of the call with `jax.ShapeDtypeStruct` for arrays; None where the call will be a part
        of another program, and nothing was started.
        """
        if not no_transformation() or _watched():
            return None
        return self._namelessly(self._begun, args, kwargs)

    def _begun(self, args, kwargs) -> Any:
        call, arrays = self._call_with(args, kwargs)
        return _filled(call, call.ahead(arrays))

    def _call_with(self, args, kwargs) -> tuple[Transformable, list]:
        """The call and its arrays."""
        leaves, tree = jax.tree.flatten((args, kwargs))
        is_array = [eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct) for leaf in leaves]
        arrays = [leaf for leaf, is_one in zip(leaves, is_array) if is_one]
        static = tuple(_PLACE if is_one else leaf for leaf, is_one in zip(leaves, is_array))
        return self.call(tree, static, tuple(map(kind, arrays))), arrays

    def call(self, tree, static: tuple, kinds: tuple) -> Transformable:
        """The call of arguments and keyword arguments with this structure and these leaves, a `Place` for each array,
        and arrays of these kinds; the same object each time."""
        key = tree, static, tuple(map(type, static)), kinds, _settings()
        if key not in self._calls:
            self._calls[key] = self._call_of(tree, static)
            if len(self._calls) > MOST:
                del self._calls[next(iter(self._calls))]
        return self._calls[key]

    def clear(self) -> None:
        """Forget the programs in memory."""
        self._calls.clear()

    def _call_of(self, tree, static) -> Transformable:
        return call_of(self.function, tree, static, self.quick)


def _filled(call: Transformable, arrays) -> Any:
    """The tree of a call's results, with its arrays put in."""
    arrays = iter(arrays)
    return jax.tree.map(lambda x: next(arrays) if isinstance(x, Place) else x, call.facts)


def _watched() -> bool:
    return any(getattr(jax.config, name) for name in WATCHED)


def _settings():
    return (*(getattr(jax.config, name) for name in SETTINGS), jax.config.read(OPTIMISATIONS))
