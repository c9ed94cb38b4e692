"""Functions evaluated operation by operation with NumPy: for programs that run once, which take long to compile.

`by_numpy(f)` traces a function of arrays, derivatives and vmap included, and carries out its jaxpr.  What has no rule
here is carried out by JAX as one operation.  What XLA makes of them is tested by tests/compilation, by loops of many
turns, which are compiled (`evaluation_by_numpy`), by the commands that are run as they are, and by the gallery.
"""

import functools
import itertools
import math
import operator
import string
import threading
import warnings
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np
import scipy.linalg
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Literal
from jax.interpreters import partial_eval
from numpy._core.multiarray import c_einsum  # `np.einsum` without its choice of an order, twice as fast

from rfem_jax.compilation import options
from rfem_jax.compilation.unbatched_calls import keep_unbatched_calls

CALLS = frozenset(["jit", "pjit", "closed_call", "checkpoint", "remat", "remat2", "custom_jvp_call", "custom_vjp_call"])
ELEMENTWISE: dict[str, Callable] = {
    **{name: getattr(np, name) for name in "sin cos tan exp exp2 log log1p expm1 sqrt tanh sinh cosh abs".split()},
    **{name: getattr(np, name) for name in "sign floor ceil cbrt nextafter square".split()},
    **{name: getattr(np, "arc" + name[1:]) for name in "acos asin atan atan2 asinh acosh atanh".split()},
    "add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "neg": np.negative, "pow": np.power,
    "max": np.maximum, "min": np.minimum, "rem": np.fmod, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal, "and": np.bitwise_and, "or": np.bitwise_or,
    "xor": np.bitwise_xor, "not": np.invert, "is_finite": np.isfinite, "stop_gradient": np.asarray,
    "convert_element_type": np.asarray, "copy": np.asarray, "copy_p": np.asarray, "name": np.asarray,
    "stage": np.asarray, "shift_right_arithmetic": np.right_shift,
    "rsqrt": lambda x: 1.0 / np.sqrt(x), "clamp": lambda low, x, high: np.clip(x, low, high),
}  # fmt: skip
REDUCED: dict[str, Callable] = {
    "reduce_sum": np.add.reduce, "reduce_prod": np.multiply.reduce,
    "reduce_and": np.logical_and.reduce, "reduce_or": np.logical_or.reduce,
    "reduce_max": lambda x, axis: np.maximum.reduce(x, axis, initial=-np.inf if x.dtype.kind == "f" else None),
    "reduce_min": lambda x, axis: np.minimum.reduce(x, axis, initial=np.inf if x.dtype.kind == "f" else None),
}  # fmt: skip


# Whose results have the type that NumPy gives them.
SAME_TYPE = frozenset(
    "sin cos tan exp log sqrt tanh abs add add_any sub mul neg max min lt le gt ge eq ne and or not is_finite".split()
)
ENTRIES = 400  # of a result, which take as long as the call of an operation of NumPy
OF_JAX = 1000.0  # calls of NumPy's operations that take as long as that of one by JAX
MANY = 16  # windows of a gather or scatter, above which they are taken together


def by_numpy(function: Callable) -> Callable:
    """The function of trees of arrays, evaluated by NumPy; returns NumPy arrays."""

    @functools.wraps(function)
    def evaluated(*arguments):
        if any(isinstance(x, Tracer) for x in jax.tree.leaves(arguments)):
            return function(*arguments)
        program, shapes = _traced(function, *arguments)
        with np.errstate(all="ignore"):
            results = _evaluate(program, [np.asarray(x) for x in jax.tree.leaves(arguments)])
        return jax.tree.unflatten(jax.tree.structure(shapes), [np.array(x) for x in results])

    return evaluated


