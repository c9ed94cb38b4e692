"""A compiled program with the structure of what it returns, as bytes for another process.

Place in the pipeline: `call` makes and runs it, `cache` keeps the bytes.
"""

import gc
import io
import pickle
from contextlib import contextmanager
from dataclasses import dataclass

import jax
import numpy as np
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache
from jaxlib.lapack import prepare_lapack_call

from rfem_jax.compilation.stages import on_stage

# Programs that call LAPACK on the CPU.  JAX looks up LAPACK's functions when it lowers such a program: without
# that, the addresses that a loaded program calls are null.
LAPACK = "lapack_"


@dataclass(frozen=True)
class Place:
    """Stands for an array in what a function takes or returns."""


class Executable:
    """A compiled program of flat arrays, and `facts` about what it returns (see `call`)."""

    def __init__(self, compiled, inputs: int, outputs: int, facts):
        self.compiled, self.inputs, self.outputs, self.facts = compiled, inputs, outputs, facts

    @classmethod
    def of(cls, function, arrays, facts) -> "Executable":
        """Compile `function` of arrays; `facts()` is called when it has been traced."""
        what = function.__name__.strip("_").replace("_", " ")
        on_stage(f"Tracing the program {what!r}")
        with without_collections():
            lowered = jax.jit(function).lower(*arrays)
        outputs = len(jax.tree.leaves(lowered.out_info))
        on_stage(f"Compiling the program {what!r}, once for all models of its kind")
        with without_jaxs_cache():
            return cls(lowered.compile(), len(arrays), outputs, facts())

    def __call__(self, arrays):
        return self.compiled(*arrays)

    def dump(self) -> bytes:
        """As bytes; `load` makes it again, in another process too.  Raises if XLA cannot."""
        program, _, _ = serialize_executable.serialize(self.compiled)
        devices = [device.id for device in self.compiled.runtime_executable().local_devices()]
        calls_lapack = LAPACK in self.compiled.as_text()
        return pickle.dumps((program, devices, calls_lapack, self.inputs, self.outputs, self.facts))

    @classmethod
    def load(cls, content: bytes) -> "Executable":
        """Unpickles, which runs code: only for what `cache` vouches for."""
        program, numbers, calls_lapack, inputs, outputs, facts = pickle.load(io.BytesIO(content))
        if calls_lapack:
            prepare_lapack_call("getrf_ffi", np.dtype("float64"))
        by_id = {device.id: device for device in jax.local_devices()}
        devices = [by_id[number] for number in numbers]
        takes, returns = jax.tree.structure(((0,) * inputs, {})), jax.tree.structure([0] * outputs)
        compiled = serialize_executable.deserialize_and_load(
            program, takes, returns, backend=devices[0].client, execution_devices=devices
        )
        return cls(compiled, inputs, outputs, facts)


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


@contextmanager
def without_jaxs_cache():
    """An executable that came out of JAX's own cache cannot be serialised: it lacks its functions."""
    wanted = jax.config.jax_enable_compilation_cache
    if not wanted or jax.config.jax_compilation_cache_dir is None:
        yield
        return
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", wanted)
        compilation_cache.reset_cache()
