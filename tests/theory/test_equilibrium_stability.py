"""Whether static equilibria are stable: Euler's columns, pendulums, toggles and springs in closed forms, the modes of
the same equilibria, and the stiffness of an independent formulation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Compliance,
    Joint,
    JointSpring,
    Mechanism,
    PointForce,
    PointSpring,
    RungeKutta4,
    Simulation,
    assemble,
    assembly_errors,
    design,
    discretise,
    natural_frequencies,
    simulate,
    static_loads,
)
from rfem_jax.mechanics.algebra.definiteness import constrained, lowest_direction, orthonormal_rows, positive
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.model.model import length_scale
from rfem_jax.mechanics.model.status import OK, UNSTABLE
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics import settling
from rfem_jax.mechanics.statics.assembly import held_angles
from rfem_jax.mechanics.statics.assembly import static_loads as loads_at_rest
from rfem_jax.mechanics.statics.designs import designed
from rfem_jax.mechanics.statics.equilibrium_stability import free_coordinates, scaled_parts, told_by_return
from rfem_jax.mechanics.statics.settling import settled
from rfem_jax.simulation.vibrations.modes import linearised
from tests import mechanisms
from tests.evaluation import evaluated
from tests.mechanisms import BAR, STEEL, link

LENGTH, RFES = 1.0, 8
BENDING = STEEL.youngs_modulus * BAR.width * BAR.height**3 / 12.0
EULER = np.pi**2 * BENDING / LENGTH**2  # of a column with hinges at both ends
MASS = STEEL.density * BAR.width * BAR.height * LENGTH
GRAVITY = 9.81
DOWN = np.pi / 2
# Ends, critical load over that of hinges, and how far below it that of eight rigid segments is at most.
COLUMNS = {
    "free": ("fixed", None, 0.25, 0.01),
    "hinged": ("revolute", "revolute", 1.0, 0.02),
    "clamped": ("fixed", "fixed", 4.0, 0.07),
    "clamped and hinged": ("fixed", "revolute", 2.04575, 0.04),
}


def column(start, end, exact):
    """A bar under a force along it, its end free or on a head that slides along its axis."""
    links, joints = [link("bar", LENGTH, RFES)], [Joint("A", "base", "bar", kind=start)]
    loaded = ("bar", LENGTH)
    if end is not None:
        links.append(link("head", 0.01))
        joints.append(Joint("G", "base", "head", kind="prismatic", position=(LENGTH, 0, 0)))
        joints.append(Joint("B", "head", "bar", kind=end, child_position=(LENGTH, 0, 0), cut=True))
        loaded = ("head", 0.0)
    kind = "geometrically_exact" if exact else "linear"
    forces = [PointForce("load", *loaded, (-1.0, 0, 0))]
    made = Mechanism(links, joints, forces=forces, elements=kind, gravity=(0, 0, 0))
    return discretise(made if exact else mechanisms.slender(made))


@pytest.mark.parametrize(
    "ends, exact",
    [
        ("free", True),
        ("free", False),
        *(
            pytest.param(ends, exact, marks=pytest.mark.long)
            for ends in COLUMNS
            for exact in (True, False)
            if ends != "free"
        ),
    ],
)
def test_columns_are_unstable_beyond_eulers_load(ends, exact):
    """In one batch, each sample its own: none below, all above. Rigid segments on springs buckle a little earlier. The
    bar is square: it buckles in two planes at once."""
    start, end, factor, early = COLUMNS[ends]
    model = column(start, end, exact)

    def at(load):
        found = static_loads(model, design=design(model, {"load.force.x": -load}))
        return found.status[0], found.stability.growth[0]

    shares = np.array([0.1, 0.9, min(0.96, 1.0 - early), 1.0 - early, 1.002, 1.01, 1.02, 1.5, 7.0])
    codes, growth = evaluated(jax.vmap(at))(jnp.asarray(shares * factor * EULER))
    np.testing.assert_array_equal(codes, np.where(shares < 1.0, OK, UNSTABLE))
    assert np.all((growth > 0.0) == (codes == UNSTABLE)) and np.all(np.diff(growth[shares > 1.0]) > 0.0)


@pytest.mark.long
def test_a_column_is_left_as_fast_as_its_lowest_mode_says():
    """At least: the motion is not sought by inertia. Of a square bar two modes have the same frequency."""
    model = column("fixed", None, exact=False)
    at = design(model, {"load.force.x": -0.3 * EULER})
    stability = static_loads(model, design=at).stability
    modes = natural_frequencies(model, design=at, count=2)
    fastest = np.sqrt(-modes.square)
    assert np.all((0.9 * fastest < stability.growth[0]) & (stability.growth[0] < fastest * (1.0 + 1e-6)))
    assert jax.tree.map(lambda x: x[0], stability).place == "link bar"


TILT = 20.0  # N m


def on_a_bushing():
    """A bar, stiff beside it, on a bushing about whose tilt its load pushes it over."""
    joint = Joint("A", "base", "bar", compliance=Compliance(radial=3e5, axial=3e5, tilt=TILT))
    load = PointForce("load", "bar", LENGTH, (-1.0, 0, 0))
    return discretise(Mechanism([link("bar", LENGTH, 2)], [joint], forces=[load], gravity=(0, 0, 0)))


@pytest.mark.parametrize(
    "make, hold, critical",
    [(lambda: column("fixed", None, exact=False), {}, 0.25 * EULER), (on_a_bushing, {"A": 0.0}, TILT / LENGTH)],
)
def test_what_the_search_returns_to_is_stable(make, hold, critical, monkeypatch):
    """From a disturbance: equilibria far from buckling are told without their Jacobian, those beyond it never, and all
    is as with the Jacobian of each."""
    model, shares = make(), np.array([0.0, 0.1, 0.3, 0.9, 1.01, 1.5, 2.0, 2.5, 9.0])
    held = held_angles(model, hold)
    assert told_by_return(apply_errors(model, assembly_errors(model)))

    def at(load):
        made = designed(model, design(model, {"load.force.x": -load}))
        actual = apply_errors(made.model, made.errors)
        found = settled(made.model, actual, held)
        state = static_state(model.topology, found.position)
        carried = loads_at_rest(made.model, actual, state, found.multipliers)
        leaving = settling.stability(made.model, actual, held, state, found.tangent, carried)
        assert found.tangent is not None and leaving is not None
        return found.tangent.stable, found.position, settling.status_at_rest(found.status, leaving), leaving.growth

    results = []
    for returns in (True, False):
        monkeypatch.setattr(settling, "told_by_return", lambda actual, returns=returns: returns)
        told, *others = evaluated(jax.vmap(at))(jnp.asarray(shares * critical))
        np.testing.assert_array_equal(told, returns & (shares < 0.5))
        np.testing.assert_array_equal(others[1], np.where(shares < 1.0, OK, UNSTABLE))
        results.append(others)
    jax.tree.map(np.testing.assert_array_equal, *results)


def swinging(*forces, angle=DOWN, **more):
    """A rigid bar on a hinge, in equilibrium under its weight."""
    return discretise(Mechanism([link("bar", LENGTH)], [Joint("A", "base", "bar", angle=angle)], forces=forces, **more))


def test_a_pendulum_on_its_head_is_unstable():
    """Of a batch in which gravity has either sense; it grows with sqrt(3 g / 2 l). A run may start there."""
    model = swinging()

    def at(gravity):
        found = assemble(model, hold={}, design=design(model, {"gravity.z": gravity}))
        return found.status, found.stability.growth

    codes, growth = evaluated(jax.vmap(at))(jnp.asarray([-GRAVITY, GRAVITY, -1.0]))
    np.testing.assert_array_equal(codes, [OK, UNSTABLE, OK])
    np.testing.assert_allclose(growth, [0.0, np.sqrt(1.5 * GRAVITY / LENGTH / (1.0 + 1e-4 / 4)), 0.0], rtol=1e-4)

    for angle in (DOWN, -DOWN):
        settings = {"duration": 1e-3, "method": RungeKutta4(step=1e-4), "start": "equilibrium"}
        run = simulate(Simulation(swinging(angle=angle), drive=None, **settings))
        assert int(run.status) == OK
        assert ("remark: the static equilibrium at the start is unstable" in str(run)) == (angle < 0.0)
    assert "by a factor of e within 0.261 s, mostly in joint A" in str(run)


@pytest.mark.long
def test_a_spring_holds_a_pendulum_on_its_head_if_it_is_stiff_enough():
    """Stiffness against half the weight times the length; also where a force that turns with the bar makes the
    equations unsymmetrical, which has no moment about the hinge."""
    needed = 0.5 * MASS * GRAVITY * LENGTH
    for more in ((), (PointForce("thrust", "bar", LENGTH, (-30.0, 0, 0), axes="link"),)):
        model = swinging(JointSpring("spring", "A", stiffness=1.0, rest=-DOWN), *more, angle=-DOWN)

        def at(stiffness, model=model):
            found = assemble(model, hold={}, design=design(model, {"spring.stiffness": stiffness}))
            return found.status, found.stability.growth

        codes, growth = evaluated(jax.vmap(at))(needed * jnp.asarray([0.2, 0.999, 1.001, 3.0]))
        np.testing.assert_array_equal(codes, [UNSTABLE, UNSTABLE, OK, OK])
        inertia = MASS * (LENGTH**2 / 3.0 + BAR.height**2 / 12.0)
        np.testing.assert_allclose(growth[0], np.sqrt(0.8 * needed / inertia), rtol=1e-9)


def test_a_spring_past_its_dead_centre():
    """It pulls the end of a bar towards a point behind the hinge: V'' = -T a l / (a + l), or before it, where it is
    shortest: T a l / (a - l)."""
    apart, tension = 1.6, 20.0
    for side, expected in ((-1.0, -tension * apart / (apart + LENGTH)), (1.0, tension * apart / (apart - LENGTH))):
        rod = PointSpring("spring", ("base", "bar"), ((side * apart, 0, 0), LENGTH), stiffness=0.0, preload=tension)
        found = assemble(swinging(rod, angle=0.0, gravity=(0, 0, 0)), hold={})
        inertia = MASS * (LENGTH**2 / 3.0 + BAR.height**2 / 12.0)
        np.testing.assert_allclose(found.stability.growth, np.sqrt(max(-expected, 0.0) / inertia), rtol=1e-9)
        assert int(found.status) == (UNSTABLE if expected < 0.0 else OK)


ABOUT_X = {"orientation": (0, 0, -DOWN), "child_orientation": (0, 0, -DOWN)}


@pytest.mark.parametrize(
    "rfes, across, more",
    [
        (None, True, ABOUT_X),
        (3, False, {"angle": 0.3}),
        pytest.param(3, False, ABOUT_X, marks=pytest.mark.long),
        pytest.param(None, False, {"kind": "free"}, marks=pytest.mark.long),
    ],
)
def test_what_turns_freely_is_stable(rfes, across, more):
    """A shaft about its own axis under loads across it, a bar without weight, flexible or not, and a free body."""
    forces = [PointForce("load", "bar", 0.3, (0.0, 300.0, 100.0))] if across else []
    joints = [Joint("A", "base", "bar", **more)]
    made = Mechanism([link("bar", LENGTH, rfes)], joints, forces=forces, gravity=(0, 0, 0))
    found = assemble(discretise(made), hold={})
    assert int(found.status) == OK and float(found.stability.growth) == 0.0


@pytest.mark.long
def test_flutter_is_not_seen():
    """Beck's column: a force that turns with the free end has no other equilibrium, whatever its size, but from
    20.05 EI / l^2 on the bar flutters; a force that does not turn buckles it from 2.47 on."""
    bar, joint = link("bar", LENGTH, RFES), Joint("A", "base", "bar", kind="fixed")
    for axes, codes in (("link", [OK] * 3), ("global", [OK, UNSTABLE, UNSTABLE])):
        force = PointForce("load", "bar", LENGTH, (-1.0, 0, 0), axes=axes)
        made = Mechanism([bar], [joint], forces=[force], elements="geometrically_exact", gravity=(0, 0, 0))
        model = discretise(made)

        def at(load, model=model):
            return static_loads(model, design=design(model, {"load.force.x": -load})).status[0]

        np.testing.assert_array_equal(evaluated(jax.vmap(at))(BENDING * jnp.asarray([2.4, 12.0, 25.0])), codes)


@pytest.mark.long
@pytest.mark.parametrize(
    "make",
    [
        # Without weight: a moment that holds a joint with sprung tilts is an outer one in statics, about axes that do
        # not tilt, and makes the stiffness unsymmetric.
        lambda: dataclasses.replace(mechanisms.compliant_four_bar(), gravity=(0, 0, 0)),
        mechanisms.slender_four_bar,
        lambda: mechanisms.loop_cut_by_sprung("cylindrical"),
        lambda: dataclasses.replace(mechanisms.loop_with_a_ball(), elements="geometrically_exact"),
        lambda: dataclasses.replace(mechanisms.four_bar(2), elements="geometrically_exact"),
    ],
)
def test_the_stiffness_is_that_of_the_equations_of_motion(make, monkeypatch):
    """Of the residual of an implicit step, which is another formulation, at the same equilibrium, among the motions
    that the closure equations leave: across them stiffnesses depend on how these are written."""
    monkeypatch.setattr(settling, "told_by_return", lambda actual: False)
    model = discretise(make())
    topology, held = model.topology, held_angles(model, "as_given")
    actual = apply_errors(model, assembly_errors(model))

    @evaluated
    def both():
        found = settled(model, actual, held)
        return found, linearised(actual, found.position, found.multipliers, length_scale(model))

    found, expected = both()
    assert int(found.status) == OK
    slender = topology.n_freedoms + np.arange(3)[:, None] * topology.n_rfes + np.flatnonzero(topology.slender_rfes)
    free = free_coordinates(topology, np.array([*topology.idle, *held, *slender.reshape(-1)], int))
    tangent, expected = found.tangent, expected.stiffness[np.ix_(free, free)]
    scaled, rows, root = evaluated(lambda tangent: scaled_parts(topology, tangent, free, jnp.asarray(1e-9)))(tangent)
    root = root[free] * tangent.units[free]
    stiffness = scaled[np.ix_(free, free)] * tangent.force * tangent.length / np.outer(root, root)
    size = np.sqrt(np.abs(np.diagonal(expected)) + 1e-9 * np.abs(expected).max())
    rows = rows[np.any(rows != 0.0, axis=1)][:, free] / root / size
    across = np.linalg.svd(rows)[2][len(rows) :] / size
    scaled, other = (across @ one @ across.T for one in (stiffness, expected))
    np.testing.assert_allclose(scaled, other, rtol=0, atol=1e-8)


def test_directions_that_constraints_leave():
    """Against eigenvalues of the matrix on the null space; rows that say the same twice; two eigenvalues nearly equal,
    and a pair of complex ones."""
    rng = np.random.default_rng(5)

    @evaluated
    def both(matrix, rows):
        reduced = constrained(matrix, orthonormal_rows(rows))
        return positive(reduced), *lowest_direction(reduced)

    for values in ([-0.1, 0.2, 0.3, 0.4, 0.5], [-3e-7, -3e-7 + 1e-13, 0.1, 0.2, 0.3], [1e-7, 0.1, 0.1, 0.2, 0.3]):
        rows = rng.normal(size=(3, 8))
        null = np.linalg.svd(rows)[2][3:]
        mixed = np.linalg.qr(rng.normal(size=(5, 5)))[0]
        matrix = null.T @ mixed @ np.diag(values) @ mixed.T @ null + 0.2 * (rows.T @ rows) / np.sum(rows**2)
        is_positive, value, vector, left = both(matrix, np.concatenate([rows, rows[:2] - rows[2:]]))
        assert bool(is_positive) == (values[0] > 0.0)
        np.testing.assert_allclose(value, values[0], rtol=1e-6)
        np.testing.assert_allclose(rows @ vector, 0.0, atol=1e-9)
        assert left < 1e-12
    turning = jnp.asarray([[-0.2, 0.1, 0.0], [-0.1, -0.2, 0.0], [0.0, 0.0, 0.3]])
    assert lowest_direction(turning)[2] > 0.09
