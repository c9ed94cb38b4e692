"""Mechanisms with joints of other kinds than revolute, against values of two independent programs.

The reference values were computed for this project: absolute coordinates and exact rotations, integrated with order 8
to 1e-9, and Exudyn beside it (a closed form for the slider-crank). Loads are those of the parent on the child, about
the child's point; a joint whose parent and child are exchanged here has the same resultants.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rfem_jax import (
    Coordinates,
    Joint,
    Link,
    Material,
    Mechanism,
    Method,
    MomentRamp,
    PrescribedRate,
    Rectangle,
    RigidBody,
    State,
    assemble,
    assembly_errors,
    describe,
    discretise,
    simulate,
)
from rfem_jax.mechanics.kinematics import motion_of
from rfem_jax.mechanics.model_with_errors import apply_errors
from rfem_jax.mechanics.statics.assembly import equilibrium, held_angles, quasi_static_rates


def body(name, length, mass, centre, inertia):
    """A rigid link with given mass, mass centre and principal inertia in its axes."""
    return Link(name, length, body=RigidBody(mass, centre, inertia))


def rotation_y(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def slider_crank():
    """Crank, rod and piston; spherical crank pin and cylindrical wrist pin leave no redundant rows."""
    links = [
        body("crank", 0.06, 0.4, (0.02, 0, 0.003), (1.5e-4, 3e-4, 2.5e-4)),
        body("piston", 0.05, 0.5, (0.012, 0, 0.006), (3e-4, 4e-4, 3.5e-4)),
        body("rod", 0.2, 0.35, (0.07, 0, 0.004), (1e-4, 1.6e-3, 1.55e-3)),
    ]
    joints = [
        Joint("A", "base", "crank"),
        Joint("G", "base", "piston", kind="prismatic", position=(0, 0, 0.01), displacement=0.26),
        Joint("C", "piston", "rod", kind="cylindrical", position=(0, 0, 0), child_position=(0.2, 0, 0)),
        Joint("B", "crank", "rod", kind="spherical", cut=True, child_position=(0, 0, 0)),
    ]
    return discretise(Mechanism(links, joints, driven_joint="A"))


@pytest.fixture(scope="module")
def run():
    period = 2.0 * np.pi / 60.0
    method = Method("rk4", step=period / 1000)
    return simulate(
        slider_crank(), drive=PrescribedRate("A", 60.0), duration=period, method=method, save_every=period / 40
    )


class TestSliderCrank:
    """Kinetostatics of the rigid slider-crank at 60 rad/s, closed form."""

    RMS_FORCE: ClassVar = {"A": 163.405163451, "B": 138.419711739, "C": 81.7375484726, "G": 17.3550624348}
    RMS_MOMENT: ClassVar = {"A": 3.36249363761, "G": 0.483691641602}
    # Time, angles of crank and rod, slide, forces x and z in global axes, moments about y of A and G.
    INSTANTS = (
        (0.0, 0.0, -0.0500208568058, 0.259749843554,
         {"A": (-252.889741594, -8.75796205076), "B": (-224.089741594, -8.36196205076),
          "C": (-140.521880798, -11.3401557196), "G": (0.0, 16.2451557196)}, 0.423237723045, -0.901991284788),
    )  # fmt: skip

    def test_rms_loads(self, run):
        assert int(run.status) == 0
        for joint, force in self.RMS_FORCE.items():
            np.testing.assert_allclose(run.metrics.rms_force[joint], force, rtol=1e-8)
        for joint in "ABCG":
            moment = self.RMS_MOMENT.get(joint, 0.0)
            np.testing.assert_allclose(run.metrics.rms_moment[joint], moment, rtol=1e-8, atol=1e-8)

    def test_components_at_an_instant(self, run):
        for time, crank, rod, slide, forces, about_a, about_g in self.INSTANTS:
            at = int(np.argmin(np.abs(np.asarray(run.times) - time)))
            np.testing.assert_allclose(run.displacements["G"][at], slide, rtol=0, atol=1e-11)
            # H of A turns with the crank, H of C with the rod, which is the child here; L of B is the crank's end.
            axes = {"A": rotation_y(crank), "B": rotation_y(crank), "C": -rotation_y(rod), "G": np.eye(3)}
            for joint, (x, z) in forces.items():
                found = axes[joint] @ np.asarray(run.loads[joint].force[at])
                np.testing.assert_allclose(found, [x, 0.0, z], rtol=0, atol=1e-6)
            np.testing.assert_allclose(run.loads["A"].moment[at][1], about_a, rtol=0, atol=1e-7)
            np.testing.assert_allclose(run.loads["G"].moment[at][1], about_g, rtol=0, atol=1e-7)

    def test_checks_of_the_run(self, run):
        assert float(run.energy_balance_error) < 1e-8
        assert float(run.momentum_balance_error) < 1e-12
        assert float(run.hinge_moment_error) < 1e-12

    def test_derivatives_in_both_modes(self):
        model = slider_crank()
        names = ("G.delta_y", "G.d_z", "rod.length", "C.child.delta_x")

        def loads(values):
            errors = assembly_errors(model, {name: values[i] for i, name in enumerate(names)})
            run = simulate(model, errors, drive=PrescribedRate("A", 60.0), duration=2e-3,
                           method=Method("rk4", step=1e-4), save_every=1e-3)  # fmt: skip
            return jnp.stack([run.metrics.mean_square_force["G"], run.metrics.mean_square_moment["C"]])

        at = jnp.asarray([2e-3, 1e-4, -2e-4, 3e-3])
        forward, backward = jax.jacfwd(loads)(at), jax.jacrev(loads)(at)
        np.testing.assert_allclose(forward, backward, rtol=1e-9, atol=1e-9 * np.abs(forward).max())
        step = 1e-5
        moved = jax.vmap(loads)(at[None] + step * jnp.concatenate([jnp.eye(4), -jnp.eye(4)]))
        differences = ((moved[:4] - moved[4:]) / (2.0 * step)).T
        np.testing.assert_allclose(forward, differences, rtol=1e-5, atol=1e-5 * np.abs(forward).max())

    @pytest.mark.parametrize("method", [Method("leapfrog", step=2e-5), Method("tsit5", rtol=1e-9, atol=1e-11),
                                        Method("generalised_alpha", step=1e-4, tolerance=1e-10)],
                             ids=lambda method: method.name)  # fmt: skip
    def test_every_method_follows_the_same_motion(self, method):
        """Under a moment; against Runge and Kutta's with a small step."""
        model, drive = slider_crank(), MomentRamp("A", 2.0, 0.02)

        def end(method):
            run = simulate(model, drive=drive, duration=0.02, method=method, save_every=0.005)
            assert int(run.status) == 0
            return float(run.displacements["G"][-1]), float(run.energy_balance_error)

        (slide, _), (found, balance) = end(Method("rk4", step=5e-5)), end(method)
        assert abs(slide - 0.2597498) > 1e-3
        np.testing.assert_allclose(found, slide, rtol=0, atol=2e-7)
        assert balance < 1e-3


