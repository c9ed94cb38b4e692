"""Sizes of drawing zones that are found: worst cases, statistics and costs against closed forms."""

import jax
import numpy as np
import pytest

from rfem_jax import FunctionProblem, InputError, Reciprocal, Tolerances, Uniform, Zone, allocate, optimise
from rfem_jax.description.tolerances.zones import SpecifiedZone
from rfem_jax.tolerancing.optimisation.sizes import Sizes
from rfem_jax.tolerancing.problems.distributions import Tolerance

jax.config.update("jax_enable_x64", True)

KEY = jax.random.key(2)
SLOPES = {"D.d_x": 3.0, "D.d_y": 1.5, "D.d_z": 4.0, "D.delta_x": 0.2, "D.delta_z": 0.5, "a.length": 2.0}
UNITS = {name: "m" for name in SLOPES if not name.startswith("D.delta")}


def linear(e):
    return {"f": sum(slope * e[name] for name, slope in SLOPES.items()), "r": e["D.d_x"] ** 2 + e["D.d_z"] ** 2}


PROBLEM = FunctionProblem(linear, tuple(SLOPES), ("f", "r"), error_units=UNITS)
LINEAR = FunctionProblem(lambda e: {"f": linear(e)["f"]}, tuple(SLOPES), "f", error_units=UNITS)
ROUND = FunctionProblem(lambda e: {"r": linear(e)["r"]}, tuple(SLOPES), "r", error_units=UNITS)
BOUNDS = (1e-3, 10.0)
PRICE = Reciprocal(1.0)
DISC, SPHERE = "D.coaxiality", SpecifiedZone("D.position", 1.0, zone="sphere")
AXIS = SpecifiedZone("D.position", 2.0, length=0.5)  # its own diameter does not count


def of_ends():
    """Worst f of a cylinder of diameter 1: each end of the axis in its own disc, d = (p+ + p-)/2, tilts (p+ - p-)/l."""
    worst = 0.0
    for sign in (1.0, -1.0):
        x = SLOPES["D.d_x"] / 2.0 - sign * SLOPES["D.delta_z"] / 0.5
        z = SLOPES["D.d_z"] / 2.0 + sign * SLOPES["D.delta_x"] / 0.5
        worst += 0.5 * np.hypot(x, z)
    return worst


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "zones", "worst"),
    [
        ("D.position", [SPHERE], 0.5 * np.sqrt(3.0**2 + 1.5**2 + 4.0**2)),
        ("D.parallelism", [SpecifiedZone("D.parallelism", 0.1, length=0.5)], np.hypot(0.2, 0.5) / 0.5),
        ("anything", {"anything": Zone(("D.d_x", "D.d_z"), 0.5 * np.eye(2), (2,))}, 0.5 * 5.0),
    ],
    ids=["sphere", "direction", "own"],
)
def test_the_worst_case_over_a_zone_decides_its_diameter(name, zones, worst):
    found = optimise(LINEAR, {}, {name: BOUNDS}, "cost", {"f": 1.0}, cost=PRICE, key=KEY, zones=zones, starts=1)
    assert found.status == "ok" and found.units[name] == "m"
    assert found.tolerances[name] == pytest.approx(1.0 / worst, rel=1e-4)
    assert found.objective == pytest.approx(worst, rel=1e-4)
    assert found.limits[0].verified == pytest.approx(1.0, rel=1e-3)
    assert found.limits[0].shadow_price == pytest.approx(-worst, rel=1e-2)  # d(worst/limit)/d(limit)


@pytest.mark.long
def test_an_allocation_over_the_ends_of_an_axis():
    found = allocate(LINEAR, {"f": 1.0}, PRICE, {"D.position": BOUNDS}, key=KEY, zones=[AXIS])
    assert found.status == "ok" and found.units == {"D.position": "m"}
    assert found.tolerances["D.position"] == pytest.approx(1.0 / of_ends(), rel=1e-4)
    assert found.limits[0].verified == pytest.approx(1.0, rel=1e-3)


def split(prices):
    """Cheapest diameter D and half-width t with 2.5 D + 2 t = 1: each by the root of its price over its slope."""
    roots = np.sqrt(np.array(prices) / [2.5, 2.0])
    return roots / (roots @ [2.5, 2.0])


@pytest.mark.long
def test_a_zone_beside_an_error_of_its_own():
    bounds = {DISC: ("1 mm", "5 m"), "a.length": BOUNDS}
    cost = {DISC: Reciprocal(3.0), "a.length": PRICE}
    diameter, width = split((3.0, 1.0))
    found = allocate(PROBLEM, {"f": 1.0}, cost, bounds, key=KEY)
    assert found.status == "ok"
    assert found.tolerances == pytest.approx({DISC: diameter, "a.length": width}, rel=1e-3)
    design = optimise(PROBLEM, {}, bounds, "cost", {"f": 1.0}, cost=cost, key=KEY)
    assert design.status == "ok" and design.units[DISC] == "m"
    assert design.tolerances == pytest.approx(found.tolerances, rel=1e-3)
    assert design.objective == pytest.approx(3.0 / diameter + 1.0 / width, rel=1e-4)


