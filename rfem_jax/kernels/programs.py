"""A jaxpr as the text of a module for LLVM.

Place in the pipeline: emission, foreign_function -> **programs** -> primitive.
"""

import hashlib
import math
import threading
from typing import NamedTuple

from jax.extend.core import ClosedJaxpr

from rfem_jax.kernels import foreign_function, machine_code
from rfem_jax.kernels.builder import Builder, filled, kind_of
from rfem_jax.kernels.emission import Emitter
from rfem_jax.kernels.foreign_function import Buffer
from rfem_jax.kernels.memory import in_one_piece, stored

MOST_TEXT = 30_000_000  # characters of programs that are remembered


class Program(NamedTuple):
    """A program without the number of lanes: text of its body, intrinsics that it declares, and where its operands and
    results are in the workspace, which has so many slots; operations: of vectors; work: how many of these are carried
    out, with a guess of the turns of loops that end by a condition."""

    body: str
    declarations: str
    operands: list[Buffer]
    results: list[Buffer]
    slots: int
    operations: int
    work: int

    def module(self, lanes: int, thorough: bool, digest: str | None = None) -> tuple[str, str]:
        """Name of the handler and text of the module for a number of lanes.  The name is that of the content, whose
        digest may be known: a program of XLA that was kept on disk names what it calls."""
        begin = "define internal void @program(ptr %workspace) {\nentry:\n%never = icmp eq ptr %workspace, null"
        body = filled(f"{begin}\n{self.body}\nret void\nnowhere:\nret void\n}}", lanes)
        declarations = filled(self.declarations, lanes)
        if digest is None:
            interface = foreign_function.interface_version()
            layout = repr((self.operands, self.results, self.slots, interface, machine_code.processor()))
            digest = hashlib.sha256("\n".join([body, declarations, layout]).encode()).hexdigest()[:40]
        name = handler_name(digest, lanes, thorough)
        handler = foreign_function.handler(name, self.operands, self.results, self.slots, lanes)
        return name, "\n".join([declarations, body, handler])


def handler_name(digest: str, lanes: int, thorough: bool) -> str:
    """Name under which XLA finds the machine code of a program for a number of lanes."""
    return f"kernel_{digest}_{lanes}_{'thorough' if thorough else 'fast'}"


_recent: dict[str, Program] = {}
_lock = threading.Lock()


def emitted(program: ClosedJaxpr, short: bool, digest: str) -> Program:
    """As `emit`, whose last programs are remembered by their digests: another number of lanes has the same one."""
    with _lock:
        found = _recent.pop(digest, None)
    found = emit(program, short) if found is None else found
    with _lock:
        _recent[digest] = found
        while len(_recent) > 1 and sum(len(one.body) for one in _recent.values()) > MOST_TEXT:
            del _recent[next(iter(_recent))]
    return found


def emit(program: ClosedJaxpr, short: bool = False) -> Program:
    """The program of a jaxpr; `short`: with loops over long arrays (`long_arrays`).

    **Raises:** `Unsupported` for an operation, or a type of numbers, without machine code.
    """
    builder = Builder(fuses=machine_code.fuses() and not short)
    emitter = Emitter(builder, short)

    def operand(variable) -> Buffer:
        size = math.prod(variable.aval.shape)
        return Buffer(kind_of(variable.aval.dtype), size, builder.reserve(size))

    def result(variable, array) -> Buffer:
        kind = kind_of(variable.aval.dtype)
        return Buffer(kind, array.size, in_one_piece(builder, array, kind))

    operands = [operand(variable) for variable in program.jaxpr.invars]
    given = [stored(builder, b.kind, b.slot, v.aval.shape) for b, v in zip(operands, program.jaxpr.invars)]
    results = [*map(result, program.jaxpr.outvars, emitter.run(program, given))]
    functions = [text for _, text in builder.functions.values()]
    builder.finish()
    tables = [f"{name} = {text}" for text, name in builder.tables.items()]
    declarations = "\n".join([*tables, *sorted(builder.intrinsics.values()), *functions])
    return Program(
        "\n".join([*builder.beginning(), *builder.lines]),
        declarations,
        operands,
        results,
        builder.slots,
        builder.operations,
        builder.work,
    )
