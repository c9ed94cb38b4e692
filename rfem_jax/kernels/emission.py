"""A jaxpr as operations on the entries of its arrays.

Place in the pipeline: arithmetic, vector_math, loops -> **emission** -> programs.

Operations that only
move entries (slices, transposes, gathers at known places) cost nothing: they are carried out on the object arrays.
Loops and branches are in `loops`.
"""

import functools
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any, SupportsIndex, cast

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal

from rfem_jax.kernels import loops, vector_math
from rfem_jax.kernels.arithmetic import Arithmetic, common_kind
from rfem_jax.kernels.builder import Builder, Entry, Unsupported, is_known
from rfem_jax.kernels.entries import (
    Entries,
    each,
    entries_of,
    is_program,
    needed,
    of_shape,
    shape_of,
    whole,
)
from rfem_jax.kernels.long_arrays import each_in_a_loop, is_long, products_in_a_loop, reduced_in_a_loop
from rfem_jax.kernels.memory import Array, Location, entries_in
from rfem_jax.kernels.places import Places

# Primitives whose operation on arrays is that on entries.
SIMPLE = {
    "add": "add", "add_any": "add", "sub": "subtract", "neg": "negative", "mul": "multiply", "div": "divide",
}  # fmt: skip
ELEMENTWISE = frozenset(
    (
        "sin cos tan asin acos atan atan2 exp exp2 log sqrt rsqrt tanh sinh cosh abs max min sign floor ceil "
        "is_finite pow rem clamp lt le gt ge eq ne and or xor not square "
        "shift_left shift_right_logical shift_right_arithmetic lt_to le_to "
        "logistic log1p expm1"
    ).split()
)
CALLS = frozenset(["jit", "pjit", "closed_call", "checkpoint", "remat", "remat2", "custom_jvp_call", "custom_vjp_call"])
SAME = frozenset(
    ["copy", "copy_p", "stop_gradient", "optimization_barrier", "name", "reduce_precision", "reshard", "pvary", "pcast"]
)
# Rules that hand their operands on to a jaxpr, and those that only move the entries of a single one.
HANDED_ON = frozenset(["kernel", "custom_linear_solve", "while", "scan", "cond"])
MOVED = frozenset(
    ["broadcast_in_dim", "expand_dims", "reshape", "rev", "slice", "split", "squeeze", "tile", "transpose"]
)

# Primitives of others, by functions of JAX's own primitives.
_EXPANSIONS: dict[str, Callable] = {}
MOST_EXPANSIONS = 1000  # that are remembered


def expand_primitive(name: str, function: Callable) -> None:
    """Say what a primitive is made of, where its implementation is not of primitives of JAX that have machine code.

    **Arguments:** `name` of the primitive; `function` of its operands and settings, that uses primitives of JAX.
    """
    _EXPANSIONS[name] = function


@functools.lru_cache(maxsize=MOST_EXPANSIONS)
def _traced(function: Callable, settings: tuple[tuple[str, Any], ...], like: tuple) -> ClosedJaxpr:
    """The jaxpr of a function with settings, for operands of given shapes and types: the same few come thousands of
    times."""
    operands = (jax.ShapeDtypeStruct(*one) for one in like)
    return jax.make_jaxpr(lambda *operands: function(*operands, **dict(settings)))(*operands)


def expansion_of(equation: JaxprEqn) -> ClosedJaxpr:
    """What an equation's primitive was said to be made of, or its implementation.

    **Raises:** `Unsupported` if it has none that can be traced.
    """
    primitive, operands = equation.primitive, cast(list[Any], equation.invars)
    like = tuple((x.aval.shape, x.aval.dtype) for x in operands)
    function, settings = _EXPANSIONS.get(primitive.name, primitive.impl), tuple(equation.params.items())
    traced = _traced if all(isinstance(x, Hashable) for _, x in settings) else _traced.__wrapped__
    try:
        return traced(function, settings, like)
    except Exception as reason:  # it is of numbers, not of arrays that are traced
        raise Unsupported(primitive.name) from reason


def called_program(settings: dict[str, Any]) -> ClosedJaxpr:
    """The jaxpr of a call."""
    inner: Any = settings.get("jaxpr", settings.get("call_jaxpr"))
    return inner if is_program(inner) else ClosedJaxpr(inner, ())


def _array(found: Any) -> Array:
    """A result of a rule, of which NumPy makes a single entry."""
    return found if isinstance(found, Location) else whole(found)


def _rule_of(name: str) -> str:
    return f"_{name.replace('-', '_')}"


