"""Scalarised jaxprs: a function of small arrays, traced as operations on their entries.

Place in the pipeline: simulation wraps its innermost functions in `scalarised`.

XLA compiles an operation on an array as a loop.  The arrays of a mechanism have three rows, so most of the time goes
into the overhead of loops, slices and concatenations.  The scalarised jaxpr of a function is a list of additions and
multiplications of scalars: slices disappear, and so do products with entries known to be zero; under vmap every
operation is one over the samples.  This pays where XLA compiles loops over steps as one kernel (`options`), and up to
some ten thousand operations, since the time of compilation grows with their number.

Here an array is an object array of NumPy whose entries are numbers, where they are known, and JAX scalars.
"""

import functools
import math
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Literal
from jaxtyping import PyTree

from rfem_jax.compilation.options import note_scalarised

Tree = TypeVar("Tree")
MOST_OPERATIONS = 65_000
UNROLLED = 64  # iterations of a scan over rows

# Primitives whose results have one entry from one entry of each operand.
ELEMENTWISE = frozenset(
    (
        "sin cos tan asin acos atan atan2 exp exp2 log log1p expm1 sqrt rsqrt cbrt tanh sinh cosh abs max min "
        "sign floor ceil round is_finite pow rem clamp lt le gt ge eq ne and or not xor nextafter "
        "convert_element_type name optimization_barrier"
    ).split()
)
# Those that are carried out on numbers without rounding: a program for each would wait for those that are being
# compiled in the background.
BY_NUMPY: dict[str, Callable] = {
    "convert_element_type": np.asarray, "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "eq": np.equal, "ne": np.not_equal, "and": np.bitwise_and, "or": np.bitwise_or, "not": np.invert, "abs": np.abs,
    "sign": np.sign, "max": np.maximum, "min": np.minimum, "name": np.asarray,
}  # fmt: skip
CALLS = frozenset(["jit", "pjit", "closed_call", "checkpoint", "remat", "remat2", "custom_jvp_call", "custom_vjp_call"])
# Primitives that only move entries, and how many of their operands hold entries; the others are indices.
MOVING = {"gather": 1, "dynamic_slice": 1, "dynamic_update_slice": 2, "pad": 2, "split": 1, "scatter": 2}


def scalarised(
    function: Callable[..., Tree], zeros: tuple | None = None, most: int = MOST_OPERATIONS
) -> Callable[..., Tree]:
    """The function, with a scalarised jaxpr.

    **Arguments:** `zeros`: trees like the arguments, of boolean arrays that say which entries are known to be zero, or
    of False (None: none is known); `most`: a function of more scalar operations is left as it is.

    **Returns:** a function of the same arguments.  Custom rules of differentiation inside of it are lost: give the
    result a rule of its own where they matter.
    """

    def evaluated(*arguments):
        given, tree = jax.tree.flatten(arguments)
        like = [jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in given]
        program, shapes = jax.make_jaxpr(
            lambda *leaves: function(*jax.tree.unflatten(tree, leaves)), return_shape=True
        )(*like)
        if operations(program) > most:
            return function(*arguments)
        note_scalarised()
        entries = [_entries(x) for x in given]
        if zeros is not None:
            known = jax.tree.leaves(zeros)
            entries = [np.where(z, x.dtype.type(0), e) for z, x, e in zip(known, like, entries, strict=True)]
        results = _evaluate(program, entries)
        arrays = [_array(x, v.aval.dtype) for x, v in zip(results, program.jaxpr.outvars)]
        return jax.tree.unflatten(jax.tree.structure(shapes), arrays)

    return evaluated


def nothing_known(tree: PyTree) -> PyTree:
    """The tree with False for its arrays: `zeros` of an argument of which no entry is known to be zero."""
    return jax.tree.map(lambda _: False, tree)


