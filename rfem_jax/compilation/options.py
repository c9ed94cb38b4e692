"""XLA's options on a CPU: loops over steps of few samples are compiled as one kernel.

Place in the pipeline: set when the package is imported, before XLA reads its options; they change nothing but speed.

By default XLA dispatches each operation of a loop's body by itself, and these calls take longer than the arithmetic
on the few numbers of a mechanism.  XLA reads the environment variable XLA_FLAGS once in a process.  The options are in
it only until then (`settle`), so that child processes do not inherit them.

One option, fusions with several results, crashes versions of XLA before that of JAX 0.12 when they compile two
`x.at[places].add(values)` of one shape.  With these versions it is used for this package's kept programs
(`own_program`), which have no such pair, and in processes that compile nothing else (`take_process`); programs of the
user are not at risk.  Another option, of LLVM, would make programs with long loops slower; only kept programs have it.
"""

import os
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

# A loop is one kernel if a turn of it accesses less than 8 MB.  A larger one (derivatives of a batch of 16, say) is
# many small kernels, which LLVM compiles in two thirds of the time, and which take a tenth longer to run.
# XLA does not unroll loops over axes, which would double the time of compilation.
OPTIONS = ("xla_cpu_small_while_loop_byte_threshold=8000000", "xla_cpu_disable_loop_unrolling=true")
FUSION = "xla_cpu_use_multi_output_fusion=true"
# No loop rotation by LLVM: it serves to vectorise loops over axes, but searches the entire kernel for each of them,
# which is half of the time of compilation and saves a tenth of the time of a step.  For this package's kept programs
# only, whose loops are over three components and a few rfes; those of scalarised jaxprs are over samples, and are
# rotated (`note_scalarised`).
NO_LOOP_ROTATION = "-rotation-max-header-size=0"
# The first option: no calls of a library for products of small matrices, which would split the kernel.
WITHOUT_FUSION = f"--xla_cpu_experimental_ynn_fusion_type= --xla_backend_extra_options={','.join(OPTIONS)}"
FLAGS = f"{WITHOUT_FUSION},{FUSION}"
FUSION_SAFE_FROM = (0, 12)  # jaxlib
# XLA's alias metadata, which tell LLVM what arrays may overlap, take a tenth of the time of compilation.  They serve
# loops over samples, which scalarised programs have.  LLVM's higher levels of optimisation take another tenth.  Without
# both a run takes up to a tenth longer.  For kept programs only.
ALIAS_METADATA = ("xla_llvm_enable_noalias_metadata", "xla_llvm_enable_alias_scope_metadata")
OPTIMISATION_LEVEL = 1
# Kernels made by way of MLIR take much of the time of compilation, most in programs that run once, and run no faster;
# scalarised programs would take longer without it.  XLA has the choice before jaxlib 0.12.  For the package's programs,
# and those of the user that have one of them inside.
EMITTERS, EMITTERS_CHOSEN_BEFORE = "xla_cpu_use_fusion_emitters", (0, 12)
OF_THIS_KIND = ("xla_backend_extra_options", "ynn_fusion")
# Versions of jaxlib tested with the flags, from the first to before the second.  XLA ends the process at a flag that it
# does not know, so the flags are tried on newer versions in a process of their own.
TESTED = ((0, 10), (0, 13))
PROBE = "from jaxlib import xla_client; xla_client.CompileOptions()"


@dataclass
class _Attempt:
    """Whether the options were given to XLA in this process."""

    made: bool = False
    settled: bool = False
    warned: bool = False
    reason: str = ""  # why they were not given; "" if they were
    before: str | None = None  # XLA_FLAGS as the user set it
    fusion: bool = False  # whether FUSION is among them, for all programs of the process


class Compilation(NamedTuple):
    """Whether XLA has the options, and if not, why."""

    set: bool
    reason: str


_attempt = _Attempt()
_own = threading.local()
_functions: set[str] = set()


