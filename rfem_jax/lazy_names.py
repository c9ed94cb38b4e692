"""Public names of a package that are loaded when they are first used: importing it stays instant.

Place in the pipeline: the `__init__.py` of packages whose parts a process rarely needs all.
"""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_names(
    package: str, names: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """A package's `__getattr__`, `__dir__` and `__all__`.

    **Arguments:** `names`: {module below the package: its public names, separated by spaces}.
    """
    module_of = {name: module for module, some in names.items() for name in some.split()}

    def load(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{module_of[name]}"), name)

    return load, lambda: sorted(module_of), sorted(module_of)