def each_by_numpy(function: Callable) -> Callable:
    """`by_numpy(jax.vmap(function))`, traced for one sample, which is half the work, and carried out for each."""

    @functools.wraps(function)
    def evaluated(*arguments):
        samples = [[np.asarray(x) for x in jax.tree.leaves(sample)] for sample in _samples(arguments)]
        program, shapes = _traced(function, *_samples(arguments)[0])
        with np.errstate(all="ignore"):
            results = zip(*(_evaluate(program, sample) for sample in samples), strict=True)
        return jax.tree.unflatten(jax.tree.structure(shapes), [np.stack(x) for x in results])

    return evaluated


def _traced(function: Callable, *arguments):
    """As a program of this package, and the shapes of its results."""
    keep_unbatched_calls()
    with options.own_program():
        return jax.make_jaxpr(function, return_shape=True)(*arguments)


def _samples(trees: tuple) -> list[tuple]:
    """The entries along axis 0 of all leaves."""
    count = len(jax.tree.leaves(trees)[0])
    return [jax.tree.map(lambda x: x[i], trees) for i in range(count)]


class TooLong(Exception):
    """An evaluation would take more operations than it was allowed."""


class Work:
    """Counts operations, each as one and a part by the size of its result; raises TooLong beyond `allowed`.

    `loop_of`: of the equation of an outermost loop, whose operations are not among these; None for loops that are
    like all other operations.
    """

    def __init__(self, allowed: float = math.inf, loop_of: Callable[[Any], "Loop"] | None = None):
        self.done, self.allowed, self.loop_of = 0.0, allowed, loop_of

    def add(self, operations: float) -> None:
        self.done += operations
        if self.done > self.allowed:
            raise TooLong


class Loop:
    """A loop that is compiled when NumPy has carried out `left` operations of it."""

    def __init__(self, equation, left: float):
        self.equation, self.left, self.program = equation, left, None

    def compiled(self, *parts) -> list:
        """Results of the loop, or of the rest of it."""
        if self.program is None:
            act = functools.partial(self.equation.primitive.bind, **self.equation.params)
            types = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in self.equation.invars]
            self.program = jax.jit(act).lower(*types).compile()
        given = [np.asarray(x, variable.aval.dtype) for x, variable in zip(parts, self.equation.invars, strict=True)]
        return self.program(*given)


_counted = threading.local()


@contextmanager
def counted(work: Work):
    """Count what this thread evaluates within the block."""
    before, _counted.work = getattr(_counted, "work", None), work
    try:
        yield
    finally:
        _counted.work = before


class Interpreted:
    """A closed jaxpr as a list of functions of NumPy arrays, each with the places of its arguments and results.

    `source`: what it was made of; while it lives no other program has its identity, the key of `_INTERPRETED`.
    """

    def __init__(self, program, source):
        jaxpr, self.source = program.jaxpr, source
        self.places: dict[Any, int] = {}
        self.first: list[Any] = []
        for variable, value in zip(jaxpr.constvars, program.consts, strict=True):
            self._place(variable, value if is_key(variable.aval) else np.asarray(value))
        self.inputs = [self._place(variable) for variable in jaxpr.invars]
        self.operations = [self._operation(equation) for equation in jaxpr.eqns]
        self.operations = [(act, _taking(places), *rest) for act, places, *rest in self.operations]
        self.outputs = [self._read(variable) for variable in jaxpr.outvars]
        sizes = sum(math.prod(x.aval.shape) for equation in jaxpr.eqns for x in equation.outvars)
        self.work = sizes / ENTRIES + sum(cost(equation.primitive.name) for equation in jaxpr.eqns)
        del self.places

    def _place(self, variable, value=None) -> int:
        self.places[variable] = len(self.first)
        self.first.append(value)
        return self.places[variable]

    def _read(self, variable) -> int:
        if isinstance(variable, Literal):
            self.first.append(np.asarray(variable.val))
            return len(self.first) - 1
        return self.places[variable]

    def _operation(self, equation):
        name, given = equation.primitive.name, [self._read(variable) for variable in equation.invars]
        results = [self._place(variable) for variable in equation.outvars]
        if name in ELEMENTWISE or name in REDUCED:
            act = ELEMENTWISE.get(name) or functools.partial(REDUCED[name], axis=tuple(equation.params.get("axes", ())))
            (dtype,) = [variable.aval.dtype for variable in equation.outvars]
            if name not in SAME_TYPE:
                return functools.partial(_typed, act, dtype), given, results[0], None
            return act, given, results[0], None
        if name in PREPARED:
            return PREPARED[name](equation), given, results[0], None
        types = [None if is_key(variable.aval) else variable.aval.dtype for variable in equation.outvars]
        return functools.partial(_apply, equation), given, results, types

    def __call__(self, given: Sequence[np.ndarray]) -> list[np.ndarray]:
        work = getattr(_counted, "work", None)
        if work is not None:
            work.add(self.work)
        values = self.first.copy()
        for place, value in zip(self.inputs, given, strict=True):
            values[place] = value
        for act, arguments_from, results, types in self.operations:
            found = act(*arguments_from(values))
            if types is None:
                values[results] = found
            else:
                for place, result, dtype in zip(results, found, types, strict=True):
                    values[place] = result if dtype is None else np.asarray(result, dtype)
        return [values[place] for place in self.outputs]


