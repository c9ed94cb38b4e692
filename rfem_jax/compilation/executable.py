"""A compiled program with the structure of its results, also as bytes for another process.

Place in the pipeline: kernels, stages -> **executable** -> program, which makes and runs it; `cache` keeps the bytes.
"""

import pickle
import threading
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache
from jax.typing import ArrayLike
from jaxlib.lapack import prepare_lapack_call

from rfem_jax.compilation import keys
from rfem_jax.compilation.stages import on_stage
from rfem_jax.kernels import registry

# In the text of programs that call LAPACK on the CPU.  JAX looks up LAPACK's functions when it lowers such a program;
# before that, the addresses that a loaded program calls are null.
LAPACK = "lapack_"


@dataclass(frozen=True)
class Place:
    """Takes the place of an array among the arguments or results of a function."""


class Executable:
    """A compiled program of a list of arrays.

    **Arguments:** `returned`: the tree of its results, with a `Place` for each array; `handlers`: names of the kernels'
    handlers that it calls.
    """

    def __init__(self, compiled: jax.stages.Compiled, inputs: int, returned: Any, handlers: Sequence[str]):
        self.compiled, self.inputs, self.returned, self.handlers = compiled, inputs, returned, tuple(handlers)

    def __call__(self, arrays: Sequence[ArrayLike]) -> Any:
        left = iter(self.compiled(*arrays))
        return jax.tree.map(lambda x: next(left) if isinstance(x, Place) else x, self.returned)

    def dump(self) -> bytes:
        """As bytes, which `unpack` reads, also in another process.

        **Raises:** an exception of XLA's if it cannot serialise the program.
        """
        program, _, _ = serialize_executable.serialize(self.compiled)
        loaded, text = self.compiled.runtime_executable(), self.compiled.as_text()
        if loaded is None or text is None:
            raise ValueError("This platform does not give its executables.")
        devices = [device.id for device in loaded.local_devices()]
        return pickle.dumps(Packed(program, self.inputs, self.returned, self.handlers, devices, LAPACK in text))


class Packed(NamedTuple):
    """A compiled program as it is kept on disk."""

    program: bytes
    inputs: int
    returned: Any
    handlers: tuple[str, ...]
    devices: list[int]
    calls_lapack: bool

    def loaded(self) -> Executable:
        """The program, in this process."""
        if self.calls_lapack:
            prepare_lapack_call("getrf_ffi", np.dtype("float64"))
        registry.prepare(self.handlers)
        by_id = {device.id: device for device in jax.local_devices()}
        devices = [by_id[number] for number in self.devices]
        results = sum(isinstance(x, Place) for x in jax.tree.leaves(self.returned))
        takes, returns = jax.tree.structure(((0,) * self.inputs, {})), jax.tree.structure([0] * results)
        compiled = serialize_executable.deserialize_and_load(
            self.program, takes, returns, backend=devices[0].client, execution_devices=devices
        )
        return Executable(compiled, self.inputs, self.returned, self.handlers)


class WithinTransformation(Exception):
    """The function depends on a traced value that is not among its arguments."""


def compiled(function: Callable, arrays: Sequence[ArrayLike], returned: list, kept: bool) -> Executable:
    """Trace and compile a function of arrays.

    **Arguments:** `returned`: the function puts the tree of its results there; `kept`: whether it is to be serialised.

    **Raises:** WithinTransformation, as where a force of the user's closes over what is differentiated.
    """
    what = function.__name__.strip("_").replace("_", " ")
    once = ", once for all models of its kind" if kept else ""
    on_stage(f"Compiling the program {what!r}{once}")
    with registry.noting() as handlers:
        traced = jax.jit(function).trace(*arrays)
        if len(traced.jaxpr.in_avals) > len(arrays):
            raise WithinTransformation
        lowered = traced.lower()
    with _without_jaxs_cache if kept else nullcontext():
        return Executable(lowered.compile(), len(arrays), returned[0], sorted(handlers))


def unpack(content: bytes) -> Packed:
    """The program from its bytes.  Unpickling runs code: only for bytes that `cache` has checked.

    **Raises:** TypeError, or an exception of `pickle`, for other bytes.
    """
    packed = pickle.loads(content)
    if not isinstance(packed, Packed):
        raise TypeError("not a packed program")
    return packed


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
