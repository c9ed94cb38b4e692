"""The kinetostatic turn: closed forms of an arm, the derivative of the energy, and the assembly at one angle."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    STATUS,
    InputError,
    Joint,
    Mechanism,
    assemble,
    assembly_errors,
    deviations,
    discretise,
    kinetostatic_turn,
)
from rfem_jax.mechanics.forces.bush_contacts import carrying
from rfem_jax.simulation.rest.turn import closed_poses, turn_over, turn_positions
from rfem_jax.validation.clearances import TILT, flexible_four_bar
from tests.coupled_mechanisms import cam
from tests.derivatives import check_derivatives
from tests.evaluation import evaluated
from tests.mechanisms import BAR, STEEL, arm, four_bar, link


@pytest.mark.slow
def test_an_arm_is_held_against_its_weight_over_a_revolution():
    length, gravity = 0.3, 9.81
    model = discretise(Mechanism([link("arm", length)], [Joint("A", "base", "arm", angle=0.2)], driven_joint="A"))
    positions = turn_positions(model, 8)
    turn = evaluated(lambda: kinetostatic_turn(model, positions=positions))()
    np.testing.assert_allclose(turn.position, 0.2 + np.arange(8) * np.pi / 4)
    mass = STEEL.density * BAR.area * length
    # The arm's x axis turns about y: at an angle a its end is at L (cos a, 0, -sin a).
    np.testing.assert_allclose(turn.holding, -mass * gravity * length / 2 * np.cos(turn.position), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(turn.loads["A"].force, axis=1), mass * gravity)
    np.testing.assert_allclose(turn.energy, -mass * gravity * length / 2 * np.sin(turn.position), atol=1e-12)
    bending = mass * gravity * length / 2 * np.abs(np.cos(turn.position)) * 6 / 0.01**3
    axial = mass * gravity * np.abs(np.sin(turn.position)) / 0.01**2
    np.testing.assert_allclose(turn.stress["arm"], bending + axial, rtol=1e-6)
    assert not turn.status.any()
    higher = deviations(model, {"arm.section.height": 1e-3})  # of 10 mm
    heavier = evaluated(lambda: kinetostatic_turn(model, higher, positions))()
    np.testing.assert_allclose(heavier.holding, 1.1 * turn.holding, atol=1e-12)
    assert not heavier.status.any()


@pytest.mark.long
def test_a_turn_is_the_assembly_at_its_angles_and_its_moment_the_derivative_of_the_energy():
    model = discretise(four_bar(2))
    errors = assembly_errors(model, {"D.delta_x": "0.5 deg", "coupler.length": "0.1 mm"})
    step, middle = 1e-3, -np.pi / 2 + 0.05
    positions = turn_positions(model, 3, middle - step, middle + step)
    poses = closed_poses(model, positions)

    def turned(size):
        return turn_over(model, jax.tree.map(lambda x: size * x, errors), poses)

    turn = evaluated(turned)(jnp.ones(()))
    assert not turn.status.any()
    derivative = (turn.energy[2] - turn.energy[0]) / (2 * step)
    assert float(turn.holding[1]) == pytest.approx(float(derivative), rel=1e-4)
    other = evaluated(lambda: assemble(model, errors, hold={"A": middle}))()
    assert int(other.status) == 0
    for name, load in other.preload.items():
        np.testing.assert_allclose(turn.loads[name].force[1], load.force, rtol=1e-7, atol=1e-6)
        np.testing.assert_allclose(turn.loads[name].moment[1], load.moment, rtol=1e-7, atol=1e-6)
    check_derivatives(lambda size: turned(size).holding, 1.0, 1e-4, reverse=1e-8, differences=1e-5)


def test_a_turn_has_labelled_data():
    length, point = 0.3, (0.05, 0.0, 0.0)
    model = discretise(arm(angle=0.2, points=["arm.end"], shaking_point=point))
    turn = kinetostatic_turn(model, positions=np.array([0.2, 1.6, 3.0, 4.6]), axes="global")
    data, table = turn.to_xarray(), turn.to_pandas()
    place = length * np.stack([np.cos(turn.position), 0.0 * turn.position, -np.sin(turn.position)], axis=1)
    np.testing.assert_allclose(data["place_arm.end"].values[0], place, atol=1e-12)
    weight = 7850.0 * 1e-4 * length * 9.81
    np.testing.assert_allclose(data.shaking_force.sel(component="z").values[0], -weight, rtol=1e-9)
    # The weight in the middle of the arm, about a point on x.
    moment = weight * (0.5 * place[:, 0] - point[0])
    np.testing.assert_allclose(data.shaking_moment.sel(component="y").values[0], moment, atol=1e-12)
    assert data.shaking_moment.attrs["units"] == "N m" and data.position.attrs["units"] == "rad"
    np.testing.assert_allclose(table["shaking_moment_y_Nm"], moment, atol=1e-12)
    np.testing.assert_allclose(table["arm.end_x_m"], place[:, 0], atol=1e-12)
    np.testing.assert_allclose(data.force.sel(joint="A").values[0], turn.loads["A"].force)
    np.testing.assert_allclose(data.force_global.sel(joint="A").values[0], [[0.0, 0.0, weight]] * 4, atol=1e-9)
    np.testing.assert_allclose(table["A_force_global_z_N"], weight, rtol=1e-9)
    # The arm's angle about y is that of its drive, also beyond half a revolution.
    np.testing.assert_allclose(data["angles_arm.end"].values[0], np.outer(turn.position, [0, 1, 0]), atol=1e-12)
    np.testing.assert_allclose(table["arm.end_angle_y_rad"], turn.position, atol=1e-12)
    # A position that was not assembled has no angle, and those after it have theirs.
    nowhere = jnp.where(jnp.arange(4) == 2, jnp.nan, 1.0)
    broken = eqx.tree_at(
        lambda t: (t.status, t.points["arm.end"].rotation), turn,
        (turn.status.at[2].set(1), turn.points["arm.end"].rotation * nowhere[:, None, None]),
    )  # fmt: skip
    left = broken.to_xarray()["angles_arm.end"].values[0, :, 1]
    np.testing.assert_allclose(left, turn.position * nowhere, atol=1e-12)
    assert "on the base" in str(turn) and "The drive holds with" in str(turn) and "<table" in turn._repr_html_()


def test_turns_that_cannot_be_are_refused():
    model = discretise(four_bar(2))
    rocker = discretise(Mechanism(four_bar(2).links, four_bar(2).joints, driven_joint="D"))
    with pytest.raises(InputError, match="the last position that closes"):
        kinetostatic_turn(rocker)
    with pytest.raises(InputError, match="`positions` must be a whole number"):
        turn_positions(model, 0)
    with pytest.raises(InputError, match="`stop` of a turn"):
        turn_positions(model, 3, 0.1)
    free = discretise(Mechanism([link("arm", 0.3)], [Joint("A", "base", "arm")]))
    with pytest.raises(InputError, match="must have a driven joint"):
        kinetostatic_turn(free)


@pytest.mark.long
def test_contacts_of_a_turn_are_those_of_assemblies_and_loads_have_derivatives_by_the_clearance():
    model = discretise(flexible_four_bar(), rfes=2)
    wrong = {"D.delta_x": TILT, "D.d_y": 5e-4}
    poses = closed_poses(model, positions := np.array([-0.4, 1.1]))

    def turned(deviation):
        def turn(deviation):
            return turn_over(model, deviations(model, {**wrong, "D.clearance.radial": deviation}), poses)

        found, change = jax.jvp(turn, (deviation,), (jnp.ones(()),))
        own = found.status, found.loads["D"], found.contacts["D"]
        return own, change.loads["D"], change.contacts["D"].penetration

    tight, step = -5e-5, 1e-7
    found = evaluated(jax.vmap(turned))(jnp.asarray([tight, tight + step, tight - step]))
    ((status, *turn), slope, deeper), ((_, *high), *_), ((_, *low), *_) = (
        jax.tree.map(lambda value: value[i], found) for i in range(3)
    )
    assert not np.asarray(status).any()
    loads, contacts = turn
    states = [carrying(depth) for depth in contacts.penetration]
    assert states == [("start", "end", "axial")] * 2
    for i, position in enumerate(positions):
        one = assemble(model, deviations(model, {**wrong, "D.clearance.radial": tight}), hold={"A": position})
        assert int(one.status) == 0 and one.contacts["D"].carrying == states[i]
        for values, other in ((contacts, one.contacts["D"]), (loads, one.preload["D"])):
            for name, part in values._asdict().items():
                np.testing.assert_allclose(part[i], getattr(other, name), rtol=1e-7, atol=1e-11, err_msg=name)
    difference = (high[0].moment - low[0].moment) / (2.0 * step)
    np.testing.assert_allclose(slope.moment, difference, rtol=1e-5, atol=1e-5 * np.abs(difference).max())
    difference = (high[1].penetration - low[1].penetration) / (2.0 * step)
    np.testing.assert_allclose(deeper, difference, rtol=1e-5)


@pytest.mark.long
def test_a_turn_with_a_table_of_a_coupling_within_a_jit_of_the_users():
    model, positions = discretise(cam()), np.array([0.0, 0.3])

    def holding(longer):
        return kinetostatic_turn(model, {"cam.length": longer}, positions).holding

    np.testing.assert_allclose(evaluated(holding)(1e-4), holding(1e-4), rtol=1e-12, atol=1e-15)


def test_what_cannot_be_assembled_says_so_and_leaves_the_rest_of_a_batch_alone():
    model, positions = discretise(four_bar(2)), np.array([-1.5, -1.4])

    def turned(tilt):
        turn = kinetostatic_turn(model, {"D.delta_x": tilt}, positions)
        return turn.status, turn.holding

    status, holding = evaluated(jax.vmap(turned))(jnp.array([0.0, jnp.nan, 1e-3]))
    assert (status == 0).tolist() == [[True, True], [False, False], [True, True]]
    assert np.isfinite(holding[[0, 2]]).all()
    np.testing.assert_array_equal(holding[2], evaluated(turned)(1e-3)[1])


def test_a_rod_on_its_head_on_a_driven_arm_is_left_as_a_pendulum_is():
    length = 0.3
    joints = [Joint("A", "base", "arm", angle=0.0), Joint("B", "arm", "rod", angle=-np.pi / 2)]
    turns = []
    for gravity in (-9.81, 9.81):  # z is up, where the rod points to
        links = [link("arm", length), link("rod", length)]
        model = discretise(Mechanism(links, joints, driven_joint="A", gravity=(0.0, 0.0, gravity)))
        turns.append(evaluated(lambda model=model: kinetostatic_turn(model, positions=np.zeros(1)))())
    on_its_head, hanging = turns
    assert STATUS[int(on_its_head.status[0])].name == "unstable" and hanging.status[0] == 0
    np.testing.assert_allclose(on_its_head.stability.growth[0], np.sqrt(1.5 * 9.81 / length), rtol=1e-3)
    assert hanging.stability.growth[0] == 0.0 and jax.tree.map(lambda x: x[0], on_its_head.stability).place == "joint B"
