"""Sine, cosine, exponential function and logarithm of vectors, as functions of LLVM.

Place in the pipeline: builder, arithmetic -> **vector_math** -> emission.

Within 2 units in the last place over the whole range.  Arguments are reduced in several parts so that no digit is
lost, and polynomials do the rest; their coefficients, and the parts of pi/2 and ln 2, are those of fdlibm (Sun
Microsystems, 1993).  Sines of numbers beyond a million are the C library's, lane by lane: there a table of the digits
of pi is needed.  A lane's result does not depend on what is in the others.

XLA runs its programs, and so these, with numbers below 2.2e-308 rounded to zero.  What is not here (tangent, inverse
functions, powers, hyperbolic functions) is LLVM's intrinsic function, which calls the C library lane by lane.
"""

from collections.abc import Callable, Sequence

import numpy as np

from rfem_jax.kernels.arithmetic import ONE, ZERO, Arithmetic
from rfem_jax.kernels.builder import Builder, Entry, Value

LARGEST_ANGLE = 2.0**20  # whose multiples of pi/2 are exact in the first parts
PARTS_OF_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624871116645580e-21)
REST_OF_HALF_PI = 8.47842766036889956997e-32
SINE = (
    -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04, 2.75573137070700676789e-06,
    -2.50507602534068634195e-08, 1.58969099521155010221e-10,
)  # fmt: skip
COSINE = (
    4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05, -2.75573143513906633035e-07,
    2.08757232129817482790e-09, -1.13596475577881948265e-11,
)  # fmt: skip
LN_2 = (6.93147180369123816490e-01, 1.90821492927058770002e-10)
EXPONENTIAL = (
    1.66666666666666019037e-01, -2.77777777770155933842e-03, 6.61375632143793436117e-05, -1.65339022054652515390e-06,
    4.13813679705723846039e-08,
)  # fmt: skip
LOGARITHM = (
    6.666666666666735130e-01, 3.999999999940941908e-01, 2.857142874366239149e-01, 2.222219843214978396e-01,
    1.818357216161805012e-01, 1.531383769920937332e-01, 1.479819860511658591e-01,
)  # fmt: skip
OVERFLOW, UNDERFLOW = 709.782712893384, -745.2  # ln of the largest number, and of less than half of the smallest
BITS_OF_FRACTION, BIAS = 52, 1023


def sine_and_cosine(arithmetic: Arithmetic, x: Value) -> tuple[Value, Value]:
    """Both of an angle [rad]."""
    sine, cosine = _call(arithmetic, "sine_and_cosine", _sine_and_cosine, x)
    return sine, cosine


def exponential(arithmetic: Arithmetic, x: Value) -> Value:
    return _call(arithmetic, "exponential", _exponential, x)[0]


def logarithm(arithmetic: Arithmetic, x: Value) -> Value:
    """The natural logarithm: not a number below zero, minus infinity of zero."""
    return _call(arithmetic, "logarithm", _logarithm, x)[0]


def logistic(arithmetic: Arithmetic, x: Value) -> Value:
    return arithmetic.divide(ONE, arithmetic.add(ONE, exponential(arithmetic, arithmetic.negative(x))))


def logarithm_of_more(arithmetic: Arithmetic, x: Value) -> Value:
    """log(1 + x), with the rounding of the sum made good (W. Kahan)."""
    total = arithmetic.add(ONE, x)
    near, changed = arithmetic.compare("eq", total, ONE), arithmetic.subtract(total, ONE)
    quotient = arithmetic.divide(x, arithmetic.select(near, ONE, changed))
    quotient = arithmetic.select(arithmetic.function("is_finite", x), quotient, ONE)
    return arithmetic.select(near, x, arithmetic.multiply(logarithm(arithmetic, total), quotient))


def exponential_less_one(arithmetic: Arithmetic, x: Value) -> Value:
    """exp(x) - 1, with the rounding of the difference made good (W. Kahan)."""
    power = exponential(arithmetic, x)
    less = arithmetic.subtract(power, ONE)
    near, gone = arithmetic.compare("eq", power, ONE), arithmetic.compare("eq", less, np.float64(-1.0))
    plain = arithmetic.either(gone, arithmetic.invert(arithmetic.function("is_finite", power)))
    safe = arithmetic.select(arithmetic.either(near, plain), np.float64(2.0), power)
    good = arithmetic.multiply(less, arithmetic.divide(x, logarithm(arithmetic, safe)))
    return arithmetic.select(near, x, arithmetic.select(plain, less, good))


FUNCTIONS: dict[str, Callable[[Arithmetic, Value], Value]] = {
    "sin": lambda arithmetic, x: sine_and_cosine(arithmetic, x)[0],
    "cos": lambda arithmetic, x: sine_and_cosine(arithmetic, x)[1],
    "exp": exponential,
    "log": logarithm,
    "logistic": logistic,
    "log1p": logarithm_of_more,
    "expm1": exponential_less_one,
}


