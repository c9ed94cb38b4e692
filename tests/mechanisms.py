"""Mechanisms that several tests share."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from rfem_jax import (
    AxisPoint,
    Circle,
    Compliance,
    CompositeSection,
    Coupling,
    DistributedForce,
    GivenSection,
    Joint,
    JointForceFunction,
    JointForceTable,
    JointSpring,
    Link,
    Material,
    Mechanism,
    PointForce,
    PointMass,
    PointMoment,
    PointSpring,
    PointSpringFunction,
    Rectangle,
    RigidBody,
    Simulation,
    Station,
    simulate,
)
from rfem_jax.mechanics.dynamics.loads import static_state

STEEL = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
BAR = Rectangle(0.01, 0.01)
NO_MASS = GivenSection(1e6, 1e6, 1e6, 1e2, 1e2, 1e2, 1e-9, 1e-15, 1e-15, 1e-15)


def link(name, length, rfes=None, **more):
    """A steel bar of 10 x 10 mm: rigid, or with a number of rfes."""
    shape = {"rigid": True} if rfes is None else {"rfes": rfes}
    return Link(name, length, BAR, STEEL, **shape, **more)


def body(name, mass, centre=(0.0, 0.0, 0.0), inertia=(1e-4, 1e-4, 1e-4), length=0.1):
    """A rigid link whose mass is that of one body: at `centre`, with moments of inertia about it."""
    return Link(name, length, NO_MASS, rigid=True, point_masses=[PointMass(mass, centre, inertia)])


def released(model, **settings):
    """Motion without a drive from the description's start, at rest."""
    start = static_state(model.topology, model.start_coordinates())
    return simulate(Simulation(model, drive=None, start=start, **settings))


def arm(rfes=None, angle=0.4, **more):
    """One driven link on a hinge: the smallest program."""
    joint = Joint("A", "base", "arm", angle=angle)
    return Mechanism([link("arm", 0.3, rfes)], [joint], driven_joint="A", **more)


def four_bar(rfes=3, crank=None, cut="C", **more):
    """The study's four-bar with few rfes; `crank`: rfes of the crank (None: rigid)."""
    links = [link("crank", 0.12, crank), link("coupler", 0.3, rfes), link("rocker", 0.3, rfes)]
    joints = [
        Joint("A", "base", "crank", position=(0, 0, 0), angle=-np.pi / 2),
        Joint("B", "crank", "coupler", angle=np.radians(54.4)),
        Joint("D", "base", "rocker", position=(0.3, 0, 0), angle=np.radians(-100.8)),
        Joint("C", "coupler", "rocker", cut=True),
    ]
    return Mechanism(links, joints, driven_joint="A", **more)


def with_stations(mechanism, **stations):
    """The mechanism with stations of the links of given names."""
    links = [dataclasses.replace(one, stations=stations.get(one.name, ())) for one in mechanism.links]
    return dataclasses.replace(mechanism, links=tuple(links))


def slender(mechanism, *names):
    """The mechanism whose flexible links, or those of given names, neither stretch nor shear."""
    chosen = names or [one.name for one in mechanism.links if one.flexible]
    links = [
        dataclasses.replace(one, flexibility=("bending", "torsion")) if one.name in chosen else one
        for one in mechanism.links
    ]
    return dataclasses.replace(mechanism, links=tuple(links))


def slender_four_bar():
    """The four-bar with links that neither stretch nor shear, the rocker tapered."""
    return slender(tapered_four_bar())


def slender_six_bar():
    """Two loops in which links with and without axial and shear coordinates follow each other."""
    return slender(two_loop_six_bar(), "rocker", "arm")


def tapered_four_bar(**more):
    """The four-bar with a rigid tapered crank, a coupler that gets thinner, and a rocker with a step."""
    thin = Rectangle(0.006, 0.008)
    stepped = Station(0.11, after=Circle(0.009)), Station(section=Circle(0.006))
    return with_stations(
        four_bar(**more), crank=[Station(section=thin)], coupler=[Station(0.2, thin), Station(section=BAR)],
        rocker=stepped,
    )  # fmt: skip


