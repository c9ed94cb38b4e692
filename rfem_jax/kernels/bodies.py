"""What a kernel is made of: its jaxpr for one sample, the machine code, and the kernels that are derived from it.

Place in the pipeline: programs, contents, machine_code, registry -> **bodies** -> primitive.
"""

import functools
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from rfem_jax.kernels import contents, machine_code, programs, registry
from rfem_jax.kernels.builder import TooLarge, Unsupported
from rfem_jax.kernels.entries import shape_of, size_of

LARGEST_ARRAYS = 5_000_000  # entries of all arrays, of which it would take long to find that they are too many
LARGEST_IN_PARTS = 1_000_000  # of a kernel in parts, in whose place XLA compiles what is between these in two seconds
# Turns of a program, times blocks of samples, from which on it is compiled thoroughly: that takes 0.1 ms an operation
# more and saves 0.35 ns of each turn of it, which pays after a hundred runs of so many turns.
THOROUGH_FROM = 8000
THOROUGH_UP_TO = 60_000  # operations: more would take longer than anyone waits who did not ask for it


_expected, _choice = threading.local(), threading.local()


@contextmanager
def left_to_xla() -> Iterator[None]:
    """Let XLA compile the kernels that this thread traces in the block, in a `jax.jit` of the caller: to compare."""
    before, _choice.xla = is_left_to_xla(), True
    try:
        yield
    finally:
        _choice.xla = before


def is_left_to_xla() -> bool:
    """Whether kernels that this thread compiles are left to XLA."""
    return getattr(_choice, "xla", False)


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


class Size(NamedTuple):
    """Operations of a program, and how many of them are carried out (see `programs.Program`)."""

    operations: int
    work: int


def thorough_pays(size: Size, blocks: int) -> bool:
    """Whether a program for so many blocks of samples is to be compiled thoroughly, where that is left open."""
    turns = expected_runs() * blocks * size.work / max(size.operations, 1)
    return turns >= THOROUGH_FROM and size.operations <= THOROUGH_UP_TO


