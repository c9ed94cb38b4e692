"""Compiled programs, kept on disk for the next process.

    program      `Program`, which is used in place of `eqx.filter_jit`
    naming       the names of things among its arguments, which are no part of it
    executable   a compiled program as bytes, and back
    keys         what a kept program depends on
    cache        files in a folder of the user's own
    keeping      whether and where programs, and the object code of kernels, are kept
    stages       what is being computed, for whoever shows it

Place in the pipeline: kernels -> **compilation** -> everything else.
"""