def operations(program: ClosedJaxpr) -> int:
    """Number of scalar operations of a jaxpr, with the body of every loop once."""
    count = 0
    for equation in program.jaxpr.eqns:
        name, settings = equation.primitive.name, equation.params
        inner = [x for x in jax.tree.leaves(list(settings.values()), is_leaf=_is_program) if _is_program(x)]
        rows = settings["length"] if name == "scan" and len(equation.outvars) > _counts(settings)[1] else 1
        count += rows * sum(operations(x) for x in inner)
        if name == "sum_of_products":
            sizes = {l: n for labels, x in zip(settings["axes"], equation.invars) for l, n in zip(labels, x.aval.shape)}
            count += len(equation.invars) * math.prod(sizes.values())
        elif name == "cross_product":
            count += (2 * len(equation.invars) - 1) * math.prod(equation.outvars[0].aval.shape)
        elif name in ARITHMETIC or name in ELEMENTWISE or name in SPECIAL_ARITHMETIC:
            size = math.prod(equation.outvars[0].aval.shape)
            if name == "dot_general":
                (summed, _), _ = settings["dimension_numbers"]
                size *= 2 * math.prod(equation.invars[0].aval.shape[i] for i in summed)
            count += size
        elif name in REDUCED:
            count += math.prod(equation.invars[0].aval.shape)
    return count


def _is_program(x) -> bool:
    return isinstance(x, ClosedJaxpr)


def _of_shape(scalars, shape) -> np.ndarray:
    """An object array, filled one by one: NumPy would try to convert a list of JAX scalars."""
    values = np.empty(math.prod(shape), object)
    for i, scalar in enumerate(scalars):
        values[i] = scalar
    return values.reshape(shape)


def _whole(values) -> np.ndarray:
    """An object array also of one entry, which is what NumPy returns in place of an array without axes."""
    if isinstance(values, np.ndarray) and values.dtype == object:
        return values
    return _of_shape([values], ())


def _entries(array) -> np.ndarray:
    """Entries of an array: numbers if it is concrete, JAX scalars if it is traced."""
    if not isinstance(array, Tracer):
        array = np.asarray(array)
    places = np.ndindex(*array.shape)
    return _of_shape([array[place] for place in places], array.shape)


def _array(values: np.ndarray, dtype) -> Array:
    if all(_known(x) for x in values.flat):
        return jnp.asarray(np.array(values.tolist(), dtype).reshape(values.shape))
    rows = [jnp.asarray(x, dtype)[None] for x in values.flat]
    return jnp.concatenate(rows).reshape(values.shape)


def _known(x) -> bool:
    """Whether an entry is a number, not a JAX scalar."""
    return isinstance(x, (bool, int, float, np.generic))


def _add(a, b):
    if _known(a) and _known(b):
        return a + b
    if _known(a) and a == 0:
        return b
    if _known(b) and b == 0:
        return a
    return lax.add(*_alike(a, b))


def _subtract(a, b):
    if _known(a) and a == 0:
        return _negative(b)
    if _known(b):
        return _add(a, -b)
    return lax.sub(*_alike(a, b))


def _multiply(a, b):
    if _known(b):
        a, b = b, a
    if not _known(a):
        return lax.mul(a, b)
    if _known(b):
        return a * b
    if a == 0:
        return a
    if a == 1:
        return b
    return _negative(b) if a == -1 else lax.mul(*_alike(a, b))


def _negative(a):
    return -a if _known(a) else lax.neg(a)


def _alike(a, b):
    return (jnp.asarray(a, b.dtype), b) if _known(a) else (a, jnp.asarray(b, a.dtype))


def _larger(a, b):
    return max(a, b) if _known(a) and _known(b) else lax.max(*_alike(a, b))


def _smaller(a, b):
    return min(a, b) if _known(a) and _known(b) else lax.min(*_alike(a, b))


ARITHMETIC = {"add": _add, "add_any": _add, "sub": _subtract, "mul": _multiply, "neg": _negative}
REDUCED = {"reduce_sum": (_add, 0.0), "reduce_max": (_larger, -np.inf), "reduce_min": (_smaller, np.inf)}


def _each(function, parts) -> np.ndarray:
    """A function of scalars applied entry by entry; arrays without axes are broadcast."""
    shape = np.broadcast_shapes(*(x.shape for x in parts))
    return _of_shape(map(function, *(np.broadcast_to(x, shape).flat for x in parts)), shape)


def _evaluate(program: ClosedJaxpr, given) -> list[np.ndarray]:
    """Results of a jaxpr of arrays for given object arrays."""
    jaxpr = program.jaxpr
    values = dict(zip(jaxpr.constvars, map(_entries, program.consts))) | dict(zip(jaxpr.invars, given))

    def read(variable):
        return _entries(variable.val) if isinstance(variable, Literal) else values[variable]

    for equation in jaxpr.eqns:
        results = _apply(equation, [read(variable) for variable in equation.invars])
        values.update(zip(equation.outvars, map(_whole, results)))
    return [read(variable) for variable in jaxpr.outvars]


