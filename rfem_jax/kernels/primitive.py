"""`kernel`: a function of arrays as a primitive of JAX, with machine code of its own on a CPU.

Place in the pipeline: bodies -> **primitive** -> transformations.

The primitive has a jaxpr for one sample.  Under `jax.vmap` its operands get one axis of samples in front, however many
batch axes there are.  Where there is no machine code (another device than a CPU, an operation that is not known, no
llvmlite) XLA is given the jaxpr.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import mlir

from rfem_jax.kernels import machine_code
from rfem_jax.kernels.bodies import Body, Size, is_left_to_xla
from rfem_jax.kernels.builder import Unsupported
from rfem_jax.kernels.entries import shape_of

Tree = TypeVar("Tree")
ON_STACK = 0.85  # of the values of a program, measured at most with the fast selection, which gives each its own place
MOST_KNOWN = 64  # forms of arguments for which a function is remembered

kernel_p = Primitive("kernel")
kernel_p.multiple_results = True


def kernel(
    function: Callable[..., Tree],
    *,
    name: str | None = None,
    selection: Literal["automatic", "thorough", "fast"] = "automatic",
    reverse: Callable[..., Tree] | None = None,
    in_parts: bool = False,
) -> Callable[..., Tree]:
    """A function of arrays, as one operation of JAX with machine code of its own.

    **Arguments:** `function` of trees of arrays of float64, bool, int32, uint32 and int64; it is traced for one sample,
    and may use loops and branches; leaves that are no arrays are settings, which a hash tells apart. `name`: what it is
    called in messages. `selection` of instructions and registers: "fast" compiles ten times as fast, and runs up to
    twice as long; "automatic" takes it unless loops and samples are so many that it would not pay; the results are the
    same. `reverse`: a function of the same results that is differentiated in reverse mode in its place, for a long loop
    whose every turn would be remembered: a loop of JAX's own over a kernel, say, with checkpoints. `in_parts`: only its
    values are one kernel; it is differentiated as if it were no kernel, so that derivatives are made of the kernels in
    it and JAX's operations between them: for a large function of many small kernels.

    **Returns:** a function of the same arguments and results. All transformations of JAX apply to it where they apply
    to `function`; in reverse mode loops must have a known number of turns, as everywhere in JAX. A sample's result is
    the same, to the last bit, in every batch and at every place in it.

    **Warns:** once for a function with an operation that has no machine code; XLA compiles it then, and `in_parts`
    nothing is said, since the kernels in it have machine code.
    """
    known: dict[Any, tuple[Body, _Structure]] = {}
    called = name or getattr(function, "__name__", "a function")

    @functools.wraps(function)
    def as_kernel(*arguments):
        leaves, tree = jax.tree.flatten(arguments)
        settings = tuple(None if _is_array(x) else x for x in leaves)
        given = [jnp.asarray(x) for x in leaves if _is_array(x)]
        key = tree, settings, tuple(map(type, settings)), tuple((x.shape, x.dtype) for x in given)
        if key in known:
            body, returned = known[key]
            return returned.filled(bind(body, given))
        returned = _Structure()
        flat = _of_arrays(function, tree, settings, returned)
        program, outer = _with_operands(jax.make_jaxpr(flat)(*map(_like, given)))
        if program.effects:  # as of a callback into Python, which is JAX's affair
            return function(*arguments)
        if outer and reverse is not None:  # what it closes over may be differentiated, too
            return reverse(*arguments)
        body = Body.of(program, called, selection)
        if reverse is not None:
            body.reverse, body.long = _of_arrays(reverse, tree, settings, _Structure()), True
        body.in_parts = in_parts
        if not outer:  # values of a transformation around this call are no part of the function
            known[key] = body, returned
            if len(known) > MOST_KNOWN:
                del known[next(iter(known))]
        return returned.filled(bind(body, [*outer, *given]))

    return as_kernel


class _Structure:
    """The tree of a function's results with its leaves that are no arrays."""

    def __init__(self) -> None:
        self.tree, self.settings = jax.tree.structure(None), ()

    def flattened(self, results: Any) -> list[jax.Array]:
        """The arrays of a tree of results, whose structure is noted."""
        leaves, self.tree = jax.tree.flatten(results)
        self.settings = tuple(None if _is_array(x) or isinstance(x, bool | int | float) else x for x in leaves)
        return [jnp.asarray(x) for x, one in zip(leaves, self.settings) if one is None]

    def filled(self, arrays: Sequence[Any]) -> Any:
        """The tree with arrays."""
        left = iter(arrays)
        return jax.tree.unflatten(self.tree, [next(left) if x is None else x for x in self.settings])


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


