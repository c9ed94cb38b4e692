"""A compiled program with the structure of what it returns, as bytes for another process.

Place in the pipeline: `call` makes and runs it, `cache` keeps the bytes.

A program that was traced here, or read from disk, is finished by compiling or loading it, by any thread.
"""

import gc
import pickle
import threading
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache
from jaxlib.lapack import prepare_lapack_call

from rfem_jax.compilation import options
from rfem_jax.compilation.stages import on_stage

# Programs that call LAPACK on the CPU.  JAX looks up LAPACK's functions when it lowers such a program: without
# that, the addresses that a loaded program calls are null.
LAPACK = "lapack_"
# For programs that run once: LLVM's optimisations take longer than what they save.
QUICK = {"xla_backend_optimization_level": 0}


@dataclass(frozen=True)
class Place:
    """Stands for an array in what a function takes or returns."""


class Executable:
    """A compiled program of flat arrays."""

    def __init__(self, compiled, head: "Head"):
        self.compiled, self.head = compiled, head

    def __call__(self, arrays):
        return self.compiled(*arrays)

    def dump(self) -> bytes:
        """As bytes; `unpack` makes it again, in another process too.  Raises if XLA cannot."""
        program, _, _ = serialize_executable.serialize(self.compiled)
        devices = [device.id for device in self.compiled.runtime_executable().local_devices()]
        calls_lapack = LAPACK in self.compiled.as_text()
        return pickle.dumps(Packed(self.head, program, devices, calls_lapack))


class Head(NamedTuple):
    """Of a program: number of arguments, results as shapes and types, and `facts` about these (see `call`)."""

    inputs: int
    results: tuple[tuple[tuple[int, ...], Any, bool], ...]
    facts: list

    def shapes(self) -> list[jax.ShapeDtypeStruct]:
        """The results as shapes."""
        return [jax.ShapeDtypeStruct(shape, dtype, weak_type=weak) for shape, dtype, weak in self.results]


class Traced(NamedTuple):
    """A program that is to be compiled."""

    head: Head
    lowered: Any
    what: str
    quick: bool
    scalarised: bool

    def finish(self) -> Executable:
        """Compile it."""
        on_stage(f"Compiling the program {self.what!r}, once for all models of its kind")
        options.own_options_hold()
        with _without_jaxs_cache, options.own_program(self.scalarised):
            return Executable(self.lowered.compile(QUICK if self.quick else None), self.head)


class Packed(NamedTuple):
    """A compiled program as it lies on disk."""

    head: Head
    program: bytes
    devices: list[int]
    calls_lapack: bool

    def finish(self) -> Executable:
        """Load it."""
        if self.calls_lapack:
            prepare_lapack_call("getrf_ffi", np.dtype("float64"))
        by_id = {device.id: device for device in jax.local_devices()}
        devices = [by_id[number] for number in self.devices]
        takes = jax.tree.structure(((0,) * self.head.inputs, {}))
        returns = jax.tree.structure([0] * len(self.head.results))
        compiled = serialize_executable.deserialize_and_load(
            self.program, takes, returns, backend=devices[0].client, execution_devices=devices
        )
        return Executable(compiled, self.head)


def trace(function, arrays, facts, quick: bool) -> Traced:
    """Trace `function` of arrays or shapes; `facts()` is called when it has been."""
    what = function.__name__.strip("_").replace("_", " ")
    on_stage(f"Tracing the program {what!r}")
    with without_collections(), options.own_program() as program:
        traced = jax.jit(function).trace(*arrays)
        lowered = traced.lower()
    results = tuple((x.shape, x.dtype, x.weak_type) for x in traced.jaxpr.out_avals)
    return Traced(Head(len(arrays), results, facts()), lowered, what, quick, program.scalarised)


def unpack(content: bytes) -> Packed:
    """Unpickles, which runs code: only for what `cache` vouches for."""
    packed = pickle.loads(content)
    if not isinstance(packed, Packed):
        raise TypeError("not a packed program")
    return packed


@contextmanager
def without_collections():
    """Tracing makes millions of objects that live on; to look for garbage among them takes a tenth of the time."""
    wanted = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if wanted:
            gc.enable()


class _WithoutJaxsCache:
    """An executable that came out of JAX's own cache cannot be serialised: it lacks its functions.

    The setting is the process's: the first thread that comes in switches the cache off, the last one on again.
    """

    def __init__(self):
        self.lock, self.inside, self.wanted = threading.Lock(), 0, False

    def __enter__(self):
        with self.lock:
            self.inside += 1
            if self.inside == 1:
                on = jax.config.jax_enable_compilation_cache
                self.wanted = on and jax.config.jax_compilation_cache_dir is not None
                self._switch(False)

    def __exit__(self, *_):
        with self.lock:
            self.inside -= 1
            if self.inside == 0:
                self._switch(True)

    def _switch(self, on: bool):
        if self.wanted:
            jax.config.update("jax_enable_compilation_cache", on)
            compilation_cache.reset_cache()


_without_jaxs_cache = _WithoutJaxsCache()
