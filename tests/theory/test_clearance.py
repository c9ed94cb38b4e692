"""Joints with clearance at rest, against closed forms and values of independent programs.

The reference values of the four-bar were computed for this project in absolute coordinates and by Exudyn beside it:
loads are those of the parent on the child about the child's point, in the axes of the parent's frame.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Clearance,
    Joint,
    Link,
    Mechanism,
    RigidBody,
    assemble,
    assembly_errors,
    design,
    discretise,
)
from tests.mechanisms import BAR, STEEL
from tests.theory.test_compliant_joints import ANGLES, in_seat

PLAY = Clearance(radial=1e-4, length=0.02, stiffness=5e7, exponent=1, axial_stiffness=2e7)
TILT = np.radians(0.5)


def body(name, mass=2.0, length=0.1):
    return Link(name, length, body=RigidBody(mass, (0.0, 0.0, 0.0), (0.01, 0.01, 0.01)))


def hung(clearance, turned=False):
    """A body that hangs by its mass centre on a clearance alone, its bush along y, or along the vertical."""
    joint = Joint("D", "base", "body", orientation=(np.pi / 2, 0, 0) if turned else (0, 0, 0), clearance=clearance)
    return discretise(Mechanism([body("body")], [joint], driven_joint="D"))


@pytest.fixture(scope="module")
def hanging():
    return hung(dataclasses.replace(PLAY, stiffness=4e9, exponent=1.5))


class TestPressedAtRest:
    WEIGHT = 2.0 * 9.81

    def test_both_ends_carry_half(self, hanging):
        found = assemble(hanging, assembly_errors(hanging))
        at_d = found.contacts["D"]
        depth = (0.5 * self.WEIGHT / 4e9) ** (2 / 3)
        assert int(found.status) == 0 and at_d.carrying == ("start", "end")
        np.testing.assert_allclose(at_d.penetration, [depth, depth, 0.0], rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(at_d.normal_force, [0.5 * self.WEIGHT] * 2 + [0.0], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(at_d.eccentricity, [[0.0, -1e-4 - depth]] * 2, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.preload["D"].force, [0.0, 0.0, self.WEIGHT], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.preload["D"].moment, 0.0, atol=1e-9)
        assert np.max(found.contacts["D"].centring) < 1e-6

    def test_derivatives_by_clearance_stiffness_and_mass(self, hanging):
        def place(values):
            names = ("D.clearance.radial", "D.clearance.stiffness", "body.mass")
            found = assemble(hanging, assembly_errors(hanging), design=design(hanging, dict(zip(names, values))))
            return found.contacts["D"].eccentricity[0, 1]

        at = jnp.array([1e-4, 4e9, 2.0])
        depth = (0.5 * self.WEIGHT / 4e9) ** (2 / 3)
        expected = [-1.0, 2 / 3 * depth / 4e9, -2 / 3 * depth / 2.0]
        np.testing.assert_allclose(jax.jacfwd(place)(at), expected, rtol=1e-6)
        np.testing.assert_allclose(jax.grad(place)(at), expected, rtol=1e-6)

    def test_without_gravity_the_weak_spring_says_that_it_holds_the_pin(self, hanging):
        floating = dataclasses.replace(hanging, gravity=jnp.zeros(3))
        found = assemble(floating, assembly_errors(floating))
        assert int(found.status) == 0 and found.contacts["D"].carrying == ()
        np.testing.assert_allclose(found.contacts["D"].penetration, [-1e-4, -1e-4, 0.0], atol=1e-11)

    def test_the_axial_stop_carries_the_weight_of_an_upright_pin(self):
        model = hung(dataclasses.replace(PLAY, axial=3e-4), turned=True)
        found = assemble(model, assembly_errors(model))
        assert int(found.status) == 0 and found.contacts["D"].carrying == ("axial",)
        np.testing.assert_allclose(found.contacts["D"].penetration[2], self.WEIGHT / 2e7, rtol=1e-6)
        np.testing.assert_allclose(np.abs(found.preload["D"].force[1]), self.WEIGHT, rtol=1e-9)


@pytest.fixture(scope="module", params=["tree", "cut"])
def shaft(request):
    """A rigid shaft on an ideal hinge, and in a bush that may be tilted against it."""
    ideal, bush = ("A", "base", "shaft"), ("D", "base", "shaft")
    play = dataclasses.replace(PLAY, stiffness=4e9, exponent=1.5)
    if request.param == "cut":
        joints = [Joint(*ideal), Joint(*bush, child_position=(0, 0, 0), position=(0, 0, 0), cut=True, clearance=play)]
    else:
        joints = [Joint(*bush, clearance=play), Joint(*ideal, child_position=(0, 0, 0), position=(0, 0, 0), cut=True)]
    return discretise(Mechanism([body("shaft")], joints, gravity=(0.0, 0.0, 0.0), driven_joint=joints[0].name))


@pytest.mark.parametrize(("tilt", "carries"), [(0.0095, False), (0.0105, True), (0.02, True)])
def test_a_misaligned_shaft_in_its_bush(shaft, tilt, carries):
    for name in ("D.delta_x", "D.delta_z"):
        found = assemble(shaft, assembly_errors(shaft, {name: tilt}))
        assert int(found.status) == 0
        expected = 0.02 * 4e9 * max(0.01 * np.sin(tilt) - 1e-4, 0.0) ** 1.5 * np.cos(tilt)
        assert found.contacts["D"].carrying == (("start", "end") if carries else ())
        np.testing.assert_allclose(np.linalg.norm(found.preload["D"].moment), expected, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(found.preload["D"].force, 0.0, atol=1e-7)


@pytest.fixture(scope="module")
def four_bar():
    return discretise(flexible_four_bar())


def flexible_four_bar(clearance=PLAY, cut=False):
    """The four-bar of the reference; `cut`: opened at D instead of C, the rocker the other way round."""
    steel = dataclasses.replace(STEEL, damping=0.0)
    links = [Link("crank", 0.12, BAR, steel, rigid=True)]
    links += [Link(name, 0.3, BAR, steel, rfes=5) for name in ("coupler", "rocker")]
    crank, coupler, rocker = ANGLES
    joints = [Joint("A", "base", "crank", angle=crank), Joint("B", "crank", "coupler", angle=coupler - crank)]
    if cut:
        joints += [Joint("C", "coupler", "rocker", angle=rocker + np.pi - coupler)]
        joints += [Joint("D", "base", "rocker", position=(0.3, 0.0, 0.0), cut=True, clearance=clearance)]
    else:
        joints += [Joint("D", "base", "rocker", position=(0.3, 0.0, 0.0), angle=rocker, clearance=clearance)]
        joints += [Joint("C", "coupler", "rocker", cut=True)]
    return Mechanism(links, joints, driven_joint="A", elements="geometrically_exact")


class TestFourBar:
    # (errors, radial, axial): force of D, moment of D, hold moment.
    GIVEN = (
        ({"D.delta_z": TILT}, 0.0, 0.0,
         (-0.442178978055, -14.1386862248, 3.23491428748), (2.54970304171, 0.0, 3.19321672542), 0.0382536472503),
        ({"D.delta_z": TILT}, 4.36332312999e-05, 0.0,
         (-0.409267397713, -3.65579127122, 3.19453417171), (0.356139119279, -1.16514666214e-06, 1.32029801425),
         0.0452819306291),
        ({"D.delta_z": TILT}, 1.308996939e-4, 0.0,
         (-0.387342781066, -0.064901863712, 3.18854707803), (0.00463374461761, -3.91767386643e-05, 0.0279152583891),
         0.0464113995286),
        ({"D.delta_x": TILT, "D.delta_z": TILT, "D.d_y": 5e-4}, 6.17067074744e-05, 2.5e-4,
         (-0.430382130512, -7.54047283366, 3.26087997035), (2.27607748831, -1.00496123892e-06, 1.72653512651),
         0.0437181265812),
    )  # fmt: skip

    def loads(self, model, errors, radial, axial):
        wanted = design(model, {"D.clearance.radial": radial, "D.clearance.axial": axial})
        found = assemble(model, assembly_errors(model, errors), design=wanted)
        j, topology = model.topology.joints.index("D"), model.topology
        angle = float(found.state.position.joints[topology.own_positions[j][0]]) if j < topology.n_links else 0.0
        return found, (in_seat(found.preload["D"].force, angle), in_seat(found.preload["D"].moment, angle))

    @pytest.mark.parametrize("case", range(len(GIVEN)))
    def test_preload_over_clearance(self, four_bar, case):
        errors, radial, axial, force, moment, hold = self.GIVEN[case]
        found, (at_d, about_d) = self.loads(four_bar, errors, radial, axial)
        assert int(found.status) == 0
        np.testing.assert_allclose(at_d, force, rtol=0, atol=1e-8 * float(np.linalg.norm(force)) + 1e-8)
        np.testing.assert_allclose(about_d, moment, rtol=0, atol=1e-8 * float(np.linalg.norm(moment)) + 1e-9)
        np.testing.assert_allclose(found.preload["A"].moment[1], hold, rtol=1e-7)

    def test_cut_at_the_bush(self):
        errors, radial, axial, force, moment, hold = self.GIVEN[3]
        model = discretise(flexible_four_bar(cut=True))
        found, (at_d, about_d) = self.loads(model, errors, radial, axial)
        assert int(found.status) == 0
        np.testing.assert_allclose(at_d, force, rtol=0, atol=1e-7 * float(np.linalg.norm(force)))
        np.testing.assert_allclose(about_d, moment, rtol=0, atol=1e-7 * float(np.linalg.norm(moment)))
        np.testing.assert_allclose(found.preload["A"].moment[1], hold, rtol=1e-7)

    def test_derivatives_by_clearance_and_misalignment(self, four_bar):
        names = ["D.clearance.radial", "D.clearance.length"]

        def loads(values):
            errors = assembly_errors(four_bar, {"D.delta_z": values[0], "D.d_x": values[3]})
            made = assemble(four_bar, errors, design=design(four_bar, dict(zip(names, values[1:3]))))
            return jnp.stack([jnp.sum(made.preload["D"].moment ** 2), jnp.sum(made.preload["B"].force ** 2)])

        at = jnp.array([TILT, 5e-5, 0.02, 1e-5])
        forward, backward = jax.jacfwd(loads)(at), jax.jacrev(loads)(at)
        np.testing.assert_allclose(backward, forward, rtol=1e-8)
        for n, size in enumerate((1e-6, 2e-9, 1e-6, 1e-8)):
            step = size * np.eye(4)[n]
            difference = (loads(at + step) - loads(at - step)) / (2 * size)
            np.testing.assert_allclose(forward[:, n], difference, rtol=1e-5)

    def test_samples_of_a_batch_are_in_different_contact_states(self, four_bar):
        def contact(tilt):
            errors = assembly_errors(four_bar, {"D.delta_x": tilt})
            made = assemble(four_bar, errors, design=design(four_bar, {"D.clearance.radial": 1.3e-4}))
            return made.status, made.contacts["D"].normal_force, made.preload["D"].moment

        tilts = jnp.array([0.0, 0.3 * TILT, 2.0 * TILT, 4.0 * TILT])
        together = jax.vmap(contact)(tilts)
        assert not np.asarray(together[0]).any()
        assert {tuple(row[:2] > 1e-6) for row in np.asarray(together[1])} == {(True, True), (False, True)}
        for n in (0, 3):
            for one, row in zip(contact(tilts[n]), together, strict=True):
                np.testing.assert_allclose(row[n], one, rtol=1e-6, atol=1e-8)
