"""`kernel`: a function of arrays as a primitive of JAX, with machine code of its own on a CPU.

Place in the pipeline: programs, machine_code -> **primitive**.

The primitive has a jaxpr for one sample.  Under `jax.vmap` its operands get one axis of samples in front, however many
batch axes there are.  Its derivative is that of the jaxpr: values are one primitive, their tangents another one, which
is linear in tangents and has a transpose, so that forward and reverse mode and derivatives of derivatives follow.
Where there is no machine code (another device than a CPU, an operation that is not known, no llvmlite) XLA is given the
jaxpr.
"""

import threading
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from rfem_jax.kernels import machine_code, programs
from rfem_jax.kernels.builder import Unsupported
from rfem_jax.kernels.entries import shape_of, size_of

Tree = TypeVar("Tree")
LARGEST = 400_000  # operations, beyond which XLA compiles faster

_kernel = Primitive("kernel")
_kernel.multiple_results = True


class Body:
    """The jaxpr of a kernel for one sample, and what was made of it; compared by identity."""

    def __init__(self, program: ClosedJaxpr, name: str, thorough: bool) -> None:
        self.program, self.name, self.thorough = program, name, thorough
        self._emitted: programs.Program | Unsupported | None = None
        self._handlers: dict[int, str] = {}
        self._derived: dict[Any, Body] = {}
        self._lock = threading.RLock()

    def by_xla(self, *operands: jax.Array, batched: tuple[bool, ...]) -> list[jax.Array]:
        """The results by JAX's own operations."""
        function = jaxpr_as_fun(self.program)
        if any(batched):
            function = jax.vmap(function, in_axes=[0 if b else None for b in batched])
        return function(*operands)

    def emitted(self) -> programs.Program | Unsupported:
        """The program, or why there is none."""
        with self._lock:
            if self._emitted is None:
                self._emitted = self._emit()
            return self._emitted

    def _emit(self) -> programs.Program | Unsupported:
        if not machine_code.is_available():
            return Unsupported("llvmlite is not installed")
        if size_of(self.program) > LARGEST:
            return Unsupported(f"more than {LARGEST} operations")
        try:
            return programs.emit(self.program)
        except Unsupported as reason:
            warnings.warn(f"{self.name!r} is compiled by XLA: there is no machine code for {reason}.", stacklevel=2)
            return reason

    def handler(self, lanes: int) -> str:
        """Name under which XLA finds the machine code for a number of lanes."""
        with self._lock:
            if lanes not in self._handlers:
                program = self.emitted()
                assert isinstance(program, programs.Program)
                name, text = program.module(lanes)
                _register(name, text, self.thorough)
                self._handlers[lanes] = name
            return self._handlers[lanes]

    def derived(self, key: Any, make: Callable[[], tuple[Callable, Sequence[Any]]]) -> "Body":
        """The kernel of another function, made once; `make`: function and shapes of its arguments."""
        with self._lock:
            if key not in self._derived:
                function, like = make()
                self._derived[key] = Body(jax.make_jaxpr(function)(*like), self.name, self.thorough)
            return self._derived[key]

    @property
    def operands(self) -> list[jax.ShapeDtypeStruct]:
        return [*map(shape_of, self.program.jaxpr.invars)]

    @property
    def results(self) -> list[jax.ShapeDtypeStruct]:
        return [*map(shape_of, self.program.jaxpr.outvars)]


_registered: set[str] = set()
_registering = threading.Lock()


def _register(name: str, text: str, thorough: bool) -> None:
    """Compile a module and tell XLA of its handler, once in a process."""
    with _registering:
        if name not in _registered:
            address = machine_code.compile_module(name, text, thorough)
            jax.ffi.register_ffi_target(name, machine_code.capsule(address), platform="cpu", api_version=1)
            _registered.add(name)


def kernel(
    function: Callable[..., Tree], *, name: str | None = None, selection: Literal["thorough", "fast"] = "thorough"
) -> Callable[..., Tree]:
    """A function of arrays, as one operation of JAX with machine code of its own.

    **Arguments:** `function` of trees of arrays of float64, bool, int32 and int64; it is traced for one sample, and may
    use loops and branches. `name`: what it is called in messages. `selection` of instructions and registers: "fast"
    compiles several times as fast, and runs slower.

    **Returns:** a function of the same arguments and results. All transformations of JAX apply to it where they apply
    to `function`; in reverse mode loops must have a known number of turns, as everywhere in JAX. A sample's result is
    the same, to the last bit, in every batch and at every place in it.

    **Warns:** once for a function with an operation that has no machine code; XLA compiles it then.
    """
    known: dict[Any, tuple[Body, Any]] = {}
    called = name or getattr(function, "__name__", "a function")

    def as_kernel(*arguments):
        leaves, tree = jax.tree.flatten(arguments)
        leaves = [jnp.asarray(x) for x in leaves]
        key = tree, tuple((x.shape, x.dtype) for x in leaves)
        outer: list[Any] = []
        if key not in known:
            flat = lambda *leaves: function(*jax.tree.unflatten(tree, leaves))  # noqa: E731
            program, shapes = jax.make_jaxpr(flat, return_shape=True)(*map(_like, leaves))
            structure = jax.tree.structure(shapes)
            program, outer = _with_operands(program)
            found = Body(program, called, selection == "thorough"), structure
            if outer:  # values of a transformation around this call are no part of the function
                return jax.tree.unflatten(structure, _bind(found[0], [*outer, *leaves]))
            known[key] = found
        body, structure = known[key]
        return jax.tree.unflatten(structure, _bind(body, leaves))

    return as_kernel


def _like(x: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape, x.dtype)