class SpatialFourBar:
    """The closed start of a spatial four-bar A-B-C-D whose hinge D is tilted: axes of the links in global axes."""

    START, D, TILTS = -np.pi / 6.0, np.array([0.22, 0.1, 0.03]), np.radians([25.0, 40.0])
    CRANK, COUPLER, ROCKER = 0.08, 0.26, 0.2

    def __init__(self):
        (cx, cz), (sx, sz) = np.cos(self.TILTS), np.sin(self.TILTS)
        seat = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        self.crank = rotation_y(self.START)
        b = self.crank @ [self.CRANK, 0, 0]
        u = seat.T @ (b - self.D)
        k = (u @ u + self.ROCKER**2 - self.COUPLER**2) / (2.0 * self.ROCKER)
        self.angle = np.arctan2(-u[2], u[0]) - np.arccos(k / np.hypot(u[0], u[2]))
        self.rocker = seat @ rotation_y(self.angle)
        x = (self.D + self.rocker @ [self.ROCKER, 0, 0] - b) / self.COUPLER
        z = np.cross(x, self.rocker[:, 1]) / np.linalg.norm(np.cross(x, self.rocker[:, 1]))
        self.coupler = np.stack([x, np.cross(z, x), z], axis=1)

    def joints(self, *others):
        crank = Joint("A", "base", "crank", angle=self.START)
        tilts = (self.TILTS[0], 0, self.TILTS[1])
        return [
            crank,
            Joint("D", "base", "rocker", position=tuple(self.D), orientation=tilts, angle=self.angle),
            *others,
        ]

    def links(self, coupler=None):
        rigid = body("coupler", self.COUPLER, 0.3, (0.12, 0, 0), (2e-5, 1.9e-3, 1.9e-3))
        return [
            body("crank", self.CRANK, 0.25, (0.03, 0.004, 0.002), (5e-5, 2.2e-4, 2e-4)),
            coupler or rigid,
            body("rocker", self.ROCKER, 0.35, (0.09, -0.005, 0.003), (8e-5, 1.4e-3, 1.35e-3)),
        ]

    def ball_at_b(self):
        start = Rotation.from_matrix(self.crank.T @ self.coupler).as_euler("xyz")
        return Joint("B", "crank", "coupler", kind="spherical", start=tuple(start))


