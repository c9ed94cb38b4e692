"""How many cores there are for this process.

Place in the pipeline: beside it; devices, threads and the keys of kept programs depend on it.
"""

import os


def usable_cores() -> int:
    """Number of cores that this process may use: of the machine, unless the system says which ones."""
    usable = getattr(os, "sched_getaffinity", None)
    return len(usable(0)) if usable else os.cpu_count() or 1
