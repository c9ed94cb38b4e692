"""The process of a command: precision, devices, compiler, cache of programs, other processes with which it shares.

Place in the pipeline: command_line calls it before anything else; JAX reads most of it only once.
"""

import argparse
import os
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from rfem_jax.usable_cores import usable_cores

MOST_DEVICES = 64  # on a machine with fewer cores


def require_platform() -> None:
    """See that JAX finds a device. Raises InputError where JAX_PLATFORMS asks for one that is not there."""
    import jax

    try:
        jax.devices()
    except (RuntimeError, AssertionError) as problem:
        from rfem_jax.description.basics.errors import InputError

        wanted = os.environ.get("JAX_PLATFORMS") or jax.config.jax_platforms  # pyright: ignore[reportAttributeAccessIssue]  # added at run time
        raise InputError(
            f"Environment variable JAX_PLATFORMS must name a kind of device that this machine has, but is {wanted!r} "
            f"({(str(problem).splitlines() or ['none was found'])[0]}); leave it out, or write cpu."
        ) from problem


def set_up_jax(devices: int | None = None, cache: bool = True, out: str | Path | None = None) -> None:
    """Double precision, `devices` CPU devices (None: one), and unless not `cache`: programs kept
    in the user's folder, and JAX's own cache (in a folder of the user's choice) for what cannot be kept."""
    # SciPy's LAPACK keeps its threads spinning after every call, which would take half of the processor.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import jax

    from rfem_jax.compilation import keeping

    jax.config.update("jax_enable_x64", True)
    if devices is not None:
        # A device's program waits on a thread of XLA's pool while its batched LU needs others: with
        # as many threads as devices (XLA's own choice) all of them could wait for ever.
        os.environ.setdefault("NPROC", str(2 * max(devices, os.cpu_count() or 1)))
        jax.config.update("jax_num_cpu_devices", devices)
    if out is not None:
        keeping.keep_apart_from(out)
    if not cache:
        keeping.keep_programs(None)
        jax.config.update("jax_enable_compilation_cache", False)
        return
    if jax.config.jax_compilation_cache_dir is not None:  # pyright: ignore[reportAttributeAccessIssue]  # as above
        return
    folder = keeping.folder_for_jax()
    if folder is None:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # The default keeps only what took a second; a study has dozens of smaller programs.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def count_devices(arguments: argparse.Namespace) -> int | None:
    """CPU devices that a command on a study asks for: all cores unless it says otherwise; None for other commands.

    `check` has as many as the commands that compute samples, for a compiled program serves only processes of as many
    devices.  Raises InputError for a number below 1.
    """
    from rfem_jax.description.basics.errors import InputError

    if not hasattr(arguments, "study"):
        return None
    if getattr(arguments, "devices", None) is None:
        return usable_cores()
    if arguments.devices < 1:
        raise InputError(
            f"Argument `--devices` must be at least 1, but is {arguments.devices}; leave it out to use all cores."
        )
    most = max(MOST_DEVICES, os.cpu_count() or 1)
    if arguments.devices > most:
        raise InputError(
            f"Argument `--devices` must be at most {most} here, but is {arguments.devices}; each takes memory and "
            "threads: leave it out to use all cores."
        )
    return arguments.devices


def sharing(arguments: argparse.Namespace) -> AbstractContextManager[None]:
    """Context in which this process does its part of the work of several, if the command names them.

    They meet in the folder of results alone; `--coordinator` of earlier versions is not needed.
    Raises InputError for an incomplete or impossible set of options.
    """
    processes, process = (getattr(arguments, name, None) for name in ("processes", "process_id"))
    if processes is None and process is None:
        return nullcontext()
    from rfem_jax.description.basics.errors import InputError

    if processes is None or process is None or processes < 1 or not 0 <= process < processes:
        raise InputError(
            f"Arguments `--processes` N and `--process-id` I must both be given, with 0 <= I < N, but are {processes} "
            f"and {process}; complete them."
        )
    from rfem_jax.tolerancing.problems.sharing import shared_among

    return shared_among(process, processes)
