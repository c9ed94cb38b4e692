"""Metrics of runs made by hand: every catalogued one against its definition, roots at zero; registered ones."""

import pickle
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Compliance,
    InputError,
    Joint,
    Mechanism,
    Metric,
    PrescribedRate,
    Problem,
    RungeKutta4,
    Simulation,
    discretise,
    metric,
    register_metric,
    sensitivity,
)
from rfem_jax.description.metrics.catalogue import JOINT_METRICS, POINT_METRICS, RUN_METRICS
from rfem_jax.tolerancing.problems import metrics
from tests.derivatives import check_derivatives
from tests.mechanisms import arm, link

jax.config.update("jax_enable_x64", True)

RNG = np.random.default_rng(8)
FORCE, MOMENT = RNG.normal(size=(2, 41, 3))
LARGEST = {"max_force": 5.0, "max_moment": 6.0}


def run(force=FORCE, moment=MOMENT):
    """What metrics read of a run, at one joint "A"."""
    loads = SimpleNamespace(force=jnp.asarray(force), moment=jnp.asarray(moment))
    squares = {"mean_square_force": 4.0, "mean_square_moment": 9.0}
    kinds = {**squares, "rms_force": 2.0, "rms_moment": 3.0, **LARGEST}
    motion = SimpleNamespace(
        angles={"A": jnp.array([0.5, 2.0, -1.0])},
        displacements={"A": jnp.array([0.1, 0.4, 0.2])},
        angle_end=jnp.asarray(1.25),
    )
    return SimpleNamespace(
        loads={"A": loads},
        preload={"A": SimpleNamespace(force=jnp.array([1.0, 2, 2]), moment=jnp.array([0.0, 3, 4]))},
        metrics=SimpleNamespace(**{name: {"A": value} for name, value in kinds.items()}),
        motion=motion,
        energy=SimpleNamespace(total=jnp.array([1.0, 0.5])),
    )


def test_every_metric_is_what_its_name_says():
    # Those of bearings, friction and drives are told in `tests/theory/test_design_metrics.py`.
    names = [name for name, kind in JOINT_METRICS.items() if kind.refusal is None]
    found = {name: float(metric(f"A.{name}")(run())) for name in names}
    peaks = {
        f"peak_{kind}": np.mean(np.linalg.norm(vectors, axis=1) ** 16) ** (1 / 16)
        for kind, vectors in (("force", FORCE), ("moment", MOMENT))
    }
    expected = {
        "mean_square_force": 4.0, "mean_square_moment": 9.0, "rms_force": 2.0, "rms_moment": 3.0,
        "preload_force_square": 9.0, "preload_moment_square": 25.0, **peaks, **LARGEST,
        "end_angle": -1.0, "angle_range": 3.0, "end_displacement": 0.2, "displacement_range": 0.3,
    }  # fmt: skip
    assert found == pytest.approx(expected, rel=1e-12)
    assert float(metric("angle_error")(run())) == 1.25
    assert float(metrics.end_angle(1.0)(run())) == 0.25
    assert float(metric("end_energy")(run())) == 0.5
    units = {name: metric(f"A.{name}").unit for name in names}
    assert units["mean_square_moment"] == "(N m)^2" and units["peak_force"] == "N"
    assert units["preload_moment_square"] == "(N m)^2" and units["rms_moment"] == "N m"


@pytest.mark.parametrize("power", [2, 16, 64])
def test_a_p_norm_bounds_the_largest_load_and_scales_with_it(power):
    norm = float(metrics.peak_force("A", power)(run()))
    largest = np.linalg.norm(FORCE, axis=1).max()
    assert norm <= largest * (1 + 1e-12)
    assert largest <= len(FORCE) ** (1 / power) * norm * (1 + 1e-12)
    for scale in (1e-20, 1e100):  # powers of loads neither vanish nor overflow
        scaled = float(metrics.peak_force("A", power)(run(force=scale * FORCE)))
        assert scaled == pytest.approx(scale * norm, rel=1e-10)
    assert float(metrics.peak_force("A", power)(run(force=0 * FORCE))) == 0.0


def test_a_p_norm_has_a_finite_derivative_where_the_load_vanishes():
    def norm(scale):
        return metrics.peak_moment("A")(run(moment=scale * jnp.asarray(MOMENT)))

    assert np.isfinite(jax.grad(norm)(0.0))
    check_derivatives(norm, 1.0, 1e-6, reverse=1e-12, differences=1e-8)


def test_metrics_of_the_user_and_bad_ones():
    own = Metric("A.swing", "rad", "swing", function=lambda run: run.motion.angle_end)
    assert float(own(run())) == 1.25 and own.even is None
    with pytest.raises(InputError, match="`function` of metric 'A.swing'"):
        Metric("A.swing", "rad")(run())
    with pytest.raises(InputError, match="did you mean `A.rms_force`"):
        metric("A.rms_forse")
    with pytest.raises(InputError, match="did you mean `end_energy`"):
        metric("end_enrgy")


