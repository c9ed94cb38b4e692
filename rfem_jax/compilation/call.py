"""A function of flat arrays that is compiled once and kept, and its transformations.

Place in the pipeline: `program` makes a `Call` of a function and its static arguments, `transformations` the
calls that derivatives and batches of it are.

    steps of a call        arrays in                             arrays out
    ()                     arguments                             results
    ("jvp", moving)        arguments, tangents of the moving     results, tangents of the inexact ones
    ("linear", moving)     arguments, tangents of the moving     tangents of the inexact results
    ("vjp", moving, seen)  arguments, cotangents of the seen     cotangents of the moving arguments
    ("vmap", size, axes)   arguments with a batch axis (or not)  results with a first axis (or not)

`moving` is a boolean for each argument, `seen` for each inexact result.  Each step is one of the call before it.
"""

import threading
from contextlib import suppress

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.compilation import keeping, keys
from rfem_jax.compilation.executable import Executable, Packed, Place, Traced, trace, unpack
from rfem_jax.compilation.transformations import has_batch_axis

_tracing = threading.RLock()


class Pending:
    """An executable that is made by the first thread that asks for it, while others wait.

    `program` is finished by it; `instead` makes another one where that fails.
    """

    def __init__(self, program: Traced | Packed, instead=None, made=None):
        self.head = program.head
        self._program, self._instead, self._made = program, instead, made
        self._lock, self._executable = threading.Lock(), None

    def get(self) -> Executable:
        if self._executable is None:
            with self._lock:
                if self._executable is None:
                    self._executable = self._finish()
                    self._program = self._instead = None
        return self._executable

    def begin(self) -> None:
        """Have it made in the background; what goes wrong there goes wrong again where it is needed."""
        threading.Thread(target=self._quietly, daemon=True).start()

    def _quietly(self):
        with suppress(Exception):
            self.get()

    def _finish(self):
        try:
            executable = self._program.finish()
        except Exception:
            if self._instead is None:
                raise
            return self._instead().get()
        if self._made is not None:
            self._made(executable)
        return executable


class Call:
    """A function of arrays with its name: what it computes is `function`, `name` says so in a key.

    `facts`, known once it has been traced or loaded: of a function, what it returns, with a `Place` for each
    array; of ("jvp", ...), which results have tangents; of ("vmap", ...), which results have the batch axis.
    `quick`: compiled in less time, for less speed.
    """

    def __init__(self, function, name, before: "Call | None" = None, step=None, quick: bool = False):
        self.function, self.name, self.before, self.step = function, name, before, step
        self.quick = quick
        self.facts = None
        self._next, self._executables = {}, {}

    def then(self, step) -> "Call":
        """This call transformed, the same object each time."""
        if step not in self._next:
            self._next[step] = _TRANSFORMED[step[0]](self, step)
        return self._next[step]

    def run(self, arrays):
        """Results (list of arrays) for concrete arrays."""
        return self.pending(arrays).get()(arrays)

    def ahead(self, arrays) -> list[jax.ShapeDtypeStruct]:
        """Begin to compile or load what `run` will need; the results as shapes."""
        pending = self.pending(arrays)
        pending.begin()
        return pending.head.shapes()

    def pending(self, arrays) -> Pending:
        """The executable for arrays (or shapes) of these kinds, traced or read from disk."""
        kinds = tuple(map(kind, arrays))
        pending = self._executables.get(kinds)
        if pending is None:
            with _tracing:
                pending = self._executables.get(kinds) or self._find(kinds, arrays)
                self._executables[kinds] = pending
        return pending

    def chain(self):
        """This call and those before it."""
        return [self] if self.before is None else [self, *self.before.chain()]

    def _find(self, kinds, arrays) -> Pending:
        key = keys.digest_named((self.name, kinds))
        content = keeping.read(key)
        if content is not None:
            try:
                packed = unpack(content)
                for call, facts in zip(self.chain(), packed.head.facts, strict=True):
                    call.facts = facts
            except Exception:  # written by another version of something that the key does not see
                keeping.forget(key)
            else:
                keeping.statistics.loaded += 1
                shapes = [x if isinstance(x, jax.ShapeDtypeStruct) else jax.typeof(x) for x in arrays]
                return Pending(packed, instead=lambda: self._make_anew(key, shapes))
        return self._trace(key, arrays)

    def _make_anew(self, key: str, arrays) -> Pending:
        """In the place of a kept executable that cannot be loaded."""
        keeping.forget(key)
        keeping.statistics.loaded -= 1
        with _tracing:
            return self._trace(key, arrays)

    def _trace(self, key: str, arrays) -> Pending:
        keeping.statistics.traced += 1

        def facts():
            return [call.facts for call in self.chain()]

        program = trace(self.function, arrays, facts, self.quick)
        return Pending(program, made=lambda executable: self._keep(key, executable))

    def _keep(self, key: str, made: Executable) -> None:
        try:
            content = made.dump()
        except Exception as reason:  # a program that calls Python back, say
            keeping.note_unkept(str(self.name), str(reason))
            return
        if keys.read_sources() == keys.hash_sources():
            keeping.write(key, content)


