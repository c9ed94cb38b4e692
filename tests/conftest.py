"""Settings of all tests: double precision, no silent promotion of ranks or dtypes."""

import gc
import os
from pathlib import Path

# SciPy's LAPACK keeps its threads spinning after a call, on the core of the other worker.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Results are compared to the last bit.
os.environ.setdefault("JAX_PLATFORMS", "cpu")

# Tests replace parts of the package, which the key of a kept program does not see.
os.environ.setdefault("RFEM_JAX_NO_CACHE", "1")

# With RFEM_JAX_CHECK_TYPES=1 types and shapes of all annotations are checked while tests run; .ci/run does so once.
TYPES_CHECKED = os.environ.get("RFEM_JAX_CHECK_TYPES") == "1"
if TYPES_CHECKED:
    import jaxtyping

    jaxtyping.install_import_hook("rfem_jax", "beartype.beartype")

import jax  # noqa: E402
import pytest  # noqa: E402

from rfem_jax.compilation.program import forget_programs  # noqa: E402

if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    # The two workers, and the next session, compile the same programs.
    cache = Path(__file__).parents[1] / ".pytest_cache" / "compiled"
    jax.config.update("jax_compilation_cache_dir", str(cache))
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
    "validation/test_joint_benchmarks.py", "validation/test_benchmarks.py", "mechanics/test_formulations.py",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    """Long files first; what is not slow is fast; and the checker is faster than the messages of functions that are
    given a value of a wrong type."""
    items.sort(key=lambda item: not item.path.as_posix().endswith(LONG))
    for item in items:
        if not any(item.get_closest_marker(name) for name in ("slow", "long", "exhaustive")):
            item.add_marker(pytest.mark.fast)
        if TYPES_CHECKED and item.get_closest_marker("wrong_types"):
            item.add_marker(pytest.mark.skip(reason="types are checked at run time"))


def memory_maps() -> int:
    """Number of memory maps of this process; Linux allows 65530, and a program takes several."""
    maps = Path("/proc/self/maps")
    return len(maps.read_bytes().splitlines()) if maps.exists() else 0


@pytest.fixture(scope="module", autouse=True)
def _drop_old_programs():
    """Compiled programs of past modules go, before there are so many that the next one crashes."""
    yield
    if memory_maps() > 10_000:
        forget_programs()
        jax.clear_caches()
        gc.collect()