def laminate():
    """Everything couples, and the mass centre is off the axis."""
    size = np.sqrt([1.2e7, 4e6, 3e6, 60.0, 90.0, 50.0])
    apart = 0.1 * np.sin(np.arange(36.0).reshape(6, 6))
    stiffness = np.outer(size, size) * (np.eye(6) + apart + apart.T)
    return CompositeSection(
        stiffness.tolist(), 0.5, 9e-6, 5e-6, 4e-6, rotary_inertia_yz=1e-6, mass_offset_y=0.002, mass_offset_z=-0.001,
        damping=STEEL.damping,
    )  # fmt: skip


def curved_four_bar(forces=(), **more):
    """The four-bar with a rigid bent crank, an arc as its coupler, whose section is turned and has a step, and a rocker
    that couples all directions, with errors of form; masses beside the axes, loads along them."""
    mechanism = four_bar(forces=[
        DistributedForce("wind", "coupler", (30, -20, 50), axes="link"),
        DistributedForce("ramp", "rocker", (5, 0, -20), (-40, 30, 70), begin=0.03, end=0.21),
        PointForce("push", "coupler", (0.2, 0.01, 0.03), force=(3, 2, -4), axes="link"),
        *forces,
    ], **more)  # fmt: skip
    crank, coupler, rocker = mechanism.links
    bent = AxisPoint((0.06, 0.0, 0.02), radius=0.01), AxisPoint((0.12, 0.0, 0.0))
    arc = AxisPoint((0.3, 0.0, 0.0), through=(0.14, 0.005, 0.03), roll=0.4)
    flat = dataclasses.replace(BAR, width=0.006)
    masses = [PointMass(0.05, (0.1, 0.01, 0.03), (1e-5, 2e-5, 3e-5))]
    links = (
        dataclasses.replace(crank, length=None, axis=bent),
        dataclasses.replace(
            coupler, length=None, axis=(arc,), section=flat, stations=[Station(0.11, after=Circle(0.008))],
            point_masses=masses,
        ),
        dataclasses.replace(
            rocker, form_errors=True, section=laminate(), material=None,
            point_masses=[PointMass(0.03, (0.2, 0.0, 0.01))],
        ),
    )  # fmt: skip
    return dataclasses.replace(mechanism, links=links)


def three_link_loop():
    """A triangle of the base and two flexible links: a structure, with a point mass."""
    links = [link("left", 0.2, 4), link("right", 0.25, 3, point_masses=[PointMass(0.05, 0.1)])]
    joints = [
        Joint("A", "base", "left", angle=np.radians(-70)),
        Joint("D", "base", "right", position=(0.2, 0, 0), angle=np.radians(-120)),
        Joint("C", "left", "right", cut=True),
    ]
    return Mechanism(links, joints)


def six_link_loop():
    """Five moving links and the base in one loop: rigid ones in a row, then flexible ones."""
    links = [
        link("a", 0.10),
        link("b", 0.12, point_masses=[PointMass(0.1, (0.06, 0.01, -0.02), (1e-5, 2e-5, 3e-5))]),
        link("c", 0.20, 3),
        link("d", 0.15),
        link("e", 0.18, 4),
    ]
    joints = [
        Joint("A", "base", "a", angle=np.radians(-90)),
        Joint("B", "a", "b", angle=np.radians(40)),
        Joint("C", "b", "c", angle=np.radians(40)),
        Joint("F", "base", "e", position=(0.35, 0, 0), angle=np.radians(-80)),
        Joint("E", "e", "d", angle=np.radians(-40)),
        Joint("G", "c", "d", cut=True),
    ]
    return Mechanism(links, joints, driven_joint="A")


