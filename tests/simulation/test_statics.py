"""Loads at rest: closed forms of beams, of a misfit, of a pendulum and of a four-bar by virtual work; derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    InputError,
    Joint,
    Mechanism,
    Point,
    PointForce,
    StaticProblem,
    Tolerances,
    Uniform,
    assemble,
    discretise,
    monte_carlo,
    static_loads,
)
from tests.derivatives import check_derivatives
from tests.evaluation import evaluated
from tests.mechanisms import BAR, STEEL, arm, four_bar, link

LENGTH, LOAD = 1.0, 1.0
BENDING = STEEL.youngs_modulus * BAR.width * BAR.height**3 / 12.0
SEGMENTS = 6
# Springs in the middles of segments: the midpoint rule for the square of the lever, less a quarter over their square.
TIP = (1.0 - 0.25 / SEGMENTS**2) * LENGTH**3 / (3.0 * BENDING)
SHEAR = 4e-4  # what the shear of a bar of this slenderness adds, at most


def beam(start, end=None, load=0.0, at=1.0, **more):
    """A bar along x with a joint at its start, perhaps one at its end, and a force down."""
    joints = [Joint("A", "base", "beam", kind=start)]
    if end is not None:
        joints.append(
            Joint("B", "base", "beam", kind=end, position=(LENGTH, 0, 0), child_position=(LENGTH, 0, 0), cut=True)
        )
    forces = [PointForce("F", "beam", at * LENGTH, (0.0, 0.0, -load))] if load else []
    points = [Point("P", "beam", (at * LENGTH, 0.0, 0.0))]
    bar = link("beam", LENGTH, SEGMENTS + 1)
    return Mechanism([bar], joints, forces=forces, points=points, gravity=(0.0, 0.0, 0.0), **more)


@pytest.mark.slow
def test_a_cantilever_bends_by_its_closed_form():
    found = evaluated(lambda: static_loads(discretise(beam("fixed", load=LOAD))))()
    assert int(found.status[0]) == 0 and not found.holding and float(found.checks.momentum_balance_error) < 1e-9
    np.testing.assert_allclose(found.loads["A"].force[0], [0.0, 0.0, LOAD], atol=1e-9)
    np.testing.assert_allclose(found.loads["A"].moment[0], [0.0, -LOAD * LENGTH, 0.0], rtol=1e-5, atol=1e-9)
    assert -found.points["P"].position[0, 2] == pytest.approx(LOAD * TIP, rel=SHEAR)
    np.testing.assert_allclose(found.recorded["beam.deflection"][0, 2], found.points["P"].position[0, 2])
    sections = found.recorded["beam.sections"]
    # The force of the far end on a section, and its bending moment.
    inside = (sections.place > 1e-9) & (sections.place < LENGTH - 1e-9)
    np.testing.assert_allclose(sections.resultants[0, 2][inside], -LOAD, rtol=1e-5)
    expected = LOAD * (LENGTH - sections.place[inside])
    np.testing.assert_allclose(np.abs(sections.resultants[0, 4][inside]), expected, rtol=1e-4)
    stress = 6.0 * LOAD * LENGTH / (BAR.width * BAR.height**2)
    assert float(found.stress["beam"][0]) == pytest.approx(stress, rel=1e-4)
    # Clapeyron: the energy is half the work of the force.
    assert float(found.energy.elastic[0]) == pytest.approx(0.5 * LOAD**2 * TIP, rel=SHEAR)


@pytest.mark.slow
def test_a_simply_supported_beam_carries_half_its_load_at_each_end():
    load = 0.01 * LOAD  # so small that it does not stretch the beam between its ends
    found = evaluated(lambda: static_loads(discretise(beam("revolute", "revolute", load, 0.5))))()
    assert int(found.status[0]) == 0
    for name in "AB":
        assert abs(float(found.loads[name].force[0, 2])) == pytest.approx(0.5 * load, rel=1e-6)
        assert abs(float(found.loads[name].moment[0, 1])) < 1e-9
    # Of each half the lever squared, by the midpoint rule of half as many segments.
    deflection = (1.0 - 0.25 / (SEGMENTS / 2) ** 2) * load * LENGTH**3 / (48.0 * BENDING)
    assert -float(found.points["P"].position[0, 2]) == pytest.approx(deflection, rel=4.0 * SHEAR)


@pytest.mark.long
def test_a_misfit_preloads_a_propped_cantilever():
    # The support is to be higher by the misfit: the beam is bent up by a force at its tip.
    model = discretise(beam("fixed", "revolute"))
    problem = StaticProblem(model, ["B.max_force", "A.max_moment", "P.deviation_z", "end_energy"])
    misfit, tip = 3e-7, 3e-7 / TIP  # so small that it does not stretch the beam between its ends

    def values(numbers):
        found, status = problem({"B.d_z": numbers[0], "A.delta_y": numbers[1]})
        return jnp.append(jnp.stack([found[one.name] for one in problem.metrics]), status.astype(float))

    jacobians = check_derivatives(values, [misfit, 0.0], 1e-7, reverse=1e-8, differences=1e-2, floor=1e-6)
    expected = [tip, tip * LENGTH, misfit, 0.5 * tip * misfit, 0.0]
    np.testing.assert_allclose(jacobians.values, expected, rtol=2.0 * SHEAR, atol=1e-15)
    # A tilt by an angle of the clamp lowers the tip by the length times it, seen from the tilted tangent.
    np.testing.assert_allclose(jacobians.forward[:2, 0], [1.0 / TIP, LENGTH / TIP], rtol=0.01)
    np.testing.assert_allclose(np.abs(jacobians.forward[:2, 1]), [LENGTH / TIP, LENGTH**2 / TIP], rtol=0.01)


def test_a_pendulum_is_held_as_given_or_settles():
    weight = 9.81 * STEEL.density * BAR.width * BAR.height * 0.3
    given = Mechanism([link("arm", 0.3)], [Joint("A", "base", "arm", angle=0.4)])
    found = evaluated(lambda: static_loads(discretise(given), positions={"A": [0.4, 1.0]}))()
    np.testing.assert_allclose(found.position["A"], [0.4, 1.0])
    np.testing.assert_allclose(found.holding["A"], -weight * 0.15 * np.cos([0.4, 1.0]), rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found.loads["A"].force, axis=1), weight)
    settled = Mechanism([link("arm", 0.3)], [Joint("A", "base", "arm", angle=1.2)], start="equilibrium")
    found = evaluated(lambda: static_loads(discretise(settled)))()
    assert not found.holding and float(found.angles["A"][0]) == pytest.approx(np.pi / 2)


def four_bar_energy(angle):
    """Potential energy [J] of the rigid four-bar of `tests.mechanisms` by its closed kinematics."""
    line = STEEL.density * BAR.width * BAR.height
    pin = 0.12 * np.array([np.cos(angle), -np.sin(angle)])
    apart = np.array([0.3, 0.0]) - pin
    distance = np.linalg.norm(apart)
    height = np.sqrt(0.3**2 - 0.25 * distance**2)  # coupler and rocker are equally long
    joint = pin + 0.5 * apart + height * np.array([-apart[1], apart[0]]) / distance
    centres = 0.12 * 0.5 * pin[1], 0.3 * 0.5 * (pin[1] + joint[1]), 0.3 * 0.5 * joint[1]
    return 9.81 * line * sum(centres)


@pytest.mark.long
def test_a_four_bar_under_its_weight_is_held_by_virtual_work():
    model = discretise(four_bar(None, redundant_reactions="minimum_norm"))
    angles = np.array([-np.pi / 2, -0.5, 0.9])
    found = evaluated(lambda: static_loads(model, positions={"A": angles}))()
    assert not np.any(found.status)
    step = 1e-6
    expected = [(four_bar_energy(one + step) - four_bar_energy(one - step)) / (2.0 * step) for one in angles]
    np.testing.assert_allclose(found.holding["A"], expected, rtol=1e-7)
    np.testing.assert_allclose(
        np.diff(found.energy.gravity), np.diff([four_bar_energy(one) for one in angles]), rtol=1e-9
    )
    # The start is that of the assembly of a simulation.
    preload = assemble(model).preload
    for name, load in preload.items():
        np.testing.assert_allclose(found.loads[name].force[0], load.force, atol=1e-12)
    data = found.to_xarray()
    assert data["force"].dims == ("case", "number", "joint", "component") and data["holding_A"].units == "N m"
    assert list(found.to_pandas()["A_position_rad"]) == pytest.approx(list(angles))
    assert "What holds the mechanism" in str(found) and "held by, N m" in found._repr_html_()


def test_samples_of_a_mechanism_at_rest():
    model = discretise(arm())
    weight = 9.81 * STEEL.density * BAR.width * BAR.height
    names = ("A.end_drive_moment", "A.max_drive_moment", "A.rms_moment", "A.max_force", "mass", "A.end_angle")
    problem = StaticProblem(model, names, {"A": 0.0})
    found, status = problem({"arm.length": 1e-3})
    assert int(status) == 0 and problem.error_unit("arm.length") == "m" and problem.nominal_value("arm.length") == 0.3
    moment = weight * 0.301**2 / 2
    expected = (-moment, moment, moment, weight * 0.301, weight * 0.301 / 9.81, 0.0)
    np.testing.assert_allclose([found[name] for name in names], expected, rtol=1e-12)
    result = monte_carlo(problem, Tolerances({"arm.length": Uniform(1e-3)}), 64, jax.random.key(1), progress=False)
    spread = weight * 0.3 * 1e-3 / np.sqrt(3.0)
    assert float(result.statistics["A.max_drive_moment"].std.value) == pytest.approx(spread, rel=0.05)


def test_what_cannot_be_asked_of_a_mechanism_at_rest_is_said():
    model = discretise(four_bar(None, redundant_reactions="minimum_norm"))
    for positions, words in (
        ({"B": 0.1}, ("'B'", "is not", "`A`")),
        ({"A": [0.1, np.nan]}, ("finite", "'A'")),
        ({"A": [[0.1]]}, ("'A'",)),
    ):
        with pytest.raises(InputError) as told:
            static_loads(model, positions=positions)
        assert all(word in str(told.value) for word in words), str(told.value)
    long_crank = Mechanism(
        [link("crank", 0.5), link("coupler", 0.3), link("rocker", 0.3)],
        [
            Joint("A", "base", "crank", angle=0.0),
            Joint("B", "crank", "coupler", angle=np.radians(130)),
            Joint("D", "base", "rocker", position=(0.3, 0, 0), angle=np.radians(60)),
            Joint("C", "coupler", "rocker", cut=True),
        ],
        driven_joint="A",
        redundant_reactions="minimum_norm",
    )
    with pytest.raises(InputError, match="closes"):
        static_loads(discretise(long_crank), positions={"A": np.pi})
    for metric in ("friction_loss", "A.peak_drive_power"):
        with pytest.raises(InputError):
            StaticProblem(model, [metric])
