"""A jaxpr as operations on the entries of its arrays.

Place in the pipeline: arithmetic, vector_math, loops -> **emission** -> programs.

Operations that only
move entries (slices, transposes, gathers at known places) cost nothing: they are carried out on the object arrays.
Loops and branches are in `loops`.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, SupportsIndex

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal

from rfem_jax.kernels import loops, vector_math
from rfem_jax.kernels.arithmetic import Arithmetic, common_kind
from rfem_jax.kernels.builder import DTYPES, Builder, Entry, Unsupported, Value, is_known, kind_of
from rfem_jax.kernels.entries import (
    Entries,
    each,
    entries_of,
    is_program,
    needed,
    numbers,
    of_shape,
    place_in_memory,
    shape_of,
    whole,
)

# Primitives whose operation on arrays is that on entries.
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

# Primitives of others, by functions of JAX's own primitives.
_EXPANSIONS: dict[str, Callable] = {}


def expand_primitive(name: str, function: Callable) -> None:
    """Say what a primitive that is not JAX's is made of.

    **Arguments:** `name` of the primitive; `function` of its operands and settings, that uses primitives of JAX.
    """
    _EXPANSIONS[name] = function


class Emitter:
    """Carries out jaxprs by the operations of a builder."""

    def __init__(self, builder: Builder) -> None:
        self.builder = builder
        self.arithmetic = Arithmetic(builder)

    def run(self, program: ClosedJaxpr, given: Sequence[Entries]) -> list[Entries]:
        """Results of a jaxpr.

        **Raises:** `Unsupported` for an operation without machine code.
        """
        jaxpr = program.jaxpr
        values = dict(zip(jaxpr.constvars, map(entries_of, program.consts), strict=True))
        values |= dict(zip(jaxpr.invars, given, strict=True))

        def read(variable) -> Entries:
            return entries_of(variable.val) if isinstance(variable, Literal) else values[variable]

        for equation in needed(jaxpr):
            results = self.apply(equation, [read(variable) for variable in equation.invars])
            values.update(zip(equation.outvars, map(whole, results)))
        return [read(variable) for variable in jaxpr.outvars]

    def apply(self, equation: JaxprEqn, parts: list[Entries]) -> Sequence[Entries]:
        """Results of one equation of a jaxpr."""
        name, settings = equation.primitive.name, equation.params
        arithmetic = self.arithmetic
        simple = {
            "add": arithmetic.add, "add_any": arithmetic.add, "sub": arithmetic.subtract, "neg": arithmetic.negative,
            "mul": arithmetic.multiply, "div": arithmetic.divide,
        }  # fmt: skip
        if name in simple:
            return [each(simple[name], parts)]
        if name in ELEMENTWISE:
            return [each(lambda *x: self._function(name, *x), parts)]
        if name in SAME:
            return parts
        if name in CALLS:
            inner: Any = settings.get("jaxpr", settings.get("call_jaxpr"))
            return self.run(inner if is_program(inner) else ClosedJaxpr(inner, ()), parts)
        special = getattr(self, f"_{name.replace('-', '_')}", None)
        if special is not None:
            return special(equation, *parts)
        if name in _EXPANSIONS:
            return self._expanded(equation, parts)
        raise Unsupported(name)

    def _function(self, name: str, *entries: Entry) -> Entry:
        """A function of entries: of vectors, or folded if they are known."""
        if name in vector_math.FUNCTIONS and not is_known(entries[0]):
            return vector_math.FUNCTIONS[name](self.arithmetic, entries[0])
        return self.arithmetic.function(name, *entries)

    def _expanded(self, equation: JaxprEqn, parts: list[Entries]) -> list[Entries]:
        like = [shape_of(v) for v in equation.invars]
        function = _EXPANSIONS[equation.primitive.name]
        return self.run(jax.make_jaxpr(lambda *x: function(*x, **equation.params))(*like), parts)

    # Arithmetic with settings

    def _integer_pow(self, equation, x):
        return [each(lambda a: self.arithmetic.power(a, equation.params["y"]), [x])]

    def _convert_element_type(self, equation, x):
        dtype = equation.outvars[0].aval.dtype
        return [each(lambda a: self.arithmetic.convert(a, dtype), [x])]

    def _select_n(self, equation, which, *cases):
        return [each(lambda w, *x: self.arithmetic.choose(w, list(x)), [which, *cases])]

    def _dot_general(self, equation, a, b):
        (a_summed, b_summed), (a_batch, b_batch) = equation.params["dimension_numbers"]
        a_own = [i for i in range(a.ndim) if i not in (*a_summed, *a_batch)]
        b_own = [i for i in range(b.ndim) if i not in (*b_summed, *b_batch)]
        batch, terms = (math.prod(a.shape[i] for i in axes) for axes in (a_batch, a_summed))
        rows, columns = (math.prod(x.shape[i] for i in own) for x, own in ((a, a_own), (b, b_own)))
        shape = [a.shape[i] for i in (*a_batch, *a_own)] + [b.shape[i] for i in b_own]
        a = a.transpose([*a_batch, *a_own, *a_summed]).reshape(batch, rows, terms)
        b = b.transpose([*b_batch, *b_own, *b_summed]).reshape(batch, columns, terms)
        multiply = self.arithmetic.multiply
        places = np.ndindex(batch, rows, columns)
        sums = [self.arithmetic.sum(map(multiply, a[i, j], b[i, k])) for i, j, k in places]
        return [of_shape(sums, shape)]

    def _reduced(self, function: Callable, nothing, values: Entries, axes: Sequence[SupportsIndex]) -> Entries:
        values = np.moveaxis(values, axes, range(len(axes)))
        kept = values.shape[len(axes) :]
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

    def _gather(self, equation, operand, indices):
        known = numbers(indices, np.int64)
        if known is None:
            return [self._gathered_rows(equation, operand, indices)]
        numbers_, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
        places = known.shape[:-1]
        taken = np.empty((*places, *sizes), object)
        for place in np.ndindex(*places):
            start = np.zeros(operand.ndim, int)
            start[list(numbers_.start_index_map)] = known[place]
            for axis, batch in zip(numbers_.operand_batching_dims, numbers_.start_indices_batching_dims):
                start[axis] = place[batch]
            if (start < 0).any() or (start + sizes > operand.shape).any():
                raise Unsupported("gather of what is outside of an array")
            taken[place] = operand[tuple(slice(a, a + size) for a, size in zip(start, sizes))]
        gone = (*numbers_.collapsed_slice_dims, *numbers_.operand_batching_dims)
        left = (size for axis, size in enumerate(sizes) if axis not in gone)
        taken = taken.reshape(*places, *left)
        return [np.moveaxis(taken, range(len(places), taken.ndim), numbers_.offset_dims)]

    def _gathered_rows(self, equation, operand, indices):
        """Windows at places that are values, of an index by lane."""
        numbers_, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
        places = indices.shape[:-1]
        gone = (*numbers_.collapsed_slice_dims, *numbers_.operand_batching_dims)
        kept = [size for axis, size in enumerate(sizes) if axis not in gone]
        taken = np.empty((*places, *kept), object)
        for place in np.ndindex(*places):
            starts = [np.int64(0)] * operand.ndim
            for axis, of in zip(numbers_.operand_batching_dims, numbers_.start_indices_batching_dims):
                starts[axis] = np.int64(place[of])
            for axis, index in zip(numbers_.start_index_map, indices[place]):
                starts[axis] = index
            taken[(*place, ...)] = self._window(operand, starts, sizes).reshape(kept)
        return np.moveaxis(taken, range(len(places), taken.ndim), numbers_.offset_dims)

    def _dynamic_slice(self, equation, operand, *starts):
        return [self._window(operand, [x[()] for x in starts], equation.params["slice_sizes"])]

    def _clamped(self, start: Entry, largest: int) -> Entry:
        arithmetic = self.arithmetic
        start = arithmetic.convert(start, np.dtype(np.int64))
        return arithmetic.smaller(arithmetic.larger(start, np.int64(0)), np.int64(largest))

    def _window(self, operand: Entries, starts: Sequence[Entry], sizes: Sequence[int]) -> Entries:
        """Entries from places on that may be values, which are moved so far that the window is within the array."""
        starts = [self._clamped(a, n - size) for a, n, size in zip(starts, operand.shape, sizes)]
        if not operand.size:
            return np.empty(sizes, object)
        fixed = tuple(slice(int(a), int(a) + n) if is_known(a) else slice(None) for a, n in zip(starts, sizes))
        operand = operand[fixed]
        moving = [(axis, a) for axis, a in enumerate(starts) if not is_known(a)]
        if not moving:
            return operand
        if 0 in sizes:
            return np.empty(sizes, object)
        row = self._row_of(operand.shape, moving)
        places = np.arange(operand.size).reshape(operand.shape)[tuple(slice(0, n) for n in sizes)]
        kind = common_kind(operand.flat)
        known = numbers(operand, DTYPES[kind])
        if known is not None:
            table = self.builder.table(kind, known.ravel())
            found = [self.builder.gather_of_table(kind, table, int(place), row) for place in places.flat]
            return of_shape(found, sizes)
        kind, first = self._in_memory(operand)
        found = [self.builder.gather(kind, first + int(place), row) for place in places.flat]
        return of_shape(found, sizes)

    def _row_of(self, shape: Sequence[int], moving: Sequence[tuple[int, Entry]]) -> Value:
        """How many entries after the first one a window begins."""
        total: Entry = np.int64(0)
        for axis, start in moving:
            stride = np.int64(math.prod(shape[axis + 1 :]))
            total = self.arithmetic.add(total, self.arithmetic.multiply(start, stride))
        assert isinstance(total, Value)
        return total

    def _in_memory(self, entries: Entries) -> tuple[str, int]:
        """Kind and first slot of an array, or of a copy of it."""
        found = place_in_memory(entries)
        return found if found is not None else self._copied(entries)

    def _copied(self, entries: Entries) -> tuple[str, int]:
        """Kind and first slot of a copy of an array."""
        kind = common_kind(entries.flat)
        first = self.builder.reserve(entries.size)
        for i, entry in enumerate(entries.flat):
            self.builder.store(entry, kind, first + i)
        return kind, first

    def _dynamic_update_slice(self, equation, operand, update, *starts):
        return [self._updated(operand, update, [a[()] for a in starts])]

    def _updated(self, operand: Entries, update: Entries, starts: Sequence[Entry]) -> Entries:
        """An array with a window at places that may be values, which is moved so far that it is within the array."""
        if not update.size:
            return operand
        starts = [self._clamped(a, n - m) for a, n, m in zip(starts, operand.shape, update.shape)]
        moving = [(axis, a) for axis, a in enumerate(starts) if not is_known(a)]
        within = tuple(slice(int(a), int(a) + n) if is_known(a) else slice(0, n) for a, n in zip(starts, update.shape))
        if not moving:
            operand = operand.copy()
            operand[within] = update
            return operand
        kind, first = self._copied(operand)
        row = self._row_of(operand.shape, moving)
        places = np.arange(operand.size).reshape(operand.shape)[within]
        for place, entry in zip(places.flat, update.flat):
            self.builder.scatter(entry, kind, first + int(place), row)
        return of_shape([self.builder.load(kind, first + i) for i in range(operand.size)], operand.shape)

    def _scatter(self, equation, operand, indices, updates):
        return [self._scattered(equation, operand, indices, updates, lambda old, new: new)]

    def _scatter_add(self, equation, operand, indices, updates):
        return [self._scattered(equation, operand, indices, updates, self.arithmetic.add)]

    def _scattered(self, equation, operand, indices, updates, combined: Callable) -> Entries:
        """Updates at places that are known."""
        known = numbers(indices, np.int64)
        settings = equation.params["dimension_numbers"]
        if known is None or settings.operand_batching_dims:
            return self._scattered_by_lane(operand, indices, updates, settings, combined)
        operand = operand.copy()
        windows = settings.update_window_dims
        batch_axes = [i for i in range(updates.ndim) if i not in windows]
        window_axes = [i for i in range(operand.ndim) if i not in settings.inserted_window_dims]
        for place in np.ndindex(*updates.shape):
            index = known[tuple(place[i] for i in batch_axes)]
            at = np.zeros(operand.ndim, int)
            at[window_axes] = [place[i] for i in windows]
            at[list(settings.scatter_dims_to_operand_dims)] += index
            if (at < 0).any() or (at >= operand.shape).any():
                raise Unsupported("scatter to what is outside of an array")
            operand[tuple(at)] = combined(operand[tuple(at)], updates[place])
        return operand

    def _scattered_by_lane(self, operand, indices, updates, settings, combined: Callable) -> Entries:
        """Windows at places that are values, one after the other; nothing where one is outside of the array."""
        arithmetic = self.arithmetic
        single = (*settings.inserted_window_dims, *settings.operand_batching_dims)
        left = (updates.shape[i] for i in settings.update_window_dims)
        sizes = [1 if axis in single else next(left) for axis in range(operand.ndim)]
        batch_axes = [i for i in range(updates.ndim) if i not in settings.update_window_dims]
        for place in np.ndindex(*indices.shape[:-1]):
            starts, inside = [np.int64(0)] * operand.ndim, np.bool_(True)
            for axis, of in zip(settings.operand_batching_dims, settings.scatter_indices_batching_dims):
                starts[axis] = np.int64(place[of])
            for axis, index in zip(settings.scatter_dims_to_operand_dims, indices[place]):
                index = arithmetic.convert(index, np.dtype(np.int64))
                within = arithmetic.compare("le", index, np.int64(operand.shape[axis] - sizes[axis]))
                inside = arithmetic.function("and", inside, within)
                inside = arithmetic.function("and", inside, arithmetic.compare("ge", index, np.int64(0)))
                starts[axis] = index
            update = np.moveaxis(updates, batch_axes, range(len(batch_axes)))[(*place, ...)]
            old = self._window(operand, starts, sizes)
            new = each(lambda a, b: arithmetic.select(inside, combined(a, b), a), [old, update.reshape(sizes)])
            operand = self._updated(operand, new, starts)
        return operand

    # Loops and branches

    def _kernel(self, equation, *parts):
        """A kernel within this one, in a loop where it has several samples."""
        program, batched = equation.params["body"].program, equation.params["batched"]
        return loops.over_rows(self, program, equation, parts, batched) if any(batched) else self.run(program, parts)

    def _sort(self, equation, *parts):
        """Of one axis, by one key: every entry goes to the place that as many others are before."""
        if parts[0].ndim != 1 or equation.params["num_keys"] != 1:
            raise Unsupported("sort of several axes or by several keys")
        arithmetic, keys = self.arithmetic, parts[0]
        zero, one = np.int64(0), np.int64(1)
        ranks = []
        for i, key in enumerate(keys):
            before = (arithmetic.function("le_to" if j < i else "lt_to", other, key) for j, other in enumerate(keys))
            counts = [arithmetic.select(b, one, zero) for j, b in enumerate(before) if j != i]
            ranks.append(functools.reduce(arithmetic.add, counts, zero))
        found = []
        for part, variable in zip(parts, equation.outvars):
            kind, first = kind_of(variable.aval.dtype), self.builder.reserve(part.size)
            for entry, rank in zip(part, ranks):
                if is_known(rank):
                    self.builder.store(entry, kind, first + int(rank))
                else:
                    self.builder.scatter(entry, kind, first, rank)
            found.append(of_shape([self.builder.load(kind, first + i) for i in range(part.size)], part.shape))
        return found

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
