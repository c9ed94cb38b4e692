"""A compiled program with the structure of its results, also as bytes for another process.

Place in the pipeline: `call` makes and runs it, `cache` keeps the bytes.

A `Traced` program is finished by compiling it, a `Packed` one, read from disk, by loading it; any thread may do so.
"""

import gc
import pickle
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array
from jax.core import ShapedArray
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache
from jax.typing import ArrayLike
from jaxlib.lapack import prepare_lapack_call

from rfem_jax.compilation import keys, options
from rfem_jax.compilation.stages import on_stage
from rfem_jax.compilation.tracing_context import same_context
from rfem_jax.compilation.unbatched_calls import keep_unbatched_calls
from rfem_jax.stack_room import with_room

# In the text of programs that call LAPACK on the CPU.  JAX looks up LAPACK's functions when it lowers such a program;
# before that, the addresses that a loaded program calls are null.
LAPACK = "lapack_"
# Options for programs that run once: LLVM's optimisations take longer than they save.
QUICK = {"xla_backend_optimization_level": 0}


@dataclass(frozen=True)
class Place:
    """Takes the place of an array among the arguments or results of a function."""


class Executable:
    """A compiled program, from a list of arrays to a list of arrays."""

    def __init__(self, compiled: jax.stages.Compiled, head: "Head"):
        self.compiled, self.head = compiled, head

    def __call__(self, arrays: Sequence[ArrayLike]) -> list[Array]:
        return self.compiled(*arrays)

    def dump(self) -> bytes:
        """As bytes, which `unpack` reads, also in another process.

        **Raises:** an exception of XLA's if it cannot serialise the program.
        """
        program, _, _ = serialize_executable.serialize(self.compiled)
        loaded, text = self.compiled.runtime_executable(), self.compiled.as_text()
        if loaded is None or text is None:
            raise ValueError("This platform does not give its executables.")
        devices = [device.id for device in loaded.local_devices()]
        return pickle.dumps(Packed(self.head, program, devices, LAPACK in text))


class Head(NamedTuple):
    """What is known of a program without loading it: number of arguments; of each result shape, dtype and whether its
    type is weak; `facts` about the results (see `call.Call`)."""

    inputs: int
    results: tuple[tuple[tuple[int, ...], Any, bool], ...]
    facts: list

    def shapes(self) -> list[jax.ShapeDtypeStruct]:
        """The results without their values."""
        return [jax.ShapeDtypeStruct(shape, dtype, weak_type=weak) for shape, dtype, weak in self.results]


class Traced(NamedTuple):
    """A program to be compiled."""

    head: Head
    lowered: jax.stages.Lowered
    what: str
    quick: bool
    own: options.OwnProgram
    kept: bool  # whether it is to be serialised

    def finish(self) -> Executable:
        """Compile it."""
        once = ", once for all models of its kind" if self.kept else ""
        on_stage(f"Compiling the program {self.what!r}{once}")
        options.own_options_hold()
        with _without_jaxs_cache if self.kept else nullcontext(), options.own_program(self.own):
            quick = QUICK if self.quick else None
            return Executable(self.lowered.compile(quick), self.head)  # pyright: ignore[reportArgumentType] # numbers are allowed


class Packed(NamedTuple):
    """A compiled program as it is kept on disk."""

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


@with_room
def trace(
    function: Callable,
    arrays: Sequence[ArrayLike | jax.ShapeDtypeStruct | ShapedArray],
    facts: Callable[[], list],
    quick: bool,
    own: options.OwnProgram,
    kept: bool,
) -> Traced:
    """Trace and lower a function for arrays, or for their shapes; `facts` is called afterwards.

    **Arguments:** `quick`: as `Call`; `own`: the kind of program; `kept`: whether it is to be serialised.
    """
    what = function.__name__.strip("_").replace("_", " ")
    on_stage(f"Tracing the program {what!r}")
    keep_unbatched_calls()
    with without_collections(), same_context(), options.own_program(own):
        traced = jax.jit(function).trace(*arrays)
        lowered = traced.lower()
    results = tuple((x.shape, x.dtype, x.weak_type) for x in traced.jaxpr.out_avals)
    return Traced(Head(len(arrays), results, facts()), lowered, what, quick, own, kept)


def unpack(content: bytes) -> Packed:
    """The program from its bytes.  Unpickling runs code: only for bytes that `cache` has checked.

    **Raises:** TypeError, or an exception of `pickle`, for other bytes.
    """
    packed = pickle.loads(content)
    if not isinstance(packed, Packed):
        raise TypeError("not a packed program")
    return packed


@contextmanager
def without_collections() -> Iterator[None]:
    """No garbage collection within the block: tracing makes millions of lasting objects, and searching them for
    garbage takes a tenth of its time."""
    wanted = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if wanted:
            gc.enable()


class _WithoutJaxsCache:
    """Switches JAX's own cache off: a program that comes from it cannot be serialised, since it lacks its functions.

    The setting holds for the process: the first thread that enters switches the cache off, the last one on again.
    """

    def __init__(self):
        self.lock, self.inside, self.wanted = threading.Lock(), 0, False

    def __enter__(self):
        with self.lock:
            self.inside += 1
            if self.inside == 1:
                on = keys.read_setting("jax_enable_compilation_cache")
                self.wanted = on and keys.read_setting("jax_compilation_cache_dir") is not None
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