def twisted_spatial_loop():
    """A Bennett linkage: four skew axes, mobile though spatial four-bars in general are not."""
    a, b, alpha = 0.2, 0.3, np.radians(30.0)
    beta = np.arcsin(b * np.sin(alpha) / a)
    ratio = np.sin((beta + alpha) / 2) / np.sin((beta - alpha) / 2)
    first = np.radians(60.0)
    second = 2.0 * np.arctan(ratio / np.tan(first / 2))
    links = [link("one", b, 3), link("two", a, 3), link("three", b)]
    joints = [
        Joint("A", "base", "one", angle=first),
        Joint("B", "one", "two", orientation=(beta, 0, 0), angle=second),
        Joint("C", "two", "three", orientation=(alpha, 0, 0), angle=-first),
        Joint(
            "D",
            "base",
            "three",
            position=(-a, 0, 0),
            orientation=(-alpha, 0, 0),
            child_orientation=(beta, 0, 0),
            cut=True,
        ),
    ]
    return Mechanism(links, joints, driven_joint="A")


def two_loop_six_bar():
    """Watt's six-bar linkage: two loops, a joint in the middle of a flexible link."""
    links = [
        link("crank", 0.12),
        link("coupler", 0.3, 3),
        link("rocker", 0.3, 4),
        link("arm", 0.25, 3),
        link("output", 0.25),
    ]
    joints = [
        Joint("A", "base", "crank", angle=-np.pi / 2),
        Joint("B", "crank", "coupler", angle=np.radians(54.4)),
        Joint("D", "base", "rocker", position=(0.3, 0, 0), angle=np.radians(-100.8)),
        Joint("C", "coupler", "rocker", cut=True),
        Joint("E", "rocker", "arm", position=(0.2, 0.0, 0.0), angle=np.radians(100)),
        Joint("F", "base", "output", position=(0.6, 0, 0), angle=np.radians(-110)),
        Joint("G", "arm", "output", cut=True),
    ]
    return Mechanism(links, joints, driven_joint="A")


def open_chain():
    """Two hinged flexible links and a rigid one: no loop."""
    links = [link("upper", 0.3, 4), link("lower", 0.2), link("tip", 0.2, 3)]
    joints = [
        Joint("A", "base", "upper", orientation=(0.2, 0.0, 0.3), angle=0.5),
        Joint("B", "upper", "lower", angle=0.7),
        Joint("C", "lower", "tip", child_position=(0.01, 0.0, 0.02), angle=-0.4),
    ]
    return Mechanism(links, joints, driven_joint="A")


def chain_of_kinds():
    """A driven crank, and behind it a joint of every kind with plain coordinates, on rigid links and on flexible ones,
    in the middle of one of them, none along a global axis."""
    links = [
        link("a", 0.1),
        link("b", 0.2, 2),
        link("c", 0.15, point_masses=[PointMass(0.1, (0.06, 0.01, -0.02), (1e-5, 2e-5, 3e-5))]),
        link("d", 0.25, 3),
        link("e", 0.12),
        link("f", 0.1, 2),
        link("g", 0.1),
    ]
    joints = [
        Joint("A", "base", "a", orientation=(0.2, 0.0, 0.3), angle=0.4),
        Joint("P", "a", "b", kind="prismatic", orientation=(0.3, -0.2, 0.1), displacement=0.05),
        Joint("U", "b", "c", kind="universal", child_position=(0.01, 0.0, 0.02), start=(0.3, -0.5)),
        Joint("C", "b", "d", kind="cylindrical", position=(0.12, 0.01, 0.0), angle=0.6, displacement=-0.03),
        Joint("L", "d", "e", kind="planar", child_orientation=(0.1, 0.2, -0.3), start=(0.02, -0.04, 0.7)),
        Joint("F", "e", "f", kind="fixed", orientation=(0.5, 0.1, 0.2)),
        Joint("R", "d", "g", position=(0.125, 0.0, 0.01), angle=-0.8),
    ]
    return Mechanism(links, joints, driven_joint="A")