def _of_arrays(function: Callable, tree: Any, settings: tuple, returned: _Structure) -> Callable:
    """The function of the arrays alone, with the arrays of its results."""

    def flat(*arrays):
        left = iter(arrays)
        return returned.flattened(
            function(*jax.tree.unflatten(tree, [next(left) if x is None else x for x in settings]))
        )

    return flat


def _like(x: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape, x.dtype)


def _with_operands(program: ClosedJaxpr) -> tuple[ClosedJaxpr, list[Any]]:
    """The jaxpr with traced values that its function closed over as first operands, and these values."""
    traced = [i for i, x in enumerate(program.consts) if isinstance(x, Tracer)]
    if not traced:
        return program, []
    outer = [jnp.asarray(program.consts[i]) for i in traced]  # a tracer of a number of Python's has no type

    def function(*operands):
        constants = list(program.consts)
        for i, x in zip(traced, operands):
            constants[i] = x
        return jaxpr_as_fun(ClosedJaxpr(program.jaxpr, constants))(*operands[len(traced) :])

    like = [*map(_like, outer), *map(shape_of, program.jaxpr.invars)]
    return jax.make_jaxpr(function)(*like), outer


def bind(body: Body, operands: Sequence[Any], batched: tuple[bool, ...] | None = None) -> list[Any]:
    return kernel_p.bind(*operands, body=body, batched=(False,) * len(operands) if batched is None else batched)


def _type(*operands, body: Body, batched: tuple[bool, ...]) -> list[ShapedArray]:
    samples = samples_of(operands, batched)
    front = () if samples is None else (samples,)
    return [ShapedArray((*front, *x.shape), x.dtype) for x in body.results]


def samples_of(operands, batched: tuple[bool, ...]) -> int | None:
    return next((x.shape[0] for x, b in zip(operands, batched) if b), None)


def _lanes(samples: int | None, body: Body) -> int:
    """How many samples at a time: less than there is room for in registers where values out of these, up to
    `ON_STACK` of all, would not fit on the stack."""
    count, widest, size = samples or 1, machine_code.vector_width(), body.size()
    assert isinstance(size, Size)
    fitting = next(n for n in (1, 2, 4, 8) if n >= min(count, widest))
    bytes_of_lane = 8 * ON_STACK * size.operations
    return max(n for n in (1, 2, 4, 8) if n <= fitting and (n == 1 or n * bytes_of_lane <= machine_code.stack_bytes()))


def _by_machine_code(*operands, body: Body, batched: tuple[bool, ...]):
    samples = samples_of(operands, batched)
    lanes = _lanes(samples, body)
    name = body.handler(lanes, -(-(samples or 1) // lanes))
    front = () if samples is None else (samples,)
    results = [jax.ShapeDtypeStruct((*front, *x.shape), x.dtype) for x in body.results]
    sizes = [int(np.prod(x.shape, dtype=int)) if b else 0 for x, b in zip(body.operands, batched)]
    numbers = jnp.asarray(np.array([1 if samples is None else samples, *sizes], np.int64))
    return jax.ffi.ffi_call(name, results, vmap_method=None, has_side_effect=False)(*operands, numbers)


def _on_cpu(*operands, body: Body, batched: tuple[bool, ...]):
    if is_left_to_xla() or isinstance(body.size(), Unsupported):
        return body.by_xla(*operands, batched=batched)
    return _by_machine_code(*operands, body=body, batched=batched)


def _anywhere(*operands, body: Body, batched: tuple[bool, ...]):
    return body.by_xla(*operands, batched=batched)


_compiled = jax.jit(lambda *x, **settings: kernel_p.bind(*x, **settings), static_argnames=("body", "batched"))


def _now(*operands, body: Body, batched: tuple[bool, ...]):
    """The results at once; by XLA where JAX then looks for the operation whose result is no number."""
    if any(getattr(jax.config, name) for name in ("jax_debug_nans", "jax_debug_infs")):
        return jax.jit(functools.partial(body.by_xla, batched=batched))(*operands)
    return _compiled(*operands, body=body, batched=batched)


kernel_p.def_abstract_eval(_type)
kernel_p.def_impl(_now)
mlir.register_lowering(kernel_p, mlir.lower_fun(_anywhere, multiple_results=True))
mlir.register_lowering(kernel_p, mlir.lower_fun(_on_cpu, multiple_results=True), platform="cpu")