def assert_preload(model, known):
    assembled = assemble(model, assembly_errors(model))
    assert int(assembled.status) == 0
    for joint, (force, moment) in known.items():
        load = assembled.preload[joint]
        if force is not None:
            np.testing.assert_allclose(np.linalg.norm(load.force), force, rtol=1e-8)
        np.testing.assert_allclose(np.linalg.norm(load.moment), moment, rtol=1e-8, atol=1e-12)


class TestUniversal:
    """Revolute, spherical, universal, revolute with a moment ramp from rest."""

    def test_rigid_preload_and_rms_loads(self):
        bar = SpatialFourBar()
        relative = bar.rocker.T @ bar.coupler
        angles = np.arctan2(relative[0, 2], relative[2, 2]), np.arctan2(relative[1, 0], relative[1, 1])
        universal = Joint("C", "rocker", "coupler", kind="universal", child_position=(0.26, 0, 0), start=angles)
        ball = Joint("B", "crank", "coupler", kind="spherical", cut=True, child_position=(0, 0, 0))
        model = discretise(Mechanism(bar.links(), bar.joints(universal, ball), driven_joint="A"))
        known = {"A": (4.20113781881, 0.185937746073), "B": (1.75236044687, 0.0), "C": (1.20630569573, 0.0),
                 "D": (4.63292854035, 0.226089787348)}  # fmt: skip
        assert_preload(model, known)
        run = simulate(model, drive=MomentRamp("A", 1.2, 0.05), duration=0.3, method=Method("rk4", step=2e-4))
        # About the normal of the cross, the universal joint's moment is small but not zero.
        for joint, moment in {"C": 0.000373975893082, "A": 0.410053852672, "D": 0.337165245538}.items():
            np.testing.assert_allclose(run.metrics.rms_moment[joint], moment, rtol=1e-7)
        assert float(run.metrics.rms_moment["B"]) == 0.0

    def test_preload_of_a_flexible_coupler_on_a_spherical_joint_of_the_tree(self):
        bar = SpatialFourBar()
        steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
        coupler = Link("coupler", bar.COUPLER, Rectangle(0.006, 0.009), steel, rfes=5)
        quarter = (np.pi / 2, 0, 0)
        universal = Joint("C", "coupler", "rocker", kind="universal", cut=True, orientation=quarter,
                          child_orientation=quarter)  # fmt: skip
        joints = bar.joints(bar.ball_at_b(), universal)
        model = discretise(Mechanism(bar.links(coupler), joints, driven_joint="A", elements="geometrically_exact"))
        assert_preload(model, {"A": (None, 0.10854576376), "D": (None, 0.158389244223), "B": (None, 0.0)})

    def test_derivatives_of_an_implicit_run_with_a_quaternion(self):
        bar = SpatialFourBar()
        steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
        coupler = Link("coupler", bar.COUPLER, Rectangle(0.006, 0.009), steel, rfes=2)
        quarter = (np.pi / 2, 0, 0)
        universal = Joint("C", "coupler", "rocker", kind="universal", cut=True, orientation=quarter,
                          child_orientation=quarter)  # fmt: skip
        model = discretise(Mechanism(bar.links(coupler), bar.joints(bar.ball_at_b(), universal), driven_joint="A"))
        names = ("B.d_y", "C.child.delta_y", "coupler.length")

        def load(values):
            errors = assembly_errors(model, {name: values[i] for i, name in enumerate(names)})
            method = Method("generalised_alpha", step=1e-3, tolerance=1e-8)
            run = simulate(
                model, errors, drive=PrescribedRate("A", 25.0), duration=5e-3, method=method, save_every=5e-3
            )
            return run.metrics.mean_square_force["D"]

        at = jnp.asarray([2e-4, 3e-3, -1e-4])
        forward, backward = jax.jacfwd(load)(at), jax.grad(load)(at)
        largest = np.abs(forward).max()
        np.testing.assert_allclose(forward, backward, rtol=1e-8, atol=1e-9 * largest)
        step = 1e-6
        moved = jax.vmap(load)(at[None] + step * jnp.concatenate([jnp.eye(3), -jnp.eye(3)]))
        np.testing.assert_allclose(forward, (moved[:3] - moved[3:]) / (2.0 * step), rtol=1e-4, atol=1e-6 * largest)