def user_cache_folder() -> Path:
    """The platform's folder for files that may be deleted at any time, `.../rfem_jax`."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "rfem_jax"


def offer() -> None:
    """Put the options into XLA_FLAGS, where XLA will read them; once in a process, without importing JAX."""
    if _attempt.made:
        return
    _attempt.made = True
    flags = os.environ.get("XLA_FLAGS")
    for mine in (FLAGS, WITHOUT_FUSION):
        if flags is not None and flags.strip().startswith(mine):
            # Inherited from a parent process in which XLA had not read them yet.
            flags = flags.strip().removeprefix(mine).strip() or None
    _attempt.before, _attempt.reason = flags, _obstacle((flags or "").strip())
    _attempt.fusion = _version() >= FUSION_SAFE_FROM
    _put()
    if "jaxlib.xla_client" in sys.modules:
        settle()


def take_process() -> None:
    """Give XLA all options, in a process that compiles this package's programs only; call it before JAX is used."""
    offer()
    if not _attempt.settled:
        _attempt.fusion = True
        _put()


def _put() -> None:
    if not _attempt.reason:
        # Ours first: XLA stops reading at the first word that is not a flag.
        flags = FLAGS if _attempt.fusion else WITHOUT_FUSION
        os.environ["XLA_FLAGS"] = f"{flags} {_attempt.before or ''}".strip()


def settle() -> Compilation:
    """Make XLA read its options now, and restore XLA_FLAGS.

    Warns once in a process if the options are not set.
    """
    offer()
    if not _attempt.settled:
        _attempt.settled = True
        if not _attempt.reason:
            if not _read_by_xla():
                _attempt.reason = "JAX had started before rfem_jax was imported; import rfem_jax first"
            _restore()
    if _attempt.reason and not _attempt.warned:
        _attempt.warned = True
        warnings.warn(warning(), stacklevel=2)
    return Compilation(not _attempt.reason, _attempt.reason)


def settle_quietly() -> Compilation:
    """As `settle`, for a caller that shows the reason itself."""
    _attempt.warned = True
    return settle()


def warning() -> str:
    """One sentence that says why the options are not set."""
    return f"Simulations will run several times slower: XLA's options could not be set, since {_attempt.reason}."


class OwnProgram:
    """A program of this package, while it is traced and compiled; scalarised: whether parts of it were scalarised;
    alone: whether no function of the user is in it, which may have what crashes XLA."""

    def __init__(self, scalarised: bool = False, alone: bool = True):
        self.scalarised, self.alone = scalarised, alone

    def options(self) -> list[str]:
        """Its options besides those of the process."""
        fusion = [FUSION] if self.alone and not _attempt.fusion else []
        return fusion + ([] if self.scalarised else [NO_LOOP_ROTATION])

    def add_to(self, options: Any) -> Any:
        """The options of a compilation with these."""
        options = _with(self.options(), options)
        debug = options.executable_build_options.debug_options
        debug.xla_backend_optimization_level = min(debug.xla_backend_optimization_level, OPTIMISATION_LEVEL)
        if not self.scalarised:
            # LLVM's vectorisers find next to nothing in loops that are not rotated, and take a quarter of the time.
            debug.xla_llvm_disable_expensive_passes = True
            without = [*ALIAS_METADATA, *([EMITTERS] if _version() < EMITTERS_CHOSEN_BEFORE else [])]
            options.env_option_overrides = [*options.env_option_overrides, *((name, False) for name in without)]
        return options


@contextmanager
def own_program(program: OwnProgram | None = None) -> Iterator[OwnProgram]:
    """Declare that what this thread traces and compiles within the block is a program of this package (default: without
    a function of the user)."""
    before, _own.program = _present(), program or OwnProgram()
    try:
        yield _own.program
    finally:
        _own.program = before


def _present() -> OwnProgram | None:
    """The program of this package that this thread traces or compiles."""
    return getattr(_own, "program", None)


def in_own_program() -> bool:
    """Whether this thread traces or compiles a program of this package."""
    return _present() is not None


def note_scalarised() -> None:
    """Record that the program which this thread is tracing has a scalarised jaxpr in it."""
    program = _present()
    if program is not None:
        program.scalarised = True


def fusion_holds() -> bool:
    """Whether XLA makes fusions with several results in what this thread compiles now."""
    program = _present()
    return settle().set and (_attempt.fusion or (program is not None and program.alone and own_options_hold()))


def explicit_methods_scalarised() -> bool:
    """Whether right-hand sides of explicit methods are scalarised."""
    import jax

    return fusion_holds() and jax.default_backend() == "cpu"