def _with_operands(program: ClosedJaxpr) -> tuple[ClosedJaxpr, list[Any]]:
    """The jaxpr with traced values that its function closed over as first operands, and these values."""
    traced = [i for i, x in enumerate(program.consts) if isinstance(x, Tracer)]
    if not traced:
        return program, []
    outer = [program.consts[i] for i in traced]

    def function(*operands):
        constants = list(program.consts)
        for i, x in zip(traced, operands):
            constants[i] = x
        return jaxpr_as_fun(ClosedJaxpr(program.jaxpr, constants))(*operands[len(traced) :])

    like = [*map(_like, outer), *map(shape_of, program.jaxpr.invars)]
    return jax.make_jaxpr(function)(*like), outer


def _bind(body: Body, operands: Sequence[Any], batched: tuple[bool, ...] | None = None) -> list[Any]:
    return _kernel.bind(*operands, body=body, batched=(False,) * len(operands) if batched is None else batched)


def _type(*operands, body: Body, batched: tuple[bool, ...]) -> list[ShapedArray]:
    samples = _samples(operands, batched)
    front = () if samples is None else (samples,)
    return [ShapedArray((*front, *x.shape), x.dtype) for x in body.results]


def _samples(operands, batched: tuple[bool, ...]) -> int | None:
    return next((x.shape[0] for x, b in zip(operands, batched) if b), None)


def _batched_rule(operands, axes, *, body: Body, batched: tuple[bool, ...]):
    """A new axis of samples in front of, and made one with, that which is there."""
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
    results = _bind(body, moved, tuple(now))
    if inner is not None:
        results = [x.reshape(size, inner, *x.shape[1:]) for x in results]
    return results, [0] * len(results)


def _derivative(primals, tangents, *, body: Body, batched: tuple[bool, ...]):
    """Values, and tangents by a kernel that is linear in tangents."""
    values = _bind(body, primals, batched)
    moving = tuple(
        i for i, (x, dx) in enumerate(zip(primals, tangents))
        if type(dx) is not ad.Zero and jnp.issubdtype(x.dtype, jnp.inexact)
    )  # fmt: skip
    continuous = [i for i, x in enumerate(body.results) if jnp.issubdtype(x.dtype, jnp.inexact)]
    along: list[Any] = [None] * len(values)
    if moving and continuous:

        def make():
            function = jaxpr_as_fun(body.program)

            def tangent(*given):
                operands, directions = given[: len(primals)], given[len(primals) :]

                def of_moving(*inputs):
                    merged = list(operands)
                    for i, x in zip(moving, inputs):
                        merged[i] = x
                    results = function(*merged)
                    return [results[i] for i in continuous]

                return jax.jvp(of_moving, [operands[i] for i in moving], list(directions))[1]

            return tangent, [*body.operands, *(body.operands[i] for i in moving)]

        linear = body.derived(("tangent", moving), make)
        found = _bind(linear, [*primals, *(tangents[i] for i in moving)], (*batched, *(batched[i] for i in moving)))
        for i, x in zip(continuous, found):
            along[i] = x
    zeros = [ad.Zero(ShapedArray(x.shape, jax.dtypes.float0 if i not in continuous else x.dtype))
             for i, x in enumerate(values)]  # fmt: skip
    return values, [zero if x is None else x for x, zero in zip(along, zeros)]


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

    def make():
        function = jaxpr_as_fun(body.program)

        def transposed(*values):
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

        return transposed, [*(body.operands[i] for i in fixed), *(body.results[i] for i in given)]

    back = body.derived(("transpose", linear, fixed, given), make)
    any_batch = any(batched)
    now = (*(batched[i] for i in fixed), *((any_batch,) * len(given)))
    results = _bind(back, [*(operands[i] for i in fixed), *(cotangents[i] for i in given)], now)
    for i, x in zip(linear, results):
        # What all samples share has the sum of their cotangents.
        found[i] = jnp.sum(x, axis=0) if any_batch and not batched[i] else x
    return found


def _lanes(samples: int | None) -> int:
    """How many samples at a time."""
    count, widest = samples or 1, machine_code.vector_width()
    return next(n for n in (1, 2, 4, 8) if n >= min(count, widest))


def _by_machine_code(*operands, body: Body, batched: tuple[bool, ...]):
    samples = _samples(operands, batched)
    name = body.handler(_lanes(samples))
    front = () if samples is None else (samples,)
    results = [jax.ShapeDtypeStruct((*front, *x.shape), x.dtype) for x in body.results]
    sizes = [int(np.prod(x.shape, dtype=int)) if b else 0 for x, b in zip(body.operands, batched)]
    numbers = jnp.asarray(np.array([1 if samples is None else samples, *sizes], np.int64))
    return jax.ffi.ffi_call(name, results, vmap_method=None, has_side_effect=False)(*operands, numbers)


def _on_cpu(*operands, body: Body, batched: tuple[bool, ...]):
    if isinstance(body.emitted(), Unsupported):
        return body.by_xla(*operands, batched=batched)
    return _by_machine_code(*operands, body=body, batched=batched)


def _anywhere(*operands, body: Body, batched: tuple[bool, ...]):
    return body.by_xla(*operands, batched=batched)


_kernel.def_abstract_eval(_type)
_kernel.def_impl(jax.jit(lambda *x, **settings: _kernel.bind(*x, **settings), static_argnames=("body", "batched")))
batching.primitive_batchers[_kernel] = _batched_rule
ad.primitive_jvps[_kernel] = _derivative
ad.primitive_transposes[_kernel] = _transpose
mlir.register_lowering(_kernel, mlir.lower_fun(_anywhere, multiple_results=True))
mlir.register_lowering(_kernel, mlir.lower_fun(_on_cpu, multiple_results=True), platform="cpu")
