"""Small machines as they come from other programs: a four-bar, a slider-crank, a Stewart platform, a double wishbone.

All of rigid bodies; those of the plane are planar, and have the masses of steel bars.
"""

import numpy as np

from rfem_jax import Joint, JointSpring, Link, Mechanism, PointSpring, RigidBody
from rfem_jax.description import Study
from rfem_jax.exchange.rigid_frames import angles_of, axes_from


def bar(name, length, mass):
    """A slender bar, 10 mm thick."""
    return Link(
        name, length, body=RigidBody(mass, (length / 2, 0.0, 0.0), (mass * 1.7e-5, *2 * (mass * length**2 / 12,)))
    )


def four_bar():
    """Crank, coupler, rocker; the crank points down."""
    links = bar("crank", 0.12, 0.0942), bar("coupler", 0.3, 0.2355), bar("rocker", 0.3, 0.2355)
    joints = (
        Joint("A", "base", "crank", angle=-np.pi / 2),
        Joint("B", "crank", "coupler", angle=0.9491818805),
        Joint("D", "base", "rocker", position=(0.3, 0.0, 0.0), angle=-1.7589654531),
        Joint("C", "coupler", "rocker", cut=True),
    )
    coil = JointSpring("coil", "D", stiffness=0.8, damping=1e-3, rest=-1.5)
    return Mechanism(links, joints, forces=(coil,))


def slider_crank():
    """Crank, rod, slider with a spring to the frame."""
    crank, rod = 0.06, 0.2
    slope = np.arcsin(0.3 * np.sin(np.pi / 3))
    links = bar("crank", crank, 0.05), bar("rod", rod, 0.15), Link(
        "slider", 0.04, body=RigidBody(0.3, (0.0, 0.0, 0.0), (8e-5, 8e-5, 8e-5)))  # fmt: skip
    joints = (
        Joint("A", "base", "crank", angle=-np.pi / 3),
        Joint("B", "crank", "rod", angle=np.pi / 3 + slope),
        Joint("G", "base", "slider", kind="prismatic", displacement=crank * 0.5 + rod * np.cos(slope)),
        Joint("P", "slider", "rod", cut=True, position=(0.0, 0.0, 0.0)),
    )
    spring = PointSpring("spring", ("base", "slider"), ((0.5, 0.0, 0.0), (0.02, 0.0, 0.0)), 200.0, 2.0, 0.2)
    return Mechanism(links, joints, forces=(spring,))


def towards(start, end):
    """Axes with x from one point to another, and their angles."""
    return axes_from(np.subtract(end, start), np.array([0.0, 1.0, 0.0]), (0, 1)).rotation


def stewart():
    """A platform on six legs, of a lower and an upper part each with a slide between them: universal joints below,
    ball joints above."""
    links = [Link("platform", 0.2, body=RigidBody(2.0, (0.0, 0.0, 0.01), (0.02, 0.02, 0.04)))]
    joints = [Joint("K", "base", "platform", kind="free", start=(0.0, 0.0, 0.4, 0.0, 0.0, 0.0))]
    for n in range(6):
        below, above = np.radians(60 * n + (-20 if n % 2 else 20)), np.radians(60 * n + (10 if n % 2 else -10))
        foot = np.array([0.3 * np.cos(below), 0.3 * np.sin(below), 0.0])
        top = np.array([0.2 * np.cos(above), 0.2 * np.sin(above), 0.0])
        leg = towards(foot, top + [0.0, 0.0, 0.4])
        reach = np.linalg.norm(top + [0.0, 0.0, 0.4] - foot)
        links += [bar(f"lower{n}", 0.2, 0.3), bar(f"upper{n}", 0.2, 0.2)]
        joints += [
            Joint(f"U{n}", "base", f"lower{n}", kind="universal", position=tuple(foot), orientation=angles_of(leg)),
            Joint(f"S{n}", f"lower{n}", f"upper{n}", kind="prismatic", displacement=reach - 0.4),
            Joint(f"B{n}", f"upper{n}", "platform", kind="spherical", cut=True, child_position=tuple(top)),
        ]
    return Mechanism(tuple(links), tuple(joints))


