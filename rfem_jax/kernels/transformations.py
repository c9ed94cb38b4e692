"""Rules of kernels: batches, directions, forward mode, and transposes.

Place in the pipeline: bodies, primitive -> **transformations**, which tells JAX.

The derivative of a kernel is that of its jaxpr: values are one kernel, their tangents another one, which is linear in
tangents and has a transpose, so that forward and reverse mode and derivatives of derivatives follow.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import jaxpr_as_fun
from jax.interpreters import ad, batching

from rfem_jax.kernels.bodies import Body, Derived, one_by_one, over_samples, with_moving
from rfem_jax.kernels.primitive import bind, kernel, kernel_p, samples_of
from rfem_jax.kernels.separation import NotSeparable, separated


def _batched_rule(operands, axes, *, body: Body, batched: tuple[bool, ...]):
    """A new axis of samples in front of, and made one with, that which is there; or of directions of tangents."""
    first = body.linear_from
    if first is not None and all(axis is None for axis in axes[:first]):
        return _in_directions(operands, axes, body, batched)
    size = next(x.shape[axis] for x, axis in zip(operands, axes) if axis is not None)
    inner = next(
        (x.shape[0 if axis is None or axis > 0 else 1] for x, b, axis in zip(operands, batched, axes) if b), None
    )
    moved, now = [], []
    for x, axis, before in zip(operands, axes, batched):
        if axis is not None:
            x = jnp.moveaxis(x, axis, 0)
        if inner is not None and (axis is not None or before):
            if axis is None:
                x = jnp.broadcast_to(x, (size, *x.shape))
            elif not before:
                x = jnp.broadcast_to(x[:, None], (size, inner, *x.shape[1:]))
            x = x.reshape(size * inner, *x.shape[2:])
        moved.append(x)
        now.append(axis is not None or before)
    results = bind(body, moved, tuple(now))
    if inner is not None:
        results = [x.reshape(size, inner, *x.shape[1:]) for x in results]
    return results, [0] * len(results)


def _in_directions(operands, axes, body: Body, batched: tuple[bool, ...]):
    """A tangent in several directions: what does not depend on these is computed once."""
    size = next(x.shape[axis] for x, axis in zip(operands, axes) if axis is not None)
    spread = tuple(axis is not None for axis in axes)
    place = int(any(batched))
    moved = [x if axis is None else jnp.moveaxis(x, axis, int(b)) for x, axis, b in zip(operands, axes, batched)]

    def make():
        like = [_several(x, size) if s else x for x, s in zip(body.operands, spread)]
        results = [_several(x, size) for x in body.results]

        def single(*given):
            return jaxpr_as_fun(body.program)(*given)

        by_xla = over_samples(body.plain or single, spread)
        if body.origin is None:  # in several directions already
            return Derived(one_by_one(single, spread), like, results, by_xla)
        of, moving = body.origin
        if of.long and of.order == 0:  # turns are few operations beside what kernels within them do for each direction
            return Derived(over_samples(single, spread), like, results, by_xla)
        if of.long:
            return Derived(one_by_one(single, spread), like, results, by_xla)

        def each(*given):
            operands, along = given[: len(of.operands)], given[len(of.operands) :]
            try:
                linear = separated(body.program, operands)
            except NotSeparable:
                linear = jax.linearize(of.as_moving(operands, moving), *(operands[i] for i in moving))[1]
            return jax.vmap(kernel(linear), [0 if s else None for s in spread[len(of.operands) :]])(*along)

        return Derived(each, like, results, by_xla)

    several = body.derived(("directions", size, spread), make)
    several.linear_from, several.single = body.linear_from, (body, spread)
    results = bind(several, moved, batched)
    return results, [place] * len(results)


def _several(like: jax.ShapeDtypeStruct, size: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((size, *like.shape), like.dtype)


def _derivative(primals, tangents, *, body: Body, batched: tuple[bool, ...]):
    """Values, and tangents by a kernel that is linear in tangents."""
    moving = tuple(
        i for i, (x, dx) in enumerate(zip(primals, tangents))
        if type(dx) is not ad.Zero and jnp.issubdtype(x.dtype, jnp.inexact)
    )  # fmt: skip
    continuous = body.continuous
    if body.in_parts:
        return _derivative_in_parts(primals, tangents, body, batched, moving)
    values = bind(body, primals, batched)
    along: list[Any] = [None] * len(values)
    if moving and continuous:

        def make():
            def tangent(*given):
                operands, directions = given[: len(primals)], given[len(primals) :]
                return jax.jvp(body.as_moving(operands, moving), [operands[i] for i in moving], list(directions))[1]

            like = [*body.operands, *(body.operands[i] for i in moving)]
            return Derived(tangent, like, [body.results[i] for i in continuous])

        linear = body.derived(("tangent", moving), make)
        linear.linear_from, linear.origin = len(primals), (body, moving)
        found = bind(linear, [*primals, *(tangents[i] for i in moving)], (*batched, *(batched[i] for i in moving)))
        for i, x in zip(continuous, found):
            along[i] = x
    return values, _with_zeros(values, along, continuous)


def _derivative_in_parts(primals, tangents, body: Body, batched: tuple[bool, ...], moving: tuple[int, ...]):
    """Values and tangents of the jaxpr, whose kernels have rules of their own."""
    function = over_samples(jaxpr_as_fun(body.program), batched)
    inputs, directions = [primals[i] for i in moving], [tangents[i] for i in moving]
    values, along = jax.jvp(with_moving(primals, moving, function), inputs, directions)
    return values, _with_zeros(values, along, body.continuous)


def _with_zeros(values, along, continuous: list[int]) -> list[Any]:
    """The tangents of all results, zeros where there is none and where a result has none."""
    zeros = [ad.Zero(ShapedArray(x.shape, jax.dtypes.float0 if i not in continuous else x.dtype))
             for i, x in enumerate(values)]  # fmt: skip
    return [zero if x is None or i not in continuous else x for i, (x, zero) in enumerate(zip(along, zeros))]


def _transpose(cotangents, *operands, body: Body, batched: tuple[bool, ...]):
    """Cotangents of the operands in which the kernel is linear."""
    linear = tuple(i for i, x in enumerate(operands) if ad.is_undefined_primal(x))
    fixed = tuple(i for i in range(len(operands)) if i not in linear)
    given = tuple(i for i, x in enumerate(cotangents) if type(x) is not ad.Zero)
    found: list[Any] = [None] * len(operands)
    if not given:
        for i in linear:
            found[i] = ad.Zero(operands[i].aval)
        return found

    of = (body if body.single is None else body.single[0]).origin
    if of is not None and of[0].reverse is not None and linear[0] >= len(of[0].operands):
        return _pulled_back(cotangents, operands, body, batched)

    def make():
        def transposed(*values):
            function = jaxpr_as_fun(body.program)
            constants, back = values[: len(fixed)], values[len(fixed) :]

            def of_linear(*inputs):
                merged: list[Any] = [None] * len(operands)
                for i, x in zip(fixed, constants):
                    merged[i] = x
                for i, x in zip(linear, inputs):
                    merged[i] = x
                results = function(*merged)
                return [results[i] for i in given]

            like = [body.operands[i] for i in linear]
            return jax.linear_transpose(of_linear, *like)(list(back))

        like = [*(body.operands[i] for i in fixed), *(body.results[i] for i in given)]
        return Derived(transposed, like, [body.operands[i] for i in linear])

    back = body.derived(("transpose", linear, fixed, given), make)
    any_batch = any(batched)
    now = (*(batched[i] for i in fixed), *((any_batch,) * len(given)))
    results = bind(back, [*(operands[i] for i in fixed), *(cotangents[i] for i in given)], now)
    for i, x in zip(linear, results):
        # What all samples share has the sum of their cotangents.
        found[i] = jnp.sum(x, axis=0) if any_batch and not batched[i] else x
    return found


def _pulled_back(cotangents, operands, body: Body, batched: tuple[bool, ...]):
    """Cotangents of a tangent's directions, by the function that reverse mode takes."""
    single, spread = (body, None) if body.single is None else body.single
    assert single.origin is not None
    of, moving = single.origin
    primals = operands[: len(of.operands)]

    def pull(*values):
        constants, back = values[: len(primals)], values[len(primals) :]

        of_moving = of.as_moving(constants, moving, of.reverse)
        pulled = jax.vjp(of_moving, *(constants[i] for i in moving))[1]
        if spread is None:
            return pulled(list(back))
        found = jax.vmap(pulled)(list(back))
        return [x if s else jnp.sum(x, axis=0) for x, s in zip(found, spread[len(primals) :])]

    samples = samples_of(primals, batched)
    front = () if samples is None else (samples,)
    back = [
        jnp.zeros((*front, *x.shape), x.dtype) if type(c) is ad.Zero else c for c, x in zip(cotangents, body.results)
    ]
    now = (*batched[: len(primals)], *((samples is not None,) * len(back)))
    found = over_samples(pull, now)(*primals, *back)
    results: list[Any] = [None] * len(operands)
    for i, x, b in zip(range(len(primals), len(operands)), found, batched[len(primals) :]):
        # What all samples share has the sum of their cotangents.
        results[i] = jnp.sum(x, axis=0) if samples is not None and not b else x
    return results


batching.primitive_batchers[kernel_p] = _batched_rule
ad.primitive_jvps[kernel_p] = _derivative
ad.primitive_transposes[kernel_p] = _transpose