def _taking(places: list[int]) -> Callable[[list], Sequence]:
    """The fastest function that returns the entries of a list at these places."""
    if len(places) > 1:
        return operator.itemgetter(*places)
    first = places[0] if places else 0
    return operator.itemgetter(slice(first, first + len(places)))


def is_key(aval) -> bool:
    """Whether values of this kind are keys of random numbers, which NumPy does not know."""
    return jax.dtypes.issubdtype(aval.dtype, jax.dtypes.extended)


def has_rule(name: str) -> bool:
    """Whether NumPy carries out the operations of this name; if not, JAX does, one by one."""
    return name in RULES


def cost(name: str) -> float:
    """Of the call of an operation of this name."""
    return 1.0 if has_rule(name) else OF_JAX


def _typed(act, dtype, *parts):
    return np.asarray(act(*parts), dtype)


_INTERPRETED: dict[int, Interpreted] = {}


def interpreted(program) -> Interpreted:
    """The program, a closed jaxpr or one without constants, made ready once."""
    found = _INTERPRETED.get(id(program))
    if found is None:
        is_closed = hasattr(program, "consts") and hasattr(program, "jaxpr")
        closed = program if is_closed else ClosedJaxpr(program, ())
        found = _INTERPRETED[id(program)] = Interpreted(closed, program)
    return found


def without_idle(program: ClosedJaxpr) -> ClosedJaxpr:
    """The program without what its results do not depend on."""
    kept, _ = partial_eval.dce_jaxpr(program.jaxpr, [True] * len(program.jaxpr.outvars), instantiate=True)
    return ClosedJaxpr(kept, program.consts)


def forget_programs() -> None:
    """Free the memory of all programs that were made ready."""
    _INTERPRETED.clear()


def _evaluate(program, given: Sequence[np.ndarray]) -> list[np.ndarray]:
    return interpreted(program)(given)


def _apply(equation, *parts: np.ndarray) -> list:
    name, settings = equation.primitive.name, equation.params
    if name in CALLS:
        return _evaluate(settings.get("jaxpr", settings.get("call_jaxpr")), parts)
    if name in SPECIAL:
        return SPECIAL[name](equation, *parts)
    arrays = [part if is_key(part) else jax.numpy.asarray(part) for part in parts]
    results = equation.primitive.bind(*arrays, **settings)
    return results if equation.primitive.multiple_results else [results]


def _divided(equation):
    if np.issubdtype(equation.outvars[0].aval.dtype, np.floating):
        return np.divide
    return lambda a, b: np.trunc(a / b).astype(equation.outvars[0].aval.dtype)