def test_only_joints_with_a_coordinate_have_a_motion():
    """Springs across a slide are no coordinates of the kind."""
    guide = Joint("A", "base", "arm", kind="prismatic", compliance=Compliance(normal=1e7))
    model = discretise(
        Mechanism([link("arm", 0.3), link("hand", 0.3)], [guide, Joint("B", "arm", "hand", kind="universal")])
    )
    settings = {"drive": None, "duration": 1e-3, "method": RungeKutta4(step=1e-6)}
    assert Problem(Simulation(model, **settings), ("A.end_displacement", "A.displacement_range")).metrics[0].unit == "m"
    for name in ("A.end_angle", "B.end_angle"):
        with pytest.raises(InputError, match="`metrics` must be of joints that have them"):
            Problem(Simulation(model, **settings), (name,))


@pytest.fixture
def registered():
    """Three metrics of a program that uses the package; the catalogue is the same afterwards."""
    kept = [(catalogue, dict(catalogue)) for catalogue in (JOINT_METRICS, POINT_METRICS, RUN_METRICS)]
    register_metric("tip", "m", lambda run: run.motion.ends["arm"][-1, 0], label="horizontal place of the tip")
    register_metric("pull", "N", lambda run, joint: run.loads[joint].force[-1, 0], of_joints=True)
    register_metric("reach", "m", lambda run, point: jnp.linalg.norm(run.points[point].position[-1]), of_points=True)
    yield
    for catalogue, entries in kept:
        catalogue.clear()
        catalogue.update(entries)


@pytest.fixture(scope="module")
def pendulum():
    """A rigid arm that turns at a prescribed rate, half a radian from the horizontal at first."""
    return discretise(arm(angle=0.5))


RATE, DURATION = 3.0, 4e-4


def build(model, names):
    return Problem(
        Simulation(
            model, drive=PrescribedRate("A", RATE), duration=DURATION, method=RungeKutta4(step=2e-5), save_every=2e-4
        ),
        names,
    )


@pytest.mark.long
def test_a_registered_metric_runs_through_a_problem_and_sensitivities_to_their_table(registered, pendulum):
    problem = build(pendulum, ("tip", "A.pull", "end_energy", "arm.end.reach"))
    assert problem.metrics[0] is metric("tip") and problem.metrics[1].label == "pull in A"
    found = sensitivity(problem, order=1, scale={"arm.length": "1 mm", "A.delta_x": "0.5 deg"})
    end = 0.5 + RATE * DURATION
    # The tip is at L cos(angle) at the end; a longer arm has it farther out.
    assert found.value[0] == pytest.approx(0.3 * np.cos(end), rel=1e-9)
    assert found.gradient[0, 0] == pytest.approx(np.cos(end), rel=1e-9)
    assert found.gradient_scaled[0, 0] == pytest.approx(1e-3 * np.cos(end), rel=1e-9)
    # However it is turned, the end of the arm is as far from the hinge as the arm is long.
    assert problem.metrics[3].label == "reach of arm.end"
    assert found.value[3] == pytest.approx(0.3, rel=1e-12) and found.gradient[3, 0] == pytest.approx(1.0, rel=1e-9)
    rows = {(row["metric"], row["error"]): row for row in found.rows()}
    assert rows["tip", "arm.length"]["gradient"] == found.gradient[0, 0]
    assert np.isfinite(rows["A.pull", "arm.length"]["gradient"])
    table = found.table("tip")
    assert "horizontal place of the tip [m]" in table and "arm.length" in table and "pull in A [N]" in str(found)


def test_a_problem_refuses_metrics_that_it_cannot_compute(registered, pendulum):
    for names, words in (
        ("tipp", "did you mean `tip`"),
        ("Q.pull", "of joints of the model"),
        ("Q.reach", "name a joint or an end of a link"),
        ("A@1ms.reach", "of the whole path"),
        (Metric("y", "N"), "must hold metrics with a function of a run, but 'y' has no function"),
        (("tip", "tip"), "`tip` occurs twice"),
        ((), "at least one name"),
    ):
        with pytest.raises(InputError) as caught:
            build(pendulum, names)
        assert words in str(caught.value)


def test_a_problem_goes_to_another_process(pendulum):
    problem = build(pendulum, ("A.rms_force", "end_energy"))
    other = pickle.loads(pickle.dumps(problem))
    assert other.metrics == problem.metrics and other({})[0] == problem({})[0]


def test_a_metric_that_is_replaced_is_another_one(registered):
    before = metric("tip")
    register_metric("tip", "rad", lambda run: run.motion.angle[-1], replace=True)
    assert metric("tip") is not before and metric("tip").unit == "rad" and metric("tip") is metric("tip")
