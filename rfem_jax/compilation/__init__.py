"""How programs are compiled and kept.

    options          XLA's options, for the whole process
    cache, keys      executables on disk, and what they depend on
    keeping          whether and where programs are kept
    executable       a compiled program as bytes, and back
    call             a function of arrays that is kept, and its derivatives and batches
    transformations  the same as a primitive of JAX
    program          `Program`, in place of `eqx.filter_jit`
    scalars          right-hand sides by arithmetic on the entries of arrays
    stages           what is being done, told to whoever shows it

Place in the pipeline: below mechanics.
"""
