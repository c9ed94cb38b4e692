"""Descriptions as pytrees, and models of traced ones: those of designs, with their derivatives."""

import dataclasses
import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Compliance,
    GeneralisedAlpha,
    InputError,
    Joint,
    JointForceFunction,
    Material,
    Mechanism,
    MomentRamp,
    Point,
    PointMass,
    PointSpring,
    PointSpringFunction,
    PrescribedRate,
    Rectangle,
    RungeKutta4,
    Simulation,
    Tube,
    assemble,
    assembly_errors,
    design,
    discretise,
    kinetostatic_turn,
    simulate,
)
from rfem_jax.mechanics.model.status import STATUS
from tests.derivatives import check_derivatives
from tests.mechanisms import BUSHING, STEEL, chain_with_forces, compliant_four_bar, four_bar, link

# Of the rocker, of the coupler's section, of the bushing at the cut joint, of gravity and the drive.
NUMBERS = {"rocker.length": 0.301, "coupler.section.height": 0.011, "C.compliance.radial": 2.9e4, "gravity.z": -9.7}
MOMENT = 1.5
METHOD = GeneralisedAlpha(step=5e-4, corrections=9, tolerance=1e-14)


def described(length, height, stiffness, gravity):
    """The four-bar with compliant joints, of other numbers."""
    nominal = compliant_four_bar(tree=None, rfes=2)
    crank, coupler, rocker = nominal.links
    coupler = dataclasses.replace(coupler, section=Rectangle(0.01, height))
    *tree, cut = nominal.joints
    cut = dataclasses.replace(cut, compliance=dataclasses.replace(BUSHING, radial=stiffness))
    links = [crank, coupler, dataclasses.replace(rocker, length=length)]
    return dataclasses.replace(nominal, links=links, joints=[*tree, cut], gravity=(0.0, 0.0, gravity))


def loads(model, moment, wanted=None):
    """Loads of a short motion, and the tilt of a loaded start."""
    errors = assembly_errors(model, {"D.delta_x": 2e-3})
    drive = MomentRamp("A", moment, 1e-3)
    run = simulate(Simulation(model, drive=drive, duration=2e-3, method=METHOD, design=wanted), errors)
    return jnp.stack([run.metrics.rms_force["C"], run.metrics.rms_moment["D"]])


@pytest.mark.long
def test_a_traced_description_is_the_design_with_its_numbers_and_has_derivatives():
    values = np.array([*NUMBERS.values(), MOMENT])
    model = discretise(described(0.3, 0.01, 3e4, -9.81))

    def of_description(factors):
        *numbers, moment = [value * factors[n] for n, value in enumerate(values.tolist())]
        return loads(discretise(described(*numbers)), moment)

    def of_design(factors):
        wanted = {name: value * factors[n] for n, (name, value) in enumerate(NUMBERS.items())}
        return loads(model, MOMENT, design(model, {**wanted, "drive.moment": MOMENT * factors[4]}))

    ones = jnp.ones(len(values))
    found = check_derivatives(of_description, ones, 1e-4, reverse=1e-7, differences=1e-5, floor=1e-2)
    expected, along = jax.jit(lambda factors: jax.jvp(of_design, (factors,), (ones,)))(ones)
    np.testing.assert_allclose(found.values, expected, rtol=1e-9)
    np.testing.assert_allclose(found.forward.sum(axis=1), along, rtol=1e-8)
    # And what the description with floats is.
    np.testing.assert_allclose(found.values, of_description(np.ones(len(values)).tolist()), rtol=1e-9)


@pytest.mark.long
def test_without_compilation_derivatives_alone_see_traced_numbers_too():
    def length_of_rfe(height, length):
        model = discretise(described(length, height, 3e4, -9.81))
        coupler, rocker = (model.link_names.index(name) for name in ("coupler", "rocker"))
        return jnp.stack([model.section.bending[coupler], model.length[rocker], model.start_joints[1]])

    for derivative in (jax.jacfwd, jax.jacrev):
        by_height, by_length = derivative(length_of_rfe, (0, 1))(0.01, 0.3)
        assert float(by_height[0]) == pytest.approx(3.0 * 210e9 * 0.01 * 0.01**2 / 12.0)
        assert float(by_length[1]) == 1.0 and float(by_height[1]) == 0.0
        ahead, behind = (discretise(described(0.3 + d, 0.01, 3e4, -9.81)).start_joints[1] for d in (1e-6, -1e-6))
        assert float(by_length[2]) == pytest.approx(float(ahead - behind) / 2e-6, rel=1e-6)
    with pytest.raises(InputError, match="greater than 0"):
        jax.grad(lambda height: length_of_rfe(height, 0.3)[0])(-0.01)