def _broadcast(equation):
    shape, dtype = equation.params["shape"], equation.outvars[0].aval.dtype
    lengths = [1] * len(shape)
    for axis, length in zip(equation.params["broadcast_dimensions"], equation.invars[0].aval.shape, strict=True):
        lengths[axis] = length
    if math.prod(lengths) == math.prod(shape):
        return lambda x: x.reshape(shape)

    def spread(x):
        made = np.empty(shape, dtype)  # faster than a view by `np.broadcast_to`
        made[...] = x.reshape(lengths)
        return made

    return spread


def _slice(equation):
    settings = equation.params
    strides = settings["strides"] or (1,) * len(settings["start_indices"])
    limits = zip(settings["start_indices"], settings["limit_indices"], strides, strict=True)
    part = tuple(slice(*limit) for limit in limits)
    return lambda x: x[part]


def _tiled(equation):
    reps = equation.params["reps"]
    return lambda x: np.tile(x, reps)


def _reshaped(equation):
    shape = equation.outvars[0].aval.shape
    return lambda x: x.reshape(shape)


def _dot(equation):
    (a_summed, b_summed), (a_batch, b_batch) = equation.params["dimension_numbers"]
    a_shape, b_shape = (variable.aval.shape for variable in equation.invars)
    a_own = [i for i in range(len(a_shape)) if i not in (*a_summed, *a_batch)]
    b_own = [i for i in range(len(b_shape)) if i not in (*b_summed, *b_batch)]
    shape = equation.outvars[0].aval.shape
    batch, terms = (math.prod(a_shape[i] for i in axes) for axes in (a_batch, a_summed))
    rows, columns = math.prod(a_shape[i] for i in a_own), math.prod(b_shape[i] for i in b_own)
    first, second = [*a_batch, *a_own, *a_summed], [*b_batch, *b_summed, *b_own]

    def product(a, b):
        a = a.transpose(first).reshape(batch, rows, terms)
        b = b.transpose(second).reshape(batch, terms, columns)
        return (a @ b).reshape(shape)

    return product


def _transposed(equation):
    order = equation.params["permutation"]
    return lambda x: x.transpose(order)


def _joined(equation):
    axis = equation.params["dimension"]
    return lambda *parts: np.concatenate(parts, axis)


def _stacked(equation):
    axis, shape = equation.params["axis"], equation.outvars[0].aval.shape
    rows = (*shape[:axis], 1, *shape[axis + 1 :])
    return lambda *parts: np.concatenate([part.reshape(rows) for part in parts], axis)


def _reordered(equation):
    axis, order = equation.params["axis"], np.array(equation.params["order"], int)
    places = (slice(None),) * axis + (order,)
    return lambda x: x[places]


def _repeated(equation):
    counts, axis = equation.params["counts"], equation.params["axis"]
    places = (slice(None),) * axis + (np.repeat(np.arange(len(counts)), counts),)
    return lambda x: x[places]


def _groups_summed(equation):
    axis, ends = equation.params["axis"], np.cumsum(equation.params["counts"]).tolist()
    places = [(slice(None),) * axis + (slice(*limits),) for limits in zip([0, *ends], ends)]
    return lambda x: np.stack([np.add.reduce(x[place], axis=axis) for place in places], axis)


def _sum_of_products(equation):
    axes, result = equation.params["axes"], equation.params["result"]
    letters = {label: string.ascii_letters[i] for i, label in enumerate({x for part in axes for x in part})}
    shape = equation.outvars[0].aval.shape
    pairs = []
    for a, b in zip(axes[::2], axes[1::2]):
        there = [label in (*a, *b) for label in result]
        words = ("".join(letters[label] for label in labels) for labels in (a, b, itertools.compress(result, there)))
        lengths = None if all(there) else [n if is_one else 1 for n, is_one in zip(shape, there)]
        pairs.append(("{},{}->{}".format(*words), lengths))

    def total(*parts):
        found = None
        for (formula, lengths), a, b in zip(pairs, parts[::2], parts[1::2]):
            product = c_einsum(formula, a, b)
            product = product if lengths is None else product.reshape(lengths)
            found = product if found is None else found + product
        return found if found.shape == shape else np.broadcast_to(found, shape)

    return total