def chain_with_forces():
    """`chain_of_kinds` with springs, dampers and laws on motions of every kind, two on one of them and one on that of
    the driven joint."""

    def law(position, rate):
        return 0.4 - 2.0 * position**3 - 0.03 * rate * position

    forces = [
        JointSpring("at_drive", "A", stiffness=2.0, damping=0.1, rest=0.2, preload=0.3),
        JointSpring("slide", "P", stiffness=300.0, damping=4.0, rest=0.03),
        JointForceTable("gas", "P", [-1.0, 0.0, 0.1, 1.0], [3.0, -2.0, 5.0, 8.0]),
        JointForceFunction("first", "U", law, motion="R_y"),
        JointSpring("second", "U", stiffness=1.5, motion="R_z"),
        JointForceFunction("along", "C", law, motion="T_y"),
        JointSpring("about", "C", damping=0.2, motion="R_y"),
        JointForceTable("across", "L", [-1.0, 1.0], [-7.0, 4.0], motion="T_z"),
        JointSpring("planar", "L", stiffness=40.0, preload=-2.0, motion="T_x"),
        JointForceFunction("turn", "R", law),
    ]
    return dataclasses.replace(chain_of_kinds(), forces=forces)


def chain_with_couplings():
    """`chain_of_kinds` with couplings: of two joints by a ratio with errors, in one joint, and by a table with flanks
    and a play."""
    forces = [
        Coupling("rack", ("A", "P"), ratio=0.1, stiffness=4e3, damping=3.0, eccentricity=2e-3, waves=3.0,
                 pitch_error=0.02),
        Coupling("screw", ("C", "C"), motions=("R_y", "T_y"), ratio=0.05, stiffness=9e2, damping=2.0, offset=0.01),
        Coupling("cam", ("R", "U"), motions=("R_y", "R_z"), positions=[-4.0, -1.0, 0.5, 1.0, 4.0],
                 values=[0.3, 0.6, 0.1, -0.4, 0.2], stiffness=20.0, backlash=0.02, contact_damping=0.1, exponent=1.5,
                 offset=-0.6),
    ]  # fmt: skip
    return dataclasses.replace(chain_of_kinds(), forces=forces)


def chain_with_ideal_couplings():
    """`chain_of_kinds` with ideal couplings: of joints on flexible links by a ratio with errors and by a table, and of
    two motions of one joint, beside an elastic one."""
    forces = [
        Coupling("rack", ("A", "P"), ratio=0.1, eccentricity=2e-3, waves=3.0, pitch_error=0.02),
        Coupling("screw", ("C", "C"), motions=("R_y", "T_y"), ratio=0.05),
        Coupling("cam", ("R", "U"), motions=("R_y", "R_z"), positions=[-4.0, -1.0, 0.5, 1.0, 4.0],
                 values=[0.3, 0.6, 0.1, -0.4, 0.2]),
        Coupling("belt", ("U", "L"), motions=("R_y", "R_y"), ratio=-1.5, stiffness=20.0, damping=0.1),
    ]  # fmt: skip
    return dataclasses.replace(chain_of_kinds(), forces=forces)


def loop_with_an_ideal_coupling():
    """A spatial four-bar with a prop on its flexible coupler, whose angle a gear ties to that of the rocker."""
    loop = loop_with_a_ball()
    prop = Joint("P", "coupler", "prop", position=(0.15, 0.0, 0.01), orientation=(0.3, -0.2, 0.1), angle=0.4)
    gear = Coupling("gear", ("D", "P"), ratio=-0.7, offset=-0.2)
    return dataclasses.replace(loop, links=[*loop.links, link("prop", 0.1)], joints=[*loop.joints, prop], forces=[gear])


