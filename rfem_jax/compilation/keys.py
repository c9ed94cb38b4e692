"""The key of a kept program: a digest of everything that it depends on.

Place in the pipeline: `program` asks for the key of a function and its arguments; tolerancing for that of a problem.

Structure and static values enter by content; arrays among the arguments, which are inputs of the program, by shape
and type; arrays inside of functions and static fields by content.  Functions and classes enter by name where their
source is covered: the files of this package are part of the key, and so are the versions of the libraries.  Fields
that are left out where objects are compared (`compare=False`) are no content.  Anything else that a program could
depend on, such as a function of the user, is refused.
"""

import dataclasses
import enum
import functools
import hashlib
import os
import platform
import sys
import types
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.sharding import Mesh

from rfem_jax.kernels import machine_code
from rfem_jax.usable_cores import usable_cores

PACKAGE = "rfem_jax"
# Their versions are part of the key.
LIBRARIES = ("jax", "jaxlib", "diffrax", "equinox", "optimistix", "lineax", "jaxtyping", "numpy", "scipy")
COVERED = frozenset((PACKAGE, "builtins", "functools", "operator", "math", *LIBRARIES))
# Environment variables that XLA and Equinox read, and the number of threads for which XLA divides loops.
VARIABLES = ("XLA_", "TF_XLA_", "EQX_", "NPROC")
# Settings of JAX about its cache and its messages, which do not change what is compiled.
UNRELATED = ("compilation_cache", "persistent_cache", "jax_log", "traceback", "_dump", "explain_cache_misses")
SIMPLE = (str, int, float, complex, bool, bytes, type(None), type(...))


class NotDigestible(Exception):
    """The program depends on something whose content is not known."""


def digest_named(name: tuple) -> str:
    """SHA-256 (hexadecimal) of a program's name and of everything else that it depends on.

    **Arguments:** `name`: nested tuples of plain data, shapes, types and shardings.
    """
    return hashlib.sha256(repr((surroundings(), _plain(name))).encode()).hexdigest()


def _plain(name):
    if isinstance(name, tuple):
        return tuple(map(_plain, name))
    return repr(name)


def canonical(value: Any, by_content: bool = False) -> tuple:
    """Nested tuples of strings that are equal for equal content only.

    **Arguments:** `by_content`: whether arrays enter by content, not by shape and type.

    **Raises:** `NotDigestible` for a value whose content is not known.
    """
    if isinstance(value, SIMPLE) and type(value).__module__ == "builtins":
        return type(value).__name__, value.hex() if isinstance(value, float) else repr(value)
    if isinstance(value, (np.ndarray, np.generic, jax.Array)):
        return _of_array(value, by_content)
    if isinstance(value, ShapedArray | jax.ShapeDtypeStruct | np.dtype):
        return type(value).__name__, str(value), str(getattr(value, "weak_type", ""))
    if isinstance(value, type):
        return "class", _name(value)
    if isinstance(value, enum.Enum):
        return "member", _name(type(value)), value.name
    if isinstance(value, Mesh):
        devices = tuple(str(device) for device in value.devices.flat)
        return "mesh", str(value.axis_names), str(value.devices.shape), devices
    if isinstance(value, dict):
        pairs = tuple((canonical(k, True), canonical(v, by_content)) for k, v in value.items())
        return _name(type(value)), pairs
    if isinstance(value, (tuple, list)):
        return _name(type(value)), tuple(canonical(item, by_content) for item in value)
    if isinstance(value, (set, frozenset)):
        return _name(type(value)), tuple(sorted(repr(canonical(item, True)) for item in value))
    if isinstance(value, functools.partial):
        return "partial", *(canonical(x, by_content) for x in (value.func, value.args, value.keywords))
    if dataclasses.is_dataclass(value):
        return _of_dataclass(value, by_content)
    return _of_function(value)


def _of_array(value, by_content: bool):
    if isinstance(value, Tracer):
        raise NotDigestible("a traced value")
    if not by_content:
        weak = bool(getattr(value, "weak_type", False))
        return "array", str(value.shape), str(value.dtype), str(weak)
    content = np.asarray(value)
    if content.dtype == object:
        raise NotDigestible("an array of objects")
    data = hashlib.sha256(np.ascontiguousarray(content).tobytes()).hexdigest()
    return type(value).__name__, str(content.shape), str(content.dtype), data


def _of_dataclass(value, by_content: bool):
    parts = []
    for field in dataclasses.fields(value):
        if not field.compare:
            continue
        static = by_content or field.metadata.get("static", False)
        content = getattr(value, field.name, None)
        parts.append((field.name, canonical(content, static)))
    return _name(type(value)), tuple(parts)


