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

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.compilation import keeping, keys
from rfem_jax.compilation.executable import Executable, Place
from rfem_jax.compilation.transformations import has_batch_axis

_compiling = threading.RLock()


class Call:
    """A function of arrays with its name: what it computes is `function`, `name` says so in a key.

    `facts`, known once it has been traced or loaded: of a function, what it returns, with a `Place` for each
    array; of ("jvp", ...), which results have tangents; of ("vmap", ...), which results have the batch axis.
    """

    def __init__(self, function, name, before: "Call | None" = None, step=None):
        self.function, self.name, self.before, self.step = function, name, before, step
        self.facts = None
        self._next, self._executables = {}, {}

    def then(self, step) -> "Call":
        """This call transformed, the same object each time."""
        if step not in self._next:
            self._next[step] = _TRANSFORMED[step[0]](self, step)
        return self._next[step]

    def run(self, arrays):
        """Results (list of arrays) for concrete arrays."""
        kinds = tuple(map(kind, arrays))
        executable = self._executables.get(kinds)
        if executable is None:
            with _compiling:
                executable = self._executables.get(kinds) or self._find(kinds, arrays)
                self._executables[kinds] = executable
        return executable(arrays)

    def chain(self):
        """This call and those before it."""
        return [self] if self.before is None else [self, *self.before.chain()]

    def _find(self, kinds, arrays) -> Executable:
        key = keys.digest_named((self.name, kinds))
        content = keeping.read(key)
        if content is not None:
            try:
                found = Executable.load(content)
            except Exception:  # written by another version of something that the key does not see
                keeping.forget(key)
            else:
                for call, facts in zip(self.chain(), found.facts, strict=True):
                    call.facts = facts
                keeping.statistics.loaded += 1
                return found
        keeping.statistics.traced += 1
        made = Executable.of(self.function, arrays, lambda: [call.facts for call in self.chain()])
        try:
            content = made.dump()
        except Exception as reason:  # a program that calls Python back, say
            keeping.note_unkept(str(self.name), str(reason))
            return made
        if keys.read_sources() == keys.hash_sources():
            keeping.write(key, content)
        return made


def kind(array):
    """Shape and type, and where an array is if that was chosen.

    Abstract values do not serve: newer versions of JAX compare them by identity.
    """
    aval = jax.typeof(array)
    chosen = array.sharding if isinstance(array, jax.Array) and _committed(array) else None
    return aval.shape, aval.dtype, aval.weak_type, chosen


def _committed(array) -> bool:
    return not isinstance(array, jax.core.Tracer) and array.committed


def call_of(function, tree, static) -> Call:
    """The call of a function of pytrees whose leaves are `static`, with a `Place` for each array.

    **Raises:** `NotDigestible` if it depends on something whose content is not known.
    """
    arguments = jax.tree.unflatten(tree, static)
    name = keys.canonical(function), keys.canonical(arguments)

    def flat(*arrays):
        rest = iter(arrays)
        leaves = [next(rest) if isinstance(leaf, Place) else leaf for leaf in static]
        args, kwargs = jax.tree.unflatten(tree, leaves)
        results, returned = jax.tree.flatten(function(*args, **kwargs))
        places = [Place() if eqx.is_array(x) else x for x in results]
        call.facts = jax.tree.unflatten(returned, places)
        return [x for x in results if eqx.is_array(x)]

    flat.__name__ = flat.__qualname__ = function.__name__
    call = Call(flat, name)
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
    return Call(function, (call.name, step), call, step)


_TRANSFORMED = {"jvp": _pushed, "linear": _pushed, "vjp": _pulled, "vmap": _batched}
