"""What NumPy evaluates instead of a compiled program is the same, and loops of many turns are compiled."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.mechanics.algebra import cross, dot, rotation_about
from tests import evaluation_by_numpy
from tests.evaluation_by_numpy import instead_of_compilation, summary
from tests.numpy_evaluation import Loop, by_numpy

COMPILED_AS_SHIPPED = True  # so that programs are evaluated only within the blocks of these tests


def everything(x):
    """Loops, branches, a linear solver, eigenvectors, sums, signs by chance, a rule of derivatives, and a batch."""

    def turn(carry, row):
        changed = jax.lax.cond(carry.sum() > 0.0, jnp.sin, lambda c: 2.0 * c, carry)
        return changed, jnp.linalg.solve(jnp.eye(3) + jnp.outer(carry, row), carry)

    last, rows = jax.lax.scan(jax.checkpoint(turn), x, jnp.arange(12.0).reshape(4, 3))
    grown = jax.lax.while_loop(lambda c: c[0] < 10.0, lambda c: c * c + 1.0, x)
    signs = jax.random.rademacher(jax.random.key(0), (3,), float)
    squares = jax.vmap(lambda y: jax.nn.softplus(y @ x) ** 3)(rows)
    sums = jax.lax.cumsum(rows[:, 0]) * jax.lax.cumsum(x[1] * rows[:, 1], reverse=True)
    values, vectors = jnp.linalg.eigh(jnp.diag(jnp.array([1.0, 2.0, 4.0])) + jnp.outer(x, x))
    along = vectors @ (values * (vectors.T @ x))
    return jnp.concatenate(
        [last, signs * grown, squares, jnp.tile(x, 2), sums, values, along, rows[::2].at[0, 1].add(x[0]).ravel()]
    )


@pytest.mark.parametrize("of", [everything, jax.jacfwd(everything)], ids=["values", "derivatives"])
def test_evaluated_and_compiled_are_the_same(of):
    x = jnp.asarray([0.3, -0.2, 0.7])
    compiled = jax.jit(lambda x: of(x))(x)
    with instead_of_compilation():
        evaluated = jax.jit(lambda x: of(x))(x)
    np.testing.assert_allclose(evaluated, compiled, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(by_numpy(of)(x), compiled, rtol=1e-13, atol=1e-14)


def compilations(run):
    """Names of the programs that are compiled, and kinds of the loops that are, while `run()` is carried out."""
    names = []
    made = evaluation_by_numpy.pjit._pjit_call_impl_python

    def noted(*arguments, **settings):
        names.append(settings["name"])
        return made(*arguments, **settings)

    class Noted(Loop):
        def compiled(self, *parts):
            name = f"{self.equation.primitive.name} {'at once' if self.left == 0.0 else 'after some turns'}"
            names.extend([name] if self.program is None else [])
            return super().compiled(*parts)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation_by_numpy.pjit, "_pjit_call_impl_python", noted)
        patch.setattr(evaluation_by_numpy, "Loop", Noted)
        with instead_of_compilation():
            run()
    return names


def move(x):
    """Some operations, by which a number goes on growing."""
    for _ in range(30):
        x = jnp.sqrt(x * x + 1.0)
    return x


def loops(count):
    """A function with a loop of known length, and one whose length is not known, with another one in it."""

    def known(x):
        return jax.lax.scan(lambda c, row: (move(c), c + row), x, jnp.arange(float(count)))

    def unknown(x):
        def turn(carry):
            inner = jax.lax.fori_loop(0, 3, lambda _, c: move(c), carry[0])
            return inner, carry[1] + 1, carry[2] + inner

        return jax.lax.while_loop(lambda c: c[1] < count, turn, (x, 0, 0.0 * x))

    return known, unknown


KINDS = ("scan at once", "while after some turns")


@pytest.mark.parametrize("which", [0, 1], ids=["known", "unknown"])
@pytest.mark.parametrize("wrapped", [lambda f: f, jax.vmap], ids=["alone", "in a batch"])
def test_a_long_loop_is_compiled_and_what_is_around_it_is_not(which, wrapped):
    function, found = loops(1000)[which], []
    x = jnp.asarray([1.0, 0.5])

    def around(x):
        return jax.tree.map(lambda y: y + 1.0, wrapped(function)(jnp.cos(x)))

    assert compilations(lambda: found.append(jax.jit(around)(x))) == [KINDS[which]]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), found[0], jax.jit(around)(x))


def test_a_loop_that_was_compiled_in_the_midst_of_it_serves_further_calls():
    _, unknown = loops(1000)
    function, found = jax.jit(unknown), []
    assert compilations(lambda: found.extend(function(x) for x in (1.0, 0.5))) == [KINDS[1]]
    for x, results in zip((1.0, 0.5), found):
        np.testing.assert_allclose(results, jax.jit(unknown)(x), rtol=1e-12)


def test_a_loop_without_a_turn_is_not_compiled():
    def function(x):
        return jax.lax.while_loop(lambda c: c < 0.0, lambda c: loops(10_000)[0](c)[0], x)

    found = []
    assert compilations(lambda: found.append(jax.jit(function)(1.0))) == [] and found == [1.0]
    assert compilations(lambda: jax.jit(function)(-1.0)) == ["while at once"]


def test_what_is_called_often_is_compiled():
    assert summary(jax.make_jaxpr(loops(1000)[0])(1.0)).least > 6e4
    assert compilations(lambda: [jax.jit(f)(1.0) for f in loops(2)]) == []
    assert summary(jax.make_jaxpr(jax.lax.erf)(1.0)).least > 100.0 * summary(jax.make_jaxpr(jnp.sin)(1.0)).least
    program = jax.jit(lambda x: move(move(x)))
    assert "<lambda>" in compilations(lambda: [program(float(x)) for x in range(400)])


def test_operations_outside_of_programs_are_evaluated():
    x = jnp.arange(6.0).reshape(2, 3)
    assert compilations(lambda: jnp.sin(x)[1:] @ jnp.ones(3) + 2.0 * jnp.asarray([1.0])) == []
    # What NumPy has no rule for is compiled, and so is everything after many evaluations.
    assert "erf" in compilations(lambda: jax.lax.erf(x))
    assert "add" in compilations(lambda: [x + float(i) for i in range(500)])


def test_results_are_of_the_kind_of_the_compiled_program_s():
    def kinds():
        """Of new programs, which JAX has not compiled before."""
        placed = jax.device_put(jnp.ones(3), jax.devices()[0])
        functions = (lambda x: 3.0 * x, lambda x: x > 0.0, lambda x: jnp.int32(2) + jnp.asarray(x).astype("int32"))
        results = [jax.jit(lambda x, f=f: f(x))(x) for f in functions for x in (2.0, jnp.ones(3), placed)]
        of_integers = jax.jit(lambda x: jax.jvp(lambda x: x.astype(int), (x,), (x,)))(jnp.ones(2))[1]
        return of_integers.dtype, [(y.dtype, y.weak_type, y.aval, y.sharding, y.committed) for y in results]

    compiled = kinds()
    with instead_of_compilation():
        assert kinds() == compiled


def test_a_program_on_a_mesh_of_one_device_is_evaluated():
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("rows",))
    over_rows = jax.sharding.PartitionSpec("rows")
    given = jax.device_put(jnp.arange(6.0).reshape(3, 2), jax.sharding.NamedSharding(mesh, over_rows))

    def function(x):
        sharded = functools.partial(jax.shard_map, in_specs=over_rows, out_specs=over_rows, check_vma=False)
        return sharded(lambda x: jnp.sin(x) + given, mesh=mesh)(x)  # what is not an argument is put on the mesh anew

    found = []
    assert "reshard" in str(jax.make_jaxpr(function)(given))
    assert compilations(lambda: found.append(jax.jit(function)(given))) == []
    np.testing.assert_allclose(found[0], np.sin(given) + given, rtol=1e-15)
    assert found[0].committed and found[0].sharding.mesh == mesh
    two = jax.sharding.AbstractMesh((2,), ("rows",), (jax.sharding.AxisType.Auto,))
    split = jax.shard_map(jnp.sin, mesh=two, in_specs=over_rows, out_specs=over_rows)
    assert not summary(jax.make_jaxpr(split)(jnp.ones(4))).possible


RNG = np.random.default_rng(3)
MATRICES = RNG.normal(size=(2, 4, 4)) + 4.0 * np.eye(4)
ORDERED = np.round(RNG.normal(size=(4, 5)))
ORDERED[2, 1] = np.nan


@pytest.mark.parametrize("how", list(itertools.product(*[(False, True)] * 4)))
def test_triangular_systems(how):
    names = ("left_side", "lower", "transpose_a", "unit_diagonal")
    loads = RNG.normal(size=(2, 4, 3) if how[0] else (2, 3, 4))

    def solve(a, b):
        return jax.lax.linalg.triangular_solve(a, b, **dict(zip(names, how)))

    np.testing.assert_allclose(by_numpy(solve)(MATRICES, loads), solve(MATRICES, loads), rtol=1e-12, atol=1e-14)


FEW, MANY = np.array([1, 3, 1, 9]), RNG.integers(-2, 6, size=40)  # places of five rows; some twice, some outside
TABLE = RNG.normal(size=(5, 3, 4))
CHANGES = {
    "rows taken": lambda x, places: x.at[places].get(mode="fill"),
    "last columns taken": lambda x, places: x.at[..., places].get(mode="clip"),
    "entries taken": lambda x, places: x.at[places, 1, places].get(mode="fill", fill_value=7.0),
    "rows taken of each": lambda x, places: jax.vmap(lambda y, i: y.at[places + i].get(mode="fill"))(x, jnp.arange(5)),
    "sums": lambda x, places: x.at[places].add(jnp.cos(jnp.arange(12.0 * len(places)).reshape(-1, 3, 4))),
    "sums in the middle": lambda x, places: x.at[:, places].add(jnp.ones((5, len(places), 4))),
    "sums of each": lambda x, places: jax.vmap(lambda y: y.at[places].add(y[:1] + 0.5))(x),
    "rows put in": lambda x, places: x.at[places].set(2.0, mode="drop"),
    "windows put in": lambda x, places: jax.vmap(lambda i: jax.lax.dynamic_update_slice(x, x[:2], (i, 0, 0)))(places),
}


@pytest.mark.parametrize("places", [FEW, MANY], ids=["few", "many"])
@pytest.mark.parametrize("name", CHANGES)
def test_entries_by_their_places(name, places):
    evaluated, compiled = by_numpy(CHANGES[name])(TABLE, places), CHANGES[name](jnp.asarray(TABLE), jnp.asarray(places))
    np.testing.assert_allclose(evaluated, compiled, rtol=1e-13, atol=1e-14)


OTHERS = {
    "factors": lambda: jax.lax.linalg.lu(MATRICES + 0.0),
    "rows in order": lambda: jax.lax.sort((ORDERED + 0.0, jnp.cos(ORDERED)), dimension=1, num_keys=2),
    "order of columns": lambda: jnp.argsort(ORDERED + 0.0, axis=0),
    "sums with constants": lambda: rotation_about(1, jnp.asarray([0.1, 0.2])),
    "vector products": lambda: cross(TABLE[:3, 0] + 0.0, TABLE[2:, 1, :1]),
    "a batch of vector products": lambda: jax.jvp(jax.vmap(lambda a: cross(a, TABLE[:3, 2])), (TABLE,), (TABLE**2,)),
    "a batch of sums": lambda: jax.vmap(lambda a: dot(a, jnp.ones(3)) + rotation_about(2, a[0])[0, 1])(ORDERED[:, :3]),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_operations(name):
    for evaluated, compiled in zip(jax.tree.leaves(by_numpy(OTHERS[name])()), jax.tree.leaves(OTHERS[name]())):
        np.testing.assert_allclose(evaluated, compiled, rtol=1e-13, atol=1e-15)