def _cross_product(equation):
    axis, following, last = equation.params["axis"], [1, 2, 0], [2, 0, 1]
    both, swapped = np.array(following + last), np.array(last + following)
    first, second = ((slice(None),) * axis + (half,) for half in (slice(0, 3), slice(3, 6)))

    def product(a, b):
        products = a.take(both, axis) * b.take(swapped, axis)
        return products[first] - products[second]

    def total(*parts):
        found = product(parts[0], parts[1])
        for a, b in zip(parts[2::2], parts[3::2]):
            found = found + product(a, b)
        return found

    return total


def _selected(equation):
    if equation.invars[0].aval.dtype == bool:
        return lambda which, no, yes: np.where(which, yes, no)
    return lambda which, *cases: np.choose(which, cases)


def _power(equation):
    is_float = np.issubdtype(equation.outvars[0].aval.dtype, np.floating)
    exponent = float(equation.params["y"]) if is_float else equation.params["y"]
    return np.square if exponent == 2 else lambda x: x**exponent


def _loop(turns: Callable) -> Callable:
    """The rule of a loop, from a generator of the operands with which it would go on after each turn, whose return
    value are the results."""

    @functools.wraps(turns)
    def rule(equation, *parts):
        work = getattr(_counted, "work", None)
        loop = None if work is None or work.loop_of is None else work.loop_of(equation)
        made, within = turns(equation, *parts), work if loop is None else Work(loop.left)
        try:
            with counted(within):
                while True:
                    parts = next(made)
        except StopIteration as end:
            return end.value
        except TooLong:
            if loop is None:
                raise
            return loop.compiled(*parts)
        finally:
            if loop is not None:
                loop.left -= within.done

    return rule


@_loop
def _while(equation, *parts):
    settings = equation.params
    first, second = settings["cond_nconsts"], settings["cond_nconsts"] + settings["body_nconsts"]
    of_condition, of_body, values = parts[:first], parts[first:second], list(parts[second:])

    def goes_on():
        with counted(Work()):  # a loop without a turn is not compiled
            return _evaluate(settings["cond_jaxpr"], [*of_condition, *values])[0]

    while (going := goes_on()).any():
        # Under vmap the condition may be one of each sample.
        results = _evaluate(settings["body_jaxpr"], [*of_body, *values])
        if going.ndim:
            pairs = zip(results, values, strict=True)
            results = [np.where(going.reshape(going.shape + (1,) * (x.ndim - going.ndim)), x, y) for x, y in pairs]
        values = results
        yield [*parts[:second], *values]
    return values


@_loop
def _scan(equation, *parts):
    settings = equation.params
    if "num_carry" in settings:
        first, carried = settings["num_consts"], settings["num_carry"]
    else:
        constants, carry, _ = settings["ft_in"].unpack()  # JAX 0.12
        first, carried = len(constants), len(carry)
    fixed, carry, rows = parts[:first], list(parts[first : first + carried]), parts[first + carried :]
    made = []
    yield parts
    turns = range(settings["length"])
    for i in reversed(turns) if settings["reverse"] else turns:
        results = _evaluate(settings["jaxpr"], [*fixed, *carry, *(x[i] for x in rows)])
        carry = results[:carried]
        made.append(results[carried:])
    made = made[::-1] if settings["reverse"] else made
    empty = [np.zeros(variable.aval.shape) for variable in equation.outvars[carried:]]
    return carry + ([np.stack(column) for column in zip(*made, strict=True)] if made else empty)


def _on_one_device(equation, *parts):
    if equation.params["mesh"].size != 1:
        raise NotImplementedError("NumPy has one device")
    return _evaluate(equation.params["jaxpr"], parts)