def kind(array):
    """Shape and type, and where an array is if that was chosen.

    Abstract values do not serve: newer versions of JAX compare them by identity.
    """
    aval = array if isinstance(array, jax.ShapeDtypeStruct) else jax.typeof(array)
    chosen = array.sharding if isinstance(array, jax.Array) and _committed(array) else None
    return aval.shape, aval.dtype, aval.weak_type, chosen


def _committed(array) -> bool:
    return not isinstance(array, jax.core.Tracer) and array.committed


def call_of(function, tree, static, quick: bool) -> Call:
    """The call of a function of pytrees whose leaves are `static`, with a `Place` for each array.

    **Raises:** `NotDigestible` if it depends on something whose content is not known.
    """
    arguments = jax.tree.unflatten(tree, static)
    name = keys.canonical(function), keys.canonical(arguments), quick

    def flat(*arrays):
        rest = iter(arrays)
        leaves = [next(rest) if isinstance(leaf, Place) else leaf for leaf in static]
        args, kwargs = jax.tree.unflatten(tree, leaves)
        results, returned = jax.tree.flatten(function(*args, **kwargs))
        places = [Place() if eqx.is_array(x) else x for x in results]
        call.facts = jax.tree.unflatten(returned, places)
        return [x for x in results if eqx.is_array(x)]

    flat.__name__ = flat.__qualname__ = function.__name__
    call = Call(flat, name, quick=quick)
    return call


def _of_moving(call: Call, moving, arrays):
    """The call as a function of its moving arguments, and these."""

    def function(*moved):
        moved = iter(moved)
        return call.function(*(next(moved) if m else x for m, x in zip(moving, arrays)))

    return function, [x for x, m in zip(arrays, moving) if m]


def _inexact(results):
    return tuple(jnp.issubdtype(jax.typeof(x).dtype, jnp.inexact) for x in results)


def _pushed(call: Call, step) -> Call:
    kind_of_step, moving = step

    def pushed(*arrays):
        arguments, tangents = arrays[: len(moving)], arrays[len(moving) :]
        function, moved = _of_moving(call, moving, arguments)
        results, changes = jax.jvp(function, moved, list(tangents))
        new.facts = _inexact(results)
        changes = [change for change, is_inexact in zip(changes, new.facts) if is_inexact]
        return changes if kind_of_step == "linear" else [*results, *changes]

    new = _named(pushed, call, step)
    return new


def _pulled(call: Call, step) -> Call:
    _, moving, seen = step

    def pulled(*arrays):
        arguments, cotangents = arrays[: len(moving)], iter(arrays[len(moving) :])
        function, moved = _of_moving(call, moving, arguments)
        results, pull = jax.vjp(function, *moved)
        is_seen = iter(seen)

        def cotangent(result, is_inexact):
            if not is_inexact:
                return np.zeros(result.shape, jax.dtypes.float0)
            return next(cotangents) if next(is_seen) else jnp.zeros_like(result)

        return list(pull([cotangent(*pair) for pair in zip(results, _inexact(results))]))

    return _named(pulled, call, step)


def _batched(call: Call, step) -> Call:
    _, size, axes = step

    def batched(*arrays):
        # Twice, traced once: which results have the batch axis is not known before.
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
    return Call(function, (call.name, step), call, step, call.quick)


_TRANSFORMED = {"jvp": _pushed, "linear": _pushed, "vjp": _pulled, "vmap": _batched}