def own_options_hold() -> bool:
    """Make JAX compile this package's own programs with their own options; returns whether it does.

    Options of this kind cannot be given to `jax.jit`, so JAX's function that makes the options of a program is wrapped.
    They are those of a CPU's compiler, some of which others refuse.
    """
    import jax

    if not settle().set or jax.default_backend() != "cpu":
        return False
    from jax._src.interpreters import pxla

    made = getattr(pxla, "create_compile_options", None)
    if made is None:
        return False
    if not isinstance(made, _WithOwnOptions):
        pxla.create_compile_options = _WithOwnOptions(made)
    return True


class _WithOwnOptions:
    """JAX's function `made`, which makes the options of a program, with those of this package's programs added."""

    def __init__(self, made: Callable):
        self.made = made

    def __call__(self, module, *args, **kwargs):
        options, program = self.made(module, *args, **kwargs), _present()
        if program is not None:
            return program.add_to(options)
        if _version() < EMITTERS_CHOSEN_BEFORE and _has_own_function(module):
            options.env_option_overrides = [*options.env_option_overrides, (EMITTERS, False)]
        return options


def note_function(name: str) -> None:
    """Record the name of a function of this package that users call, and may have inside of their programs."""
    _functions.add(name)


def _has_own_function(module) -> bool:
    """Whether a module (MLIR) has a function with the name of one of this package's."""
    named = (operation.attributes for operation in module.body.operations if "sym_name" in operation.attributes)
    names = (str(attributes["sym_name"]).strip('"') for attributes in named)
    # JAX numbers functions of one name.
    return any(name in _functions or name.rstrip("0123456789").removesuffix("_") in _functions for name in names)


def _with(more: list[str], options):
    """The options of a program with more of them: what is appended to a serialised message is merged into it."""
    content = options.SerializeAsString()
    for option in more:
        name, value = option.split("=")
        entry = _field(1, name.encode()) + _field(2, value.encode())
        # CompileOptions.executable_build_options (3), .debug_options (3), .xla_backend_extra_options (500).
        content += _field(3, _field(3, _field(500, entry)))
    return type(options).ParseFromString(content)


def _field(number: int, content: bytes) -> bytes:
    """A field of a protocol buffer that holds bytes."""
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _varint(number: int) -> bytes:
    parts = []
    while number > 127:
        parts.append(number & 127 | 128)
        number >>= 7
    return bytes([*parts, number])


def _obstacle(flags: str) -> str:
    """Why the options must not be set beside the user's `flags`; "" if nothing is in the way."""
    if flags and not flags.startswith("-"):
        return "XLA_FLAGS names a file; put the options of `rfem_jax.compilation.options` into it"
    if any(name in flags for name in OF_THIS_KIND):
        return "XLA_FLAGS has options of this kind; leave them out"
    from jaxlib.version import __version__ as version

    if _version() < TESTED[0]:
        return f"jaxlib {version} is older than the tested ones; install a newer one"
    if _version() >= TESTED[1] and not _known_to_newer(version):
        return f"jaxlib {version} does not know them; install one before {'.'.join(map(str, TESTED[1]))}"
    return ""


def _version() -> tuple[int, ...]:
    """The first two numbers of jaxlib's version."""
    from jaxlib.version import __version__ as version

    return tuple(int(part) for part in version.split(".")[:2])


def _known_to_newer(version: str) -> bool:
    """Whether a version of jaxlib newer than the tested ones accepts the flags; tried once for each version."""
    verdict = user_cache_folder() / f"options_{version}"
    try:
        kept = verdict.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        kept = []
    if len(kept) != 2 or kept[0] != FLAGS:
        environment = {**os.environ, "XLA_FLAGS": FLAGS}
        child = subprocess.run([sys.executable, "-c", PROBE], env=environment, capture_output=True)
        kept = [FLAGS, "yes" if child.returncode == 0 else "no"]
        try:
            verdict.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            verdict.write_text("\n".join(kept), encoding="utf-8")
        except OSError:
            pass  # tried again next time
    return kept[1] == "yes"


def _read_by_xla() -> bool:
    """Make XLA read its flags, unless it has; returns whether the options are among those it has read."""
    from jaxlib import xla_client

    return OPTIONS[0].split("=")[0].encode() in xla_client.CompileOptions().SerializeAsString()


def _restore() -> None:
    if _attempt.before is None:
        os.environ.pop("XLA_FLAGS", None)
    else:
        os.environ["XLA_FLAGS"] = _attempt.before
