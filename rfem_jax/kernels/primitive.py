"""`kernel`: a function of arrays as a primitive of JAX, with machine code of its own on a CPU.

Place in the pipeline: programs, machine_code -> **primitive**.

The primitive has a jaxpr for one sample.  Under `jax.vmap` its operands get one axis of samples in front, however many
batch axes there are.  Its derivative is that of the jaxpr: values are one primitive, their tangents another one, which
is linear in tangents and has a transpose, so that forward and reverse mode and derivatives of derivatives follow.
Where there is no machine code (another device than a CPU, an operation that is not known, no llvmlite) XLA is given the
jaxpr.
"""

import functools
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from rfem_jax.kernels import machine_code, programs, registry
from rfem_jax.kernels.builder import TooLarge, Unsupported
from rfem_jax.kernels.entries import shape_of, size_of

Tree = TypeVar("Tree")
MOST_KNOWN = 64  # forms of arguments for which a function is remembered
LARGEST_ARRAYS = 5_000_000  # entries of all arrays, of which it would take long to find that they are too many
# Turns of a program, times blocks of samples, from which on it is compiled thoroughly: that takes 0.1 ms an operation
# more and saves 0.35 ns of each turn of it, which pays after a hundred runs of so many turns.
THOROUGH_FROM = 8000
THOROUGH_UP_TO = 60_000  # operations: more would take longer than anyone waits who did not ask for it

_kernel = Primitive("kernel")
_kernel.multiple_results = True


_expected = threading.local()


def expected_runs() -> int:
    """How often what this thread compiles is expected to run."""
    return getattr(_expected, "runs", 1)


@contextmanager
def expecting(runs: int) -> Iterator[None]:
    """Declare that what is compiled within the block will run about so many times, for the automatic selection."""
    before, _expected.runs = expected_runs(), max(runs, 1)
    try:
        yield
    finally:
        _expected.runs = before


class Body:
    """The jaxpr of a kernel for one sample, and what was made of it; compared by identity.

    Attributes: plain: a function of the same operands and results for XLA, None: the jaxpr; reverse: one that reverse
    mode takes, None: the jaxpr; linear_from: number of the first operand in which the kernel is linear, None where it
    is in none; origin: of a tangent the kernel and its moving operands; single: of a tangent in several directions that
    in one, and which operands have directions; long: whether it has a loop whose turns are not to be remembered; order:
    of the derivatives in it.
    """

    def __init__(self, program: ClosedJaxpr, name: str, selection: str, plain: Callable | None = None) -> None:
        self.program, self.name, self.selection, self.plain = program, name, selection, plain
        self.reverse: Callable | None = None
        self.linear_from: int | None = None
        self.origin: tuple[Body, tuple[int, ...]] | None = None
        self.single: tuple[Body, tuple[bool, ...]] | None = None
        self.long, self.order = False, 0
        self._emitted: programs.Program | Unsupported | None = None
        self._handlers: dict[tuple[int, bool], tuple[str, str]] = {}
        self._derived: dict[Any, Body] = {}
        self._lock = threading.RLock()

    def by_xla(self, *operands: jax.Array, batched: tuple[bool, ...]) -> list[jax.Array]:
        """The results by JAX's own operations."""
        return _over_samples(self.plain or jaxpr_as_fun(self.program), batched)(*operands)

    def emitted(self) -> programs.Program | Unsupported:
        """The program, or why there is none."""
        with self._lock:
            if self._emitted is None:
                self._emitted = self._emit()
            return self._emitted

    def _emit(self) -> programs.Program | Unsupported:
        if not machine_code.is_available():
            return Unsupported("llvmlite is not installed")
        if size_of(self.program) > LARGEST_ARRAYS:
            return TooLarge(f"arrays of {LARGEST_ARRAYS} entries in all")
        try:
            return programs.emit(self.program)
        except TooLarge as reason:
            return reason
        except Unsupported as reason:
            warnings.warn(f"{self.name!r} is compiled by XLA: there is no machine code for {reason}.", stacklevel=2)
            return reason

    def handler(self, lanes: int, blocks: int) -> str:
        """Name under which XLA finds the machine code for a number of lanes, and so many blocks of samples."""
        program = self.emitted()
        assert isinstance(program, programs.Program)
        thorough = self.selection == "thorough"
        if self.selection == "automatic":
            turns = expected_runs() * blocks * program.work / max(program.operations, 1)
            thorough = turns >= THOROUGH_FROM and program.operations <= THOROUGH_UP_TO
        with self._lock:
            if (lanes, thorough) not in self._handlers:
                self._handlers[lanes, thorough] = program.module(lanes, thorough)
            name, text = self._handlers[lanes, thorough]
        registry.announce(name, text, thorough)
        return name

    def derived(self, key: Any, make: Callable[[], tuple]) -> "Body":
        """The kernel of another function, made once; `make`: function, shapes of its arguments, function for XLA."""
        with self._lock:
            if key not in self._derived:
                function, like, *plain = make()
                made = Body(jax.make_jaxpr(function)(*like), self.name, self.selection, *plain)
                made.long, made.order = self.long, self.order + (key[0] == "tangent")
                self._derived[key] = made
            return self._derived[key]

    def as_moving(self, operands: Sequence[Any], moving: Sequence[int]) -> Callable:
        """The results that have derivatives, as a function of the operands that move."""
        function = jaxpr_as_fun(self.program)

        def of_moving(*inputs):
            merged = list(operands)
            for i, x in zip(moving, inputs):
                merged[i] = x
            results = function(*merged)
            return [results[i] for i in self.continuous]

        return of_moving

    @property
    def continuous(self) -> list[int]:
        """Numbers of the results that have derivatives."""
        return [i for i, x in enumerate(self.results) if jnp.issubdtype(x.dtype, jnp.inexact)]

    @property
    def operands(self) -> list[jax.ShapeDtypeStruct]:
        return [*map(shape_of, self.program.jaxpr.invars)]

    @property
    def results(self) -> list[jax.ShapeDtypeStruct]:
        return [*map(shape_of, self.program.jaxpr.outvars)]


