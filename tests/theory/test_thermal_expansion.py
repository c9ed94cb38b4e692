"""Links and a base of another temperature than at assembly."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Base,
    Compliance,
    DistributedForce,
    GivenSection,
    InputError,
    Joint,
    Link,
    Mechanism,
    Point,
    PointForce,
    PointMass,
    PointSpring,
    Rectangle,
    RigidBody,
    assemble,
    assembly_errors,
    design,
    deviations,
    discretise,
    parameters,
    static_loads,
)
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.elements import elasticity
from rfem_jax.mechanics.kinematics.motion import relative_motion
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.designs import designed
from tests.derivatives import check_derivatives
from tests.mechanisms import STEEL, four_bar

ALPHA, LENGTH, SIDE, WARMER = 12e-6, 0.5, 0.01, 40.0
WARM_STEEL = replace(STEEL, thermal_expansion=ALPHA)
AXIAL = STEEL.youngs_modulus * SIDE**2
NOTHING = (0.0, 0.0, 0.0)


def held(temperature=None, rfes=4, elements="linear", bearing=None, temperature_gradient_z=None, **more):
    """A bar between two clamps of the base, or one of them and a bearing that gives way."""
    warm = {"temperature": temperature, "temperature_gradient_z": temperature_gradient_z}
    bar = Link("bar", LENGTH, Rectangle(SIDE, SIDE), WARM_STEEL, rfes=rfes, **warm)
    stiffness = {} if bearing is None else {"compliance": Compliance(T_x=bearing, T_x_damping=1.0)}
    joints = [
        Joint("A", "base", "bar", kind="fixed"),
        Joint("B", "base", "bar", kind="fixed", cut=True, position=(LENGTH, 0, 0), child_position=(LENGTH, 0, 0),
              **stiffness),
    ]  # fmt: skip
    return discretise(Mechanism([bar], joints, gravity=NOTHING, **more), elements=elements)


def push(model, errors=None):
    """What the bar exerts on its far clamp [N], and the status of assembly."""
    assembled = assemble(model, deviations(model, errors), {})
    return -assembled.preload["B"].force[0], assembled.status


class TestHeldBar:
    """E A alpha T, over the length of the bar without load."""

    @pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
    def test_as_a_deviation(self, elements):
        found, status = push(held(elements=elements), {"bar.temperature": "40 K"})
        assert int(status) == 0
        np.testing.assert_allclose(found, AXIAL * ALPHA * WARMER / (1.0 + ALPHA * WARMER), rtol=1e-9)

    def test_as_a_number_it_must_leave_loops_closed(self):
        """The perfect mechanism stresses nothing, at its temperature neither."""
        with pytest.raises(InputError, match=r"stays open by 0.00024 m .*is an error of a case"):
            held(WARMER)
        found, status = push(held(WARMER, base=Base(ALPHA, WARMER)), {"bar.temperature": 1.0})
        assert int(status) == 0
        np.testing.assert_allclose(found, AXIAL * ALPHA / (1.0 + ALPHA * (WARMER + 1.0)), rtol=1e-9)

    @pytest.mark.long
    def test_with_a_bearing_in_series(self):
        stiffness = 3e7
        found, status = push(held(bearing=stiffness), {"bar.temperature": WARMER})
        grown = ALPHA * WARMER * LENGTH
        assert int(status) == 0
        np.testing.assert_allclose(found, grown / ((LENGTH + grown) / AXIAL + 1.0 / stiffness), rtol=1e-9)

    def test_a_base_that_grows_alike_lets_it_grow(self):
        model = held(base=Base(2.0 * ALPHA))
        growth, less = 1.0 + ALPHA * WARMER, ALPHA * (WARMER - 2.0 * 15.0)
        found, status = push(model, {"bar.temperature": WARMER, "base.temperature": "15 K"})
        assert int(status) == 0
        np.testing.assert_allclose(found, AXIAL * less / growth, rtol=1e-9)
        np.testing.assert_allclose(push(model, {"bar.temperature": 40.0, "base.temperature": 20.0})[0], 0.0, atol=1e-6)

    @pytest.mark.long
    def test_derivatives(self):
        """By temperatures that deviate, and by the expansion of the material as a design."""
        model = held(base=Base(23e-6))

        def answers(numbers):
            made = designed(
                model,
                design(model, {"steel.thermal_expansion": numbers[0]}),
                deviations(model, {"bar.temperature": numbers[1], "base.temperature": numbers[2]}),
            )
            return assemble(made.model, made.errors, {}).preload["B"].force[:1]

        at = np.array([ALPHA, WARMER, 10.0])
        found = check_derivatives(answers, at, [1e-8, 1.0, 1.0], reverse=1e-9, differences=1e-6)

        def closed(numbers):
            alpha, warmer, base = numbers
            growth = 1.0 + alpha * warmer
            return -AXIAL * (growth - (1.0 + 23e-6 * base)) / growth

        np.testing.assert_allclose(found.forward[0], jax.grad(closed)(jnp.asarray(at)), rtol=1e-7)

    def test_descriptions_with_traced_temperatures(self):
        """Of a beam that one clamp holds: its weight's moment grows with its length alone."""

        @jax.jit
        def found(temperature):
            beam = Link("beam", LENGTH, Rectangle(SIDE, SIDE), WARM_STEEL, rfes=2, temperature=temperature)
            model = discretise(Mechanism([beam], [Joint("A", "base", "beam", kind="fixed")]))
            return assemble(model, assembly_errors(model), {}).preload["A"].moment[1]

        moment = STEEL.density * SIDE**2 * LENGTH * 9.81 * 0.5 * LENGTH
        np.testing.assert_allclose(found(WARMER), -moment * (1.0 + ALPHA * WARMER), rtol=1e-6)
        np.testing.assert_allclose(jax.jacfwd(found)(WARMER), -moment * ALPHA, rtol=1e-4)

    def test_what_has_no_length_left_has_a_status(self):
        model = held()
        made = designed(model, design(model, {"bar.temperature": -1.0 / ALPHA}))
        assert int(made.status) != 0


