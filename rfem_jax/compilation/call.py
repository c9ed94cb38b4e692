"""A function of flat arrays that is a program by itself, kept where its content is known, and its transformations.

Place in the pipeline: `program` makes a `Call` of a function and its static arguments, `transformations` the calls
that are its derivatives and batches.

    step                     arrays in                               arrays out
    ()                       arguments                               results
    ("jvp", active)          arguments, tangents of the active ones  results, tangents of those that change
    ("linear", active)       arguments, tangents of the active ones  tangents of the inexact results
    ("vjp", active, used)    arguments, cotangents of the used ones  cotangents of the active arguments
    ("vmap", size, axes)     arguments with a batch axis (or not)    results with a first axis (or not)

`active` has a boolean for each argument, whether it is differentiated by; `used` one for each inexact result, whether
it has a cotangent; `axes` the batch axis (None) of each argument.  Each step transforms the call before it.
"""

import functools
import threading
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jax.tree_util import PyTreeDef
from jax.typing import ArrayLike

from rfem_jax.compilation import keeping, keys, last_time, options
from rfem_jax.compilation.executable import Executable, Place, trace
from rfem_jax.compilation.pending import Pending, read_kept
from rfem_jax.compilation.transformations import has_batch_axis

_tracing = threading.RLock()


class Call:
    """A function from arrays to a list of arrays.

    **Arguments:** `name`: of what it computes, for the key; None if it depends on something whose content is not known;
    `before` and `step`: the call that it transforms, and how; `quick`: compile in less time, for less speed.

    Attributes: facts, known once the function has been traced or loaded: of a function, the tree of its results with
    a `Place` for each array; of ("jvp", ...), which results change, that is, have tangents; of ("linear", ...), which
    are inexact; of ("vmap", ...), which results have the batch axis.
    """

    def __init__(
        self,
        function: Callable[..., list],
        name: tuple | None,
        before: "Call | None" = None,
        step: tuple | None = None,
        quick: bool = False,
    ):
        self.function, self.name, self.before, self.step = function, name, before, step
        self.quick = quick
        self.facts: Any = None
        self._next: dict[tuple, Call] = {}
        self._executables: dict[tuple, Pending] = {}

    def then(self, step: tuple) -> "Call":
        """This call transformed; the same object each time."""
        if step not in self._next:
            self._next[step] = _TRANSFORMED[step[0]](self, step)
        return self._next[step]

    def run(self, arrays: Sequence[ArrayLike]) -> list[Array]:
        """Results for concrete arrays."""
        return self.pending(arrays).get()(arrays)

    def ahead(self, arrays: Sequence[ArrayLike | jax.ShapeDtypeStruct]) -> list[jax.ShapeDtypeStruct]:
        """Start to compile or load in the background what `run` will need; returns the results without values."""
        pending = self.pending(arrays)
        pending.begin()
        return pending.head.shapes()

    def pending(self, arrays: Sequence[ArrayLike | jax.ShapeDtypeStruct]) -> Pending:
        """The executable for arrays of these shapes and types, traced or read from disk."""
        kinds = tuple(map(kind, arrays))
        pending = self._executables.get(kinds)
        if pending is None:
            with _tracing:
                pending = self._executables.get(kinds) or self._find(kinds, arrays)
                self._executables[kinds] = pending
        return pending

    def chain(self) -> "list[Call]":
        """This call and those that it transforms, one after the other."""
        return [self] if self.before is None else [self, *self.before.chain()]

    def _find(self, kinds, arrays) -> Pending:
        if self.name is None or not keeping.wanted():
            return self._trace(None, arrays)
        key = keys.digest_named((self.name, kinds))
        last_time.note(key)
        try:
            kept = last_time.take(key) or read_kept(key)
            if kept is not None:
                for call, facts in zip(self.chain(), kept.head.facts, strict=True):
                    call.facts = facts
        except Exception:  # written by another version of something that is not in the key
            keeping.forget(key)
            kept = None
        if kept is None:
            return self._trace(key, arrays)
        keeping.statistics.loaded += 1
        shapes = [x if isinstance(x, jax.ShapeDtypeStruct) else jax.typeof(x) for x in arrays]
        kept.instead = lambda: self._make_anew(key, shapes)
        return kept

    def _make_anew(self, key: str, arrays) -> Pending:
        """Replaces a kept program that cannot be loaded."""
        keeping.forget(key)
        keeping.statistics.loaded -= 1
        with _tracing:
            return self._trace(key, arrays)

    def _trace(self, key: str | None, arrays) -> Pending:
        """The program traced; to be kept under the key, if there is one."""
        keeping.statistics.traced += 1

        def facts():
            return [call.facts for call in self.chain()]

        own = options.OwnProgram(alone=self.name is not None)
        program = trace(self.function, arrays, facts, self.quick, own, key is not None)
        return Pending(program, made=None if key is None else lambda executable: self._keep(key, executable))

    def _keep(self, key: str, made: Executable) -> None:
        try:
            content = made.dump()
        except Exception as reason:  # a program with a callback into Python, say
            keeping.note_unkept(str(self.name), str(reason))
            return
        if keys.read_sources() == keys.hash_sources() and keeping.write(key, content):
            keeping.statistics.written += 1


