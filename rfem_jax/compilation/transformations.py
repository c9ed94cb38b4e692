"""A call as a primitive of JAX, whose derivatives and batches are calls, too: nothing is traced twice.

Place in the pipeline: `program` binds it where the user transforms without `jit`, as in `jax.jacfwd(moment)(0.005)`.

    evaluation      the executable of the call
    jvp, vmap       the call with one more step
    reverse mode    the results at once, and the linear part later, whose transpose is the vjp of the call
    inside `jit`    the function itself, traced

The private names of JAX that it uses say which transformations are in progress.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
from jax import Array
from jax._src import core
from jax._src.interpreters.ad import JVPTrace, LinearizeTrace
from jax._src.interpreters.batching import BatchTrace, BatchTracer
from jax._src.interpreters.partial_eval import JaxprTracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.typing import ArrayLike

EAGER = (JVPTrace, LinearizeTrace, BatchTrace)


@runtime_checkable
class Transformable(Protocol):
    """What this module and `program` need of `call.Call`, which says more, and of `parts.CallInParts`."""

    function: Callable[..., list]
    name: tuple | None
    before: Any
    step: tuple | None
    facts: Any

    def run(self, arrays: Sequence[ArrayLike]) -> list[Array]: ...

    def ahead(self, arrays: Sequence[ArrayLike | jax.ShapeDtypeStruct]) -> list: ...

    def then(self, step: tuple) -> "Transformable": ...


call_p = Primitive("rfem_jax_call")
call_p.multiple_results = True


def no_transformation() -> bool:
    """Whether no transformation is in progress."""
    return type(core.trace_ctx.trace) is core.EvalTrace


def no_staging() -> bool:
    """Whether the transformations in progress, if any, evaluate at once: none of them stages a jaxpr."""
    trace = core.trace_ctx.trace
    while isinstance(trace, EAGER):
        trace = trace.parent_trace
    return type(trace) is core.EvalTrace


def has_batch_axis(array: ArrayLike) -> bool:
    """Whether an array inside of a function under `vmap` has the batch axis."""
    return isinstance(array, BatchTracer)


def bind(
    call: Transformable, arrays: Sequence[ArrayLike], kinds: Sequence[core.AbstractValue] | None = None
) -> list[Array]:
    """Results of a call for arrays, some of them traced; `kinds`: abstract values of the results if they are known."""
    return call_p.bind(*arrays, call=call, kinds=kinds)


@call_p.def_impl
def _evaluate(*arrays, call, kinds):
    # Where a derivative is taken by a Python number, that number arrives here.
    return call.run([x if eqx.is_array(x) else jax.numpy.asarray(x) for x in arrays])


@call_p.def_abstract_eval
def _result_kinds(*arrays, call, kinds):
    if kinds is not None:
        return kinds
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays]
    return [core.ShapedArray(x.shape, x.dtype) for x in jax.eval_shape(call.function, *shapes)]


def _push(primals, tangents, *, call, kinds):
    active = tuple(type(tangent) is not ad.Zero for tangent in tangents)
    given = [tangent for tangent, is_active in zip(tangents, active) if is_active]
    if any(isinstance(tangent, JaxprTracer) for tangent in given):
        results = bind(call, primals, kinds)
        has_change = [jax.numpy.issubdtype(jax.typeof(x).dtype, jax.numpy.inexact) for x in results]
        avals = tuple(jax.typeof(x).to_tangent_aval() for x, is_one in zip(results, has_change) if is_one)
        changes = bind(call.then(("linear", active)), [*primals, *given], avals)
    else:
        pushed = call.then(("jvp", active))
        results = bind(pushed, [*primals, *given])
        has_change = pushed.facts
        results, changes = results[: len(has_change)], results[len(has_change) :]
    changes = iter(changes)
    return results, [
        next(changes) if is_one else ad.Zero(jax.typeof(result).to_tangent_aval())
        for result, is_one in zip(results, has_change)
    ]


def _pull(cotangents, *arrays, call, kinds):
    if call.step is None or call.step[0] != "linear":
        raise NotImplementedError("transpose of a call that is not the linear part of another")
    active = call.step[1]
    used = tuple(type(cotangent) is not ad.Zero for cotangent in cotangents)
    given = [cotangent for cotangent, is_used in zip(cotangents, used) if is_used]
    pulled = call.before.then(("vjp", active, used))
    return [None] * len(active) + bind(pulled, [*arrays[: len(active)], *given])


def _batch(arrays, axes, *, call, kinds):
    size = next(x.shape[axis] for x, axis in zip(arrays, axes) if axis is not None)
    batched = call.then(("vmap", size, tuple(axes)))
    results = bind(batched, arrays)
    return results, [0 if has_axis else None for has_axis in batched.facts]


def _staged(*arrays, call, kinds):
    return call.function(*arrays)


ad.primitive_jvps[call_p] = _push
ad.primitive_transposes[call_p] = _pull
batching.primitive_batchers[call_p] = _batch
mlir.register_lowering(call_p, mlir.lower_fun(_staged, multiple_results=True))