def _of_function(value):
    if isinstance(value, types.MethodType):
        return "method", canonical(value.__func__, True), canonical(value.__self__, True)
    if isinstance(value, types.FunctionType):
        _require_covered(value)
        cells = tuple(cell.cell_contents for cell in value.__closure__ or ())
        inside = canonical((cells, value.__defaults__, value.__kwdefaults__), True)
        # Two lambdas of one function differ by their lines.
        line = str(value.__code__.co_firstlineno), value.__code__.co_code.hex()
        return "function", value.__module__, value.__qualname__, line, inside
    # Other objects that their own module knows by name: `jnp.sin`, a built-in, a jitted function.
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    found = sys.modules.get(module or "")
    for part in (name or "").split("."):
        found = getattr(found, part, None)
    if found is None or found is not value:
        raise NotDigestible(f"an object of {type(value).__module__}.{type(value).__qualname__}")
    _require_covered(value)
    return "named", module, name


def _name(kind: type) -> str:
    _require_covered(kind)
    return f"{kind.__module__}.{kind.__qualname__}"


def _require_covered(value) -> None:
    """Raises NotDigestible unless the source of a function or class is part of the key."""
    module = getattr(value, "__module__", None) or ""
    package, known = module.split(".")[0], sys.modules.get(module)
    if package not in COVERED or known is None:
        raise NotDigestible(f"{module}.{getattr(value, '__qualname__', value)}")
    if isinstance(value, types.FunctionType) and value.__globals__ is not vars(known):
        raise NotDigestible(f"{module}.{value.__qualname__}")


@functools.cache
def hash_sources() -> str:
    """SHA-256 of all files of this package, read once (the version of an editable install does not change)."""
    return read_sources()


def read_sources() -> str:
    """As `hash_sources`, read again."""
    root = Path(__file__).parents[1]
    parts = [(path.relative_to(root).as_posix(), path.read_bytes()) for path in root.rglob("*.py")]
    return hashlib.sha256(repr(sorted(parts)).encode()).hexdigest()


# Read before the other modules are imported; `program` reads again and keeps nothing if a file has changed since.
hash_sources()


def surroundings() -> tuple:
    """Versions, machine, options and settings at present."""
    changing = tuple(
        (name, repr(read_setting(name)))
        for name in sorted(jax.config.values)
        if not any(word in name for word in UNRELATED)
    )
    variables = tuple(sorted(x for x in os.environ.items() if x[0].startswith(VARIABLES)))
    flags = os.environ.get("XLA_FLAGS", "").strip()
    if flags and not flags.startswith("-"):
        variables += (Path(flags).read_text(encoding="utf-8", errors="replace"),)
    kernels = machine_code.processor() if machine_code.is_available() else ""
    fixed = _versions(), _processor(), hash_sources(), kernels
    return *fixed, changing, variables, _devices()


def read_setting(name: str) -> Any:
    """The value of a setting of JAX in this thread."""
    return getattr(jax.config, name) if hasattr(jax.config, name) else jax.config.read(name)


def digest_content(value: Any) -> str:
    """SHA-256 (hexadecimal) of a value with all its numbers, of this package's sources and of the libraries'
    versions: the same on every machine.

    **Raises:** `NotDigestible`, as `canonical`.
    """
    whole = _versions(), hash_sources(), canonical(value, True)
    return hashlib.sha256(repr(whole).encode()).hexdigest()


def digest_value(value: Any) -> str:
    """SHA-256 (hexadecimal) of a value with all its numbers alone.

    **Raises:** `NotDigestible`, as `canonical`.
    """
    return hashlib.sha256(repr(canonical(value, True)).encode()).hexdigest()


@functools.cache
def _versions():
    from importlib.metadata import PackageNotFoundError, version

    def of(name):
        try:
            return version(name)
        except PackageNotFoundError:
            return getattr(sys.modules.get(name), "__version__", "")

    return sys.version, tuple((name, of(name)) for name in LIBRARIES)


@functools.cache
def _processor():
    """Model and features of the processor, and the number of cores, for which programs are divided."""
    words = {"model name", "flags", "Features", "CPU part"}
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    found = sorted({line for line in lines if line.split(":")[0].strip() in words})
    cores = os.cpu_count(), usable_cores()
    return platform.platform(), platform.machine(), platform.processor(), str(cores), tuple(found)


def _devices():
    devices = jax.devices()
    kinds = tuple(f"{device} {device.device_kind}" for device in devices)
    return devices[0].client.platform_version, jax.process_index(), jax.process_count(), kinds