def kind(array: ArrayLike | jax.ShapeDtypeStruct) -> tuple:
    """Shape, dtype, whether the type is weak, and the sharding of an array if it was chosen.

    Not JAX's abstract value, which newer versions compare by identity.
    """
    if isinstance(array, jax.ShapeDtypeStruct):
        return array.shape, array.dtype, array.weak_type, array.sharding
    aval = jax.typeof(array)
    chosen = array.sharding if isinstance(array, jax.Array) and _committed(array) else None
    return aval.shape, aval.dtype, aval.weak_type, chosen


def _committed(array) -> bool:
    return not isinstance(array, Tracer) and array.committed


def call_of(
    function: Callable,
    tree: PyTreeDef,  # pyright: ignore[reportInvalidTypeForm] # a class at run time
    static: Sequence,
    quick: bool,
) -> Call:
    """The call of a function of pytrees.

    **Arguments:** `tree`, `static`: structure and leaves of (arguments, keyword arguments), with a `Place` for each
    array; `quick`: as `Call`.
    """
    try:
        name = keys.canonical(function), keys.canonical(jax.tree.unflatten(tree, static)), quick
    except keys.NotDigestible as reason:
        keeping.note_unkept(function.__qualname__, str(reason))
        name = None

    def flat(*arrays):
        remaining = iter(arrays)
        leaves = [next(remaining) if isinstance(leaf, Place) else leaf for leaf in static]
        args, kwargs = jax.tree.unflatten(tree, leaves)
        results, returned = jax.tree.flatten(function(*args, **kwargs))
        places = [Place() if eqx.is_array(x) else x for x in results]
        call.facts = jax.tree.unflatten(returned, places)
        return [x for x in results if eqx.is_array(x)]

    flat.__name__ = flat.__qualname__ = function.__name__
    call = Call(flat, name, quick=quick)
    return call


def _of_active(call: Call, active, arrays):
    """The call as a function of its active arguments, and these."""
    once = jax.jit(call.function)  # JAX transforms a jaxpr faster than what Python does step by step

    def function(*values):
        values = iter(values)
        return once(*(next(values) if is_active else x for is_active, x in zip(active, arrays)))

    return function, [x for x, is_active in zip(arrays, active) if is_active]


def _inexact(results) -> tuple[bool, ...]:
    return tuple(jnp.issubdtype(jax.typeof(x).dtype, jnp.inexact) for x in results)


def _pushed(call: Call, step) -> Call:
    """Forward mode: ("jvp", active) or ("linear", active)."""
    kind_of_step, active = step

    def pushed(*arrays):
        arguments, tangents = arrays[: len(active)], arrays[len(active) :]
        function, values = _of_active(call, active, arguments)
        seen = _Changes()
        results, changes = jax.jvp(lambda *values: seen.of(function(*values)), values, list(tangents))
        new.facts = _inexact(results) if kind_of_step == "linear" else seen.found
        changes = [change for change, is_one in zip(changes, new.facts) if is_one]
        return changes if kind_of_step == "linear" else [*results, *changes]

    new = _named(pushed, call, step)
    return new


class _Changes:
    """Notes which of some results have a tangent while they are differentiated."""

    def __init__(self):
        self.found: tuple[bool, ...] = ()

    def of(self, results: list[Array]) -> list[Array]:
        """The results themselves."""

        @jax.custom_jvp
        def unchanged(results):
            return results

        @functools.partial(unchanged.defjvp, symbolic_zeros=True)
        def _(primals, tangents):
            self.found = tuple(not isinstance(tangent, SymbolicZero) for tangent in tangents[0])
            return primals[0], tangents[0]

        self.found = (False,) * len(results)
        return unchanged(results)


def _pulled(call: Call, step) -> Call:
    """Reverse mode: ("vjp", active, used)."""
    _, active, used = step

    def pulled(*arrays):
        arguments, cotangents = arrays[: len(active)], iter(arrays[len(active) :])
        function, values = _of_active(call, active, arguments)
        results, pull = jax.vjp(function, *values)
        is_used = iter(used)

        def cotangent(result, is_inexact):
            if not is_inexact:
                return np.zeros(result.shape, jax.dtypes.float0)
            return next(cotangents) if next(is_used) else jnp.zeros_like(result)

        return list(pull([cotangent(*pair) for pair in zip(results, _inexact(results))]))

    return _named(pulled, call, step)


def _batched(call: Call, step) -> Call:
    """Batches: ("vmap", size, axes)."""
    _, size, axes = step

    def batched(*arrays):
        # Mapped twice but traced once: the first time tells which results have the batch axis.
        once = jax.jit(call.function)

        def noted(*arrays):
            results = once(*arrays)
            new.facts = tuple(map(has_batch_axis, results))
            return results

        settings = {"in_axes": axes, "axis_size": size}
        jax.eval_shape(jax.vmap(noted, **settings), *arrays)
        out_axes = [0 if has_axis else None for has_axis in new.facts]
        return jax.vmap(once, out_axes=out_axes, **settings)(*arrays)

    new = _named(batched, call, step)
    return new


def _named(function, call: Call, step) -> Call:
    function.__name__ = function.__qualname__ = f"{step[0]}_{call.function.__name__}"
    return Call(function, call.name and (call.name, step), call, step, call.quick)


_TRANSFORMED = {"jvp": _pushed, "linear": _pushed, "vjp": _pulled, "vmap": _batched}