def _call(arithmetic: Arithmetic, name: str, define: Callable, x: Value) -> tuple[Value, ...]:
    """Results of a function of a vector, which is defined once in a module."""
    builder = arithmetic.builder
    if name not in builder.functions:
        inner = Builder(immediate=True)
        results = define(Arithmetic(inner), Value("%x", "d"))
        builder.intrinsics |= inner.intrinsics
        types = ", ".join(["#d"] * len(results))
        lines, packed = inner.lines, "undef"
        for i, result in enumerate(results):
            packed = inner.scalar(f"insertvalue {{ {types} }} {packed}, #d {result.name}, {i}")
        body = "\n".join([*lines, f"ret {{ {types} }} {packed}"])
        builder.functions[name] = (
            len(results),
            f"define internal {{ {types} }} @{name}(#d %x) noinline {{\nentry:\n{body}\n}}",
        )
    count, _ = builder.functions[name]
    types = f"{{ {', '.join(['#d'] * count)} }}"
    both = builder.operation("d", f"call {types} @{name}(#d {x.name})")
    return tuple(builder.operation("d", f"extractvalue {types} {both.name}, {i}") for i in range(count))


def _polynomial(arithmetic: Arithmetic, coefficients: Sequence[float], x: Entry) -> Entry:
    """c0 + x (c1 + x (c2 + ...))."""
    total: Entry = np.float64(coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = arithmetic.add(np.float64(coefficient), arithmetic.multiply(total, x))
    return total


def _whole_number(builder: Builder, x: Entry) -> Value:
    """A double, which is whole and of moderate size, as an integer."""
    return builder.operation("l", f"fptosi #d {builder.operand(x, 'd')} to #l")


def _integers(builder: Builder, name: str, a: Value | int, b: Value | int) -> Value:
    """An operation on 64-bit integers."""
    a_text, b_text = (x.name if isinstance(x, Value) else f"splat (i64 {x})" for x in (a, b))
    return builder.operation("l", f"{name} #l {a_text}, {b_text}")


def _as_bits(builder: Builder, x: Entry) -> Value:
    return builder.operation("l", f"bitcast #d {builder.operand(x, 'd')} to #l")


def _from_bits(builder: Builder, bits: Value) -> Value:
    return builder.operation("d", f"bitcast #l {bits.name} to #d")


def _sine_and_cosine(arithmetic: Arithmetic, x: Value) -> tuple[Value, Value]:
    builder, add, subtract, multiply = (
        arithmetic.builder, arithmetic.add, arithmetic.subtract, arithmetic.multiply,
    )  # fmt: skip
    size = arithmetic.function("abs", x)
    small = arithmetic.compare("le", size, np.float64(LARGEST_ANGLE))
    angle = arithmetic.select(small, x, ZERO)
    turns = builder.call("rint", "d", multiply(angle, np.float64(2.0 / np.pi)))
    # angle - turns pi/2 in two parts, high + low; every subtraction but the last is exact.
    high: Entry = angle
    low: Entry = ZERO
    for part in PARTS_OF_HALF_PI:
        product = multiply(turns, np.float64(part))
        total = subtract(high, product)
        lost = subtract(subtract(high, total), product)
        high, low = total, add(low, lost)
    low = subtract(low, multiply(turns, np.float64(REST_OF_HALF_PI)))
    rounded = add(high, low)
    low = add(subtract(high, rounded), low)
    high = rounded
    square = multiply(high, high)
    half = np.float64(0.5)
    # sin(high + low)
    cubic = multiply(square, high)
    rest = _polynomial(arithmetic, SINE[1:], square)
    inner = subtract(multiply(square, subtract(multiply(half, low), multiply(cubic, rest))), low)
    sine = subtract(high, subtract(inner, multiply(cubic, np.float64(SINE[0]))))
    # cos(high + low)
    halved = multiply(half, square)
    rest = multiply(multiply(square, square), _polynomial(arithmetic, COSINE, square))
    first = subtract(ONE, halved)
    lost = subtract(subtract(ONE, first), halved)
    cosine = add(first, add(lost, subtract(rest, multiply(high, low))))
    quarter = _integers(builder, "and", _whole_number(builder, turns), 3)
    odd = arithmetic.compare("ne", _integers(builder, "and", quarter, 1), np.int64(0))
    below = arithmetic.compare("ge", quarter, np.int64(2))
    left = arithmetic.compare("ne", _integers(builder, "and", _integers(builder, "add", quarter, 1), 2), np.int64(0))
    of_sine, of_cosine = arithmetic.select(odd, cosine, sine), arithmetic.select(odd, sine, cosine)
    of_sine = arithmetic.select(below, arithmetic.negative(of_sine), of_sine)
    of_cosine = arithmetic.select(left, arithmetic.negative(of_cosine), of_cosine)
    # Zero keeps its sign.
    of_sine = arithmetic.select(arithmetic.compare("eq", x, ZERO), x, of_sine)
    return _where_large(builder, arithmetic, small, x, of_sine, of_cosine)


def _where_large(builder: Builder, arithmetic: Arithmetic, small, x: Value, *values) -> tuple[Value, Value]:
    """Sine and cosine, of angles that are not small by the C library."""
    large = arithmetic.invert(small)
    before = builder.block
    builder.line(f"br i1 {builder.any(large)}, label %large, label %joined")
    builder.begin("large")
    taken = [arithmetic.select(large, builder.call(name, "d", x), y) for name, y in zip(("sin", "cos"), values)]
    builder.line("br label %joined")
    builder.begin("joined")
    found = []
    for name, a, b in zip(("sine", "cosine"), values, taken):
        builder.line(f"%{name} = phi #d [ {a.name}, %{before} ], [ {b.name}, %large ]")
        found.append(Value(f"%{name}", "d"))
    return found[0], found[1]


def _exponential(arithmetic: Arithmetic, x: Value) -> tuple[Value]:
    builder, subtract, multiply = arithmetic.builder, arithmetic.subtract, arithmetic.multiply
    no_number = arithmetic.compare("ne", x, x)
    bounded = arithmetic.smaller(arithmetic.larger(x, np.float64(UNDERFLOW)), np.float64(OVERFLOW))
    bounded = arithmetic.select(no_number, ZERO, bounded)
    power = builder.call("rint", "d", multiply(bounded, np.float64(1.0 / np.log(2.0))))
    high = subtract(bounded, multiply(power, np.float64(LN_2[0])))
    low = multiply(power, np.float64(LN_2[1]))
    rest = subtract(high, low)
    square = multiply(rest, rest)
    c = subtract(rest, multiply(square, _polynomial(arithmetic, EXPONENTIAL, square)))
    quotient = arithmetic.divide(multiply(rest, c), subtract(np.float64(2.0), c))
    value = subtract(ONE, subtract(subtract(low, quotient), high))
    # 2^power in two factors: neither overflows where the result does not.
    whole = _whole_number(builder, power)
    half = _integers(builder, "ashr", whole, 1)
    for part in (half, _integers(builder, "sub", whole, half)):
        biased = _integers(builder, "add", part, BIAS)
        value = multiply(value, _from_bits(builder, _integers(builder, "shl", biased, BITS_OF_FRACTION)))
    value = arithmetic.select(arithmetic.compare("gt", x, np.float64(OVERFLOW)), np.float64(np.inf), value)
    value = arithmetic.select(arithmetic.compare("lt", x, np.float64(UNDERFLOW)), ZERO, value)
    found = arithmetic.select(no_number, x, value)
    assert isinstance(found, Value)
    return (found,)


def _logarithm(arithmetic: Arithmetic, x: Value) -> tuple[Value]:
    builder, add, subtract, multiply = (
        arithmetic.builder, arithmetic.add, arithmetic.subtract, arithmetic.multiply,
    )  # fmt: skip
    tiny = arithmetic.compare("lt", x, np.float64(np.finfo(float).tiny))
    normal = arithmetic.select(tiny, multiply(x, np.float64(2.0**54)), x)
    bits = _as_bits(builder, normal)
    # x = 2^power m, m from sqrt(1/2) to sqrt(2).
    shift = (BIAS << BITS_OF_FRACTION) - int(np.float64(np.sqrt(0.5)).view(np.int64))
    moved = _integers(builder, "add", bits, shift)
    exponent = _integers(builder, "sub", _integers(builder, "ashr", moved, BITS_OF_FRACTION), BIAS)
    fraction = _integers(builder, "sub", bits, _integers(builder, "shl", exponent, BITS_OF_FRACTION))
    power: Entry = builder.operation("d", f"sitofp #l {exponent.name} to #d")
    power = subtract(power, arithmetic.select(tiny, np.float64(54.0), ZERO))
    f = subtract(_from_bits(builder, fraction), ONE)
    s = arithmetic.divide(f, add(np.float64(2.0), f))
    z = multiply(s, s)
    r = multiply(z, _polynomial(arithmetic, LOGARITHM, z))
    halved = multiply(multiply(np.float64(0.5), f), f)
    inner = add(multiply(s, add(halved, r)), multiply(power, np.float64(LN_2[1])))
    value = subtract(multiply(power, np.float64(LN_2[0])), subtract(subtract(halved, inner), f))
    value = arithmetic.select(arithmetic.compare("eq", x, np.float64(np.inf)), x, value)
    value = arithmetic.select(arithmetic.compare("eq", x, ZERO), np.float64(-np.inf), value)
    value = arithmetic.select(arithmetic.compare("lt", x, ZERO), np.float64(np.nan), value)
    found = arithmetic.select(arithmetic.compare("ne", x, x), x, value)
    assert isinstance(found, Value)
    return (found,)
