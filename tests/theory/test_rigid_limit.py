"""Very stiff flexible links move and load their joints like rigid ones; the difference falls with
the stiffness."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Coordinates,
    GivenSection,
    Joint,
    Link,
    Mechanism,
    PointMass,
    RungeKutta4,
    Simulation,
    State,
    discretise,
    simulate,
)

MOMENT, RISE = 16.0, 0.01  # of flexible_four_bar_runs
STIFFER = 4.0


@pytest.mark.long
def test_stiff_four_bar_tends_to_the_closed_form(flexible_four_bar_runs, exact_four_bar, four_bar_loads):
    """Coupler and rocker flexible, with steel's modulus and with four times that."""
    runs = [flexible_four_bar_runs[1][name] for name in ("perfect", "stiff")]
    times = runs[0].times

    def moment(t, piece):
        return MOMENT * t / RISE if piece == 0 else 0.0

    crank, rate = exact_four_bar.motion(moment, (RISE, times[-1]), times)
    assert rate[-1] > 15.0
    off = [np.abs(run.motion.angle - crank).max() for run in runs]
    assert off[0] < 1e-3 and off[1] < 0.4 * off[0]
    expected = []
    for i, t in enumerate(times):
        applied = moment(t, 0 if t < RISE + 1e-9 else 1)
        acceleration = exact_four_bar.crank_acceleration(crank[i], rate[i], applied)
        expected.append(four_bar_loads("C", crank[i], rate[i], acceleration)[0])
    # From release to the jump of the moment, both of which set the links ringing.
    steady = (times > 0.25 * RISE) & (times < RISE + 1e-9)
    for joint in "ABCD":
        forces = np.array([loads[joint] for loads in expected])[steady]
        off = [np.abs(run.loads[joint].force[steady][:, [0, 2]] - forces).max() for run in runs]
        largest = np.abs(forces).max()
        assert largest > 10.0
        assert off[0] < 3e-2 * largest and off[1] < 0.5 * off[0]


def test_one_element_is_a_rigid_link(four_bar):
    def as_programs_see_it(model):
        return eqx.tree_at(lambda m: m.source, model, None)

    rigid = four_bar("C")
    assert rigid.topology.elements == (1, 1, 1)
    assert eqx.tree_equal(as_programs_see_it(rigid), as_programs_see_it(four_bar("C", rfes=1)))
    section = GivenSection(1e7, 1e6, 1e6, 1e3, 1e3, 1e3, 1.0, 2e-4, 1e-4, 1e-4)
    single, named = (
        discretise(Mechanism([Link("bar", 0.5, section, **how)], [Joint("A", "base", "bar")]))
        for how in ({"rfes": 1}, {"rigid": True})
    )
    assert eqx.tree_equal(as_programs_see_it(single), as_programs_see_it(named))


@pytest.fixture(scope="module")
def tripods():
    """A spatial chain of two links, the second hinged between the ends of the first, both with a
    mass beside their axis: rigid, and flexible with three rfes at two stiffnesses."""
    masses = (PointMass(0.3, (0.35, 0.03, -0.02), (1e-4, 2e-4, 2e-4)),)

    def chain(scale, rfes):
        section = GivenSection(
            *(scale * np.array([4e5, 1.5e5, 1.5e5, 300.0, 500.0, 800.0])),
            1.2,
            5e-3,
            2e-3,
            3e-3,
            damping=1.5e-4,
        )
        links = [
            Link("upper", 0.5, section, rfes=rfes, point_masses=masses),
            Link("lower", 0.4, section, rfes=rfes, point_masses=masses),
        ]
        joints = [
            Joint("A", "base", "upper", orientation=(0.2, 0.0, 0.1)),
            Joint("B", "upper", "lower", position=(0.3, 0.0, 0.0), orientation=(0.5, 0.3, -0.4)),
        ]
        return discretise(Mechanism(links, joints))

    def simulated(model):
        elastic = jnp.zeros((6, model.topology.n_rfes))
        start = State(Coordinates(jnp.array([0.5, 0.8]), elastic), Coordinates(jnp.zeros(2), elastic))
        return simulate(
            Simulation(model, drive=None, duration=0.3, method=RungeKutta4(step=5e-5), save_every=0.01, start=start)
        )

    flexible = jax.tree.map(lambda *x: jnp.stack(x), chain(4.0, 3), chain(4.0 * STIFFER, 3))
    runs = eqx.filter_jit(eqx.filter_vmap(simulated))(flexible)
    return jax.tree.map(np.asarray, (eqx.filter_jit(simulated)(chain(1.0, 1)), runs))


@pytest.mark.long
def test_stiff_chain_moves_like_a_rigid_one(tripods):
    rigid, flexible = tripods
    assert (flexible.status == 0).all()
    for joint in "AB":
        assert np.ptp(rigid.motion.angles[joint]) > 0.5
        off = np.abs(flexible.motion.angles[joint] - rigid.motion.angles[joint]).max(axis=1)
        assert off[0] < 0.02 and off[1] < 0.4 * off[0]


def test_stiff_chain_has_the_loads_of_a_rigid_one(tripods):
    """After the ringing of the sudden start has died down."""
    rigid, flexible = tripods
    late = rigid.times > 0.2
    for joint in "AB":
        for kind in ("force", "moment"):
            exact = getattr(rigid.loads[joint], kind)[late]
            off = np.abs(getattr(flexible.loads[joint], kind)[:, late] - exact)
            assert off[0].max() < 0.1 * np.abs(exact).max()
            assert off[1].max() < 0.5 * off[0].max()
            assert off[1].max() < 0.01 * np.abs(exact).max()


def test_flexible_chain_balances(tripods):
    """A hinge on an inner rfe, bent links, spatial motion: momentum and energy balance."""
    _, flexible = tripods
    assert flexible.checks.momentum_balance_error.max() < 1e-10
    assert flexible.checks.hinge_moment_error.max() < 1e-10
    assert flexible.checks.energy_balance_error.max() < 1e-5