def chain_with_drives():
    """Drives on motions of all kinds, two of them on one joint, one beside a spring and one beside a law; one link is
    a body with products of inertia."""
    body = RigidBody(0.3, (0.04, 0.01, -0.02), [[3e-4, 5e-5, -2e-5], [5e-5, 4e-4, 8e-5], [-2e-5, 8e-5, 5e-4]])
    links = [link("a", 0.1), link("b", 0.2, 2), Link("c", 0.15, body=body), link("d", 0.12)]
    joints = [
        Joint("P", "base", "a", kind="prismatic", orientation=(0.3, -0.2, 0.1), displacement=0.05),
        Joint("U", "a", "b", kind="universal", child_position=(0.01, 0.0, 0.02), start=(0.3, -0.5)),
        Joint("C", "b", "c", kind="cylindrical", position=(0.12, 0.01, 0.0), angle=0.6, displacement=-0.03),
        Joint("L", "c", "d", kind="planar", child_orientation=(0.1, 0.2, -0.3), start=(0.02, -0.04, 0.7)),
    ]
    forces = [
        JointSpring("slide", "P", stiffness=300.0, damping=4.0, rest=0.03),
        JointForceTable("along", "C", [-1.0, 1.0], [-7.0, 4.0], motion="T_y"),
    ]
    return Mechanism(links, joints, driven_joint=["P", "U.R_z", "U.R_y", "C.T_y", "L.T_z", "L.R_y"], forces=forces)


def loop_with_springs():
    """A triangle of the base and two flexible links, with a spring and a damper at its feet."""
    forces = [
        JointSpring("left", "A", stiffness=30.0, rest=-1.0, preload=2.0),
        JointSpring("right", "D", damping=0.4),
        JointForceTable("table", "D", [-3.0, -2.0, 0.0], [5.0, -1.0, 2.0]),
    ]
    return dataclasses.replace(three_link_loop(), forces=forces)


TABLE = {"positions": [0.0, 0.01, 0.2], "forces": [0.0, 3.0, 20.0]}  # of a resultant


def compliant_chain():
    """A chain of four kinds of joints with most of what they hold sprung, linearly and by tables."""
    turn = {"positions": [-1.0, 0.0, 1.0], "forces": [-2.0, 0.0, 3.0]}  # another one in each sense
    first = Compliance(
        radial=300.0, axial=200.0, tilt=2.0, radial_damping=3.0, axial_damping=2.0, tilt_damping=0.3
    )  # fmt: skip
    second = Compliance(normal=TABLE, R_x=turn, R_y=2.0, R_z=1.5, normal_damping=0.4, R_y_damping=0.1)
    links = [link("a", 0.1), link("b", 0.2, 2), link("c", 0.15), link("d", 0.25)]
    joints = [
        Joint("A", "base", "a", orientation=(0.2, 0.0, 0.3), angle=0.4, compliance=first),
        Joint("P", "a", "b", kind="prismatic", orientation=(0.3, -0.2, 0.1), displacement=0.05, compliance=second),
        Joint("U", "b", "c", kind="universal", child_position=(0.01, 0.0, 0.02), start=(0.3, -0.5),
              compliance=Compliance(radial=400.0, tilt=1.5, tilt_damping=0.1)),
        Joint("C", "b", "d", kind="cylindrical", position=(0.12, 0.01, 0.0), angle=0.6, displacement=-0.03,
              compliance=Compliance(T_x=100.0, tilt=TABLE, tilt_damping=0.05)),
    ]  # fmt: skip
    spring = JointSpring("at_drive", "A", stiffness=2.0, damping=0.1, rest=0.2, preload=0.3)
    law = JointForceTable("beside", "A", [-1.0, 1.0], [-3.0, 4.0])
    return Mechanism(links, joints, driven_joint="A", forces=[spring, law])


BUSHING = Compliance(
    radial=3e4, axial=2e4, tilt=20.0, radial_damping=30.0, axial_damping=20.0, tilt_damping=0.3
)  # fmt: skip


