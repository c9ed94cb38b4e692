"""Tolerance zones and process capability: their shapes in samples, in moments, in the worst case and in study files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rfem_jax import (
    CorrelatedNormal,
    FunctionProblem,
    InputError,
    ProcessNormal,
    Tolerances,
    Triangular,
    TruncatedNormal,
    Uniform,
    Zone,
    monte_carlo,
    process_capability,
    worst_case,
)
from rfem_jax.description.tolerances.tolerances import read_tolerances
from rfem_jax.description.tolerances.zones import SpecifiedZone
from rfem_jax.tolerancing.sampling.sequences import unit_points
from tests.derivatives import check_derivatives

jax.config.update("jax_enable_x64", True)

KEY = jax.random.key(5)
TABLE = {
    "D.position": {"diameter": "0.1 mm", "length": "40 mm"},
    "C.parallelism": {"zone": "cylinder", "diameter": "0.05 mm", "length": "25 mm"},
    "B.position": {"fit": "25 H7/g6"},
    "coupler.length": {"iso": "200 js7"},
    "A.d_y": {"half_width": "0.1 mm", "cp": 1.33, "cpk": 1.0, "side": "lower"},
}


def tolerances():
    return Tolerances.of(read_tolerances(TABLE))


def drawn(zone, n=4096):
    return np.asarray(jax.vmap(zone.quantile)(unit_points(KEY, n, len(zone.names), "sobol")))


@pytest.mark.long
@pytest.mark.parametrize("n", [1, 2, 3])
def test_a_ball_is_filled_evenly_in_all_directions(n):
    points = drawn(Zone("xyz"[:n], 2.0 * np.eye(n), (n,)))
    radius = np.linalg.norm(points, axis=1) / 2.0
    assert radius.max() <= 1.0
    assert stats.kstest(radius**n, "uniform").statistic < 0.01  # the volume within a radius
    np.testing.assert_allclose(np.cov(points.T), np.eye(n) * 4.0 / (n + 2), atol=0.02)
    inside = points[radius < 0.5]
    assert np.all(np.abs(inside.mean(axis=0)) < 0.03)


@pytest.mark.long
def test_the_map_to_the_ball_is_smooth_at_its_middle():
    zone = Zone("xy", np.eye(2), (2,))
    exact = np.eye(2) * np.sqrt(0.5)  # y = w sqrt((1 - exp(-w^2/2))/w^2)
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(mode(zone.from_normal)(jnp.zeros(2)), exact, rtol=1e-12)
    for size in (1e-3, 0.1413, 0.1416, 2.0, 6.0):  # on both sides of where the series ends
        w = jnp.array([0.6 * size, 0.8 * size])
        np.testing.assert_allclose(zone.from_normal(w), w / size * np.sqrt(-np.expm1(-(size**2) / 2)), rtol=1e-10)


def test_the_ends_of_an_axis_stay_in_their_discs():
    zone = SpecifiedZone("D.position", "0.1 mm", length="40 mm")
    points = drawn(Zone(zone.errors, zone.matrix(), zone.balls))
    x, z, tilt_x, tilt_z = points.T
    ends = [np.hypot(x - tilt_z * y, z + tilt_x * y) for y in (0.02, -0.02)]  # an end moves by tilt times y
    for end in ends:
        assert 0.049e-3 < end.max() <= 0.05e-3 * (1 + 1e-12)
        assert stats.kstest((end / 0.05e-3) ** 2, "uniform").statistic < 0.01
    reach = zone.half_widths()
    np.testing.assert_allclose(list(reach.values()), [5e-5, 5e-5, 2.5e-3, 2.5e-3])
    assert np.all(np.abs(points) <= list(reach.values()))
    # Displaced to the rim an axis cannot tilt: the box of the four errors is far larger than the zone.
    assert np.max(np.abs(x) / 5e-5 + np.abs(tilt_z) / 2.5e-3) <= 1.0 + 1e-12


def test_tables_of_drawings_become_distributions():
    found = tolerances()
    assert found.names == (
        *("coupler.length", "A.d_y", "D.d_x", "D.d_z", "D.delta_x", "D.delta_z"),
        *("C.delta_x", "C.delta_z", "B.d_x", "B.d_z"),
    )
    assert [len(factor) for factor in found.factors] == [1, 1, 4, 2, 2]
    widths = found.half_widths()
    assert float(widths["C.delta_x"]) == pytest.approx(0.05 / 25)
    assert float(widths["B.d_x"]) == pytest.approx(20.5e-6)  # half of the largest clearance
    assert float(widths["coupler.length"]) == pytest.approx(23e-6)
    result = monte_carlo(
        FunctionProblem(lambda e: {"f": e["D.d_x"] + e["A.d_y"]}, found.names, "f", error_units=units(found)),
        found, 512, KEY,
    )  # fmt: skip
    np.testing.assert_allclose(np.cov(result.errors.T), found.covariance(), atol=0.1 * np.max(found.covariance()))
    std = result.errors.std(axis=0, ddof=1)
    np.testing.assert_allclose(std, np.sqrt(np.diagonal(found.covariance())), rtol=0.05)


def units(found):
    return {name: "rad" if "delta" in name else "m" for name in found.names}


def test_zones_keep_their_shape_at_other_widths():
    zone = SpecifiedZone("D.position", "0.1 mm")
    found = Tolerances(zones=Zone(zone.errors, zone.matrix(), zone.balls))
    twice = found.with_half_widths({"D.d_x": 1e-4})
    np.testing.assert_allclose(np.asarray(twice.zones[0].matrix), np.diag([1e-4, 5e-5]))


@pytest.mark.slow
def test_the_worst_case_in_a_disc_is_on_its_rim_not_in_a_corner():
    """f = 3 x + 4 z over a disc of radius R is 5 R; in the box it would be 7 R. A square of another adds to it."""

    def f(e):
        return {"f": 3.0 * e["x"] + 4.0 * e["z"] + 2.0 * e["t"] ** 2 + e["t"], "g": e["x"] ** 2 + 4.0 * e["z"] ** 2}

    problem = FunctionProblem(f, ("x", "z", "t"), ("f", "g"), error_units={"x": "m", "z": "m"})
    found = Tolerances({"t": Uniform(0.5)}, zones=Zone(("x", "z"), 0.1 * np.eye(2), (2,)))
    worst = worst_case(problem, found, "f", key=KEY)
    assert worst.status == "ok" and worst.region == "box with zones" and worst.corners is None
    assert worst.value == pytest.approx(0.5 + 1.0, rel=1e-9)
    np.testing.assert_allclose([worst.errors["x"], worst.errors["z"], worst.errors["t"]], [0.06, 0.08, 0.5], rtol=1e-6)
    assert worst.active == {"t": "upper", "zone 1": "surface"}
    assert worst.quadratic_bound == pytest.approx(1.5, rel=1e-6)
    assert worst_case(problem, found, "g", key=KEY).value == pytest.approx(0.04, rel=1e-9)
    with pytest.raises(InputError, match="no corners"):
        worst_case(problem, found, "f", key=KEY, corners=True)


@pytest.mark.slow
def test_the_worst_axis_of_a_zone_over_a_length():
    """Of x + h tilt_z, a point of the axis at y = -h, the worst case is the rim where that point is an end."""
    zone = SpecifiedZone("D.position", 0.1, length=2.0)
    found = Tolerances(zones=Zone(zone.errors, zone.matrix(), zone.balls))

    def f(e):
        return {"end": e["D.d_x"] + e["D.delta_z"], "far": e["D.d_x"] + 3.0 * e["D.delta_z"]}

    problem = FunctionProblem(f, zone.errors, ("end", "far"), error_units=units(found))
    assert worst_case(problem, found, "end", key=KEY).value == pytest.approx(0.05, rel=1e-8)
    assert worst_case(problem, found, "far", key=KEY).value == pytest.approx(0.05 * (2.0 + 1.0), rel=1e-8)


def test_capability_to_a_normal_distribution_and_back():
    found = ProcessNormal(interval=(-0.1, 0.3), cp=1.5, cpk=0.9, side="lower")
    mean, std = float(found.mean), float(jnp.sqrt(found.variance()))
    np.testing.assert_allclose(process_capability(mean, std, (-0.1, 0.3)), (1.5, 0.9), rtol=1e-12)
    assert mean < 0.1
    u = np.array([1e-6, 0.2, 0.5, 0.999])
    np.testing.assert_allclose(found.quantile(jnp.asarray(u)), stats.norm(mean, std).ppf(u), rtol=1e-9)
    np.testing.assert_allclose(found.interval, (-0.1, 0.3))  # the limits of the drawing, for the worst case
    assert process_capability(0.0, 0.1, (-0.3, 0.6)) == pytest.approx((1.5, 1.0))
    assert float(ProcessNormal(0.3, cp=1.0).mean) == 0.0
    box = Tolerances({"a": found})
    assert float(box.centres()["a"]) == pytest.approx(0.1) and float(box.means()["a"]) == pytest.approx(mean)
    np.testing.assert_allclose(box.intervals()["a"], (-0.1, 0.3))
    for arguments, word in (({"cp": 1.0, "cpk": 1.2}, "at most cp"), ({"cp": 1.0, "side": "left"}, "`side`")):
        with pytest.raises(InputError, match=word):
            ProcessNormal(0.1, **arguments)


@pytest.mark.long
@pytest.mark.parametrize(
    "found",
    [
        Uniform(interval=(-0.1, 0.3)),
        Triangular(0.2),
        TruncatedNormal(0.2, deviations=1.5),
        ProcessNormal(0.2, cp=1.0, cpk=0.5),
    ],
)
def test_errors_of_normal_numbers_are_those_of_the_quantiles(found):
    w = jnp.array([-4.0, -1.0, -1e-3, 0.0, 0.5, 3.0])
    np.testing.assert_allclose(found.from_normal(w), found.quantile(jax.scipy.special.ndtr(w)), atol=1e-12)
    for at in (-1.0, 0.0, 2.0):
        check_derivatives(found.from_normal, at, 1e-5, reverse=1e-9, differences=1e-5)
    assert float(found.from_normal(9.0)) > float(found.from_normal(8.5)) - 1e-15  # finite and rising far out


def test_groups_draw_by_normal_numbers_as_by_points_of_the_cube():
    found = Tolerances(
        {"a": Uniform(0.1)}, correlated=CorrelatedNormal("bc", [[2.0, 1.0], [1.0, 1.0]]),
        zones=Zone("de", np.eye(2), (2,)),
    )  # fmt: skip
    w = jnp.array([0.3, -1.2, 0.8, 2.0, -0.4])
    one, other = found.from_normal(w), found.errors(jax.scipy.special.ndtr(w))
    assert list(one) == list("abcde")
    np.testing.assert_allclose(list(one.values()), list(other.values()), rtol=1e-12)


@pytest.mark.parametrize(
    ("entry", "pieces"),
    [
        ({"D.position": {"fit": "25 H7/p6"}}, ("`fit`", "interferes by up to 35 um")),
        ({"D.position": {"fit": "25 H7/g6", "diameter": 1e-4}}, ("`diameter`", "both are")),
        ({"D.position": {"zone": "planes", "diameter": 1e-4}}, ("`zone`", "cylinder")),
        ({"D.parallelism": {"diameter": 1e-4}}, ("`length`", "over a length")),
        ({"D.parallelism": {"diameter": 1e-4, "length": 0.1, "zone": "sphere"}}, ("`zone`", "position without length")),
        ({"D.position": 1e-4, "D.d_x": 1e-4}, ("`D.d_x` occurs twice", "in one zone")),
        ({"D.delta_x": {"iso": "20 h9"}}, ("`iso`", "angle")),
        ({"D.d_x": {"cpk": 1.0, "half_width": 1e-4}}, ("`cp`", "add it")),
        ({"D.d_x": {"cp": 1.0, "cpk": 1.3, "half_width": 1e-4}}, ("`cpk`", "at most cp")),
        ({"D.d_x": {"cp": 1.0, "distribution": "triangular", "half_width": 1e-4}}, ("`cp`", "without `distribution`")),
        ({"D.d_x": {"iso": "20 h9", "half_width": 1e-4}}, ("`half_width`", "both are")),
    ],
)
def test_what_does_not_fit_is_refused(entry, pieces):
    with pytest.raises(InputError) as found:
        read_tolerances(entry)
    assert all(piece in str(found.value) for piece in pieces), str(found.value)