class Body:
    """The jaxpr of a kernel for one sample, and what was made of it; compared by identity.

    A derivative's jaxpr is made when it is asked for: it never is where nothing needs its values.

    Attributes: operands, results: their shapes and types; plain: a function of the same operands and results for XLA,
    None: the jaxpr; reverse: one that reverse mode takes, None: the jaxpr; linear_from: number of the first operand in
    which the kernel is linear, None where it is in none; origin: of a tangent the kernel and its moving operands;
    single: of a tangent in several directions that in one, and which operands have directions; long: whether it has a
    loop whose turns are not to be remembered; in_parts: whether it is differentiated as if it were no kernel; order:
    of the derivatives in it.
    """

    def __init__(
        self,
        make: Callable[[], ClosedJaxpr],
        operands: Sequence[jax.ShapeDtypeStruct],
        results: Sequence[jax.ShapeDtypeStruct],
        name: str,
        selection: str,
        plain: Callable | None = None,
    ) -> None:
        self._make, self.operands, self.results = make, operands, results
        self.name, self.selection, self.plain = name, selection, plain
        self.reverse: Callable | None = None
        self.linear_from: int | None = None
        self.origin: tuple[Body, tuple[int, ...]] | None = None
        self.single: tuple[Body, tuple[bool, ...]] | None = None
        self.long, self.in_parts, self.order = False, False, 0
        self._emitted: programs.Program | None = None
        self._size: Size | Unsupported | None = None
        self._handlers: dict[tuple[int, bool], str] = {}
        self._derived: dict[Any, Body] = {}
        self._lock = threading.RLock()

    @classmethod
    def of(cls, program: ClosedJaxpr, name: str, selection: str) -> "Body":
        """Of a jaxpr."""
        operands, results = map(shape_of, program.jaxpr.invars), map(shape_of, program.jaxpr.outvars)
        return cls(lambda: program, [*operands], [*results], name, selection)

    @functools.cached_property
    def program(self) -> ClosedJaxpr:
        """The jaxpr."""
        with self._lock:
            return self._make()

    def by_xla(self, *operands: jax.Array, batched: tuple[bool, ...]) -> list[jax.Array]:
        """The results by JAX's own operations."""
        return over_samples(self.plain or jaxpr_as_fun(self.program), batched)(*operands)

    @functools.cached_property
    def digest(self) -> str | None:
        """Of the content of the jaxpr, None if it is not known."""
        return contents.digest_of(self.program, self.in_parts)

    def size(self) -> Size | Unsupported:
        """The size of the program, or why there is none; what was noted of the same content is not found again."""
        with self._lock:
            if self._size is None:
                if not machine_code.is_available():
                    self._size = Unsupported("llvmlite is not installed")
                else:
                    noted = registry.noted(f"size_{self.digest}") if self.digest else None
                    numbers = re.fullmatch(rb"(\d+) (\d+)", noted or b"")
                    self._size = Size(*map(int, numbers.groups())) if numbers else self._emitted_size()
                    if isinstance(self._size, Size) and 8 * self._size.operations > machine_code.stack_bytes():
                        self._size = TooLarge(f"{self._size.operations} operations, whose values do not fit on a stack")
            return self._size

    def _emitted_size(self) -> Size | Unsupported:
        largest = LARGEST_IN_PARTS if self.in_parts else LARGEST_ARRAYS
        if size_of(self.program) > largest:
            return TooLarge(f"arrays of {largest} entries in all")
        try:
            emitted = self._emission()
        except TooLarge as reason:
            return reason
        except Unsupported as reason:
            if not self.in_parts:
                warnings.warn(f"{self.name!r} is compiled by XLA: there is no machine code for {reason}.", stacklevel=2)
            return reason
        size = Size(emitted.operations, emitted.work)
        if self.digest:
            registry.note(f"size_{self.digest}", f"{size.operations} {size.work}".encode())
        return size

    def handler(self, lanes: int, blocks: int) -> str:
        """Name under which XLA finds the machine code for a number of lanes, and so many blocks of samples."""
        size = self.size()
        assert isinstance(size, Size)
        thorough = self.selection == "thorough"
        if self.selection == "automatic" and not self.in_parts:  # much of whose code is seldom run
            thorough = thorough_pays(size, blocks)

        def module() -> tuple[str, str]:
            return self._emission().module(lanes, thorough, self.digest)

        with self._lock:
            if (lanes, thorough) not in self._handlers:
                name = programs.handler_name(self.digest, lanes, thorough) if self.digest else module()[0]
                self._handlers[lanes, thorough] = name
            name = self._handlers[lanes, thorough]
            registry.announce(name, lambda: module()[1], thorough)
        return name

    def _emission(self) -> programs.Program:
        """The program, which is remembered by its content, or here where that is not known."""
        if self.digest:
            return programs.emitted(self.program, self.in_parts, self.digest)
        if self._emitted is None:
            self._emitted = programs.emit(self.program, self.in_parts)
        return self._emitted

    def derived(self, key: Any, make: Callable[[], "Derived"]) -> "Body":
        """The kernel of another function, made once."""
        with self._lock:
            if key not in self._derived:
                function, operands, results, plain = make()
                program = functools.partial(jax.make_jaxpr(function), *operands)
                made = Body(program, operands, results, self.name, self.selection, plain)
                made.long, made.order = self.long, self.order + (key[0] == "tangent")
                self._derived[key] = made
            return self._derived[key]

    def as_moving(self, operands: Sequence[Any], moving: Sequence[int], function: Callable | None = None) -> Callable:
        """The results that have derivatives, of the kernel or of another function in its place, as a function of the
        operands that move."""
        all_results = with_moving(operands, moving, function or jaxpr_as_fun(self.program))

        def of_moving(*inputs):
            results = all_results(*inputs)
            return [results[i] for i in self.continuous]

        return of_moving

    @property
    def continuous(self) -> list[int]:
        """Numbers of the results that have derivatives."""
        return [i for i, x in enumerate(self.results) if jnp.issubdtype(x.dtype, jnp.inexact)]


class Derived(NamedTuple):
    """What a kernel is made of: function, shapes and types of its arguments and of its results, function for XLA (None:
    the same)."""

    function: Callable
    operands: Sequence[jax.ShapeDtypeStruct]
    results: Sequence[jax.ShapeDtypeStruct]
    plain: Callable | None = None


def with_moving(operands: Sequence[Any], moving: Sequence[int], function: Callable) -> Callable:
    """A function of all operands as one of those that move."""

    def of_moving(*inputs):
        merged = list(operands)
        for i, x in zip(moving, inputs):
            merged[i] = x
        return function(*merged)

    return of_moving


def one_by_one(function: Callable, spread: Sequence[bool]) -> Callable:
    """The function for every row of the operands that have an axis of them in front, in a loop."""

    def each(*given):
        def one(rows):
            left = iter(rows)
            return function(*(next(left) if s else x for x, s in zip(given, spread)))

        return jax.lax.map(one, [x for x, s in zip(given, spread) if s])

    return each


def over_samples(function: Callable, batched: Sequence[bool]) -> Callable:
    """The function of operands some of which have an axis of samples in front."""
    return jax.vmap(function, in_axes=[0 if b else None for b in batched]) if any(batched) else function