class TestTwoSphericalJoints:
    """Revolute, spherical, spherical, revolute at a constant rate: the coupler's spin about its axis is idle."""

    RMS: ClassVar = {"A": 0.71613158729, "D": 0.484085641546}

    def test_rms_loads_without_spin(self):
        bar = SpatialFourBar()
        ball = Joint("C", "coupler", "rocker", kind="spherical", cut=True)
        model = discretise(Mechanism(bar.links(), bar.joints(bar.ball_at_b(), ball), driven_joint="A"))
        structure = describe(model)
        assert structure.idle == ("coupler",) and structure.mobility == 2
        period, rate = 2.0 * np.pi / 25.0, 25.0
        method, start = Method("rk4", step=period / 1000), without_spin(model, "coupler", rate)
        run = simulate(model, drive=PrescribedRate("A", rate), duration=period, method=method, start=start)
        for joint, moment in self.RMS.items():
            np.testing.assert_allclose(run.metrics.rms_moment[joint], moment, rtol=1e-7)
        assert float(run.metrics.rms_moment["C"]) == 0.0
        assert float(run.energy_balance_error) < 1e-8

    @pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
    def test_statics_holds_the_idle_freedom_of_a_flexible_coupler(self, elements):
        bar = SpatialFourBar()
        steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
        coupler = Link("coupler", bar.COUPLER, Rectangle(0.006, 0.009), steel, rfes=2)
        ball = Joint("C", "coupler", "rocker", kind="spherical", cut=True)
        mechanism = Mechanism(bar.links(coupler), bar.joints(bar.ball_at_b(), ball), driven_joint="A")
        model = discretise(mechanism, elements=elements)
        assert [model.topology.link_of_freedom[k] for k in model.topology.idle] == [model.link_names.index("coupler")]

        def preload(longer):
            assembled = assemble(model, assembly_errors(model, {"coupler.length": longer}))
            return assembled.preload["A"].moment, assembled

        forward, assembled = jax.jacfwd(preload, has_aux=True)(1e-4)
        assert int(assembled.status) == 0
        # What holds it against the weight of the bent rod, which is off the line of the balls by micrometres.
        assert np.abs(assembled.preload["B"].moment).max() < 1e-4 * np.abs(assembled.preload["A"].moment).max()
        ahead, behind = preload(1e-4 + 1e-6)[0], preload(1e-4 - 1e-6)[0]
        np.testing.assert_allclose(forward, (ahead - behind) / 2e-6, rtol=1e-6, atol=1e-8)