def double_wishbone():
    """Two wishbones on hinges that are not parallel, an upright between two balls, a tie rod, and a strut."""
    lower, upper = np.array([0.05, -0.3, -0.1]), np.array([0.02, -0.28, 0.15])
    outer, top = np.array([0.03, -0.65, -0.12]), np.array([0.0, -0.6, 0.13])
    rack, steer = np.array([-0.12, -0.25, -0.02]), np.array([-0.1, -0.62, 0.0])
    arms = {}
    for name, seat, ball, slant in (("lower", lower, outer, 0.05), ("upper", upper, top, -0.1)):
        arms[name] = axes_from(ball - seat, np.array([1.0, 0.0, slant]), (0, 1)).rotation, ball - seat
    knuckle = towards(outer, top)
    links = (
        bar("lower", float(np.linalg.norm(arms["lower"][1])), 3.0),
        bar("upper", float(np.linalg.norm(arms["upper"][1])), 2.0),
        Link("upright", float(np.linalg.norm(top - outer)), body=RigidBody(
            8.0, (0.12, 0.01, 0.02), ((0.08, 0.002, 0.001), (0.002, 0.06, 0.0), (0.001, 0.0, 0.07)))),
        bar("tie", float(np.linalg.norm(steer - rack)), 0.5),
    )  # fmt: skip
    place = tuple(knuckle.T @ (steer - outer))
    tie = towards(rack, steer)
    joints = (
        Joint("L", "base", "lower", position=tuple(lower), orientation=tuple(angles_of(arms["lower"][0]))),
        Joint("U", "base", "upper", position=tuple(upper), orientation=tuple(angles_of(arms["upper"][0]))),
        Joint("O", "lower", "upright", kind="spherical", start=tuple(angles_of(arms["lower"][0].T @ knuckle))),
        Joint("T", "upper", "upright", kind="spherical", cut=True),
        Joint("R", "base", "tie", kind="spherical", position=tuple(rack), start=tuple(angles_of(tie))),
        Joint("S", "tie", "upright", kind="spherical", cut=True, child_position=place),
    )
    strut = PointSpring("strut", ("base", "lower"), ((0.05, -0.3, 0.3), (0.25, 0.0, 0.0)), 3e4, 1500.0, 0.5)
    return Mechanism(links, joints, forces=(strut,))


MACHINES = {
    "four_bar": four_bar, "slider_crank": slider_crank, "stewart": stewart, "double_wishbone": double_wishbone,
}  # fmt: skip
MOBILITY = {"four_bar": 1, "slider_crank": 1, "stewart": 6, "double_wishbone": 2}


def study(name, **settings):
    """A machine as a study of a second."""
    return Study(name, MACHINES[name](), duration=1.0, **settings)


def same_places(one, other, atol=1e-9):
    """Whether two layouts have the same masses, centres, inertias, joint centres and axes in global axes, by names."""
    for body in one.bodies:
        again = other.body(body.name)
        np.testing.assert_allclose(again.mass, body.mass, rtol=1e-9)
        np.testing.assert_allclose(centre_of(again), centre_of(body), atol=atol)
        np.testing.assert_allclose(inertia_of(again), inertia_of(body), rtol=1e-7, atol=1e-9 * body.inertia.max())
    kinds = {joint.name: joint for joint in other.joints}
    for joint in one.joints:
        again = kinds[joint.name]
        assert again.kind == joint.kind and again.cut == joint.cut, joint.name
        if joint.kind == "free":
            continue
        for mine, theirs in zip(one.sides(joint), other.sides(again), strict=True):
            apart = theirs.position - mine.position
            if joint.kind == "prismatic":  # where along a slide it counts from is a matter of the format
                apart = apart - (apart @ mine.rotation[:, 0]) * mine.rotation[:, 0]
            np.testing.assert_allclose(apart, 0.0, atol=atol)
            if joint.kind not in ("spherical", "fixed"):
                axis = 0 if joint.kind == "prismatic" else 1
                np.testing.assert_allclose(theirs.rotation[:, axis], mine.rotation[:, axis], atol=1e-7)
    return True


def centre_of(body):
    return body.pose.position + body.pose.rotation @ body.centre


def inertia_of(body):
    return body.pose.rotation @ body.inertia @ body.pose.rotation.T