def test_a_zone_that_stays_as_it_is_keeps_its_shape():
    """Not the box about it: that would be worse by 3 + 4 against 5."""
    zone = Zone(("D.d_x", "D.d_z"), 0.05 * np.eye(2), (2,))
    fixed = optimise(PROBLEM, {"a.length": (-1.0, 1.0)}, Tolerances({}, zones=zone), "f", {"f": (-1.0, None)}, key=KEY)
    assert fixed.status == "ok"
    assert fixed.designs["a.length"] == pytest.approx(0.5 * (-1.0 + 0.05 * 5.0), rel=1e-5)
    both = optimise(PROBLEM, {}, {DISC: 0.1, "a.length": BOUNDS}, "cost", {"f": 1.0}, cost=PRICE, key=KEY)
    assert both.tolerances == pytest.approx({DISC: 0.1, "a.length": 0.5 * (1.0 - 0.25)}, rel=1e-5)


@pytest.mark.long
def test_a_yield_counts_points_uniform_in_the_disc():
    """P(r^2 <= 1) = 1/(D/2)^2 whatever the distribution of other errors is."""
    settings = {"target": 0.8, "samples": 512, "verify_samples": 2048, "distribution": Uniform}
    found = allocate(ROUND, {"r": 1.0}, PRICE, {DISC: BOUNDS}, "yield", key=KEY, **settings)
    assert found.status == "ok"
    assert found.tolerances[DISC] == pytest.approx(2.0 / np.sqrt(0.8), rel=0.04)
    assert found.yield_interval[0] < 0.8 < found.yield_interval[1] + 0.01
    design = optimise(ROUND, {}, {DISC: BOUNDS}, "cost", {"r": 1.0}, cost=PRICE, key=KEY, robust="yield", **settings)
    assert design.tolerances[DISC] == pytest.approx(2.0 / np.sqrt(0.8), rel=0.04)


@pytest.mark.long
def test_deviations_of_a_zone():
    """A coordinate of a disc of radius R has the deviation R/2."""
    design = optimise(LINEAR, {}, {DISC: BOUNDS}, "cost", {"f": 1.0}, cost=PRICE, key=KEY, robust="rss", samples=512)
    assert design.tolerances[DISC] == pytest.approx(2.0 / (3.0 * 2.5), rel=0.02)
    found = allocate(LINEAR, {"f": 1.0}, PRICE, {DISC: BOUNDS}, "rss", key=KEY, coverage=2.0)
    assert found.status == "ok" and found.tolerances[DISC] == pytest.approx(2.0 / (2.0 * 2.5), rel=1e-3)


def test_sizes_are_coordinates_of_errors():
    sizes = Sizes(("a.length",), {"D.position": Zone(AXIS.errors, AXIS.matrix() / AXIS.diameter, AXIS.balls)})
    t = np.array([0.3, 0.2])
    assert sizes.region == (1, 2, 2) and sizes.owner.tolist() == [0, 1, 1, 1, 1]
    np.testing.assert_allclose(sizes.spread(t), [0.3, 0.2, 0.2, 0.2, 0.2])
    e = np.random.default_rng(0).normal(size=(3, 5))
    np.testing.assert_allclose(sizes.coordinates(e) @ sizes.matrix.T, e, atol=1e-12)
    uniform: Tolerance = Uniform(1.0)
    z = sizes.standard(uniform, np.random.default_rng(1).uniform(size=(4000, 5)))
    assert np.max(np.abs(z[:, 0])) <= 1.0 and np.max(np.linalg.norm(z[:, 1:3], axis=1)) <= 1.0
    np.testing.assert_allclose(z.std(axis=0), sizes.deviations(uniform), rtol=0.05)
    errors = (z * sizes.spread(t)) @ sizes.matrix.T
    assert np.all(np.abs(errors) <= sizes.reaches(t) + 1e-12)
    region = sizes.tolerances(t)
    assert isinstance(region, Tolerances)
    np.testing.assert_allclose(region.half_widths()["D.delta_x"], sizes.reaches(t)[3])


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ({"D.coaxialty": BOUNDS}, ("`D.coaxialty`", "did you mean `D.coaxiality`?")),
        ({"D.parallelism": BOUNDS}, ("`length`", "D.parallelism")),
        ({DISC: BOUNDS, "D.d_x": BOUNDS}, ("`D.d_x` is in two",)),
        ({"E.coaxiality": BOUNDS}, ("`E.coaxiality` needs `E.d_x`",)),
        ({DISC: ("1 deg", "2 deg")}, ("`D.coaxiality` of `bounds`", "length")),
        ({DISC: (0.2, 0.1)}, ("0 < smallest < largest",)),
    ],
)
def test_bad_bounds_are_refused_in_one_sentence(bounds, words):
    with pytest.raises(InputError) as caught:
        allocate(PROBLEM, {"f": 1.0}, PRICE, bounds, key=KEY)
    text = str(caught.value)
    assert all(word in text for word in words), text
    assert "\n" not in text
    with pytest.raises(InputError):
        optimise(PROBLEM, {}, bounds, "cost", {"f": 1.0}, cost=PRICE, key=KEY)