def _apply(equation, parts) -> list[np.ndarray]:
    """Results of one equation of a jaxpr."""
    name, settings = equation.primitive.name, equation.params
    if name in ARITHMETIC:
        return [_each(ARITHMETIC[name], parts)]
    if name in SPECIAL:
        return SPECIAL[name](equation, *parts)
    if name in REDUCED:
        return [_reduced(*REDUCED[name], parts[0], settings["axes"])]
    if name in ELEMENTWISE:
        return [_each(functools.partial(_bound, equation), parts)]
    if name in CALLS:
        inner = settings.get("jaxpr", settings.get("call_jaxpr"))
        return _evaluate(inner if _is_program(inner) else ClosedJaxpr(inner, ()), parts)
    if name in MOVING and all(_known(x) for part in parts[MOVING[name] :] for x in part.flat):
        return _moved(equation, parts, MOVING[name])
    return _by_arrays(equation, parts)


def _bind(equation, arguments):
    results = equation.primitive.bind(*arguments, **equation.params)
    return results if equation.primitive.multiple_results else [results]


def _bound(equation, *scalars):
    """A primitive applied to one entry of each operand; a number, if all of these are."""
    dtypes = [variable.aval.dtype for variable in equation.invars]
    if all(map(_known, scalars)):
        exact = BY_NUMPY.get(equation.primitive.name)
        if exact is not None:
            result = exact(*(np.asarray(x, dtype) for x, dtype in zip(scalars, dtypes)))
            return np.asarray(result, equation.outvars[0].aval.dtype)[()]
        with jax.ensure_compile_time_eval():
            arguments = [jnp.asarray(x, dtype) for x, dtype in zip(scalars, dtypes)]
            return np.asarray(_bind(equation, arguments)[0])[()]
    return _bind(equation, [jnp.asarray(x, dtype) for x, dtype in zip(scalars, dtypes)])[0]


def _by_arrays(equation, parts):
    """An equation that is not scalarised."""
    arguments = [_array(x, variable.aval.dtype) for x, variable in zip(parts, equation.invars)]
    return [_entries(x) for x in _bind(equation, arguments)]


def _moved(equation, parts, count: int):
    """A primitive that moves entries, carried out on their indices."""
    operands = list(zip(parts, equation.invars))
    if equation.primitive.name == "scatter":
        operands[1], operands[2] = operands[2], operands[1]
    moved = [part for part, _ in operands[:count]]
    entries = np.concatenate([part.ravel() for part in moved])
    sizes = np.cumsum([part.size for part in moved])[:-1]
    numbers = [x.reshape(part.shape) for x, part in zip(np.split(np.arange(entries.size), sizes), moved)]
    numbers += [np.array(part.tolist(), variable.aval.dtype) for part, variable in operands[count:]]
    if equation.primitive.name == "scatter":
        numbers[1], numbers[2] = numbers[2], numbers[1]
    if equation.primitive.name == "gather":
        found = _gathered(*numbers, **equation.params)
        return _by_arrays(equation, parts) if found is None else [entries[found]]
    with jax.ensure_compile_time_eval():
        results = [np.asarray(x) for x in _bind(equation, [jnp.asarray(x) for x in numbers])]
    return [entries[x] for x in results]


def _gathered(operand, indices, *, dimension_numbers, slice_sizes, **_) -> np.ndarray | None:
    """`lax.gather` in NumPy, which compiles nothing; None for windows that are not within the operand."""
    numbers, places = dimension_numbers, indices.shape[:-1]
    taken = np.empty((*places, *slice_sizes), operand.dtype)
    for place in np.ndindex(*places):
        start = np.zeros(operand.ndim, int)
        start[list(numbers.start_index_map)] = indices[place]
        for axis, batch in zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims):
            start[axis] = place[batch]
        if (start < 0).any() or (start + slice_sizes > operand.shape).any():
            return None
        taken[place] = operand[tuple(slice(a, a + size) for a, size in zip(start, slice_sizes))]
    gone = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    taken = taken.reshape(*places, *(size for axis, size in enumerate(slice_sizes) if axis not in gone))
    return np.moveaxis(taken, range(len(places), taken.ndim), numbers.offset_dims)