GRADIENT = 2000.0  # K/m, along z; half of it along y
BENT = {"bar.temperature_gradient_z": GRADIENT, "bar.temperature_gradient_y": 0.5 * GRADIENT}
BENDING = STEEL.youngs_modulus * SIDE**4 / 12.0


class TestGradient:
    """A bar that is warmer above than below: free it is an arc of the curvature alpha dT/dz, clamped it has the moment
    E I alpha dT/dz all along, and no force."""

    @pytest.mark.slow
    @pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
    def test_free_and_clamped(self, elements):
        clamped = held(elements=elements)
        far = assemble(clamped, deviations(clamped, BENT), {}).preload["B"]
        moment = BENDING * ALPHA * GRADIENT
        np.testing.assert_allclose(far.moment, [0.0, -moment, 0.5 * moment], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(far.force, 0.0, atol=1e-9)
        bar, end = Link("bar", LENGTH, Rectangle(SIDE, SIDE), WARM_STEEL, rfes=4), Point("P", "bar", (LENGTH, 0, 0))
        hung = Mechanism([bar], [Joint("A", "base", "bar", kind="fixed")], gravity=NOTHING, points=[end])
        found = static_loads(discretise(hung, elements=elements), BENT)
        turned = ALPHA * GRADIENT * LENGTH
        # The warm side is convex: the end goes down, and its slope with it.
        assert int(found.status[0]) == 0
        place = np.asarray(found.points["P"].position)[0]
        np.testing.assert_allclose(place[1:], [-0.25 * turned * LENGTH, -0.5 * turned * LENGTH], rtol=1e-4)
        np.testing.assert_allclose(found.points["P"].angles[0, 1:], [turned, -0.5 * turned], rtol=1e-4)
        assert max(float(found.stress["bar"][0]), *np.abs(found.loads["A"].moment[0])) < 1e-6 * moment / SIDE**3

    @pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
    def test_forces_are_slopes_of_the_energy(self, elements):
        """At any position, so that runs balance their energy."""
        model = held(elements=elements)
        made = designed(model, None, deviations(model, BENT))
        actual, start = apply_errors(made.model, made.errors), model.start_coordinates()
        moved = 1e-2 * np.random.default_rng(0).normal(size=start.elastic.shape)

        @jax.jit
        def both(elastic):
            def energy(x):
                return elasticity.elastic_energy(actual, replace_elastic(start, x))

            state = static_state(model.topology, replace_elastic(start, elastic))
            relative = relative_motion(actual, state.position, state.velocity)
            return elasticity.generalised_forces(actual, state, relative)[0], jax.grad(energy)(elastic)

        forces, slopes = both(jnp.asarray(moved))
        np.testing.assert_allclose(forces, -slopes, rtol=1e-9, atol=1e-9 * np.abs(slopes).max())
        np.testing.assert_allclose(both(jnp.zeros_like(moved))[0][4, -1], BENDING * ALPHA * GRADIENT, rtol=1e-9)

    @pytest.mark.long
    def test_derivatives(self):
        """By both gradients, by the expansion as a design, and by a longer link, whose moment is the same."""
        model = held()

        def answers(numbers):
            errors = dict(zip((*BENT, "bar.length"), numbers[:3], strict=True))
            chosen = design(model, {"steel.thermal_expansion": numbers[3]})
            made = designed(model, chosen, deviations(model, errors))
            return assemble(made.model, made.errors, {}).preload["B"].moment[1:]

        at = np.array([*BENT.values(), 0.0, ALPHA])
        found = check_derivatives(answers, at, [1.0, 1.0, 1e-7, 1e-8], reverse=1e-9, differences=1e-6, floor=1e-6)
        slope = BENDING * np.array([[-ALPHA, 0.0, 0.0, -GRADIENT], [0.0, ALPHA, 0.0, 0.5 * GRADIENT]])
        np.testing.assert_allclose(found.forward, slope, rtol=1e-6, atol=1e-3)

    def test_descriptions_with_traced_gradients(self):
        @jax.jit
        def found(gradient):
            return push_of_bent(held(temperature_gradient_z=gradient))

        np.testing.assert_allclose(found(GRADIENT), -BENDING * ALPHA * GRADIENT, rtol=1e-9)
        np.testing.assert_allclose(jax.jacfwd(found)(GRADIENT), -BENDING * ALPHA, rtol=1e-9)


def replace_elastic(position, elastic):
    return eqx.tree_at(lambda one: one.elastic, position, elastic)


def push_of_bent(model):
    return assemble(model, assembly_errors(model), {}).preload["B"].moment[1]


def with_everything(link_length=0.3, growth=1.0, grown_base=1.0, **warm):
    """Two links with all that has a place on them, of lengths and places that grow."""

    def on(place, by=growth):
        return tuple(by * x for x in place)

    section = GivenSection(2e7, 7e6, 6e6, 150.0, 180.0, 120.0, *(x / growth for x in (0.7, 1.4e-5, 8e-6, 6e-6)))
    links = [
        Link("one", link_length * growth, section, rfes=3, **warm,
             point_masses=[PointMass(0.2, on((0.1, 0.01, 0.02)))]),
        Link("two", 0.2, body=RigidBody(0.3, (0.1, 0.02, 0.0), (1e-3, 1e-3, 1e-3))),
    ]  # fmt: skip
    joints = [
        Joint("A", "base", "one", position=on((0.1, 0.2, 0.3), grown_base), child_position=on((0.02, 0.0, 0.01))),
        Joint("B", "one", "two", position=on((0.2, 0.01, 0.0))),
    ]
    forces = [
        PointForce("push", "one", on((0.25, 0.0, 0.01)), (1.0, 2.0, 3.0)),
        PointSpring("coil", ["base", "one"], [on((0.0, 0.0, 0.5), grown_base), on((0.15, 0.0, 0.0))], 100.0),
        DistributedForce("wind", "one", (0, 0, 1), (0, 0, 2), 0.05 * growth, 0.2 * growth),
    ]
    points = [Point("P", "one", on((0.12, 0.03, 0.0)))]
    return Mechanism(links, joints, forces=forces, points=points)


def arrays(model):
    """All but curvatures, which are zero here."""
    assert model.curvature is None or not np.any(model.curvature)
    return jax.tree.leaves(replace(model, source=None, curvature=None))


def test_all_places_on_a_link_and_on_the_base_move():
    """The arrays of a warm mechanism are those of one whose numbers are the warm ones; sections keep their stiffness,
    and links their mass."""
    growth, of_base = 1.0 + 2e-5 * 100.0, 1.0 + 3e-5 * 50.0
    cold = with_everything(temperature=0.0, thermal_expansion=2e-5)
    warm = replace(with_everything(temperature=100.0, thermal_expansion=2e-5), base=Base(3e-5, "50 K"))
    expected = discretise(with_everything(growth=growth, grown_base=of_base))
    for found, wanted in zip(arrays(discretise(warm)), arrays(expected), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-14, atol=1e-16)
    assert any(np.any(x != y) for x, y in zip(arrays(discretise(cold)), arrays(expected), strict=True))
    model = discretise(replace(cold, base=Base(3e-5)))
    made = designed(model, design(model, {"one.temperature": 100.0, "base.temperature": 50.0})).model
    for found, wanted in zip(arrays(made), arrays(expected), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(made.section.line_density * made.length, [0.7 * 0.3, 0.0], rtol=1e-13)


def test_what_has_no_expansion_is_as_before():
    cold, none = (four_bar(2, base=base) for base in (Base(ALPHA), None))
    for found, wanted in zip(arrays(discretise(cold)), arrays(discretise(none)), strict=True):
        assert np.array_equal(found, wanted)
    names = [*parameters(discretise(none))]
    assert discretise(none).curvature is None
    assert not any("temperature" in name or name.endswith(".thermal_expansion") for name in names)


@pytest.mark.long
def test_a_warm_coupler_is_a_longer_one():
    """Of the same mass: preload and positions of the assembled four-bar, and with a length error."""
    growth = 1.0 + ALPHA * 100.0
    cold = four_bar(2)
    cold = replace(cold, links=[replace(one, material=WARM_STEEL) for one in cold.links])
    coupler = cold.links[1]
    longer = replace(coupler, length=coupler.length * growth, material=replace(STEEL, name="light",
                     density=STEEL.density / growth))  # fmt: skip
    model, other = discretise(cold), discretise(replace(cold, links=[cold.links[0], longer, cold.links[2]]))
    deviates = deviations(model, {"coupler.temperature": 100.0})
    erroneous = assembly_errors(model, {"coupler.length": (growth - 1.0) * coupler.length})
    warm, wanted, heavier = (
        assemble(*pair) for pair in ((model, deviates), (other, assembly_errors(other)), (model, erroneous))
    )
    assert [int(one.status) for one in (warm, wanted, heavier)] == [0, 0, 0]
    np.testing.assert_allclose(warm.state.position.joints, wanted.state.position.joints, rtol=0, atol=1e-9)
    np.testing.assert_allclose(warm.state.position.joints, heavier.state.position.joints, rtol=0, atol=1e-6)
    for name, load in warm.preload.items():
        np.testing.assert_allclose(load.force, wanted.preload[name].force, rtol=0, atol=1e-6)
        # With more mass by a thousandth.
        np.testing.assert_allclose(load.force, heavier.preload[name].force, rtol=0, atol=2e-3)
    # As warm as its base and its links, it is a larger one of the same shape, which stands at the same angles.
    model = discretise(replace(cold, base=Base(ALPHA), gravity=NOTHING))
    alike = dict.fromkeys(["base.temperature", *(f"{one.name}.temperature" for one in cold.links)], 100.0)
    grown, before = (assemble(model, deviations(model, errors)) for errors in (alike, {}))
    np.testing.assert_allclose(grown.state.position.joints, before.state.position.joints, rtol=0, atol=1e-10)
    frame = assemble(model, deviations(model, {"base.temperature": 100.0}))
    apart = replace(cold, gravity=NOTHING)
    joints = [replace(one, position=(0.3 * growth, 0, 0)) if one.name == "D" else one for one in apart.joints]
    moved = discretise(replace(apart, joints=joints))
    positions = assemble(moved, assembly_errors(moved)).state.position.joints
    np.testing.assert_allclose(frame.state.position.joints, positions, rtol=0, atol=1e-9)
    assert np.abs(np.asarray(frame.state.position.joints - before.state.position.joints)).max() > 1e-4