def _one_by_one(function: Callable, spread: Sequence[bool]) -> Callable:
    """The function for every row of the operands that have an axis of them in front, in a loop."""

    def each(*given):
        def one(rows):
            left = iter(rows)
            return function(*(next(left) if s else x for x, s in zip(given, spread)))

        return jax.lax.map(one, [x for x, s in zip(given, spread) if s])

    return each


def _over_samples(function: Callable, batched: Sequence[bool]) -> Callable:
    """The function of operands some of which have an axis of samples in front."""
    return jax.vmap(function, in_axes=[0 if b else None for b in batched]) if any(batched) else function


def kernel(
    function: Callable[..., Tree],
    *,
    name: str | None = None,
    selection: Literal["automatic", "thorough", "fast"] = "automatic",
    reverse: Callable[..., Tree] | None = None,
) -> Callable[..., Tree]:
    """A function of arrays, as one operation of JAX with machine code of its own.

    **Arguments:** `function` of trees of arrays of float64, bool, int32, uint32 and int64; it is traced for one sample,
    and may use loops and branches; leaves that are no arrays are settings, which a hash tells apart. `name`: what it is
    called in messages. `selection` of instructions and registers: "fast" compiles ten times as fast, and runs up to
    twice as long; "automatic" takes it unless loops and samples are so many that it would not pay; the results are the
    same. `reverse`: a function of the same results that is differentiated in reverse mode in its place, for a long loop
    whose every turn would be remembered: a loop of JAX's own over a kernel, say, with checkpoints.

    **Returns:** a function of the same arguments and results. All transformations of JAX apply to it where they apply
    to `function`; in reverse mode loops must have a known number of turns, as everywhere in JAX. A sample's result is
    the same, to the last bit, in every batch and at every place in it.

    **Warns:** once for a function with an operation that has no machine code; XLA compiles it then.
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
            return returned.filled(_bind(body, given))
        returned = _Structure()
        flat = _of_arrays(function, tree, settings, returned)
        program, outer = _with_operands(jax.make_jaxpr(flat)(*map(_like, given)))
        if program.effects:  # as of a callback into Python, which is JAX's affair
            return function(*arguments)
        if outer and reverse is not None:  # what it closes over may be differentiated, too
            return reverse(*arguments)
        body = Body(program, called, selection)
        if reverse is not None:
            body.reverse, body.long = _of_arrays(reverse, tree, settings, _Structure()), True
        if not outer:  # values of a transformation around this call are no part of the function
            known[key] = body, returned
            if len(known) > MOST_KNOWN:
                del known[next(iter(known))]
        return returned.filled(_bind(body, [*outer, *given]))

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
    results = _bind(body, moved, tuple(now))
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
        like = [
            jax.ShapeDtypeStruct((size, *x.shape) if s else x.shape, x.dtype) for x, s in zip(body.operands, spread)
        ]
        by_xla = _over_samples(body.plain or jaxpr_as_fun(body.program), spread)
        if body.origin is None:  # in several directions already
            return _one_by_one(jaxpr_as_fun(body.program), spread), like, by_xla
        of, moving = body.origin
        if of.long and of.order == 0:  # turns are few operations beside what kernels within them do for each direction
            return _over_samples(jaxpr_as_fun(body.program), spread), like, by_xla
        if of.long:
            return _one_by_one(jaxpr_as_fun(body.program), spread), like, by_xla

        def each(*given):
            operands, along = given[: len(of.operands)], given[len(of.operands) :]
            linear = jax.linearize(of.as_moving(operands, moving), *(operands[i] for i in moving))[1]
            return jax.vmap(kernel(linear), [0 if s else None for s in spread[len(of.operands) :]])(*along)

        return each, like, by_xla

    several = body.derived(("directions", size, spread), make)
    several.linear_from, several.single = body.linear_from, (body, spread)
    results = _bind(several, moved, batched)
    return results, [place] * len(results)


def _derivative(primals, tangents, *, body: Body, batched: tuple[bool, ...]):
    """Values, and tangents by a kernel that is linear in tangents."""
    values = _bind(body, primals, batched)
    moving = tuple(
        i for i, (x, dx) in enumerate(zip(primals, tangents))
        if type(dx) is not ad.Zero and jnp.issubdtype(x.dtype, jnp.inexact)
    )  # fmt: skip
    continuous = body.continuous
    along: list[Any] = [None] * len(values)
    if moving and continuous:

        def make():
            def tangent(*given):
                operands, directions = given[: len(primals)], given[len(primals) :]
                return jax.jvp(body.as_moving(operands, moving), [operands[i] for i in moving], list(directions))[1]

            return tangent, [*body.operands, *(body.operands[i] for i in moving)]

        linear = body.derived(("tangent", moving), make)
        linear.linear_from, linear.origin = len(primals), (body, moving)
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

    of = (body if body.single is None else body.single[0]).origin
    if of is not None and of[0].reverse is not None and linear[0] >= len(of[0].operands):
        return _pulled_back(cotangents, operands, body, batched)

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


def _pulled_back(cotangents, operands, body: Body, batched: tuple[bool, ...]):
    """Cotangents of a tangent's directions, by the function that reverse mode takes."""
    single, spread = (body, None) if body.single is None else body.single
    assert single.origin is not None
    of, moving = single.origin
    reverse = of.reverse
    assert reverse is not None
    primals = operands[: len(of.operands)]

    def pull(*values):
        constants, back = values[: len(primals)], values[len(primals) :]

        def of_moving(*inputs):
            merged = list(constants)
            for i, x in zip(moving, inputs):
                merged[i] = x
            results = reverse(*merged)
            return [results[i] for i in of.continuous]

        pulled = jax.vjp(of_moving, *(constants[i] for i in moving))[1]
        if spread is None:
            return pulled(list(back))
        found = jax.vmap(pulled)(list(back))
        return [x if s else jnp.sum(x, axis=0) for x, s in zip(found, spread[len(primals) :])]

    samples = _samples(primals, batched)
    front = () if samples is None else (samples,)
    back = [
        jnp.zeros((*front, *x.shape), x.dtype) if type(c) is ad.Zero else c for c, x in zip(cotangents, body.results)
    ]
    now = (*batched[: len(primals)], *((samples is not None,) * len(back)))
    found = _over_samples(pull, now)(*primals, *back)
    results: list[Any] = [None] * len(operands)
    for i, x, b in zip(range(len(primals), len(operands)), found, batched[len(primals) :]):
        # What all samples share has the sum of their cotangents.
        results[i] = jnp.sum(x, axis=0) if samples is not None and not b else x
    return results


def _lanes(samples: int | None) -> int:
    """How many samples at a time."""
    count, widest = samples or 1, machine_code.vector_width()
    return next(n for n in (1, 2, 4, 8) if n >= min(count, widest))


def _by_machine_code(*operands, body: Body, batched: tuple[bool, ...]):
    samples = _samples(operands, batched)
    lanes = _lanes(samples)
    name = body.handler(lanes, -(-(samples or 1) // lanes))
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