class Emitter(Places):
    """Carries out jaxprs by the operations of a builder; `short`: long arrays in loops, see `long_arrays`."""

    def __init__(self, builder: Builder, short: bool = False) -> None:
        self.builder, self.short = builder, short
        self.arithmetic = Arithmetic(builder)
        self._expanding: set[str] = set()

    def run(self, program: ClosedJaxpr, given: Sequence[Array]) -> list[Array]:
        """Results of a jaxpr.

        **Raises:** `Unsupported` for an operation without machine code.
        """
        jaxpr = program.jaxpr
        values: dict[Any, Array] = dict(zip(jaxpr.constvars, map(entries_of, program.consts), strict=True))
        values |= dict(zip(jaxpr.invars, given, strict=True))

        def read(variable) -> Array:
            return entries_of(variable.val) if isinstance(variable, Literal) else values[variable]

        for equation in needed(jaxpr):
            results = self.apply(equation, [read(variable) for variable in equation.invars])
            values.update(zip(equation.outvars, map(_array, results)))
        return [read(variable) for variable in jaxpr.outvars]

    def apply(self, equation: JaxprEqn, parts: list[Array]) -> Sequence[Array]:
        """Results of one equation of a jaxpr."""
        name, settings = equation.primitive.name, equation.params
        if name in SIMPLE:
            return [self._each(getattr(self.arithmetic, SIMPLE[name]), [*map(entries_in, parts)])]
        if name in ELEMENTWISE:
            return [self._each(lambda *x: self._function(name, *x), [*map(entries_in, parts)])]
        if name in SAME:
            return parts
        if name in CALLS:
            return self.run(called_program(settings), parts)
        special = getattr(self, _rule_of(name), None)
        if special is None:
            return self._expanded(equation, parts)
        if name in HANDED_ON:
            return special(equation, *parts)
        if name in MOVED and isinstance(parts[0], Location):
            return [parts[0].moved(slots) for slots in special(equation, parts[0].slots)]
        return special(equation, *map(entries_in, parts))

    @classmethod
    def knows(cls, name: str) -> bool:
        """Whether there is a rule for a primitive; any other is what it is made of."""
        return name in SIMPLE or name in ELEMENTWISE | SAME | CALLS or hasattr(cls, _rule_of(name))

    def _each(self, function: Callable, parts: Sequence[Entries]) -> Entries:
        """A function of entries applied to each; arrays without axes are broadcast."""
        shape = np.broadcast_shapes(*(x.shape for x in parts))
        if self.short and is_long(parts, shape):
            return each_in_a_loop(self.builder, function, parts, shape)
        return each(function, parts)

    def _function(self, name: str, *entries: Entry) -> Entry:
        """A function of entries: of vectors, or folded if they are known."""
        if name in vector_math.FUNCTIONS and not is_known(entries[0]):
            return vector_math.FUNCTIONS[name](self.arithmetic, entries[0])
        return self.arithmetic.function(name, *entries)

    def _expanded(self, equation: JaxprEqn, parts: list[Array]) -> list[Array]:
        """By what a primitive was said to be made of, or by its implementation, where that is of other primitives."""
        name = equation.primitive.name
        if name in self._expanding:  # its implementation is itself
            raise Unsupported(name)
        self._expanding.add(name)
        found = self.run(expansion_of(equation), parts)
        self._expanding.discard(name)
        return found

    # Arithmetic with settings

    def _integer_pow(self, equation, x):
        return [self._each(lambda a: self.arithmetic.power(a, equation.params["y"]), [x])]

    def _convert_element_type(self, equation, x):
        dtype = equation.outvars[0].aval.dtype
        return [self._each(lambda a: self.arithmetic.convert(a, dtype), [x])]

    def _select_n(self, equation, which, *cases):
        return [self._each(lambda w, *x: self.arithmetic.choose(w, list(x)), [which, *cases])]

    def _dot_general(self, equation, a, b):
        (a_summed, b_summed), (a_batch, b_batch) = equation.params["dimension_numbers"]
        dtype = equation.outvars[0].aval.dtype  # of which the operands need not be
        a, b = (
            x if shape_of(v).dtype == dtype else self._each(lambda one: self.arithmetic.convert(one, dtype), [x])
            for x, v in zip((a, b), equation.invars)
        )
        a_own = [i for i in range(a.ndim) if i not in (*a_summed, *a_batch)]
        b_own = [i for i in range(b.ndim) if i not in (*b_summed, *b_batch)]
        batch, terms = (math.prod(a.shape[i] for i in axes) for axes in (a_batch, a_summed))
        rows, columns = (math.prod(x.shape[i] for i in own) for x, own in ((a, a_own), (b, b_own)))
        shape = [a.shape[i] for i in (*a_batch, *a_own)] + [b.shape[i] for i in b_own]
        a = a.transpose([*a_batch, *a_own, *a_summed]).reshape(batch, rows, terms)
        b = b.transpose([*b_batch, *b_own, *b_summed]).reshape(batch, columns, terms)
        if self.short and is_long((max(a, b, key=np.size),), (batch, rows, columns, terms)):
            return [products_in_a_loop(self.arithmetic, a, b).reshape(shape)]
        multiply = self.arithmetic.multiply
        places = np.ndindex(batch, rows, columns)
        sums = [self.arithmetic.sum(map(multiply, a[i, j], b[i, k])) for i, j, k in places]
        return [of_shape(sums, shape)]

    def _reduced(self, function: Callable, nothing, values: Entries, axes: Sequence[SupportsIndex]) -> Entries:
        values = np.moveaxis(values, axes, range(len(axes)))
        kept = values.shape[len(axes) :]
        if self.short and is_long((values,), values.shape) and common_kind(values.flat) in "db":
            return reduced_in_a_loop(self.builder, function, nothing, values, len(axes))
        terms = [whole(values[place]) for place in np.ndindex(*values.shape[: len(axes)])]
        if not terms:
            return of_shape([nothing] * math.prod(kept), kept)
        total = terms[0]
        for term in terms[1:]:
            total = each(function, [total, term])
        return total

    def _reduce_sum(self, equation, x):
        return [self._reduced(self.arithmetic.add, equation.outvars[0].aval.dtype.type(0), x, equation.params["axes"])]

    def _reduce_max(self, equation, x):
        return [self._reduced(self.arithmetic.larger, -np.float64(np.inf), x, equation.params["axes"])]

    def _reduce_min(self, equation, x):
        return [self._reduced(self.arithmetic.smaller, np.float64(np.inf), x, equation.params["axes"])]

    def _reduce_and(self, equation, x):
        both = lambda a, b: self.arithmetic.function("and", a, b)  # noqa: E731
        return [self._reduced(both, np.bool_(True), x, equation.params["axes"])]

    def _reduce_or(self, equation, x):
        return [self._reduced(self.arithmetic.either, np.bool_(False), x, equation.params["axes"])]

    def _reduce_prod(self, equation, x):
        return [
            self._reduced(self.arithmetic.multiply, equation.outvars[0].aval.dtype.type(1), x, equation.params["axes"])
        ]

    def _cumulated(self, equation, x, function: Callable) -> list[Entries]:
        axis, found = equation.params["axis"], x.copy()
        rows = np.moveaxis(found, axis, 0)
        rows = rows[::-1] if equation.params["reverse"] else rows
        for i in range(1, len(rows)):
            rows[(i, ...)] = each(function, [whole(rows[i - 1]), whole(rows[i])])
        return [found]

    def _cumsum(self, equation, x):
        return self._cumulated(equation, x, self.arithmetic.add)

    def _cumprod(self, equation, x):
        return self._cumulated(equation, x, self.arithmetic.multiply)

    def _cummax(self, equation, x):
        return self._cumulated(equation, x, self.arithmetic.larger)

    def _cummin(self, equation, x):
        return self._cumulated(equation, x, self.arithmetic.smaller)

    def _argmax(self, equation, x):
        return self._place_of_extreme(equation, x, "gt")

    def _argmin(self, equation, x):
        return self._place_of_extreme(equation, x, "lt")

    def _place_of_extreme(self, equation, x, order: str) -> list[Entries]:
        """The first place along an axis of the largest or smallest entry, or of what is not a number."""
        (axis,), arithmetic = equation.params["axes"], self.arithmetic
        number = equation.outvars[0].aval.dtype.type
        rows = np.moveaxis(x, axis, 0)
        found = whole(rows[0])
        at = of_shape([number(0)] * found.size, found.shape)

        def better(new, old):
            chosen = arithmetic.compare(order, new, old)
            if common_kind((new, old)) != "d":
                return chosen
            nothing = arithmetic.function("and", arithmetic.compare("ne", new, new), arithmetic.compare("eq", old, old))
            number_before = arithmetic.compare("eq", old, old)
            return arithmetic.either(arithmetic.function("and", chosen, number_before), nothing)

        for i in range(1, len(rows)):
            row = whole(rows[i])
            chosen = each(better, [row, found])
            at = each(lambda c, old: arithmetic.select(c, number(i), old), [chosen, at])
            found = each(arithmetic.select, [chosen, row, found])
        return [at]

    def _round(self, equation, x):
        name = "round" if equation.params["rounding_method"] == jax.lax.RoundingMethod.AWAY_FROM_ZERO else "roundeven"
        by_numpy = np.round if name == "roundeven" else lambda a: np.copysign(np.floor(np.abs(a) + 0.5), a)
        return [each(lambda a: by_numpy(a) if is_known(a) else self.builder.call(name, "d", a), [x])]

    # Entries that move

    def _empty2(self, equation):
        return [entries_of(np.zeros((), equation.params["dtype"]))]

    def _iota(self, equation):
        settings = equation.params
        lengths = [n if i == settings["dimension"] else 1 for i, n in enumerate(settings["shape"])]
        row = np.arange(settings["shape"][settings["dimension"]], dtype=settings["dtype"]).reshape(lengths)
        return [entries_of(np.broadcast_to(row, settings["shape"]))]

    def _broadcast_in_dim(self, equation, x):
        shape, axes = equation.params["shape"], equation.params["broadcast_dimensions"]
        lengths = [1] * len(shape)
        for axis, length in zip(axes, x.shape):
            lengths[axis] = length
        return [np.broadcast_to(x.reshape(lengths), shape)]

    def _concatenate(self, equation, *parts):
        return [np.concatenate(parts, equation.params["dimension"])]

    def _stack(self, equation, *parts):
        return [np.stack(parts, equation.params["axis"])]

    def _unstack(self, equation, x):
        return [*map(whole, np.moveaxis(x, equation.params["axis"], 0))]

    def _split(self, equation, x):
        places = np.cumsum(equation.params["sizes"])[:-1]
        return np.split(x, places, equation.params["axis"])

    def _expand_dims(self, equation, x):
        return [np.expand_dims(x, equation.params["dimensions"])]

    def _reshape(self, equation, x):
        return [x.reshape(equation.params["new_sizes"])]

    def _rev(self, equation, x):
        return [np.flip(x, equation.params["dimensions"])]

    def _squeeze(self, equation, x):
        return [np.squeeze(x, tuple(equation.params["dimensions"]))]

    def _tile(self, equation, x):
        return [np.tile(x, equation.params["reps"])]

    def _transpose(self, equation, x):
        return [x.transpose(equation.params["permutation"])]

    def _slice(self, equation, x):
        settings = equation.params
        strides = settings["strides"] or (1,) * x.ndim
        limits = zip(settings["start_indices"], settings["limit_indices"], strides)
        return [x[tuple(slice(*limit) for limit in limits)]]

    def _pad(self, equation, x, value):
        lows, highs, inner = zip(*equation.params["padding_config"]) if x.ndim else ((), (), ())
        if min((*lows, *highs), default=0) < 0:
            raise Unsupported("padding that cuts off")
        shape = [a + b + n + max(n - 1, 0) * i for a, b, i, n in zip(lows, highs, inner, x.shape)]
        found = np.empty(shape, object)
        found.fill(None)
        for place in np.ndindex(*shape):
            found[place] = value[()]
        found[tuple(slice(a, a + n + max(n - 1, 0) * i, i + 1) for a, i, n in zip(lows, inner, x.shape))] = x
        return [found]

    # Loops and branches

    def _kernel(self, equation, *parts):
        """A kernel within this one, in a loop where it has several samples."""
        program, batched = equation.params["body"].program, equation.params["batched"]
        return loops.over_rows(self, program, equation, parts, batched) if any(batched) else self.run(program, parts)

    def _platform_index(self, equation):
        """Which of several forms of a function is for a CPU."""
        forms = equation.params["platforms"]
        return [entries_of(np.int32(next(i for i, names in enumerate(forms) if names is None or "cpu" in names)))]

    def _custom_linear_solve(self, equation, *parts):
        counts, solve = equation.params["const_lengths"], equation.params["jaxprs"].solve
        first, given = counts.matvec + counts.vecmat, sum(counts)
        return self.run(solve, [*parts[first : first + counts.solve], *parts[given:]])

    def _while(self, equation, *parts):
        return loops.repeat_while(self, equation, parts)

    def _scan(self, equation, *parts):
        return loops.scan(self, equation, parts)

    def _cond(self, equation, which, *parts):
        return loops.branch(self, equation, which, parts)