def _reduced(function, nothing, values, axes):
    values = np.moveaxis(values, axes, range(len(axes)))
    kept = values.shape[len(axes) :]
    terms = [_whole(values[place]) for place in np.ndindex(*values.shape[: len(axes)])]
    if not terms:
        return _of_shape([nothing] * math.prod(kept), kept)
    return _each(lambda *terms: functools.reduce(function, terms), terms)


def _groups_summed(equation, x):
    counts, axis = equation.params["counts"], equation.params["axis"]
    parts = np.split(x, np.cumsum(counts)[:-1], axis)
    return [np.stack([_reduced(_add, 0.0, part, (axis,)) for part in parts], axis)]


def _broadcast(equation, x):
    shape, axes = equation.params["shape"], equation.params["broadcast_dimensions"]
    lengths = [1] * len(shape)
    for axis, length in zip(axes, x.shape):
        lengths[axis] = length
    return [np.broadcast_to(x.reshape(lengths), shape)]


def _slice(equation, x):
    settings = equation.params
    strides = settings["strides"] or (1,) * x.ndim
    limits = zip(settings["start_indices"], settings["limit_indices"], strides)
    return [x[tuple(slice(*limit) for limit in limits)]]


def _dot(equation, a, b):
    (a_summed, b_summed), (a_batch, b_batch) = equation.params["dimension_numbers"]
    a_own = [i for i in range(a.ndim) if i not in (*a_summed, *a_batch)]
    b_own = [i for i in range(b.ndim) if i not in (*b_summed, *b_batch)]
    batch, terms = (math.prod(a.shape[i] for i in axes) for axes in (a_batch, a_summed))
    rows, columns = (math.prod(x.shape[i] for i in own) for x, own in ((a, a_own), (b, b_own)))
    shape = [a.shape[i] for i in (*a_batch, *a_own)] + [b.shape[i] for i in b_own]
    a = a.transpose([*a_batch, *a_own, *a_summed]).reshape(batch, rows, terms)
    b = b.transpose([*b_batch, *b_own, *b_summed]).reshape(batch, columns, terms)
    sums = (
        functools.reduce(_add, map(_multiply, a[i, j], b[i, k]), 0.0) for i, j, k in np.ndindex(batch, rows, columns)
    )
    return [_of_shape(sums, shape)]


def _products_summed(equation, *parts):
    """Of products in all their axes, those of the result first, the sums over the others."""
    axes, result = equation.params["axes"], equation.params["result"]
    order = [*result, *sorted({label for labels in axes for label in labels} - {*result})]
    spread = []
    for labels, part in zip(axes, parts):
        places = [order.index(label) for label in labels]
        missing = tuple(place for place in range(len(order)) if place not in places)
        spread.append(np.expand_dims(part.transpose(np.argsort(places)), missing))
    terms = [_each(_multiply, pair) for pair in zip(spread[::2], spread[1::2])]
    total = _each(lambda *terms: functools.reduce(_add, terms), terms)
    return [_reduced(_add, 0.0, total, tuple(range(len(result), total.ndim)))]


def _crossed(equation, *parts):
    axis = equation.params["axis"]
    forth, back = [], []
    for a, b in zip(parts[::2], parts[1::2]):
        forth.append(_each(_multiply, [a, np.take(b, [1, 2, 0], axis)]))
        back.append(_each(_multiply, [np.take(a, [1, 2, 0], axis), b]))
    sums = [_each(lambda *terms: functools.reduce(_add, terms), terms) for terms in (forth, back)]
    return [np.take(_each(_subtract, sums), [1, 2, 0], axis)]


def _divided(equation, a, b):
    def quotient(a, b):
        if (_known(b) and b == 1) or (_known(a) and a == 0 and not _known(b)):
            return a
        return _bound(equation, a, b)

    return [_each(quotient, [a, b])]


def _power(equation, x):
    exponent = equation.params["y"]
    return [_each(lambda a: a**exponent if _known(a) else lax.integer_pow(a, exponent), [x])]


def _select(equation, which, *cases):
    dtype = equation.outvars[0].aval.dtype

    def chosen(which, *cases):
        if _known(which):
            return cases[int(which)]
        return lax.select_n(which, *(jnp.asarray(x, dtype) for x in cases))

    return [_each(chosen, [which, *cases])]


def _scalars(parts, variables) -> list[Array]:
    """Operands of a loop or a branch as a list of scalars."""
    pairs = zip(parts, variables)
    return [jnp.asarray(x, variable.aval.dtype) for part, variable in pairs for x in part.flat]