@pytest.mark.parametrize("traced", [["lengths"], ["angle"], ["place", "angle"]])
def test_what_loops_are_closed_by_may_be_traced(traced):
    def starts(numbers):
        nominal = four_bar(rfes=2)
        numbers = {"lengths": [0.121, 0.301, 0.299], "angle": -1.55, "place": 0.302, **numbers}
        links = [dataclasses.replace(a, length=b) for a, b in zip(nominal.links, numbers["lengths"], strict=True)]
        crank, coupler, rocker, cut = nominal.joints
        crank = dataclasses.replace(crank, angle=numbers["angle"])
        rocker = dataclasses.replace(rocker, position=(numbers["place"], 0.0, 0.0))
        changed = dataclasses.replace(nominal, links=links, joints=[crank, coupler, rocker, cut])
        return discretise(changed).start_joints

    values = {"lengths": jnp.array([0.121, 0.301, 0.299]), "angle": -1.55, "place": 0.302}
    found = jax.jit(starts)({name: values[name] for name in traced})
    np.testing.assert_allclose(found, starts({}), rtol=0.0, atol=1e-10)


@pytest.mark.long
def test_the_place_of_a_point_may_be_traced():
    def place(x, z):
        nominal = Mechanism([link("arm", 0.3)], [Joint("A", "base", "arm", angle=0.2)], driven_joint="A")
        model = discretise(dataclasses.replace(nominal, points=[Point("P", "arm", (x, 0.0, z))]))
        drive, method = PrescribedRate("A", 0.0), RungeKutta4(step=1e-3)
        return simulate(Simulation(model, drive=drive, duration=2e-3, method=method)).points["P"].position[-1]

    x, z = 0.25, 0.03
    exact = [x * np.cos(0.2) + z * np.sin(0.2), 0.0, z * np.cos(0.2) - x * np.sin(0.2)]
    np.testing.assert_allclose(place(x, z), exact, atol=1e-14)
    for slopes in (jax.jit(jax.jacfwd(place, (0, 1)))(x, z), jax.jacrev(place, (0, 1))(x, z)):
        np.testing.assert_allclose(slopes[0], [np.cos(0.2), 0.0, -np.sin(0.2)], atol=1e-14)
        np.testing.assert_allclose(slopes[1], [np.sin(0.2), 0.0, np.cos(0.2)], atol=1e-14)


def test_a_turn_refuses_traced_numbers():
    with pytest.raises(InputError, match="deviations among `errors`"):
        jax.jit(lambda x: kinetostatic_turn(discretise(described(x, 0.01, 3e4, -9.81))).holding)(0.3)


def test_what_cannot_close_has_a_status():
    @jax.jit
    def status(length):
        model = discretise(described(length, 0.01, 3e4, -9.81))
        return assemble(model).status

    assert [STATUS[int(status(length))].name == "ok" for length in (0.3, 3.0)] == [True, False]


@pytest.mark.parametrize(
    ("changed", "pieces"),
    [
        (lambda one, x: dataclasses.replace(one, joints=[dataclasses.replace(one.joints[0]), dataclasses.replace(
            one.joints[1], angle=x), *one.joints[2:]]), ("joints[1].angle", "start values")),
        (lambda one, x: dataclasses.replace(one, links=[*one.links[:2], link("rocker", 0.3, 3, point_masses=[PointMass(
            0.1, x)])]), ("point mass", "`rocker`", "rfem_jax.design")),
        (lambda one, x: dataclasses.replace(one, points=[Point("P", "coupler", x)]), (
            "point `P`", "`coupler`", "rfem_jax.design")),
        (lambda one, x: dataclasses.replace(one, reaction_length=x, redundant_reactions="minimum_norm"), (
            "reaction_length", "known before compilation")),
        (lambda one, x: dataclasses.replace(one, gravity=jnp.stack([x, x, x])[:2]), ("three components",)),
        (lambda one, x: Rectangle(jnp.stack([x, x]), 0.01), ("float64 scalar",)),
    ],
)  # fmt: skip
def test_traced_numbers_that_cannot_be_are_refused_in_a_sentence(changed, pieces):
    with pytest.raises(InputError) as refused:
        jax.jit(lambda x: discretise(changed(four_bar(), x)).length)(0.1)
    assert all(piece in str(refused.value) for piece in pieces), str(refused.value)


