"""How XLA compiles a simulation on a CPU: every loop over steps as one function.

XLA's own choice is a call from a table for each operation of a loop's body, and these calls cost more than
the few numbers that a mechanism has.  Options of the compiler are read once in a process, before
its first array, and so is what goes with them: explicit right-hand sides, and if wanted the steps of
implicit methods, as programs of scalars.
"""

import os

import jaxlib

from rfem_jax.description.errors import InputError

# Loops of any size; values used twice are computed once; loops over axes are not written out, which
# would double the time of compilation.
OPTIONS = (
    "xla_cpu_small_while_loop_byte_threshold=1000000000000000",
    "xla_cpu_use_multi_output_fusion=true",
    "xla_cpu_disable_loop_unrolling=true",
)
# Products of small matrices by a library are calls again, which end the function.
NO_LIBRARY = "--xla_cpu_experimental_ynn_fusion_type="
KNOWN = "0.10."  # jaxlib; another version may refuse to start with a flag that it does not know

_chosen = {"whole loops": False, "scalars": False}


def compile_whole_loops(*, scalars: bool = False) -> bool:
    """Let XLA compile loops over steps as single functions: call it right after the imports.

    An implicit simulation then runs about 2 times faster on a CPU, an explicit one, whose right-hand side becomes
    a program of scalars, 8 (in a batch) to 16 (alone) times; programs take about as long to compile as
    otherwise, those of derivatives two to three times as long.  Results agree to rounding.

    **Arguments:** `scalars`: also the steps of the implicit method, and their derivatives, as programs of
    scalars: 2 to 3 times faster again, for half a minute more of compilation (a derivative: two to four
    minutes in all).  It pays for tens of thousands of simulations.

    **Returns:** whether it did; not if the environment variable XLA_FLAGS has options of this kind or
    names a file, or if the version of jaxlib is not one for which the flags are known.

    **Raises:** InputError when JAX has started already.
    """
    own = f"{NO_LIBRARY} --xla_backend_extra_options={','.join(OPTIONS)}"
    # A second call, or a process that this one has started, finds them.
    flags = os.environ.get("XLA_FLAGS", "").strip().removeprefix(own).strip()
    names_a_file = bool(flags) and not flags.startswith("-")
    if names_a_file or "xla_backend_extra_options" in flags or "ynn_fusion" in flags:
        return False
    if not jaxlib.__version__.startswith(KNOWN):
        return False
    _require_not_started()
    # First: XLA reads no further than a word that is no flag.
    os.environ["XLA_FLAGS"] = f"{own} {flags}".strip()
    _chosen.update({"whole loops": True, "scalars": scalars})
    return True


def explicit_in_scalars() -> bool:
    """Whether right-hand sides of explicit methods are programs of scalars: seconds more to compile."""
    return _chosen["whole loops"] and _on_cpu()


def implicit_in_scalars() -> bool:
    """Whether steps of implicit methods are programs of scalars."""
    return _chosen["scalars"] and _on_cpu()


def _on_cpu() -> bool:
    import jax

    return jax.default_backend() == "cpu"


def _require_not_started() -> None:
    """Raises InputError when JAX has read its options already."""
    import jax

    devices = jax.config.jax_num_cpu_devices
    try:
        # JAX refuses to change this number once it has started.
        jax.config.update("jax_num_cpu_devices", devices + 1)
        jax.config.update("jax_num_cpu_devices", devices)
    except RuntimeError:
        raise InputError(
            "compile_whole_loops() must be called before the first array is made, but JAX has started "
            "(load_study makes arrays, too); move the call to the top, after the imports."
        ) from None
