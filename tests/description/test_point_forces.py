"""Forces at points of links and between them: what is described, what is refused, and in study files."""

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    InputError,
    Joint,
    Link,
    Mechanism,
    PointForce,
    PointMoment,
    PointSpring,
    PointSpringFunction,
    PointSpringTable,
    Rectangle,
    discretise,
    load_study,
)
from tests.mechanisms import STEEL

from .test_study_files import FULL

BAR = Rectangle(0.01, 0.01)
ENDS = {"links": ["base", "a"], "points": [(0, 0, 0.1), 0.05]}

FORCES = """
[[mechanism.forces]]
kind = "point_spring"
name = "coil"
links = ["base", "one"]
points = [["-1 cm", 0, "0.1 m"], "20 mm"]
stiffness = "2 N/mm"
damping = 0.1
free_length = "8 cm"
preload = "-3 N"
[[mechanism.forces]]
kind = "point_spring_table"
name = "buffer"
links = ["two", "three"]
points = [0.1, [0.05, 0, 0]]
lengths = [0, "90 mm"]
forces = [0, "1.5 kN"]
[[mechanism.forces]]
kind = "point_force"
name = "push"
link = "two"
position = "30 mm"
force = [[0, 0, "1 kN"], [0, 0, 0]]
times = [0, "10 ms"]
axes = "link"
[[mechanism.forces]]
kind = "point_moment"
name = "twist"
link = "one"
position = 0
moment = ["1 N m", 0, 0]
"""


def mechanism(*forces):
    """A rigid bar and a flexible one of four rfes."""
    links = [Link("a", 0.1, BAR, STEEL, rigid=True), Link("b", 0.1, BAR, STEEL, rfes=4)]
    return Mechanism(links, [Joint("A", "base", "a"), Joint("B", "a", "b")], forces=forces)


def test_quantities_are_converted():
    spring = PointSpring("k", ["a", "b"], ["2 cm", (0, 0, "1 mm")], "2 N/mm", preload="-1 kN")
    assert (spring.links, spring.points) == (("a", "b"), ((0.02, 0.0, 0.0), (0.0, 0.0, 0.001)))
    assert (spring.stiffness, spring.preload) == (2000.0, -1000.0)
    table = PointForce("p", "a", 0.0, [("1 kN", 0, 0), (0, 0, 2)], times=["0 s", "5 ms"])
    assert (table.force, table.times) == (((1000.0, 0.0, 0.0), (0.0, 0.0, 2.0)), (0.0, 0.005))
    made = mechanism(spring, table)
    assert made.point_forces == (spring, table) and made.joint_forces == () and made.force("k") is spring


@pytest.mark.parametrize(
    "make, pieces",
    [
        (lambda: PointSpring("k", ["a"], [0, 0]), ("`links` of force `k`", "two names")),
        (lambda: PointSpring("k", ["a", "b"], 0.1), ("`points` of force `k`", "two points")),
        (lambda: PointSpring("k", **ENDS, stiffness="2 N m/rad"), ("`stiffness` of force `k`", "a stiffness")),
        (lambda: PointSpring("k", **ENDS, free_length=-1.0), ("`free_length` of force `k`", "negative")),
        (lambda: PointSpringTable("k", **ENDS, lengths=[0.2, 0.1], forces=[0, 0]), ("`lengths`", "increasing")),
        (lambda: PointSpringTable("k", **ENDS, lengths=[0.1, 0.2], forces=[0]), ("`forces`", "has 1")),
        (lambda: PointSpringFunction("k", **ENDS, function=3.0), ("`function`", "function of length, rate")),
        (lambda: PointSpringFunction("k", **ENDS, function=lambda x: x), ("function(length, rate)", "TypeError")),
        (lambda: PointForce("p", "base", 0, (0, 0, 1)), ("`link` of force `p`", "the base, which no force moves")),
        (lambda: PointForce("p", "a", 0, (0, 1)), ("`force` of force `p`", "three components")),
        (lambda: PointForce("p", "a", 0, "1 N"), ("`force` of force `p`", "list of numbers")),
        (lambda: PointForce("p", "a", 0, (0, 0, 1), axes="local"), ("`axes` of force `p`", '"global", "link"')),
        (lambda: PointForce("p", "a", 0, (0, 0, 1), times=[0, 1]), ("`force` of force `p`", "as many rows", "has 3")),
        (lambda: PointForce("p", "a", 0, (0, 0, 1), breakpoints=[1.0]), ("`breakpoints`", "is not a function")),
        (lambda: PointMoment("p", "a", 0, lambda t, n: jnp.zeros(3), times=[0, 1]), ("`times`", "is a function")),
        (lambda: PointMoment("p", "a", 0, lambda t, n: t), ("`moment` of force `p`", "float64 array of 3")),
    ],
)
def test_mistakes_are_told(refused, make, pieces):
    with refused(*pieces):
        make()


