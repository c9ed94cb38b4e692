"""A jaxpr as the text of a module for LLVM.

Place in the pipeline: emission, foreign_function -> **programs** -> primitive.
"""

import hashlib
from typing import NamedTuple

import numpy as np
from jax.extend.core import ClosedJaxpr

from rfem_jax.kernels import foreign_function
from rfem_jax.kernels.builder import Builder, filled, kind_of
from rfem_jax.kernels.emission import Emitter
from rfem_jax.kernels.entries import of_shape
from rfem_jax.kernels.foreign_function import Buffer


class Program(NamedTuple):
    """A program without the number of lanes: text of its body, intrinsics that it declares, and where its operands and
    results are in the workspace, which has so many slots; operations: of vectors."""

    body: str
    declarations: str
    operands: list[Buffer]
    results: list[Buffer]
    slots: int
    operations: int

    def module(self, lanes: int) -> tuple[str, str]:
        """Name of the handler and text of the module for a number of lanes.  The name is that of the content: a program
        of XLA that was kept on disk names what it calls."""
        body = filled(f"define internal void @program(ptr %workspace) {{\nentry:\n{self.body}\nret void\n}}", lanes)
        declarations = filled(self.declarations, lanes)
        layout = repr((self.operands, self.results, self.slots, lanes, foreign_function.interface_version()))
        digest = hashlib.sha256("\n".join([body, declarations, layout]).encode()).hexdigest()[:32]
        name = f"kernel_{digest}"
        handler = foreign_function.handler(name, self.operands, self.results, self.slots, lanes)
        return name, "\n".join([declarations, body, handler])


def emit(program: ClosedJaxpr) -> Program:
    """The program of a jaxpr.

    **Raises:** `Unsupported` for an operation, or a type of numbers, without machine code.
    """
    builder = Builder()
    emitter = Emitter(builder)

    def buffers(variables) -> list[Buffer]:
        found = []
        for variable in variables:
            size = int(np.prod(variable.aval.shape, dtype=int))
            found.append(Buffer(kind_of(variable.aval.dtype), size, builder.reserve(size)))
        return found

    operands = buffers(program.jaxpr.invars)
    given = [
        of_shape([builder.load(kind, slot + i) for i in range(size)], variable.aval.shape)
        for (kind, size, slot), variable in zip(operands, program.jaxpr.invars)
    ]
    found = emitter.run(program, given)
    results = buffers(program.jaxpr.outvars)
    for (kind, _, slot), array in zip(results, found):
        for i, entry in enumerate(array.flat):
            builder.store(entry, kind, slot + i)
    functions = [text for _, text in builder.functions.values()]
    declarations = "\n".join([*sorted(builder.intrinsics.values()), *functions])
    return Program("\n".join(builder.lines), declarations, operands, results, builder.slots, builder.operations)
