"""Programs with kernels in them: a kept one is loaded with the object code that is kept beside it, in another process,
which traces and compiles nothing; without good object code it is made anew."""

import hashlib
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.compilation.cache import Folder
from rfem_jax.compilation.program import Program
from rfem_jax.kernels import is_available, kernel, machine_code
from tests.compilation.functions import covered, folded, oscillator, shaken, shaken_kept
from tests.processes import in_a_new_process

pytestmark = pytest.mark.skipif(not is_available(), reason="llvmlite gives kernels their machine code")

X = jnp.linspace(0.2, 0.9, 3)
PROCESS = """
import sys
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
from rfem_jax.kernels import machine_code
compiled, compile_text = [], machine_code.compiled
machine_code.compiled = lambda *given: compiled.append(given) or compile_text(*given)
from tests.compilation.functions import covered, folded, oscillator, shaken_kept, stirred_kept
x = jnp.linspace(0.2, 0.9, 3)
made = {
    "shaken": lambda: shaken_kept(oscillator(), x),
    "stirred": lambda: stirred_kept(oscillator(), x),
    "alone": lambda: folded(x, jnp.asarray(0.7)),
    "in a batch": lambda: jax.vmap(lambda x: stirred_kept(oscillator(), x))(jnp.stack([x, 2.0 * x, 3.0 * x])),
    "slopes": lambda: jax.jacfwd(lambda x: shaken_kept(oscillator(), x)[0])(x),
}
with covered(sys.argv[1]) as statistics:
    found = jax.tree.leaves([made[name]() for name in sys.argv[2:]])
print(statistics.traced, statistics.loaded, statistics.written, len(compiled))
print(*(float(number).hex() for one in found for number in jnp.ravel(one)))
"""


def counted(folder, *names, before=""):
    """Programs traced, loaded and written by a new process, and kernels compiled; and the bits of its results."""
    counts, bits = in_a_new_process(before + PROCESS, str(folder), *names).splitlines()
    return [int(count) for count in counts.split()], bits


def object_codes(folder):
    return [path for path in folder.iterdir() if path.name.startswith("kernel_")]


@pytest.fixture(scope="module")
def shaken_program(tmp_path_factory):
    """A folder with one program and its kernel, which another process wrote, and the bits of its results."""
    folder = tmp_path_factory.mktemp("shaken") / "programs"
    return folder, counted(folder, "shaken")[1]


@pytest.fixture
def of_one_program(shaken_program, tmp_path):
    """A copy of it."""
    shutil.copytree(shaken_program[0], tmp_path / "programs")
    return tmp_path / "programs", shaken_program[1]


@pytest.mark.slow
def test_another_process_loads_programs_and_their_object_code(tmp_path):
    """Two programs that call one kernel."""
    folder = tmp_path / "programs"
    made, bits = counted(folder, "shaken", "stirred")
    assert made == [2, 0, 2, 1] and len(object_codes(folder)) == 1 and len(list(folder.iterdir())) == 4
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for names in (("shaken", "stirred"), ("stirred", "shaken")):
        loaded, same = counted(folder, *names)
        assert loaded == [0, 2, 0, 0]
        assert sorted(same.split()) == sorted(bits.split()) and (same == bits) == (names[0] == "shaken")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.slow
def test_what_is_made_and_loaded_gives_the_bits_of_the_function_itself(of_one_program):
    folder, bits = of_one_program
    expected = jax.tree.leaves(jax.jit(lambda x: shaken(oscillator(), x))(X))
    assert bits.split() == [float(number).hex() for one in expected for number in np.ravel(one)]
    assert counted(folder, "shaken") == ([0, 1, 0, 0], bits)


@pytest.mark.slow
def test_object_code_is_kept_also_where_no_program_is(tmp_path):
    """That of a kernel by itself, in a batch, of its derivative."""
    names = "alone", "in a batch", "slopes"
    made, bits = counted(tmp_path / "programs", *names)
    assert made[:3] == [0, 0, 0] and made[3] == len(object_codes(tmp_path / "programs")) >= len(names)
    assert counted(tmp_path / "programs", *names) == ([0, 0, 0, 0], bits)


def rewritten(content):
    """A change of a file that leaves it whole."""

    def write(path):
        path.write_bytes(hashlib.sha256(content).digest() + content)

    return write


OTHER = "define i64 @another(i64 %x) {\nret i64 %x\n}"
DAMAGE = {
    "deleted": lambda path: path.unlink(),
    "cut off": lambda path: path.write_bytes(path.read_bytes()[:-100]),
    "no object code": rewritten(b"whole, but no object code"),
    "of another function": lambda path: rewritten(machine_code.compiled(OTHER))(path),
}


@pytest.mark.slow
@pytest.mark.parametrize("damage", DAMAGE)
def test_without_good_object_code_a_program_is_made_anew(of_one_program, damage):
    folder, bits = of_one_program
    (code,) = object_codes(folder)
    good = code.read_bytes()
    DAMAGE[damage](code)
    assert counted(folder, "shaken") == ([1, 0, 1, 1], bits)
    assert code.read_bytes() == good  # which another process loads


def test_without_a_folder_nothing_is_kept(tmp_path):
    with covered(None) as statistics:
        shaken_kept(oscillator(), X)
        folded(X, jnp.asarray(0.3))
        assert (statistics.traced, statistics.written) == (1, 0)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_where_kernels_have_no_machine_code_others_programs_are_not_loaded(of_one_program):
    """They call functions that are not there."""
    folder, bits = of_one_program
    without = 'import sys\nsys.modules["llvmlite"] = None\n'
    made, others = counted(folder, "shaken", before=without)
    assert made == [1, 0, 1, 0]
    values = ([float.fromhex(number) for number in text.split()] for text in (bits, others))
    np.testing.assert_allclose(*values, rtol=1e-13)
    assert counted(folder, "shaken", before=without) == ([0, 1, 0, 0], others)
    assert counted(folder, "shaken") == ([0, 1, 0, 0], bits)


def test_a_kernel_may_be_computed_while_a_program_is_traced(kept):
    """Its numbers are known then; no program calls it."""

    @kernel
    def known(x):
        return jnp.cos(x) * 1.25

    def function(x):
        with jax.ensure_compile_time_eval():
            return x * known(jnp.arange(3.0))

    np.testing.assert_allclose(Program(function)(X), X * np.cos(np.arange(3.0)) * 1.25, rtol=1e-14)


BATCH = jnp.stack([X, 2.0 * X, 0.5 * X])
TRANSFORMED = {
    "jit": lambda f: jax.jit(f)(X),
    "forward": lambda f: jax.jacfwd(f)(X),
    "reverse": lambda f: jax.jacrev(f)(X),
    "twice": lambda f: jax.hessian(f)(X),
    "batch": lambda f: jax.vmap(f)(BATCH),
    "derivatives of a batch": lambda f: jax.vmap(jax.jacfwd(f))(BATCH),
}


@pytest.mark.parametrize("name", TRANSFORMED)
def test_derivatives_and_batches_are_those_of_the_function(kept, name):
    found, expected = (TRANSFORMED[name](lambda x, f=f: f(oscillator(), x)) for f in (shaken_kept, shaken))
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14)
    assert kept.traced == 0


def test_object_code_is_written_for_the_user_alone(kept, tmp_path):
    @kernel
    def own(x):
        return x * 0.375

    own(X)
    (code,) = object_codes(tmp_path / "programs")
    assert code.stat().st_mode & 0o777 == 0o600
    assert Folder(tmp_path / "programs").read(code.stem)
