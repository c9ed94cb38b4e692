"""Forces along links as a user states them."""

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import DistributedForce, discretise, load_study, parameters
from rfem_jax.description.study_file.force_reader import read_force

from .test_point_forces import mechanism, with_forces

LINES = """
[[mechanism.forces]]
name = "wind"
link = "two"
load = [0, 0, "2 kN/m"]
end_load = [0, "1 N/mm", 0]
begin = "10 mm"
end = "30 mm"
frame = "link"
[[mechanism.forces]]
kind = "distributed_force"
name = "snow"
link = "one"
load = [[0, 0, 0], [0, 0, -5]]
times = [0, "10 ms"]
"""


def test_quantities_are_converted():
    wind = DistributedForce("w", "b", ["2 kN/m", 0, 0], (0, "3 N/mm", 1), "1 cm", "9 cm")
    assert (wind.load, wind.end_load) == ((2000.0, 0.0, 0.0), (0.0, 3000.0, 1.0))
    assert (wind.begin, wind.end, wind.axes) == (0.01, 0.09, "global")
    made = mechanism(wind)
    assert made.point_forces == (wind,) and made.force("w") is wind and wind.ends() == ()
    assert DistributedForce("w", "b", (0, 0, 1)).along(made.link("b")) == (0.0, 0.1)


def test_forces_of_a_study_file(tmp_path):
    wind, snow = load_study(with_forces(tmp_path, LINES)).mechanism.forces
    assert wind == DistributedForce("wind", "two", (0, 0, 2000.0), (0, 1000.0, 0), 0.01, 0.03, axes="link")
    assert (snow.load, snow.times, snow.changes) == (((0, 0, 0), (0, 0, -5)), (0, 0.01), True)
    assert snow.jumps() == (0.01,)
    table = {"name": "w", "link": "one", "load": [0, 0, 1]}
    assert read_force(table, "[[mechanism.forces]]") == DistributedForce("w", "one", (0, 0, 1))


def test_its_numbers_are_parameters():
    constant = DistributedForce("w", "b", (0, 0, 1), (0, 0, 3), end=0.08)
    over_time = DistributedForce("s", "a", [(0, 0, 1), (0, 0, 2)], [(0, 0, 3), (0, 0, 4)], times=[0, 1])
    function = DistributedForce("f", "a", lambda t, phase: jnp.zeros(3))
    model = discretise(mechanism(constant, over_time, function))
    known = parameters(model)
    assert [name for name in known if name[:2] in ("w.", "s.", "f.")] == [
        "w.end", *(f"w.{part}.{axis}" for part in ("load", "end_load") for axis in "xyz"), "s.factor",
    ]  # fmt: skip
    assert (known["w.end"].value, known["w.end_load.z"].value, known["w.load.z"].unit) == (0.08, 3.0, "N/m")
    twice = model.source.blueprint.filled((2.0 * np.asarray(model.source.numbers)).tolist()).forces[1]
    np.testing.assert_allclose([twice.load, twice.end_load], [[(0, 0, 2), (0, 0, 4)], [(0, 0, 6), (0, 0, 8)]])
    # A load makes no rfe an interface.
    assert model.topology.holders == () and model.frame_forces is None


@pytest.mark.parametrize(
    "make, pieces",
    [
        (lambda: DistributedForce("w", "base", (0, 0, 1)), ("`link` of force `w`", "the base, which no force moves")),
        (lambda: DistributedForce("w", "a", 3.0), ("`load` of force `w`", "list of numbers")),
        (lambda: DistributedForce("w", "a", (0, 1)), ("`load` of force `w`", "three components")),
        (lambda: DistributedForce("w", "a", ("1 N", 0, 0)), ("`load` of force `w`", "N/m")),
        (lambda: DistributedForce("w", "a", (0, 0, 1), (0, 1)), ("`end_load` of force `w`", "three components")),
        (lambda: DistributedForce("w", "a", (0, 0, 1), begin=-0.1), ("`begin` of force `w`", "negative")),
        (lambda: DistributedForce("w", "a", (0, 0, 1), end=0.0), ("`end` of force `w`", "greater than 0")),
        (lambda: DistributedForce("w", "a", (0, 0, 1), axes="local"), ("`axes` of force `w`", '"global", "link"')),
        (lambda: DistributedForce("w", "a", (0, 0, 1), times=[0, 1]), ("`load` of force `w`", "as many rows", "has 3")),
        (
            lambda: DistributedForce("w", "a", [(0, 0, 1)] * 2, [(0, 0, 1)], times=[0, 1]),
            ("`end_load` of force `w`", "as many rows", "has 1"),
        ),
        (lambda: DistributedForce("w", "a", (0, 0, 1), breakpoints=[1.0]), ("`breakpoints`", "is not a function")),
        (lambda: DistributedForce("w", "a", lambda t, n: t), ("`load` of force `w`", "float64 array of 3")),
        (
            lambda: DistributedForce("w", "a", lambda t, n: jnp.zeros(3), (0, 0, 1)),
            ("`end_load` of force `w`", "one of the two is a function"),
        ),
        (lambda: mechanism(DistributedForce("w", "c", (0, 0, 1))), ("`link` of force `w`", "no link `c`")),
        (
            lambda: mechanism(DistributedForce("w", "b", (0, 0, 1), begin=0.2)),
            ("`begin` of force `w`", "link `b` (from 0 to 0.1 m)", "from 0.2 m to 0.1 m"),
        ),
        (
            lambda: mechanism(DistributedForce("w", "a", (0, 0, 1), end=0.2)),
            ("`end` of force `w`", "from 0 m to 0.2 m"),
        ),
        (
            lambda: mechanism(DistributedForce("w", "a", (0, 0, 1), begin=0.08, end=0.03)),
            ("`begin` of force `w`", "the smaller one first"),
        ),
    ],
)
def test_mistakes_are_told(refused, make, pieces):
    with refused(*pieces):
        make()


@pytest.mark.parametrize(
    "old, new, pieces",
    [
        ('kind = "distributed_force"\n', 'kind = "distributed"\n', ("`snow`", '"distributed_force"')),
        ("end_load", "endload", ("`endload`", "`end_load`?")),
        ('link = "two"', 'link = "tow"', ("`wind`", "no link `tow`")),
        ('frame = "link"', 'frame = "rod"', ("`wind`", "`frame`", '"link"')),
    ],
)
def test_mistakes_in_a_study_file_are_named(refused, tmp_path, old, new, pieces):
    with refused(*pieces):
        load_study(with_forces(tmp_path, LINES.replace(old, new, 1)))