def test_sections_of_one_name_that_differ_are_told_apart():
    def bending(one, other):
        nominal = four_bar()
        sections = [Rectangle(0.01, height, name="bar") for height in (one, other, other)]
        links = [dataclasses.replace(a, section=b) for a, b in zip(nominal.links, sections, strict=True)]
        return discretise(dataclasses.replace(nominal, links=links)).section.bending

    alike, apart = jnp.array([0.01, 0.01]), jnp.array([0.01, 0.011])
    for heights in (alike, apart):
        found = jax.jit(lambda x: bending(x[0], x[1]))(heights)
        np.testing.assert_allclose(found, bending(*heights.tolist()), rtol=1e-14)
    with pytest.raises(InputError, match="different names"):
        jax.jvp(bending, (0.01, 0.01), (1.0, 0.0))


def test_a_tube_has_the_shear_factor_of_traced_diameters():
    def stiffness(wall):
        arm = link("arm", 0.3, 3)
        arm = dataclasses.replace(arm, section=Tube(0.02, wall))
        return discretise(Mechanism([arm], [Joint("A", "base", "arm")])).section.stiffness[:, 0]

    assert np.array_equal(jax.jit(stiffness)(0.002), stiffness(0.002)) or np.allclose(
        jax.jit(stiffness)(0.002), stiffness(0.002), rtol=1e-15
    )
    slope = jax.jit(jax.jacfwd(stiffness))(0.002)
    np.testing.assert_allclose(slope, (stiffness(0.002 + 1e-6) - stiffness(0.002 - 1e-6)) / 2e-6, rtol=1e-6)


def test_descriptions_are_trees_of_their_numbers():
    with_functions = chain_with_forces()
    leaves, tree = jax.tree.flatten(with_functions)
    assert eqx.tree_equal(jax.tree.unflatten(tree, leaves), with_functions)
    # A partial function of JAX is equal only to itself.
    plain = [one for one in with_functions.forces if not isinstance(one, (JointForceFunction, PointSpringFunction))]
    mechanism = dataclasses.replace(with_functions, forces=plain)
    leaves, tree = jax.tree.flatten(mechanism)
    again = jax.tree.unflatten(tree, leaves)
    assert again == mechanism and hash(again) == hash(mechanism) and repr(again) == repr(mechanism)
    assert pickle.loads(pickle.dumps(again)) == mechanism
    assert all(isinstance(leaf, float) or eqx.is_array(leaf) for leaf in leaves)
    thicker = eqx.tree_at(lambda one: one.links[0].length, mechanism, 0.5)
    assert thicker == dataclasses.replace(
        mechanism, links=[dataclasses.replace(mechanism.links[0], length=0.5), *mechanism.links[1:]]
    )


def test_numbers_put_into_a_tree_are_traced_too():
    nominal = compliant_four_bar(rfes=2)
    spring = PointSpring("s", ("base", "rocker"), (0.0, 0.1), stiffness=100.0, damping=1.0)
    nominal = dataclasses.replace(nominal, forces=[spring])

    def places(one):
        return [one.links[1].material.youngs_modulus, one.joints[1].compliance.radial, one.forces[0].stiffness]

    @jax.jit
    def numbers(values):
        model = discretise(eqx.tree_at(places, nominal, list(values)))
        law, bush = model.frame_forces["s"], model.springs["B.radial"]
        return jnp.stack([model.section.stiffness[0, model.link_names.index("coupler")], bush.stiffness, law.stiffness])

    found = numbers(jnp.array([200e9, 1e4, 90.0]))
    np.testing.assert_allclose(found, [200e9 * 1e-4, 1e4, 90.0], rtol=1e-14)
    assert Material("steel", 200e9, 7850.0, 0.3) != STEEL and Compliance(radial=1e4) != BUSHING
