"""Settings of all tests: double precision, no silent promotion of ranks or dtypes."""

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

# SciPy's LAPACK keeps its threads spinning after a call, on the core of the other worker.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Results are compared to the last bit, and programs compiled with options of a CPU's compiler.
os.environ.setdefault("JAX_PLATFORMS", "cpu")

# Tests replace parts of the package, which the key of a kept program does not see.
os.environ.setdefault("RFEM_JAX_NO_CACHE", "1")

# With RFEM_JAX_CHECK_TYPES=1 types and shapes of all annotations are checked while tests run; .ci/run does so once.
TYPES_CHECKED = os.environ.get("RFEM_JAX_CHECK_TYPES") == "1"
if TYPES_CHECKED:
    import jaxtyping

    jaxtyping.install_import_hook("rfem_jax", "beartype.beartype")

from rfem_jax.compilation import keeping, options  # noqa: E402

options.take_process()

import jax  # noqa: E402
import pytest  # noqa: E402
from _pytest.runner import runtestprotocol  # noqa: E402
from jax._src import compiler  # noqa: E402
from matplotlib.layout_engine import ConstrainedLayoutEngine  # noqa: E402

from rfem_jax.compilation.program import Program  # noqa: E402
from rfem_jax.report import pictures, style  # noqa: E402
from rfem_jax.simulation import stepping  # noqa: E402
from rfem_jax.stack_room import with_room  # noqa: E402
from tests import evaluation_by_numpy  # noqa: E402
from tests.drawn_first import drawn_first  # noqa: E402
from tests.evaluation_by_numpy import instead_of_compilation  # noqa: E402
from tests.numpy_evaluation import forget_programs  # noqa: E402

if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    # The two workers, and the next session, compile the same programs.
    cache = Path(__file__).parents[1] / ".pytest_cache" / "compiled"
    jax.config.update("jax_compilation_cache_dir", str(cache))
# Tracing makes millions of lasting objects; to look through them for garbage, of which there is little, takes long.
gc.disable()
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


BY_NAME = ("browser", "documents")  # folders of tests that run only where they are asked for


def pytest_ignore_collect(collection_path, config):
    """Tests that need a browser, and those of documents, are for who asks for them by the name of their folder."""
    name = collection_path.name
    asked = any(f"tests/{name}" in str(argument) for argument in config.invocation_params.args)
    return True if name in BY_NAME and collection_path.is_dir() and not asked else None


def pytest_report_header():
    return "tests/browser (needs Chromium), tests/documents: only by name, as in `python -m pytest -n0 tests/browser`"


