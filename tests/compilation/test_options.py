"""XLA's options: the import sets them, and a loop is compiled as one kernel with the same results; a warning says once
why they could not be set; XLA_FLAGS is restored."""

import jax
import jax.numpy as jnp
import pytest

from rfem_jax.compilation import options
from tests.compilation.functions import oscillator, swing_kept
from tests.processes import in_a_new_process

COMPILED_AS_SHIPPED = True

LOOP = """
import sys, warnings
warnings.simplefilter("ignore")
if sys.argv[1] == "late":
    import jax
    jax.numpy.ones(3)
import rfem_jax
import jax
jax.config.update("jax_enable_x64", True)
from tests.compilation.test_options import compiled_loop
print(*compiled_loop(), compiled_loop(30_000)[0])
"""
SAID = """
import os, sys, warnings
if sys.argv[1] == "late":
    import jax
    jax.numpy.ones(3)
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    before = os.environ["XLA_FLAGS"]
    import rfem_jax
    rfem_jax.assembly_errors
    from rfem_jax.compilation import options
    options.settle()
from jaxlib import xla_client
print(options.settle_quietly().set, len(said), os.environ["XLA_FLAGS"] == before)
print(b"small_while_loop" in xla_client.CompileOptions().SerializeAsString())
print(*(str(one.message) for one in said))
"""


