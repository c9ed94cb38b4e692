"""How many rfes: values whose convergence is known, and loads of mechanisms."""

import numpy as np
import pytest

from rfem_jax import (
    GivenSection,
    InputError,
    Joint,
    Link,
    Mechanism,
    Metric,
    Point,
    PointForce,
    StaticProblem,
    design,
    discretise,
    mesh_convergence,
)
from rfem_jax.tolerancing.refinement import extrapolated
from tests.mechanisms import four_bar

RIGIDITY, LENGTH = 400.0, 0.8
UP = Metric("P.up", "m", function=lambda loads: loads.points["P"].position[-1, 2])


def clamped(rfes=None, own=5):
    """A clamped beam under a small force at its end, without shear: off by 1 / 4 m^2 (theory (11.1))."""
    section = GivenSection(1e12, 1e12, 1e12, 1e5, RIGIDITY, RIGIDITY, 1e-9, 2e-13, 1e-13, 1e-13)
    mechanism = Mechanism(
        [Link("beam", LENGTH, section, rfes=own), Link("tip", 0.1, rigid=True, section=section)],
        [Joint("A", "base", "beam", kind="fixed"), Joint("B", "beam", "tip", kind="fixed")],
        gravity=(0.0, 0.0, 0.0), points=[Point("P", "beam", LENGTH)],
        forces=[PointForce("push", "beam", LENGTH, (0.0, 0.0, 3e-3))], elements="linear",
    )  # fmt: skip
    return StaticProblem(discretise(mechanism, rfes), [UP, "A.max_force"])


@pytest.mark.long
def test_the_limit_of_a_beam_is_that_of_theory():
    found = mesh_convergence(clamped, accuracy=1e-4, progress=False)
    exact = 3e-3 * LENGTH**3 / (3.0 * RIGIDITY)
    assert found.ok and found.refinements == (0.5, 1.0, 2.0) and found.rfes == {"beam": 5}
    np.testing.assert_allclose(found.limit[0], [exact, 3e-3], rtol=1e-7)
    np.testing.assert_allclose(found.order[0], [2.0, np.nan], atol=1e-4)
    # m = 4 sdes; 1 / 4 m^2 = 1e-4 at m = 50. The force in the clamp has no error.
    np.testing.assert_allclose(found.error[0], [-1.0 / 64.0, 0.0], rtol=1e-5, atol=1e-7)
    assert found.settled.all() and found.worst == ("", "P.up")
    assert found.rfes_for() == {"beam": 51} and found.rfes_for(0.01) == {"beam": 6}
    enough = float(clamped({"beam": 6})({})[0]["P.up"])
    assert enough == pytest.approx(0.99 * exact, rel=1e-7)


@pytest.mark.long
def test_few_rfes_are_doubled_twice():
    found = mesh_convergence(lambda rfes: clamped(rfes, own=3), progress=False)
    assert found.refinements == (1.0, 2.0, 4.0)
    np.testing.assert_allclose(found.error[0, 0], -1.0 / 16.0, rtol=1e-5)


def test_what_does_not_converge_with_order_two_is_said():
    m = np.array([2.0, 4.0, 8.0])[:, None, None]
    series = [
        1.0 + 0.3 / m**2,
        1.0 + 0.3 / m,
        1.0 + 0.1 * (-1.0) ** np.log2(m),
        1.0 + 1e-5 / m,
        0.0 * m,
        0.01 - 0.01 / m,
    ]
    values = np.concatenate(series, axis=2)
    limit, order, error, settled = extrapolated(values, 1, ["N"] * 6, 0.01)
    assert settled[0].tolist() == [True, False, False, True, True, False]
    np.testing.assert_allclose(order[0, :2], [2.0, 1.0])
    assert np.isnan(order[0, [2, 4]]).all()
    assert limit[0, 0] == pytest.approx(1.0) and error[0, 0] == pytest.approx(0.3 / 16.0)
    # Of a small value relative to a twentieth of the largest one of its unit.
    assert error[0, 4] == 0.0 and error[0, 5] == pytest.approx((values[1, 0, 5] - limit[0, 5]) / 0.05, rel=0.05)


def test_a_result_is_a_table_and_labelled_data():
    found = mesh_convergence(clamped, {"one": {}, "warm": {"A.d_z": 1e-3}}, progress=False)
    text = str(found)
    assert "3, 5 and 9 rfes" in text and "Case warm" in text and "beam 6 rfes" in text and "-1.6 %" in text
    data = found.to_xarray()
    assert data.value.dims == ("mesh", "case", "metric") and data.wanted_rfes.sel(link="beam") == 6
    table = found.to_pandas()
    assert table.loc[("one", "P.up"), "error"] == pytest.approx(-1.0 / 64.0, rel=1e-5)
    assert found._repr_html_().count("<table") == 2


def test_a_case_that_fails_has_its_status():
    found = mesh_convergence(clamped, {"good": {}, "gone": {"beam.length": -0.9}}, progress=False)
    assert found.statuses == ("ok", "design_out_of_range") and not found.ok
    assert "Case gone has no values" in str(found) and found.rfes_for(0.01) == {"beam": 6}


@pytest.mark.long
def test_a_finest_mesh_that_fails_is_left_out():
    def make(rfes):
        n = 5 if rfes is None else rfes["beam"]
        jumping = {3: 1.0, 5: 1.1, 9: 0.9, 17: 1.2}[n]
        metric = Metric("P.up", "m", function=lambda loads: jumping * loads.points["P"].position[-1, 2])
        problem = clamped(rfes)
        return StaticProblem(problem.model, [metric, "A.max_force"], design=pushed(problem.model, n))

    def pushed(model, n):
        return design(model, {"push.force.z": 3e-3 if n < 17 else 3e9})

    found = mesh_convergence(make, progress=False)
    assert found.ok and found.refinements == (0.5, 1.0, 2.0) and not found.settled.all()
    assert "* The order is not yet 2" in str(found)


def test_what_cannot_be_refined_is_refused():
    with pytest.raises(InputError, match="flexible links, but all links are rigid"):
        mesh_convergence(lambda rfes: StaticProblem(discretise(_rigid()), "A.max_force"), progress=False)
    for accuracy in (0.0, 1.0, "1 %"):
        with pytest.raises(InputError, match="share between 0 and 1"):
            mesh_convergence(clamped, accuracy=accuracy)


def _rigid():
    section = GivenSection(*[1.0] * 6, *[1e-3] * 4)
    return Mechanism([Link("arm", 0.3, section, rigid=True)], [Joint("A", "base", "arm", kind="fixed")])


def test_numbers_of_rfes_by_link():
    mechanism = four_bar(5)
    of_one = discretise(mechanism, {"rocker": 3}).topology
    counts = dict(zip(of_one.links, of_one.elements, strict=True))
    assert counts["rocker"] == 3 and counts["coupler"] == 5 and counts["crank"] == 1
    for wrong, words in (({"crank": 3}, "`crank` is not one"), ({"rocker": 1}, "at least 2"), (1, "at least 2")):
        with pytest.raises(InputError, match=words):
            discretise(mechanism, wrong)