@pytest.mark.parametrize(
    "force, pieces",
    [
        (PointSpring("k", ["base", "c"], [0, 0]), ("`links` of force `k`", "no link `c`")),
        (PointForce("p", "c", 0, (0, 0, 1)), ("`link` of force `p`", "no link `c`")),
        (PointSpring("k", ["a", "a"], [0, 0.1]), ("`links` of force `k`", "the rigid link `a`")),
        (PointSpring("k", ["base", "base"], [0, 0.1]), ("`links` of force `k`", "the base")),
        (PointSpring("k", ["a", "b"], [0, 0.2]), ("`points` of force `k`", "flexible link `b`", "x = 0.2")),
        (PointForce("p", "b", -0.01, (0, 0, 1)), ("`position` of force `p`", "flexible link `b`")),
    ],
)
def test_points_that_there_are_not_are_refused(refused, force, pieces):
    with refused(*pieces):
        mechanism(force)


def test_points_that_do_not_move_against_each_other_or_coincide_are_refused():
    for points, piece in ((([0.02, 0, 0], [0.04, 0, 0.01]), "one rigid finite element of link `b`"),):
        with pytest.raises(InputError, match=piece):
            discretise(mechanism(PointSpring("k", ["b", "b"], points)))
    with pytest.raises(InputError, match="`points` of force 'k' must lie apart at the start, but coincide"):
        discretise(mechanism(PointSpring("k", ["a", "b"], [0.1, 0.0])))


def test_within_a_flexible_link_the_rfes_hold_the_points():
    model = discretise(mechanism(PointSpring("k", ["b", "b"], [0.0, 0.1]), PointForce("p", "b", 0.05, (0, 0, 1))))
    ends = model.frame_forces["k"]
    # Rfes of 1/6, 1/3, 1/3 and 1/6 of the length: nodes 1 (rfe 0 of b) and 2, 3, 4.
    assert (ends.parent.node, ends.child.node, model.frame_forces["p"].child.node) == (1, 4, 3)
    np.testing.assert_allclose(ends.child.position, [0.1 / 12, 0.0, 0.0], atol=1e-15)
    assert model.topology.interfaces == (1, 2)


def with_forces(tmp_path, text):
    path = tmp_path / "study.toml"
    path.write_text(FULL.replace("[drive]", text + "[drive]", 1), encoding="utf-8")
    return path


def test_forces_of_a_study_file(tmp_path):
    coil, buffer, push, twist = load_study(with_forces(tmp_path, FORCES)).mechanism.forces
    assert coil == PointSpring("coil", ("base", "one"), ((-0.01, 0, 0.1), 0.02), 2000.0, 0.1, 0.08, -3.0)
    assert (buffer.lengths, buffer.forces) == ((0.0, 0.09), (0.0, 1500.0))
    assert (push.force, push.axes) == (((0.0, 0.0, 1000.0), (0.0, 0.0, 0.0)), "link")
    assert (twist.moment, twist.axes) == ((1.0, 0.0, 0.0), "global")


@pytest.mark.parametrize(
    "old, new, pieces",
    [
        ('kind = "point_spring"\n', 'kind = "spring"\n', ("[[mechanism.forces]] `coil`", '"point_spring"')),
        ("free_length", "free_lenght", ("`free_lenght`", "`free_length`?")),
        ('link = "two"', 'link = "tow"', ("`push`", "no link `tow`")),
        ("times = [0", "breakpoints = [1]\ntimes = [0", ("`push`", "`breakpoints`")),
    ],
)
def test_mistakes_in_a_study_file_are_named(refused, tmp_path, old, new, pieces):
    with refused(*pieces):
        load_study(with_forces(tmp_path, FORCES.replace(old, new, 1)))
