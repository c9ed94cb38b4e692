"""How functions are compiled, and kept on disk for the next process.

    options          XLA's options, for the whole process
    cache, keys      compiled programs on disk, and what they depend on
    keeping          whether and where programs are kept
    executable       a compiled program as bytes, and back
    call             a function of arrays whose compiled program is kept, and its derivatives and batches
    transformations  the same as a primitive of JAX
    program          `Program`, which is used in place of `eqx.filter_jit`
    parts            functions that are sequences of programs
    tracing_context  the same for functions and for the rules of their derivatives
    unbatched_calls  calls within `jax.vmap` that have no batch
    scalarisation    jaxprs of arrays as jaxprs of scalars
    stages           what is being computed, for whoever shows it

Place in the pipeline: below mechanics.
"""