def _shaped(scalars, variables) -> list[np.ndarray]:
    """The inverse of `_scalars`."""
    scalars = iter(scalars)
    shapes = [variable.aval.shape for variable in variables]
    return [_of_shape([next(scalars) for _ in range(math.prod(x))], x) for x in shapes]


def _while(equation, *parts):
    settings, variables = equation.params, equation.outvars
    first, second = settings["cond_nconsts"], settings["cond_nconsts"] + settings["body_nconsts"]
    of_condition, of_body, start = parts[:first], parts[first:second], parts[second:]

    def goes_on(scalars):
        result = _evaluate(settings["cond_jaxpr"], [*of_condition, *_shaped(scalars, variables)])
        return jnp.asarray(result[0][()])

    def again(scalars):
        results = _evaluate(settings["body_jaxpr"], [*of_body, *_shaped(scalars, variables)])
        return _scalars(results, variables)

    return _shaped(lax.while_loop(goes_on, again, _scalars(start, variables)), variables)


def _counts(settings) -> tuple[int, int]:
    """How many operands of a scan are constants and how many are carried; JAX 0.12 keeps them as trees."""
    if "num_carry" in settings:
        return settings["num_consts"], settings["num_carry"]
    constants, carry, _ = settings["ft_in"].unpack()
    return len(constants), len(carry)


def _scan(equation, *parts):
    settings, variables = equation.params, equation.outvars
    first, carried = _counts(settings)
    second = first + carried
    fixed, carry, rows = parts[:first], list(parts[first:second]), parts[second:]
    body, length = settings["jaxpr"], settings["length"]
    if not rows and len(variables) == carried:

        def again(scalars, _):
            return _scalars(_evaluate(body, [*fixed, *_shaped(scalars, variables)]), variables), None

        scalars, _ = lax.scan(again, _scalars(carry, variables), None, length=length)
        return _shaped(scalars, variables)
    if length > UNROLLED:
        return _by_arrays(equation, parts)
    made = []
    for i in reversed(range(length)) if settings["reverse"] else range(length):
        results = _evaluate(body, [*fixed, *carry, *(_whole(x[i]) for x in rows)])
        carry = results[:carried]
        made.append(results[carried:])
    made = made[::-1] if settings["reverse"] else made
    return carry + [np.stack(column) for column in zip(*made)]


def _branches(equation, which, *parts):
    branches, variables, operands = equation.params["branches"], equation.outvars, equation.invars[1:]
    if _known(which[()]):
        return _evaluate(branches[int(which[()])], list(parts))

    def branch(program):
        return lambda scalars: _scalars(_evaluate(program, _shaped(scalars, operands)), variables)

    scalars = lax.switch(which[()], [branch(x) for x in branches], _scalars(parts, operands))
    return _shaped(scalars, variables)


SPECIAL = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda e, *parts: [np.concatenate(parts, e.params["dimension"])],
    "cond": _branches,
    "copy": lambda _, x: [x],
    "cross_product": _crossed,
    "div": _divided,
    "dot_general": _dot,
    "expand_dims": lambda e, x: [np.expand_dims(x, e.params["dimensions"])],
    "integer_pow": _power,
    "reorder": lambda e, x: [np.take(x, e.params["order"], e.params["axis"])],
    "repeat_rows": lambda e, x: [np.repeat(x, e.params["counts"], e.params["axis"])],
    "reshape": lambda e, x: [x.reshape(e.params["new_sizes"])],
    "rev": lambda e, x: [np.flip(x, e.params["dimensions"])],
    "scan": _scan,
    "select_n": _select,
    "slice": _slice,
    "square": lambda _, x: [_each(_multiply, [x, x])],
    "squeeze": lambda e, x: [np.squeeze(x, e.params["dimensions"])],
    "stack": lambda e, *parts: [np.stack(parts, e.params["axis"])],
    "sum_of_products": _products_summed,
    "sum_row_groups": _groups_summed,
    "stop_gradient": lambda _, x: [_each(lambda a: a if _known(a) else lax.stop_gradient(a), [x])],
    "transpose": lambda e, x: [x.transpose(e.params["permutation"])],
    "while": _while,
}
SPECIAL_ARITHMETIC = frozenset(("div", "dot_general", "integer_pow", "select_n", "square"))