@eqx.filter_jit
def without_spin(model, name, driven_rate):
    """Start at a rate of the driven joint with no angular velocity of a link about its x axis."""
    topology, actual = model.topology, apply_errors(model, assembly_errors(model))
    held = held_angles(model, None)
    position, _, _ = equilibrium(model, actual, held)
    rates = quasi_static_rates(model, actual, held, {topology.driven_coordinate: driven_rate})
    now = motion_of(actual, State(position, rates))
    l = topology.links.index(name)
    axis = now.links.rotation[:, 0, l]
    spin = now.links.velocity[:3, l] @ axis
    of_parent = now.links.rotation[:, :, topology.parents[l]]
    at = topology.coordinates[l]
    return State(
        position, Coordinates(rates.joints.at[at.start : at.stop].add(-spin * (of_parent.T @ axis)), rates.elastic)
    )


class TestCylindricalAndFixed:
    """Four-bar with a tilted cylindrical joint, a spherical one and a bracket on a fixed joint, rigid."""

    STATIC: ClassVar = {
        "A": (5.65503630071, 0.152166612094), "B": (2.88321610313, 0.0), "C": (1.92450231074, 0.339300692561),
        "D": (6.42249341785, 0.292485601281), "F": (1.4715, 0.048959166351),
    }  # fmt: skip
    RMS: ClassVar = {
        "A": (20.3900654327, 0.228503896546), "B": (16.0590355432, 0.0), "C": (6.59552017571, 1.05608755613),
        "D": (6.48786246749, 0.994567432016), "F": (2.79448303441, 0.100089564369),
    }  # fmt: skip

    def model(self):
        crank, coupler, rocker = -np.pi / 3.0, -0.549669951459351, -1.60493172092035
        tilt, bracket = np.radians([12.0, -8.0]), np.radians([30.0, 20.0])
        links = [
            body("crank", 0.08, 0.3, (0.03, 0.002, 0.002), (5e-5, 3e-4, 2.8e-4)),
            body("rocker", 0.2, 0.35, (0.09, -0.002, 0.003), (8e-5, 1.3e-3, 1.25e-3)),
            body("coupler", 0.25, 0.4, (0.11, 0.003, -0.004), (9e-5, 2.2e-3, 2.15e-3)),
            body("bracket", 0.05, 0.15, (0.02, 0.03, 0.01), (6e-5, 5e-5, 4e-5)),
        ]
        joints = [
            Joint("A", "base", "crank", angle=crank),
            Joint("D", "base", "rocker", kind="cylindrical", position=(0.26, 0.015, 0),
                  orientation=(tilt[0], 0, tilt[1]), angle=rocker),
            Joint("C", "rocker", "coupler", child_position=(0.25, 0, 0), angle=coupler - rocker),
            Joint("F", "rocker", "bracket", kind="fixed", position=(0.12, 0, 0),
                  orientation=(bracket[0], 0, bracket[1])),
            Joint("B", "crank", "coupler", kind="spherical", cut=True, child_position=(0, 0, 0)),
        ]  # fmt: skip
        return discretise(Mechanism(links, joints, driven_joint="A"))

    def test_preload_and_rms_loads(self):
        model = self.model()
        assert_preload(model, self.STATIC)
        run = simulate(model, drive=MomentRamp("A", 1.0, 0.05), duration=0.4, method=Method("rk4", step=2e-4))
        np.testing.assert_allclose(run.displacements["D"][0], -0.0300738842075, rtol=0, atol=1e-11)
        for joint, (force, moment) in self.RMS.items():
            np.testing.assert_allclose(run.metrics.rms_force[joint], force, rtol=1e-7)
            np.testing.assert_allclose(run.metrics.rms_moment[joint], moment, rtol=1e-7, atol=1e-12)
        assert np.isnan(run.metrics.max_axial_force["F"]) and np.isfinite(run.metrics.max_axial_force["D"])