def _split(equation, x):
    stops = np.cumsum(equation.params["sizes"])[:-1]
    return np.split(x, stops, equation.params["axis"])


def _padded(equation, x, value):
    low, high, inner = np.array(equation.params["padding_config"]).T
    length = np.array(x.shape) + np.maximum(np.array(x.shape) - 1, 0) * inner
    before, after = np.maximum(low, 0), np.maximum(high, 0)
    padded = np.full(before + length + after, value)
    places = zip(before, length, inner, strict=True)
    padded[tuple(slice(a, a + n, i + 1) for a, n, i in places)] = x
    # Negative padding cuts off.
    kept = zip(before - low, before + length + np.minimum(high, 0) + after, strict=True)
    return [padded[tuple(slice(a, b) for a, b in kept)]]


def _starts(x, size, starts):
    return [int(np.clip(start, 0, n - s)) for start, n, s in zip(starts, x.shape, size, strict=True)]


def _dynamic_slice(equation, x, *starts):
    size = equation.params["slice_sizes"]
    return [x[tuple(slice(a, a + s) for a, s in zip(_starts(x, size, starts), size, strict=True))]]


def _dynamic_update_slice(_, x, update, *starts):
    changed = x.copy()
    places = zip(_starts(x, update.shape, starts), update.shape, strict=True)
    changed[tuple(slice(a, a + s) for a, s in places)] = update
    return [changed]


def _windows(numbers, batch, inserted, indices, shape, size):
    """Indices of an operand of the given shape for every place of `indices`, and the place; None where a window of the
    given size is not within the operand."""
    settings = (tuple(part) for part in (numbers, batch, inserted, shape, size))
    return _windows_at(*settings, indices.tobytes(), indices.dtype, indices.shape)


@functools.lru_cache(maxsize=4096)
def _windows_at(numbers, batch, inserted, shape, size, content, dtype, extent) -> list:
    """`_windows` for indices by their content: nearly always constants."""
    return list(_windows_of(numbers, batch, inserted, np.frombuffer(content, dtype).reshape(extent), shape, size))


def _windows_of(numbers, batch, inserted, indices, shape, size):
    for place in np.ndindex(*indices.shape[:-1]):
        start = np.zeros(len(shape), int)
        start[list(numbers)] = indices[place]
        for axis, other in zip(*batch, strict=True):
            start[axis] = place[other]
        inside = (start >= 0).all() and (start + size <= shape).all()
        ends = zip(start, size, strict=True)
        window = tuple(int(a) if i in inserted else slice(int(a), int(a + s)) for i, (a, s) in enumerate(ends))
        yield place, window if inside else None


def _clipped(indices, numbers, shape, size):
    """Starts of windows that are within an operand."""
    last = np.array(shape) - np.array(size)
    return np.clip(indices, 0, last[list(numbers)])


def _entries_of(numbers, batch, inserted, indices, shape, size):
    """Indices of the entries of all windows, which are the first axes, then those within a window; and which windows
    are within the operand: as `_windows`, for many."""
    places = indices.shape[:-1]
    starts = np.zeros((*places, len(shape)), int)
    starts[..., list(numbers)] = indices
    for axis, other in zip(*batch, strict=True):
        starts[..., axis] = np.arange(places[other]).reshape([-1 if i == other else 1 for i in range(len(places))])
    inside = ((starts >= 0) & (starts + np.array(size) <= np.array(shape))).all(-1)
    starts = np.where(inside[..., None], starts, 0)
    kept = [axis for axis in range(len(shape)) if axis not in inserted]
    entries = []
    for axis in range(len(shape)):
        index = starts[..., axis].reshape(places + (1,) * len(kept))
        if axis in kept:
            index = index + np.arange(size[axis]).reshape([-1 if other == axis else 1 for other in kept])
        entries.append(index)
    return tuple(entries), inside