def compliant_four_bar(cut=BUSHING, tree=BUSHING, rfes=2, **more):
    """The study's four-bar with compliances at its cut joint and at the others; `rfes` None: rigid."""
    plain = four_bar(rfes, **more)
    joints = [dataclasses.replace(joint, compliance=cut if joint.cut else tree) for joint in plain.joints]
    return dataclasses.replace(plain, joints=joints)


def loop_cut_by_sprung(kind):
    """`loop_cut_by` with a part of what the cut joint holds sprung."""
    loop = loop_cut_by(kind)
    name = {"prismatic": "T_z", "fixed": "T_y", "planar": "axial"}.get(kind, "radial")
    tilt = {} if kind in ("prismatic", "fixed", "spherical") else {"tilt": TABLE, "tilt_damping": 0.2}
    compliance = Compliance(**{name: 2e4, f"{name}_damping": 5.0}, **tilt)
    joints = [dataclasses.replace(joint, compliance=compliance if joint.cut else None) for joint in loop.joints]
    return dataclasses.replace(loop, joints=joints)


OFFSETS = {"prismatic": (0.04, 0.0, 0.0), "cylindrical": (0.0, 0.05, 0.0), "planar": (0.03, 0.0, -0.02)}


def loop_cut_by(kind, rfes=2):
    """A structure of two links at right angles, whose ends the cut joint joins with all its axes alike, apart where
    its kind lets them be."""
    x, y, z = OFFSETS.get(kind, (0.0, 0.0, 0.0))
    links = [link("left", 0.3, rfes), link("right", 0.25, rfes)]
    joints = [
        Joint("A", "base", "left"),
        Joint("D", "base", "right", position=(0.3 + x, y, 0.25 + z), angle=np.pi / 2),
        Joint("C", "left", "right", cut=True, kind=kind, child_orientation=(0.0, -np.pi / 2, 0.0)),
    ]
    return Mechanism(links, joints)


def chain_with_balls():
    """A free link, spherical joints on a rigid and on a flexible one, and a driven hinge on another branch."""
    links = [link("a", 0.1), link("b", 0.2, 2), link("c", 0.15), link("d", 0.1)]
    joints = [
        Joint("O", "base", "a", kind="free", orientation=(0.2, 0.0, 0.3), start=(0.1, -0.2, 0.3, 2.0, 1.4, -0.5)),
        Joint("S", "a", "b", kind="spherical", start=(0.3, -0.6, 0.2)),
        Joint("T", "b", "c", kind="spherical", position=(0.15, 0.01, 0.0), child_position=(0.01, 0.0, 0.02)),
        Joint("A", "a", "d", position=(0.05, 0.0, 0.0), angle=0.4),
    ]
    return Mechanism(links, joints, driven_joint="A")


def loop_with_a_ball():
    """A spatial four-bar revolute, spherical, universal, revolute with a flexible coupler, cut at the universal."""
    links = [link("crank", 0.1), link("coupler", 0.3, 2), link("rocker", 0.3)]
    joints = [
        Joint("A", "base", "crank", angle=-np.pi / 2),
        Joint("B", "crank", "coupler", kind="spherical"),
        Joint("D", "base", "rocker", position=(0.3, 0, -0.2), angle=-np.pi / 2),
        Joint("C", "coupler", "rocker", kind="universal", cut=True, child_orientation=(0.0, np.pi / 2, 0.0)),
    ]
    return Mechanism(links, joints, driven_joint="A")


def two_cuts_of_different_kinds():
    """The loop with a cut prismatic joint, and a third link with a cut universal joint in the middle of the first."""
    loop = loop_cut_by("prismatic")
    joints = [
        *loop.joints,
        Joint("E", "base", "prop", position=(0.2, 0.0, 0.2), kind="cylindrical", angle=np.pi / 2),
        Joint("U", "left", "prop", cut=True, kind="universal", position=(0.2, 0.0, 0.0),
              child_orientation=(0.0, -np.pi / 2, 0.0)),
    ]  # fmt: skip
    return Mechanism([*loop.links, link("prop", 0.2)], joints)


