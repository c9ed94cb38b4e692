"""Operations on single entries: numbers that are known are folded, the others become LLVM's operations.

Place in the pipeline: builder -> **arithmetic** -> emission.

Products with entries that are known to be zero are zero, also where the other factor is not finite; sums of one term
are that term.  Everything else is carried out in the order in which it was written and rounded as IEEE 754 has it (sums
of products once, where the builder fuses them): LLVM contracts and exchanges nothing, so that a sample has the same
bits whatever the number of lanes.
"""

import functools
from collections.abc import Callable, Iterable

import numpy as np

from rfem_jax.kernels.builder import DTYPES, Builder, Entry, Product, Unsupported, Value, is_known, kind_of

ZERO, ONE = np.float64(0.0), np.float64(1.0)
COMPARED = {"lt": "lt", "le": "le", "gt": "gt", "ge": "ge", "eq": "eq", "ne": "ne"}
BY_NUMPY: dict[str, Callable] = {
    "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal, "eq": np.equal, "ne": np.not_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "not": np.invert, "abs": np.abs,
    "sign": np.sign, "max": np.maximum, "min": np.minimum, "floor": np.floor, "ceil": np.ceil, "rem": np.fmod,
    "is_finite": np.isfinite, "sqrt": np.sqrt, "sin": np.sin, "cos": np.cos, "tan": np.tan, "asin": np.arcsin,
    "acos": np.arccos, "atan": np.arctan, "atan2": np.arctan2, "exp": np.exp, "exp2": np.exp2, "log": np.log,
    "tanh": np.tanh, "sinh": np.sinh, "cosh": np.cosh, "pow": np.power, "shift_left": np.left_shift,
    "log1p": np.log1p, "expm1": np.expm1,
    "logistic": lambda a: ONE / (ONE + np.exp(-a)),
    "shift_right_arithmetic": np.right_shift,
}  # fmt: skip
INTRINSICS = {
    "sqrt": "sqrt", "floor": "floor", "ceil": "ceil", "tan": "tan", "asin": "asin", "acos": "acos", "atan": "atan",
    "atan2": "atan2", "exp2": "exp2", "tanh": "tanh", "sinh": "sinh", "cosh": "cosh",
    "pow": "pow",
}  # fmt: skip


def common_kind(entries: Iterable[Entry]) -> str:
    """The kind of the values among entries, or of the first number."""
    entries = list(entries)
    for entry in entries:
        if isinstance(entry, Value):
            return entry.kind
    return kind_of(np.asarray(entries[0]).dtype)


def _same_number(a: Entry, b: Entry) -> bool:
    """Whether two known numbers have the same bits; those that are not numbers have not."""
    return bool(a == b) and bool(np.signbit(np.float64(a)) == np.signbit(np.float64(b)))


