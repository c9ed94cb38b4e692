"""XLA's options for loops over steps on a CPU: each loop becomes one kernel.

Place in the pipeline: set when the package is imported, before XLA reads its options; nothing depends on
them but speed.

XLA's own choice is a call from a table for each operation of a loop's body, and these calls cost more than
the few numbers that a mechanism has.  XLA reads the environment variable XLA_FLAGS once in a process.  The
options stand there only until it has done so (`settle`), so that other programs do not see them.
"""

import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import NamedTuple

# Loops of any size; values used twice are computed once; loops over axes are not written out, which
# would double the time of compilation.
OPTIONS = (
    "xla_cpu_small_while_loop_byte_threshold=1000000000000000",
    "xla_cpu_use_multi_output_fusion=true",
    "xla_cpu_disable_loop_unrolling=true",
)
# Products of small matrices by a library are calls again, which end the kernel.
FLAGS = f"--xla_cpu_experimental_ynn_fusion_type= --xla_backend_extra_options={','.join(OPTIONS)}"
OF_THIS_KIND = ("xla_backend_extra_options", "ynn_fusion")
# Versions of jaxlib that were tested with the flags, from the first to before the second; XLA ends the process
# at a flag that it does not know, so a newer one is tried in a process of its own.
TESTED = ((0, 10), (0, 13))
PROBE = "from jaxlib import xla_client; xla_client.CompileOptions()"


class _Attempt:
    """What became of the options in this process: `reason` "" if they were given to XLA."""

    def __init__(self):
        self.made, self.settled, self.said = False, False, False
        self.reason, self.before = "", None


class Compilation(NamedTuple):
    """Whether XLA has the options, and if not, why."""

    set: bool
    reason: str


_attempt = _Attempt()


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
    """Put the options where XLA will read them; once in a process, without importing JAX."""
    if _attempt.made:
        return
    _attempt.made = True
    flags = os.environ.get("XLA_FLAGS")
    if flags is not None and flags.strip().startswith(FLAGS):
        # The process that started this one had not used them yet.
        flags = flags.strip().removeprefix(FLAGS).strip() or None
    _attempt.before, _attempt.reason = flags, _obstacle((flags or "").strip())
    if not _attempt.reason:
        # First: XLA reads no further than a word that is no flag.
        os.environ["XLA_FLAGS"] = f"{FLAGS} {flags or ''}".strip()
    if "jaxlib.xla_client" in sys.modules:
        settle()


def settle() -> Compilation:
    """Let XLA read its options now, and take them out of the environment again.

    Warns once in a process if they do not hold.
    """
    offer()
    if not _attempt.settled:
        _attempt.settled = True
        if not _attempt.reason:
            if not _read_by_xla():
                _attempt.reason = "JAX had started before rfem_jax was imported; import rfem_jax first"
            _restore()
    if _attempt.reason and not _attempt.said:
        _attempt.said = True
        warnings.warn(warning(), stacklevel=2)
    return Compilation(not _attempt.reason, _attempt.reason)


def settle_quietly() -> Compilation:
    """As `settle`, for a caller that shows the reason itself."""
    _attempt.said = True
    return settle()


def warning() -> str:
    """One sentence about options that do not hold."""
    return f"Simulations will run several times slower: XLA's options could not be set, since {_attempt.reason}."


def explicit_in_scalars() -> bool:
    """Whether right-hand sides of explicit methods are scalarised."""
    import jax

    return settle().set and jax.default_backend() == "cpu"


def _obstacle(flags: str) -> str:
    """Why the options must not be set beside the user's `flags`; "" if nothing is in the way."""
    if flags and not flags.startswith("-"):
        return "XLA_FLAGS names a file; put the options of `rfem_jax.compilation.options` into it"
    if any(name in flags for name in OF_THIS_KIND):
        return "XLA_FLAGS has options of this kind; leave them out"
    from jaxlib.version import __version__ as version

    numbers = tuple(int(part) for part in version.split(".")[:2])
    if numbers < TESTED[0]:
        return f"jaxlib {version} is older than the tested ones; install a newer one"
    if numbers >= TESTED[1] and not _known_to_newer(version):
        return f"jaxlib {version} does not know them; install one before {'.'.join(map(str, TESTED[1]))}"
    return ""


def _known_to_newer(version: str) -> bool:
    """Whether a version of jaxlib newer than the tested ones accepts the flags; tried once for each version."""
    verdict = user_cache_folder() / f"options_{version}"
    try:
        kept = verdict.read_text().splitlines()
    except OSError:
        kept = []
    if len(kept) != 2 or kept[0] != FLAGS:
        environment = {**os.environ, "XLA_FLAGS": FLAGS}
        child = subprocess.run([sys.executable, "-c", PROBE], env=environment, capture_output=True)
        kept = [FLAGS, "yes" if child.returncode == 0 else "no"]
        try:
            verdict.parent.mkdir(parents=True, exist_ok=True)
            verdict.write_text("\n".join(kept))
        except OSError:
            pass  # tried again next time
    return kept[1] == "yes"


def _read_by_xla() -> bool:
    """Makes XLA read its flags, unless it has; whether it knows the options now."""
    from jaxlib import xla_client

    return OPTIONS[0].split("=")[0].encode() in xla_client.CompileOptions().SerializeAsString()


def _restore() -> None:
    if _attempt.before is None:
        os.environ.pop("XLA_FLAGS", None)
    else:
        os.environ["XLA_FLAGS"] = _attempt.before
