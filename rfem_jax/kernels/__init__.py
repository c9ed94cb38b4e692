"""Functions of small arrays as machine code of their own, called by XLA.

XLA's compiler for CPUs is made for large arrays: a program of ten thousand operations on arrays of three rows takes it
many seconds, and runs many times slower than its arithmetic.  Here every entry of every array is a vector over samples,
LLVM compiles the operations on these as they stand, and JAX sees one primitive with rules for batches and derivatives.

    transformations   batches, directions, derivatives and transposes of kernels
    primitive         `kernel(function)`: the primitive
    bodies            the jaxpr of a kernel, and what is made of it
    contents          a jaxpr as a digest, under which all of this is kept
    programs          a jaxpr as the text of a module for LLVM
    emission          primitives of JAX as operations on entries
    places            entries at places that are known or computed
    linear_algebra    LU factors, triangular systems and singular values, of other primitives
    long_arrays       operations on long arrays as loops, where code is to be short
    newer_primitives  primitives that newer versions of JAX have in place of several
    loops             loops and branches, over all samples at once
    vector_math       sine, cosine, exponential function and logarithm of vectors
    arithmetic        operations on entries; known numbers are folded
    memory            arrays in the workspace: where they lie, rows, copies
    entries           arrays as NumPy's arrays of entries
    builder           LLVM's assembly language
    foreign_function  the function that XLA calls
    machine_code      the compiler (llvmlite)
    registry          handlers by their names, and where object code is kept

The package knows nothing of mechanics, and uses public interfaces of JAX and llvmlite alone (docs/kernels.md).
"""

from rfem_jax.kernels import linear_algebra, newer_primitives, transformations  # noqa: F401 # tell JAX and the emitter
from rfem_jax.kernels.bodies import expecting, left_to_xla
from rfem_jax.kernels.emission import expand_primitive
from rfem_jax.kernels.machine_code import is_available
from rfem_jax.kernels.primitive import kernel

__all__ = ["expand_primitive", "expecting", "is_available", "kernel", "left_to_xla"]
