"""A call as a primitive of JAX: derivatives and batches of it are calls, too, and nothing is traced twice.

Place in the pipeline: `program` binds it where the user transforms without `jit`, as in `jax.jacfwd(moment)(0.005)`.

    evaluated       the executable of the call
    jvp, vmap       the call with one more step
    reverse mode    the results now, and the linear part later, whose transpose is the call's vjp
    in a `jit`      the function itself, traced

The only module that asks JAX for what has no public name: which transformations are going on.
"""

import equinox as eqx
import jax
from jax._src import core
from jax._src.interpreters.ad import JVPTrace, LinearizeTrace
from jax._src.interpreters.batching import BatchTrace, BatchTracer
from jax._src.interpreters.partial_eval import JaxprTracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

EAGER = (JVPTrace, LinearizeTrace, BatchTrace)

call_p = Primitive("rfem_jax_call")
call_p.multiple_results = True


def nothing_going_on() -> bool:
    """Whether no transformation is going on."""
    return type(core.trace_ctx.trace) is core.EvalTrace


def nothing_staged() -> bool:
    """Whether the transformations that are going on, if any, compute at once."""
    trace = core.trace_ctx.trace
    while isinstance(trace, EAGER):
        trace = trace.parent_trace
    return type(trace) is core.EvalTrace


def has_batch_axis(array) -> bool:
    """Whether an array depends on a batch, inside of a function under `vmap`."""
    return isinstance(array, BatchTracer)


def bind(call, arrays, kinds=None):
    """Results of a call for arrays, some of them traced; `kinds`: of the results if they are known."""
    return call_p.bind(*arrays, call=call, kinds=kinds)


@call_p.def_impl
def _evaluate(*arrays, call, kinds):
    # A derivative by a Python number brings that number.
    return call.run([x if eqx.is_array(x) else jax.numpy.asarray(x) for x in arrays])


@call_p.def_abstract_eval
def _result_kinds(*arrays, call, kinds):
    if kinds is not None:
        return kinds
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays]
    return [core.ShapedArray(x.shape, x.dtype) for x in jax.eval_shape(call.function, *shapes)]


def _push(primals, tangents, *, call, kinds):
    moving = tuple(type(tangent) is not ad.Zero for tangent in tangents)
    moved = [tangent for tangent, moves in zip(tangents, moving) if moves]
    if any(isinstance(tangent, JaxprTracer) for tangent in moved):
        results = bind(call, primals, kinds)
        inexact = [jax.numpy.issubdtype(jax.typeof(x).dtype, jax.numpy.inexact) for x in results]
        avals = tuple(jax.typeof(x).to_tangent_aval() for x, i in zip(results, inexact) if i)
        changes = bind(call.then(("linear", moving)), [*primals, *moved], avals)
    else:
        pushed = call.then(("jvp", moving))
        results = bind(pushed, [*primals, *moved])
        inexact = pushed.facts
        results, changes = results[: len(inexact)], results[len(inexact) :]
    changes = iter(changes)
    return results, [
        next(changes) if is_inexact else ad.Zero(jax.typeof(result).to_tangent_aval())
        for result, is_inexact in zip(results, inexact)
    ]


def _pull(cotangents, *arrays, call, kinds):
    if call.step is None or call.step[0] != "linear":
        raise NotImplementedError("transpose of a call that is not the linear part of another")
    moving = call.step[1]
    seen = tuple(type(cotangent) is not ad.Zero for cotangent in cotangents)
    given = [cotangent for cotangent, is_seen in zip(cotangents, seen) if is_seen]
    pulled = call.before.then(("vjp", moving, seen))
    return [None] * len(moving) + bind(pulled, [*arrays[: len(moving)], *given])


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
