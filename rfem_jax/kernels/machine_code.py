"""LLVM's text compiled to machine code in this process, by llvmlite.

Place in the pipeline: programs -> **machine_code** -> foreign_function, primitive.
"""

import ctypes
import ctypes.util
from functools import cache
from typing import Any

try:
    import llvmlite.binding as llvm
except ImportError:  # everything runs by XLA then
    llvm = None

# Machine code outlives every program that calls it: engines are never freed.
_ENGINES: list[Any] = []


def is_available() -> bool:
    """Whether llvmlite can be imported."""
    return llvm is not None


@cache
def _target_machine(thorough: bool) -> Any:
    assert llvm is not None
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    if library := ctypes.util.find_library("m"):
        llvm.load_library_permanently(library)
    features = llvm.get_host_cpu_features()
    text = features.flatten()
    if features.get("avx512f"):
        text += ",-prefer-256-bit"
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=text, opt=2 if thorough else 0, jit=True
    )


def vector_width() -> int:
    """Doubles in a register of this processor."""
    assert llvm is not None
    features = llvm.get_host_cpu_features()
    return 8 if features.get("avx512f") else 4 if features.get("avx2") or features.get("avx") else 2


def compile_module(name: str, text: str, thorough: bool = True) -> int:
    """Address of a function of a module.

    **Arguments:** `name` of the function; `text` of the module; `thorough`: whether instructions are chosen and
    registers allocated with care, so that it runs faster, or as fast as possible, so that it compiles faster.  LLVM's
    passes over the text are left out: what they find, the builder has found.
    """
    assert llvm is not None
    machine = _target_machine(thorough)
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    _ENGINES.append(engine)
    return engine.get_function_address(name)


def capsule(address: int) -> Any:
    """The address as what JAX registers."""
    import jax

    return jax.ffi.pycapsule(ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(address))