def _gather(equation, operand, indices):
    settings = equation.params
    numbers, size = settings["dimension_numbers"], settings["slice_sizes"]
    if settings["mode"] is None or "CLIP" in str(settings["mode"]):
        indices = _clipped(indices, numbers.start_index_map, operand.shape, size)
    gone = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    places = indices.shape[:-1]
    fill = settings["fill_value"]
    taken = np.full((*places, *(n for i, n in enumerate(size) if i not in gone)), np.nan if fill is None else fill)
    taken = taken.astype(operand.dtype) if operand.dtype.kind == "f" else np.zeros(taken.shape, operand.dtype)
    batch = numbers.operand_batching_dims, numbers.start_indices_batching_dims
    if math.prod(places) > MANY:
        entries, inside = _entries_of(numbers.start_index_map, batch, gone, indices, operand.shape, size)
        assert inside.all() or operand.dtype.kind == "f"
        taken[inside] = operand[entries][inside]
    else:
        for place, window in _windows(numbers.start_index_map, batch, gone, indices, operand.shape, size):
            assert window is not None or operand.dtype.kind == "f"
            if window is not None:
                taken[place] = operand[window]
    return [np.moveaxis(taken, range(len(places), taken.ndim), numbers.offset_dims)]


def _scatter(equation, operand, indices, updates, combine=None):
    numbers, changed = equation.params["dimension_numbers"], operand.copy()
    batch = numbers.operand_batching_dims, numbers.scatter_indices_batching_dims
    gone = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    own = iter(numbers.update_window_dims)
    size = [1 if i in gone else updates.shape[next(own)] for i in range(operand.ndim)]
    updates = np.moveaxis(updates, numbers.update_window_dims, range(indices.ndim - 1, updates.ndim))
    if "CLIP" in str(equation.params["mode"]):
        indices = _clipped(indices, numbers.scatter_dims_to_operand_dims, operand.shape, size)
    if math.prod(indices.shape[:-1]) > MANY:
        entries, inside = _entries_of(numbers.scatter_dims_to_operand_dims, batch, gone, indices, operand.shape, size)
        entries = tuple(np.broadcast_to(entry, updates.shape)[inside] for entry in entries)
        if combine is None:
            changed[entries] = updates[inside]
        else:
            combine.at(changed, entries, updates[inside])
        return [changed]
    targets = _windows(numbers.scatter_dims_to_operand_dims, batch, gone, indices, operand.shape, size)
    for place, window in targets:
        if window is not None:
            changed[window] = updates[place] if combine is None else combine(changed[window], updates[place])
    return [changed]


def _linear_solve(equation, *parts):
    """`custom_linear_solve` by its own solver."""
    settings = equation.params
    sizes = settings["const_lengths"]
    solve = sum(getattr(sizes, name) for name in ("matvec", "vecmat"))
    constants, rest = parts[solve : solve + sizes.solve], parts[solve + sizes.solve + sizes.transpose_solve :]
    return _evaluate(settings["jaxprs"].solve, [*constants, *rest])


def _sorted(equation, *parts):
    """All operands in the order of the first ones."""
    settings = equation.params
    axis = settings["dimension"]
    order = np.lexsort(parts[: settings["num_keys"]][::-1], axis)
    return [np.take_along_axis(part, order, axis) for part in parts]


def _triangular_solve(equation, a, b):
    settings = equation.params
    if not settings["left_side"]:
        a, b = np.swapaxes(a, -1, -2), np.swapaxes(b, -1, -2)
    rules = {
        "lower": settings["lower"] == settings["left_side"],
        "trans": int(settings["transpose_a"]),
        "unit_diagonal": settings["unit_diagonal"],
        "check_finite": False,
    }
    found = np.empty_like(b)
    for place in np.ndindex(b.shape[:-2]):
        try:
            found[place] = scipy.linalg.solve_triangular(a[place], b[place], **rules)
        except np.linalg.LinAlgError:  # JAX divides by zero
            found[place] = np.nan
    return [found if settings["left_side"] else np.swapaxes(found, -1, -2)]