class Arithmetic:
    """Operations on entries, which go to a builder."""

    def __init__(self, builder: Builder) -> None:
        self.builder = builder

    def _binary(self, float_op: str, int_op: str, a: Entry, b: Entry) -> Value:
        kind = a.kind if isinstance(a, Value) else common_kind((a, b))
        if kind == "b":
            raise Unsupported(f"{int_op} of conditions")
        build = self.builder
        left = a.name if isinstance(a, Value) else build.operand(a, kind)
        right = b.name if isinstance(b, Value) else build.operand(b, kind)
        return build.operation(kind, f"{float_op if kind == 'd' else int_op} #{kind} {left}, {right}")

    # Sums and products are most of all operations: they ask once what is known.

    def add(self, a: Entry, b: Entry) -> Entry:
        if isinstance(a, Value):
            if not isinstance(b, Value) and b == 0:
                return a
        elif not isinstance(b, Value):
            return a + b
        elif a == 0:
            return b
        for one, other in ((b, a), (a, b)):
            if isinstance(one, Product):
                return self.builder.fused(one.factors, self.builder.operand(other, "d"))
        return self._binary("fadd", "add", a, b)

    def subtract(self, a: Entry, b: Entry) -> Entry:
        if isinstance(a, Value):
            if not isinstance(b, Value) and b == 0:
                return a
        elif not isinstance(b, Value):
            return a - b
        elif a == 0:
            return self.negative(b)
        # The difference of two products stays what it is: a b - b a is zero.
        if isinstance(a, Product) != isinstance(b, Product):
            return self._fused_difference(a, b)
        return self._binary("fsub", "sub", a, b)

    def _fused_difference(self, a: Entry, b: Entry) -> Value:
        build = self.builder
        if isinstance(a, Product):
            minus = build.operand(-b, "d") if is_known(b) else build.negated(b.name)
            return build.fused(a.factors, minus)
        left, right = b.factors
        return build.fused((build.negated(left), right), build.operand(a, "d"))

    def multiply(self, a: Entry, b: Entry) -> Entry:
        if not isinstance(b, Value):
            a, b = b, a
        if not isinstance(a, Value):
            if not isinstance(b, Value):
                return a * b
            if a == 0:
                return a
            if a == 1:
                return b
            if a == -1:
                return self.negative(b)
        if b.kind == "d":
            return self.builder.product(a.name if isinstance(a, Value) else self.builder.operand(a, "d"), b.name)
        return self._binary("fmul", "mul", a, b)

    def divide(self, a: Entry, b: Entry) -> Entry:
        if is_known(a) and is_known(b):
            with np.errstate(all="ignore"):
                return DTYPES[common_kind((a,))].type(np.divide(a, b) if common_kind((a,)) == "d" else int(a / b))
        if (is_known(b) and b == 1) or (is_known(a) and a == 0):
            return a
        return self._binary("fdiv", "udiv" if common_kind((a, b)) == "u" else "sdiv", a, b)

    def negative(self, a: Entry) -> Entry:
        if is_known(a):
            return -a
        # LLVM's fast selection knows no change of sign of vectors: minus zero less a number has the same bits.
        return self._binary("fsub", "sub", DTYPES[a.kind].type(-0.0), a)

    def power(self, a: Entry, exponent: int) -> Entry:
        """A whole power, by squaring."""
        if is_known(a):
            return np.asarray(a) ** exponent if exponent >= 0 else ONE / np.asarray(a) ** -exponent
        if exponent == 0:
            return ONE
        total, square, left = None, a, abs(exponent)
        while left:
            if left & 1:
                total = square if total is None else self.multiply(total, square)
            left >>= 1
            square = self.multiply(square, square) if left else square
        assert total is not None
        return total if exponent > 0 else self.divide(ONE, total)

    def larger(self, a: Entry, b: Entry) -> Entry:
        return self._extreme("gt", np.maximum, a, b)

    def smaller(self, a: Entry, b: Entry) -> Entry:
        return self._extreme("lt", np.minimum, a, b)

    def _extreme(self, order: str, by_numpy: Callable, a: Entry, b: Entry) -> Entry:
        if is_known(a) and (is_known(b) or a != a):
            return by_numpy(a, b) if is_known(b) else a
        if common_kind((a, b)) == "b":
            raise Unsupported("max or min of conditions")
        chosen = self.compare(order, a, b)
        if common_kind((a, b)) == "d" and not is_known(a):
            # What is not a number is the result, as everywhere in JAX.
            chosen = self.either(chosen, self.compare("ne", a, a))
        return self.select(chosen, a, b)

    def compare(self, order: str, a: Entry, b: Entry) -> Entry:
        if is_known(a) and is_known(b):
            return np.bool_(BY_NUMPY[order](a, b))
        kind, build = common_kind((a, b)), self.builder
        operands = f"#{kind} {build.operand(a, kind)}, {build.operand(b, kind)}"
        if kind == "d":
            return build.operation("b", f"fcmp {'u' if order == 'ne' else 'o'}{order} {operands}")
        sign = "" if order in ("eq", "ne") else "u" if kind in "bu" else "s"
        return build.operation("b", f"icmp {sign}{order} {operands}")

    def either(self, a: Entry, b: Entry) -> Entry:
        return self._bitwise("or", a, b)

    def _bitwise(self, name: str, a: Entry, b: Entry) -> Entry:
        if is_known(a) and is_known(b):
            return BY_NUMPY[name](a, b)
        kind, build = common_kind((a, b)), self.builder
        for known, other in ((a, b), (b, a)):
            if kind == "b" and is_known(known) and name != "xor":
                absorbed = bool(known) == (name == "or")
                return known if absorbed else other
        return build.operation(kind, f"{name} #{kind} {build.operand(a, kind)}, {build.operand(b, kind)}")

    def invert(self, a: Entry) -> Entry:
        if is_known(a):
            return np.invert(a)
        ones = np.bool_(True) if a.kind == "b" else np.invert(DTYPES[a.kind].type(0))
        return self._bitwise("xor", a, ones)

    def select(self, which: Entry, yes: Entry, no: Entry) -> Entry:
        """`yes` where a condition holds, else `no`."""
        if is_known(which):
            return yes if which else no
        if yes is no or (isinstance(yes, Value) and isinstance(no, Value) and yes.name == no.name):
            return yes
        if is_known(yes) and is_known(no) and _same_number(yes, no):
            return yes
        kind, build = common_kind((yes, no)), self.builder
        chosen = f"#{kind} {build.operand(yes, kind)}, #{kind} {build.operand(no, kind)}"
        return build.operation(kind, f"select #b {which.name}, {chosen}")

    def choose(self, which: Entry, cases: list[Entry]) -> Entry:
        """The case of a number, or of a condition (the second where it holds)."""
        if is_known(which):
            return cases[int(which)]
        if which.kind == "b":
            return self.select(which, cases[1], cases[0])
        found = cases[0]
        for i, case in enumerate(cases[1:], 1):
            found = self.select(self.compare("eq", which, DTYPES[which.kind].type(i)), case, found)
        return found

    def convert(self, a: Entry, dtype: np.dtype) -> Entry:
        kind = kind_of(dtype)
        if is_known(a):
            return np.asarray(a).astype(dtype)[()]
        if a.kind == kind:
            return a
        if kind == "b":
            return self.compare("ne", a, DTYPES[a.kind].type(0))
        if {kind, a.kind} == {"i", "u"}:
            return Value(a.name, kind)
        if kind == "d":
            name = "uitofp" if a.kind in "bu" else "sitofp"
        elif a.kind == "d":
            return self.builder.whole_number(kind, a)
        else:
            name = "zext" if a.kind == "b" or (a.kind == "u" and kind == "l") else "sext" if kind == "l" else "trunc"
        return self.builder.operation(kind, f"{name} #{a.kind} {a.name} to #{kind}")

    def function(self, name: str, *entries: Entry) -> Entry:
        """A primitive of JAX whose result has one entry from one entry of each operand.

        **Raises:** `Unsupported` for one that has no machine code.
        """
        if all(map(is_known, entries)) and name in BY_NUMPY:
            with np.errstate(all="ignore"):
                return np.asarray(BY_NUMPY[name](*entries))[()]
        special = getattr(self, f"_{name}", None)
        if special is not None:
            return special(*entries)
        if name in COMPARED:
            return self.compare(name, *entries)
        if name in ("and", "or", "xor"):
            return self._bitwise(name, *entries)
        if name in INTRINSICS:
            return self.builder.call(INTRINSICS[name], "d", *entries)
        raise Unsupported(name)

    def _abs(self, a: Entry) -> Entry:
        if common_kind((a,)) == "d":
            return self.builder.call("fabs", "d", a)
        return self.larger(a, self.negative(a))

    def _max(self, a: Entry, b: Entry) -> Entry:
        return self.larger(a, b)

    def _min(self, a: Entry, b: Entry) -> Entry:
        return self.smaller(a, b)

    def _not(self, a: Entry) -> Entry:
        return self.invert(a)

    def _pow(self, a: Entry, b: Entry) -> Entry:
        return self.builder.call("pow", "d", a, self.convert(b, DTYPES["d"]))

    def _square(self, a: Entry) -> Entry:
        return self.multiply(a, a)

    def _rsqrt(self, a: Entry) -> Entry:
        return self.divide(ONE, self.function("sqrt", a))

    def _sign(self, a: Entry) -> Entry:
        if common_kind((a,)) != "d":
            number = DTYPES[a.kind].type
            negative = self.select(self.compare("lt", a, number(0)), self.negative(number(1)), number(0))
            return self.select(self.compare("gt", a, number(0)), number(1), negative)
        one = self.builder.call("copysign", "d", ONE, a)
        # Zero, and what is not a number, stay as they are.
        special = self.either(self.compare("eq", a, ZERO), self.compare("ne", a, a))
        return self.select(special, a, one)

    def _is_finite(self, a: Entry) -> Entry:
        return self.compare("lt", self._abs(a), np.float64(np.inf))

    def _rem(self, a: Entry, b: Entry) -> Entry:
        return self._binary("frem", "urem" if common_kind((a, b)) == "u" else "srem", a, b)

    def _lt_to(self, a: Entry, b: Entry) -> Entry:
        return self._in_total_order("lt", a, b)

    def _le_to(self, a: Entry, b: Entry) -> Entry:
        return self._in_total_order("le", a, b)

    def _in_total_order(self, order: str, a: Entry, b: Entry) -> Entry:
        """Comparison in which what is not a number is the largest."""
        below = self.compare(order, a, b)
        if common_kind((a, b)) != "d":
            return below
        last = self.compare("ne", b, b)
        if order == "lt":
            last = self.function("and", last, self.compare("eq", a, a))
        return self.either(below, last)

    def _shift_left(self, a: Entry, b: Entry) -> Entry:
        return self._shifted("shl", a, b)

    def _shift_right_logical(self, a: Entry, b: Entry) -> Entry:
        return self._shifted("lshr", a, b)

    def _shift_right_arithmetic(self, a: Entry, b: Entry) -> Entry:
        return self._shifted("ashr", a, b)

    def _shifted(self, name: str, a: Entry, b: Entry) -> Entry:
        """By as many bits as there are, or more, everything is shifted out."""
        kind = common_kind((a, b))
        number = DTYPES[kind].type
        most = number(8 * DTYPES[kind].itemsize - 1)
        inside = self.function("and", self.compare("ge", b, number(0)), self.compare("le", b, most))
        shifted = self._binary(name, name, a, self.select(inside, b, most if name == "ashr" else number(0)))
        return shifted if name == "ashr" else self.select(inside, shifted, number(0))

    def _clamp(self, low: Entry, a: Entry, high: Entry) -> Entry:
        return self.smaller(self.larger(a, low), high)

    def sum(self, terms: Iterable[Entry]) -> Entry:
        return functools.reduce(self.add, terms, ZERO)
