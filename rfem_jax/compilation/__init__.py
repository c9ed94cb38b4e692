"""How programs are made of the equations: what XLA is told, and what it is given.

    whole_loops    options of XLA: every loop over steps as one function
    scalars        functions of small arrays as lists of scalar operations

Of the subject it knows nothing; the other rooms ask it which way was chosen.
"""

from rfem_jax.compilation.whole_loops import compile_whole_loops

__all__ = ["compile_whole_loops"]