def _lu(equation, x):
    """Factors, pivots and the permutation of rows that they stand for."""
    factors, pivots, permutation = (np.empty(variable.aval.shape, variable.aval.dtype) for variable in equation.outvars)
    for place in np.ndindex(x.shape[:-2]):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)  # JAX does not tell of singular matrices
            factors[place], pivots[place] = scipy.linalg.lu_factor(x[place], check_finite=False)
        order = np.arange(x.shape[-2])
        for row, other in enumerate(pivots[place]):
            order[[row, other]] = order[[other, row]]
        permutation[place] = order
    return [factors, pivots, permutation]


def _eigenvectors(equation, x):
    finite = np.all(np.isfinite(x), axis=(-2, -1))  # JAX gives NaN of others, and NumPy raises
    whole = np.where(finite[..., None, None], x, 0.0)
    values, vectors = np.linalg.eigh(whole, "L" if equation.params["lower"] else "U")
    return [np.where(finite[..., None, None], vectors, np.nan), np.where(finite[..., None], values, np.nan)]


def _summed_up(equation):
    axis, reverse = equation.params["axis"], equation.params["reverse"]
    if reverse:
        return lambda x: np.flip(np.cumsum(np.flip(x, axis), axis), axis)
    return lambda x: np.cumsum(x, axis)


def _unstack(equation, x):
    return list(np.moveaxis(x, equation.params["axis"], 0))


def _iota(equation):
    settings = equation.params
    shape, axis = settings["shape"], settings["dimension"]
    numbers = np.arange(shape[axis]).reshape([-1 if i == axis else 1 for i in range(len(shape))])
    return [np.broadcast_to(numbers, shape)]


SPECIAL: dict[str, Callable] = {
    "argmax": lambda e, x: [np.argmax(x, *e.params["axes"])],
    "argmin": lambda e, x: [np.argmin(x, *e.params["axes"])],
    "cond": lambda e, which, *parts: _evaluate(e.params["branches"][int(which)], list(parts)),
    "custom_linear_solve": _linear_solve,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "eigh": _eigenvectors,
    "empty2": lambda e: [np.zeros(variable.aval.shape, variable.aval.dtype) for variable in e.outvars],
    "gather": _gather,
    "iota": _iota,
    "lu": _lu,
    "optimization_barrier": lambda _, *parts: list(parts),
    "pad": _padded,
    "reshard": lambda _, x: [x],
    "rev": lambda e, x: [np.flip(x, e.params["dimensions"])],
    "scan": _scan,
    "shard_map": _on_one_device,
    "scatter": _scatter,
    "scatter-add": lambda e, *parts: _scatter(e, *parts, combine=np.add),
    "scatter_add": lambda e, *parts: _scatter(e, *parts, combine=np.add),
    "sort": _sorted,
    "split": _split,
    "triangular_solve": _triangular_solve,
    "unstack": _unstack,
    "while": _while,
}
# Made ready once for an equation; of one result.
PREPARED: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": _joined,
    "cross_product": _cross_product,
    "cumsum": _summed_up,
    "div": _divided,
    "dot_general": _dot,
    "expand_dims": _reshaped,
    "integer_pow": _power,
    "reorder": _reordered,
    "repeat_rows": _repeated,
    "reshape": _reshaped,
    "select_n": _selected,
    "slice": _slice,
    "squeeze": _reshaped,
    "stack": _stacked,
    "sum_of_products": _sum_of_products,
    "sum_row_groups": _groups_summed,
    "tile": _tiled,
    "transpose": _transposed,
}
SIMPLE = frozenset([*ELEMENTWISE, *REDUCED, *PREPARED])  # one function of NumPy, of one result
RULES = SIMPLE.union(CALLS, SPECIAL)