@pytest.fixture(scope="module")
def model():
    steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
    bar, crank = Rectangle(0.01, 0.01), -np.pi / 3.0
    rod = np.arcsin(-0.06 * np.sin(crank) / 0.25)
    links = [
        Link("crank", 0.06, bar, steel, rigid=True),
        Link("rod", 0.25, bar, steel, rfes=5),
        body("piston", 0.05, 0.3, (0, 0, 0), (1e-4, 1.2e-4, 1.1e-4)),
    ]
    joints = [
        Joint("A", "base", "crank", angle=crank),
        Joint("B", "crank", "rod", angle=rod - crank),
        Joint("G", "base", "piston", kind="prismatic", displacement=0.27),
        Joint("C", "rod", "piston", cut=True, child_position=(0, 0, 0)),
    ]
    return discretise(Mechanism(links, joints, driven_joint="A", elements="geometrically_exact"))


class TestGuideErrors:
    """Slider-crank with a flexible rod (geometrically exact elements), guide and wrist pin tilted: assembly."""

    ERRORS: ClassVar = {"G.delta_x": np.radians(0.3), "G.delta_z": np.radians(0.2), "G.d_y": 3e-4,
              "C.delta_x": np.radians(0.2), "C.delta_z": np.radians(-0.15)}  # fmt: skip

    def test_preload(self, model):
        assembled = assemble(model, assembly_errors(model, self.ERRORS))
        assert int(assembled.status) == 0
        known = {"A": 12.786178467, "B": 11.5558174023, "C": 1.63251677221, "G": 1.63251677221}
        for joint, moment in known.items():
            np.testing.assert_allclose(np.linalg.norm(assembled.preload[joint].moment), moment, rtol=1e-9)
        # The guide is free along its own, tilted axis.
        assert abs(float(assembled.preload["G"].force[0])) < 1e-9

    def test_derivative_of_the_preload(self, model):
        def preload(value):
            errors = assembly_errors(model, {**self.ERRORS, "G.delta_y": value})
            return assemble(model, errors).preload["G"].moment

        forward, backward = jax.jacfwd(preload)(1e-3), jax.jacrev(preload)(1e-3)
        np.testing.assert_allclose(forward, backward, rtol=1e-8, atol=1e-8 * np.abs(forward).max())
        step = 1e-5
        differences = (preload(1e-3 + step) - preload(1e-3 - step)) / (2.0 * step)
        np.testing.assert_allclose(forward, differences, rtol=1e-5, atol=1e-5 * np.abs(forward).max())

    def test_a_slide_that_is_held_stays_where_it_is(self, model):
        actual = apply_errors(model, assembly_errors(model))
        k = model.topology.coordinates[model.link_names.index("piston")][0]
        position, _, status = jax.jit(lambda x: equilibrium(model, actual, {k: x}))(jnp.asarray(0.272))
        assert int(status) == 0
        np.testing.assert_allclose(position.joints[k], 0.272, rtol=0, atol=1e-14)
        crank = float(position.joints[0])
        rigid = 0.06 * np.cos(crank) + np.sqrt(0.25**2 - (0.06 * np.sin(crank)) ** 2)
        np.testing.assert_allclose(rigid, 0.272, rtol=0, atol=1e-6)
