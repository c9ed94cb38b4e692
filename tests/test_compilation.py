"""Whole loops: XLA knows the options, a simulation's loop over steps is one function, with the same
loads; who asks too late is told."""

import os
import re

import jax
import jax.numpy as jnp
import pytest

from rfem_jax import Method, MomentRamp, assembly_errors, discretise, simulate
from tests.mechanisms import four_bar
from tests.processes import in_a_new_process

SIMULATION = """
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)
from rfem_jax import compile_whole_loops
assert compile_whole_loops()
from tests.test_compilation import compiled_loads
program, loads = compiled_loads()
for line in program.split("ENTRY")[1].splitlines():
    if " while(" in line or " call(" in line:
        print(line)
print(*loads)
"""
TOO_LATE = """
import jax.numpy as jnp
from rfem_jax import compile_whole_loops
jnp.ones(3)
try:
    compile_whole_loops()
except ValueError as problem:
    print(problem)
"""
NOT_STARTED = "from rfem_jax import compile_whole_loops; print(compile_whole_loops())"
TWICE = """
import os
from rfem_jax import compile_whole_loops
from rfem_jax.compilation.whole_loops import explicit_in_scalars, implicit_in_scalars
done = [compile_whole_loops()]
flags = os.environ["XLA_FLAGS"]
done += [compile_whole_loops(scalars=True), os.environ["XLA_FLAGS"] == flags]
print(*done, explicit_in_scalars(), implicit_in_scalars())
"""


def compiled_loads():
    """The program of two samples, as text, and the RMS moments [N m] that it computes."""
    model = discretise(four_bar())
    method = Method("generalised_alpha", step=2.5e-3, tolerance=1e-6)

    def load(tilt):
        errors = assembly_errors(model, {"D.delta_x": tilt})
        run = simulate(
            model, errors, drive=MomentRamp("A", -1.0, 0.01), duration=0.02, method=method,
            save_every=0.01,
        )  # fmt: skip
        return run.metrics.rms_moment["A"]

    tilts = jnp.asarray([1e-3, 2e-3])
    program = jax.jit(jax.vmap(load)).lower(tilts).compile()
    return program.as_text(), program(tilts).tolist()


@pytest.mark.slow
def test_loop_over_steps_is_one_function_with_the_same_loads(quick_compilation):
    *program, loads = in_a_new_process(SIMULATION).splitlines()
    over_steps = [line for line in program if re.search(r'_simulate\)+/while"', line)]
    assert over_steps
    assert all('xla_cpu_small_call="true"' in line for line in over_steps)
    _, expected = compiled_loads()
    assert min(expected) > 0.1
    assert [float(load) for load in loads.split()] == pytest.approx(expected, rel=1e-9)


def test_the_last_call_counts():
    assert in_a_new_process(TWICE) == "True True True True True"
    assert in_a_new_process(TWICE, flags="--xla_cpu_multi_thread_eigen=false") == "True True True True True"


def test_too_late_is_an_error():
    assert "before the first array" in in_a_new_process(TOO_LATE)


def test_options_of_the_user_stay():
    flags = "--xla_backend_extra_options=xla_cpu_disable_loop_unrolling=true"
    assert in_a_new_process(NOT_STARTED, flags=flags) == "False"
    assert in_a_new_process(NOT_STARTED, flags="flags_in_a_file") == "False"
    assert in_a_new_process(NOT_STARTED, flags="--xla_cpu_multi_thread_eigen=false") == "True"


def test_unknown_versions_are_left_alone(monkeypatch):
    import jaxlib

    from rfem_jax.compilation import compile_whole_loops

    monkeypatch.setattr(jaxlib, "__version__", "9.0.0")
    monkeypatch.setenv("XLA_FLAGS", "")
    assert compile_whole_loops() is False
    assert os.environ["XLA_FLAGS"] == ""
