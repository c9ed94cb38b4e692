"""LLVM's text compiled to machine code in this process, by llvmlite.

Place in the pipeline: programs -> **machine_code** -> registry.
"""

import ctypes
import ctypes.util
import platform
import sys
from functools import cache
from typing import Any

try:
    import llvmlite.binding as llvm
except ImportError:  # everything runs by XLA then
    llvm = None

# Machine code outlives every program that calls it: engines are never freed.
_ENGINES: list[Any] = []
_LEFT_OUT: list[str] = []


def is_available() -> bool:
    """Whether llvmlite can be imported."""
    return llvm is not None


def leave_out_features(*beginnings: str) -> None:
    """Compile for a processor without the features whose names begin so ("avx512"), to compare; before all kernels."""
    _LEFT_OUT[:] = beginnings
    for function in (_features, _target_machine, processor, fuses):
        function.cache_clear()


@cache
def _features() -> Any:
    assert llvm is not None
    found = llvm.get_host_cpu_features()
    for name in found:
        found[name] = found[name] and not name.startswith(tuple(_LEFT_OUT))
    return found


@cache
def _target_machine(thorough: bool) -> Any:
    assert llvm is not None
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    if library := ctypes.util.find_library("m"):
        llvm.load_library_permanently(library)
    text = _features().flatten()
    if _features().get("avx512f"):
        text += ",-prefer-256-bit"
    # At LLVM's second level a scheduler takes three times as long as all the rest, and nothing runs faster.
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=text, opt=1 if thorough else 0, jit=True
    )


@cache
def processor() -> str:
    """What machine code depends on besides its text: processor, and versions of the compiler."""
    assert llvm is not None
    import llvmlite

    return " ".join([
        llvm.get_default_triple(), llvm.get_host_cpu_name(), _features().flatten(), llvmlite.__version__,
        ".".join(map(str, llvm.llvm_version_info)),
    ])  # fmt: skip


def vector_width() -> int:
    """Doubles in a register of this processor."""
    return 8 if _features().get("avx512f") else 4 if _features().get("avx2") or _features().get("avx") else 2


@cache
def fuses() -> bool:
    """Whether this processor has an instruction for a product plus a term, rounded once; without it that takes long."""
    return bool(_features().get("fma")) or platform.machine().lower() in ("aarch64", "arm64")


@cache
def stack_bytes() -> int:
    """What a program may take of the stack of a thread of XLA's, whose size is the system's own choice."""
    if sys.platform == "win32":
        return 700_000
    import resource

    soft, _ = resource.getrlimit(resource.RLIMIT_STACK)
    whole = 2**21 if soft == resource.RLIM_INFINITY else min(soft, 2**23)  # of threads, by the C library
    return 3 * whole // 4 if sys.platform == "linux" else 380_000


def compiled(text: str, thorough: bool = True) -> bytes:
    """Object code of a module.

    **Arguments:** `text` of the module; `thorough`: whether instructions are chosen and registers allocated with care,
    so that it runs faster, or as fast as possible, so that it compiles faster.  LLVM's passes over the text are left
    out: what they find, the builder has found.
    """
    assert llvm is not None
    machine = _target_machine(thorough)
    module = llvm.parse_assembly(text, llvm.create_context())
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    return machine.emit_object(module)


def loaded(name: str, code: bytes) -> int:
    """Address of a function of object code, which stays in this process.

    **Raises:** ValueError for other bytes, and if they have no such function.
    """
    assert llvm is not None
    machine = _target_machine(False)
    found = llvm.ObjectFileRef.from_data(code)
    if not found:
        raise ValueError("no object code")
    module = llvm.parse_assembly("", llvm.create_context())
    module.triple = machine.triple
    engine = llvm.create_mcjit_compiler(module, llvm.Target.from_default_triple().create_target_machine(jit=True))
    engine.add_object_file(found)
    engine.finalize_object()
    address = engine.get_function_address(name)
    if not address:
        raise ValueError(f"the object code has no function {name!r}")
    _ENGINES.append(engine)
    return address


def capsule(address: int) -> Any:
    """The address as what JAX registers."""
    import jax

    return jax.ffi.pycapsule(ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(address))