def compiled_loop(n=300):
    """Number of loops compiled as one kernel, and results, of a program that rotates axes of n bodies 50 times."""

    def rotate(x, _):
        c, s = jnp.cos(x[:n]), jnp.sin(x[:n])
        axes = jnp.stack([jnp.stack([c, -s, s * c]), jnp.stack([s, c, c * c]), jnp.stack([c * s, s, c])])
        rotated = jnp.einsum("ijk,jk->ik", axes, x[n:].reshape(3, n))
        return x + 1e-2 * jnp.concatenate([rotated[0], -rotated.reshape(3 * n)]), None

    program = jax.jit(lambda x: jax.lax.scan(rotate, x, None, length=50)[0]).lower(jnp.ones(4 * n)).compile()
    values = program(jnp.linspace(0.1, 0.6, 4 * n))[:: n // 3].tolist()
    return program.as_text().count('xla_cpu_small_call="true"'), *values


def test_a_loop_over_steps_is_one_kernel_with_the_same_results_unless_it_is_large():
    kernels, *values, kernels_of_large = in_a_new_process(LOOP, "early").split()
    none, *expected, _ = in_a_new_process(LOOP, "late").split()
    assert int(kernels) == 1 and int(kernels_of_large) == 0
    if jax.__version__.startswith("0.10."):  # later ones make this loop a kernel by themselves
        assert int(none) == 0
    assert [float(x) for x in values] == pytest.approx([float(x) for x in expected], rel=1e-12)


def test_a_child_process_takes_inherited_options_as_its_own():
    code = SAID.replace("== before", "== ''").replace("os.environ[", "os.environ.get(").replace('"]', '", "")')
    first, second, *said = in_a_new_process(code, "early", flags=options.FLAGS).splitlines()
    assert f"{first} {second}" == "True 0 True True" and not "".join(said)


def test_this_process_has_them():
    assert options.settle().set


@pytest.mark.parametrize(
    ("when", "flags", "result", "reason"),
    [
        ("early", "", "True 0 True True", ""),
        ("early", "--xla_cpu_multi_thread_eigen=false", "True 0 True True", ""),
        ("late", "", "False 1 True False", "JAX had started before"),
        ("early", "--xla_backend_extra_options=xla_cpu_disable_loop_unrolling=true", "False 1 True False", "kind"),
        ("early", "file", "False 1 True False", "names a file"),
    ],
)
def test_options_are_set_unless_there_is_an_obstacle(when, flags, result, reason, tmp_path):
    if flags == "file":
        flags = str(tmp_path / "flags")
        (tmp_path / "flags").write_text("--xla_cpu_multi_thread_eigen=false")
    first, second, *said = in_a_new_process(SAID, when, flags=flags).splitlines()
    assert f"{first} {second}" == result
    assert reason in " ".join(said)


SCATTERS = """
import rfem_jax, jax, numpy as np
from tests.compilation.test_options import add_twice, fused
x, places = np.ones((6, 5)), np.array([1, 3, 4])
from rfem_jax.compilation import options
from rfem_jax.compilation.program import Program
print(*(float(part.sum()) for part in jax.jit(add_twice)(x, 2.0 * x, places, np.ones((6, 3)))))
print(fused(jax.jit(lambda x: (x + 1.0, x - 1.0))))
with options.own_program():
    print(options.fusion_holds(), fused(jax.jit(lambda x: (x + 2.0, x - 2.0))))
with_function = Program(lambda function, *arrays: (*function(*arrays), options.fusion_holds()))
*sums, holds = with_function(lambda *arrays: add_twice(*arrays), x, 2.0 * x, places, np.ones((6, 3)))
print(*(float(part.sum()) for part in sums), holds)
"""


def add_twice(x, y, places, values):
    """Fused, this ends the process in XLA of JAX 0.10."""
    return x.at[:, places].add(values), y.at[:, places].add(values)


def fused(program):
    """Whether a program of two results is one fusion."""
    return program.lower(jnp.ones(3)).compile().as_text().count(" fusion(") == 1


def test_programs_of_the_user_are_not_at_risk_and_own_ones_are_fused():
    sums, users, own, with_function = in_a_new_process(SCATTERS).splitlines()
    safe = str(options._version() >= options.FUSION_SAFE_FROM)
    assert sums == "48.0 78.0" and users == safe
    assert own == "True True" and with_function == f"48.0 78.0 {safe}"


def test_fusions_are_not_asked_for_where_a_function_of_the_user_takes_part(monkeypatch):
    monkeypatch.setattr(options._attempt, "fusion", False)
    assert options.FUSION in options.OwnProgram().options()
    assert options.FUSION not in options.OwnProgram(alone=False).options()


OWN = """
import sys, jax, numpy as np
from rfem_jax.compilation import options
from tests.compilation.functions import covered, oscillator, swing_kept
given, before = [], options._with
options._with = lambda more, made: given.append(more) or before(more, made)
with covered(sys.argv[1]):
    swing_kept(oscillator(), np.linspace(0.0, 1.0, 4))
jax.jit(lambda x: x + 1.0)(2.0)
print(len(given), options.NO_LOOP_ROTATION in given[0])
with options.own_program():
    options.note_scalarised()
    jax.jit(lambda x: x + 2.0)(2.0)
options.note_scalarised()
print(options.NO_LOOP_ROTATION in given[-1])
"""


def test_loops_are_not_rotated_in_own_programs_that_are_not_scalarised(tmp_path):
    assert in_a_new_process(OWN, str(tmp_path / "programs")).splitlines() == ["1 True", "False"]


def test_options_of_one_program_are_added_to_the_others():
    from jaxlib import xla_client

    made = xla_client.CompileOptions()
    made.num_replicas = 3
    more = options._with([options.NO_LOOP_ROTATION, options.FUSION], made)
    assert more.num_replicas == 3
    for option in (options.NO_LOOP_ROTATION, options.FUSION):
        name, value = option.encode().split(b"=")
        content = more.SerializeAsString()
        assert content.count(name) >= 1 and name + b"\x12" + bytes([len(value)]) + value in content


def test_expensive_passes_are_left_out_of_own_programs_without_scalars():
    from jaxlib import xla_client

    def left_out(program):
        made = program.add_to(xla_client.CompileOptions())
        return made.executable_build_options.debug_options.xla_llvm_disable_expensive_passes

    assert left_out(options.OwnProgram()) and not left_out(options.OwnProgram(scalarised=True))


def test_own_programs_without_scalars_are_made_without_mlir_and_alias_metadata():
    from jaxlib import xla_client

    def overridden(program):
        return program.add_to(xla_client.CompileOptions()).env_option_overrides

    without = {name for name, value in overridden(options.OwnProgram()) if not value}
    assert without >= set(options.ALIAS_METADATA)
    assert (options.EMITTERS in without) == (options._version() < options.EMITTERS_CHOSEN_BEFORE)
    assert overridden(options.OwnProgram(scalarised=True)) == []


def test_programs_of_the_user_with_one_of_ours_inside_are_made_without_mlir(monkeypatch):
    found, call = [], options._WithOwnOptions.__call__
    monkeypatch.setattr(options._WithOwnOptions, "__call__", lambda *a: (found.append(call(*a)), found[-1])[1])

    def overridden(program):
        del found[:]
        program(jnp.linspace(0.1, 0.9, 3))
        return found[-1].env_option_overrides

    def ours(x):
        return jnp.sum(swing_kept(oscillator(), x).path)

    before = (options.EMITTERS, False) if options._version() < options.EMITTERS_CHOSEN_BEFORE else None
    expected = [] if before is None else [before]
    for program in ours, jax.grad(ours), jax.vmap(jax.grad(ours), in_axes=None, axis_size=2):
        assert overridden(jax.jit(program)) == expected
    assert overridden(jax.jit(lambda x: x * 2.0)) == []


def test_own_programs_are_optimised_by_a_low_level_and_no_more_than_was_asked_for():
    from jaxlib import xla_client

    def level(asked):
        made = xla_client.CompileOptions()
        made.executable_build_options.debug_options.xla_backend_optimization_level = asked
        return options.OwnProgram().add_to(made).executable_build_options.debug_options.xla_backend_optimization_level

    assert [level(asked) for asked in (0, 1, 3)] == [0, 1, 1]


def test_options_of_a_cpu_are_not_given_to_other_compilers(monkeypatch):
    # A GPU's compiler refuses one of them, and programs fail.
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not options.own_options_hold()
    monkeypatch.undo()
    assert options.own_options_hold()


def test_an_older_jaxlib_gets_no_options_and_a_newer_one_is_tried_once(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(options, "user_cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr("jaxlib.version.__version__", "0.9.2")
    assert "older" in options._obstacle("")
    monkeypatch.setattr("jaxlib.version.__version__", "9.0.0")
    tried = []

    def run(command, env, **_):
        tried.append(env["XLA_FLAGS"])
        return type("Child", (), {"returncode": -6})

    monkeypatch.setattr(options.subprocess, "run", run)
    assert "does not know" in options._obstacle("") and "does not know" in options._obstacle("")
    assert tried == [options.FLAGS]
    monkeypatch.setattr(options, "FLAGS", "--others")
    assert "does not know" in options._obstacle("")
    assert len(tried) == 2


def test_the_probe_knows_flags_from_others(monkeypatch, tmp_path):
    monkeypatch.setattr(options, "user_cache_folder", lambda: tmp_path)
    assert options._known_to_newer("known")
    monkeypatch.setattr(options, "FLAGS", "--xla_no_such_flag=1")
    assert not options._known_to_newer("unknown")