# No worker begins one of the longest files when the other one is about to end.
LONG = (
    "programs/test_study_files.py", "programs/test_studies.py", "simulation/test_derivatives.py",
    "validation/test_joint_benchmarks.py",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    """Long files first; and the checker is faster than the messages of functions that are given a value of a wrong
    type."""
    items.sort(key=lambda item: not item.path.as_posix().endswith(LONG))
    for item in items:
        if TYPES_CHECKED and item.get_closest_marker("wrong_types"):
            item.add_marker(pytest.mark.skip(reason="types are checked at run time"))


# What costs more time in XLA than it saves in a program that runs a few times: notes on which arrays may overlap, and
# kernels made by way of MLIR (a choice only before JAX 0.12). An analysis of copies by regions is faster, too, but
# compiles wrong programs of some loops in reverse mode.
QUICK_OPTIONS = {
    "xla_llvm_enable_noalias_metadata": False,
    "xla_llvm_enable_alias_scope_metadata": False,
    "xla_llvm_enable_invariant_load_metadata": False,
    **({"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 12) else {}),
}
QUICK_FLAGS = " ".join(f"--{name}={str(value).lower()}" for name, value in QUICK_OPTIONS.items())


@pytest.fixture(scope="module", autouse=True)
def _compilation(request):
    """Quick, unless the module says `COMPILED_AS_SHIPPED`, because compiled programs are its subject or run long."""
    if not getattr(request.module, "COMPILED_AS_SHIPPED", False):
        request.getfixturevalue("quick_compilation")


@contextmanager
def compiled_quickly(always_compiled: bool = False) -> Iterator[None]:
    """In which programs are compiled without most optimisations and what is not scalarised, for many programs that run
    a few times each; unless `always_compiled`, NumPy evaluates what is not worth that."""
    before, made = jax.config.read("jax_disable_most_optimizations"), compiler.get_compile_options

    def quick(*args, **kwargs):
        chosen = made(*args, **kwargs)
        chosen.env_option_overrides = [*chosen.env_option_overrides, *QUICK_OPTIONS.items()]
        return chosen

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiler, "get_compile_options", quick)
        patch.setattr(stepping, "explicit_methods_scalarised", lambda: False)
        jax.config.update("jax_disable_most_optimizations", True)
        with nullcontext() if always_compiled else instead_of_compilation():
            yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(scope="module")
def quick_compilation(request):
    """As `compiled_quickly`; NumPy evaluates nothing where the module says `ALWAYS_COMPILED`, because it compares
    results to the last bit, or its programs run long. Session fixtures, which come first, do it themselves."""
    with compiled_quickly(getattr(request.module, "ALWAYS_COMPILED", False)):
        yield


@pytest.fixture
def long_loops_compiled(monkeypatch):
    """For a test whose loops run so long that NumPy need not try them first."""
    monkeypatch.setattr(evaluation_by_numpy, "RATIO_OF_LOOPS", 0.0)


@pytest.fixture
def long_loops_optimised(long_loops_compiled):
    """For a test whose loops run so long that their optimisation pays."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture
def often_called_programs_compiled(monkeypatch):
    """For a test whose programs are called so often that NumPy need not try them first."""
    monkeypatch.setattr(evaluation_by_numpy, "RATIO", 0.0)


@pytest.fixture(scope="session", autouse=True)
def _programs_within_others():
    """JAX transforms the programs of this package and finds what it has traced for another one, as within a program of
    the user; except where a test says where programs are kept, or that none are (`keep_programs`)."""
    call, ahead = Program.__call__, Program.ahead

    def within():
        return not keeping.wanted() and keeping._choice.asked is keeping.DEFAULT

    def called(program, *args, **kwargs):
        return program._plainly(args, kwargs) if within() else call(program, *args, **kwargs)

    def not_ahead(program, *args, **kwargs):
        return None if within() else ahead(program, *args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Program, "__call__", called)
        patch.setattr(Program, "ahead", not_ahead)
        yield


draw, draw_first = pictures._drawn, drawn_first(pictures._drawn)


@pytest.fixture
def every_picture_drawn(monkeypatch):
    """For a test that compares pictures of one kind."""
    monkeypatch.setattr(pictures, "_drawn", draw)


@pytest.fixture(scope="module", autouse=True)
def _rough_pictures(request):
    """Pictures have few pixels, their parts stay where they are put first, one process draws them, and the first of
    each kind only, unless the module says `PICTURES_AS_SHIPPED`."""
    with pytest.MonkeyPatch.context() as patch:
        if not getattr(request.module, "PICTURES_AS_SHIPPED", False):
            patch.setattr(ConstrainedLayoutEngine, "execute", lambda engine, figure: None)
            patch.setattr(pictures, "_drawn", draw_first)
            patch.setitem(style.SETTINGS, "savefig.dpi", 50)
            patch.setattr(pictures, "draw_beside", lambda: None)
        yield


def memory_maps() -> int:
    """Number of memory maps of this process; Linux allows 65530, and a program takes several."""
    maps = Path("/proc/self/maps")
    return len(maps.read_bytes().splitlines()) if maps.exists() else 0


def pytest_runtest_protocol(item, nextitem):
    """As pytest's own, with room for the frames of tests, which begin tens of calls deep."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    with_room(runtestprotocol)(item, nextitem=nextitem)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_sessionfinish():
    """What is left is not looked through for garbage, as pytest would do at the end for seconds."""
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def _drop_old_programs():
    """Programs of past modules go: compiled ones before there are so many that the next one crashes."""
    yield
    forget_programs()
    if memory_maps() > 30_000:
        jax.clear_caches()
        gc.collect()