def loop_with_point_forces():
    """The four-bar with forces at points and between them: on rigid and flexible links and the base, within a link, on
    rfes with joints and without, with jumps and by a function of time."""

    def over_time(t, phase):
        return jnp.stack([t, 2.0 * phase.astype(jnp.float64), 1.0 + t])

    def law(length, rate):
        return 30.0 * length**2 + 5.0 * jnp.sin(rate)

    rows = [(3, 2, 3), (0, 0, 1), (1, 1, 1), (2, 0, 0)]
    return four_bar(forces=[
        PointSpring("across", ["crank", "rocker"], [(0.05, 0.01, 0.02), (0.2, 0.0, 0.01)], 800.0, 30.0, 0.1, 5.0),
        PointSpring("within", ["coupler", "coupler"], [(0.0, 0.03, 0.02), (0.3, 0.02, 0.0)], 300.0, 3.0, 0.2),
        PointSpringFunction("law", ["base", "rocker"], [(0.1, 0.1, 0.5), 0.1], law),
        PointForce("follower", "rocker", 0.3, (30.0, -20.0, 30.0), axes="link"),
        PointForce("jump", "crank", (0.1, 0.0, 0.02), rows, times=[0, 0.1, 0.1, 0.3]),
        PointMoment("twist", "coupler", 0.1, over_time, breakpoints=[0.05], axes="link"),
    ])  # fmt: skip


def loop_with_line_loads():
    """The four-bar with loads along its links: whole and in part, constant and linear, in global axes and with the
    link, on a rigid link and on rfes with joints and without, by a table with a jump and by a function of time."""

    def over_time(t, phase):
        return jnp.stack([10.0 * t, 2.0 * phase.astype(jnp.float64), 1.0 + t])

    def rows(*heights):
        return [(height, 2.0 * height, 30.0 - height) for height in heights]

    return four_bar(forces=[
        DistributedForce("wind", "coupler", (30, -20, 50), axes="link"),
        DistributedForce("ramp", "coupler", (5, 0, -20), (-40, 30, 70), begin=0.03, end=0.21),
        DistributedForce("table", "rocker", rows(1, 5, 2, 2), rows(-3, 2, 0, 9), end=0.2, times=[0, 0.1, 0.1, 0.3]),
        DistributedForce("function", "crank", over_time, begin=0.02, breakpoints=[0.05], axes="link"),
    ])  # fmt: skip


ALL = (four_bar, three_link_loop, six_link_loop, twisted_spatial_loop, two_loop_six_bar, open_chain)


def some_errors(model, rng):
    """Every error of a model at once, of a few mrad and tenths of millimetres."""
    from rfem_jax import assembly_errors
    from rfem_jax.description.tolerances.error_catalogue import error_dimension

    size = {"angle": 5e-3, "length": 3e-4}
    names = model.topology.error_names
    return assembly_errors(model, {n: size[error_dimension(n)] * rng.normal() for n in names})


def random_state(model, rng, angle=0.5, rate=5.0):
    """A state far from equilibrium: large angles, fast, all rfes displaced."""
    import jax.numpy as jnp

    from rfem_jax import Coordinates, State
    from rfem_jax.mechanics.model.orientations import moved

    n, k = model.topology.n_freedoms, model.topology.n_rfes
    scale = np.array([0.01, 0.01, 0.01, 0.3, 0.3, 0.3])[:, None]

    def draw(size, elastic):
        return Coordinates(
            jnp.asarray(size * rng.normal(size=n)),
            jnp.asarray(elastic * scale * rng.normal(size=(6, k))),
        )

    position, velocity = draw(angle, 1.0), draw(rate, 10.0)
    return State(moved(model.topology, model.start_coordinates(), position), velocity)
