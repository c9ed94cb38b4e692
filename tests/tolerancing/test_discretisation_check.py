"""Whether a model is divided finely enough for what was measured: closed forms, links, steps, an independent engine."""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    FunctionProblem,
    GeneralisedAlpha,
    MomentRamp,
    Normal,
    Sensor,
    Simulation,
    Tolerances,
    discretise,
    identify,
    load_study,
    simulate,
)
from rfem_jax.tolerancing.identification.discretisation_check import Division, discretisation_remarks, too_coarse
from tests.mechanisms import arm

TIMES = np.linspace(0.0, 1.0, 101)
NAMES = ("D.delta_x", "D.d_y")
TOLERANCES = Tolerances({"D.delta_x": Normal(9e-3), "D.d_y": Normal(6e-4)})
TRUTH = {"D.delta_x": 3e-3, "D.d_y": -1e-4}
NOISE = 0.02


def divided(m, wave=5.0):
    """A signal of a model with m elements, whose error falls with their square."""

    def signals(errors):
        t = jnp.asarray(TIMES)
        a, b = errors["D.delta_x"] / 3e-3, errors["D.d_y"] / 2e-4
        return {"rate_rad_s": a * (1.0 - 0.8 / m**2) * t + b * (1.0 + 0.2 / m**2) * jnp.cos(wave * t)}

    return FunctionProblem(signals, NAMES, ("rate_rad_s",), error_units={"D.d_y": "m"})


def solve(m, wave=5.0, every=1, noise=NOISE, ends=1, **more):
    """What is found with m elements of a machine with many, of which a run saves every so manieth time."""
    rng, values = np.random.default_rng(0), divided(1e9, wave)(TRUTH)[0]["rate_rad_s"]
    sampled, values = TIMES[ends:-ends], np.asarray(values)[ends:-ends]
    data = {"time_s": sampled, "rate_rad_s": values + noise * rng.normal(size=sampled.shape)}
    model = divided(m, wave)

    def saved(errors):
        values, _ = model(errors)
        return {"rate_rad_s": values["rate_rad_s"][::every]}

    problem = FunctionProblem(saved, NAMES, ("rate_rad_s",), error_units={"D.d_y": "m"})
    sensors, settings = {"rate_rad_s": Sensor(noise)}, {"starts": 2, "samples": 64, "times": TIMES[::every]}
    return identify(problem, data, sensors, TOLERANCES, **settings | more)


def test_the_errors_would_move_to_those_of_an_infinitely_fine_model():
    coarse, fine = solve(4, finer=divided(8)), solve(1e9)
    (of_times, of_rfes) = coarse.divisions
    assert coarse.status == "coarse" and of_rfes.what == "rfes" and of_rfes.coarse and not of_times.coarse
    moved = fine.estimate - coarse.estimate
    assert np.abs(moved[0]) > 2.0 * coarse.deviation[0]  # which is why it must not say ok
    np.testing.assert_allclose(of_rfes.movement, moved, rtol=0.1, atol=0.05 * coarse.deviation.min())
    np.testing.assert_allclose(of_rfes.deviations, np.abs(of_rfes.movement) / coarse.deviation, rtol=1e-9)
    assert "too coarse" in str(coarse) and "D.delta_x by" in str(coarse)
    # As many as would move it by half a standard deviation: the error falls with the square of the elements.
    m = 4.0 * np.sqrt(of_rfes.deviations.max() / 0.5)
    enough = solve(m, finer=divided(2.0 * m))
    assert enough.status == "ok" and enough.divisions[1].deviations.max() == pytest.approx(0.5, rel=0.1)
    assert "fine enough" in str(enough) and f"{enough.divisions[1].deviations.max():.2g}"[:3] in str(enough)


def test_saved_times_that_are_far_apart_are_told():
    """A wave of which a run saves sixteen values a period, and a sensor that sees what a spline misses."""
    settings = {"wave": 20.0, "noise": 1e-5, "ends": 15}  # at the ends splines are worse
    found, dense = solve(1e9, every=2, **settings), solve(1e9, **settings)
    (division,) = found.divisions
    assert division.what == "save_every" and division.now[""] == pytest.approx(0.02)
    assert not dense.divisions[0].coarse and dense.status == "ok"
    moved = dense.estimate - found.estimate
    large = np.abs(moved) > 0.5 * found.deviation
    assert found.status in ("coarse", "misfit") and division.coarse and large.any()
    np.testing.assert_allclose(division.movement[large], moved[large], rtol=0.2)


def test_divisions_that_are_too_coarse_together_are():
    def division(what, movement):
        movement = np.array(movement)
        return Division(what, movement, np.abs(movement) / 1e-3, {"": 1.0}, {"": 1.0})

    one, same, against = division("rfes", [4e-4, 0.0]), division("step", [3e-4, 0.0]), division("step", [-3e-4, 0.0])
    assert too_coarse((one, same)) and not too_coarse((one, against)) and not too_coarse((one,))
    (said,) = discretisation_remarks((one, same), NAMES)
    assert "together" in said and "D.delta_x by 0.7 standard deviations" in said and "rfes" in said
    failed = replace(one, movement=np.full(2, np.nan), deviations=np.full(2, np.nan), failed="diverged")
    assert not too_coarse((failed,)) and "not known" in discretisation_remarks((failed,), NAMES)[0]
    assert not too_coarse(())


def test_it_may_be_left_out():
    found = solve(4, check_model=False, finer=divided(8))
    assert found.status == "ok" and found.divisions == ()


SENSORS = {"rate_rad_s": Sensor(1e-3)}
MOMENT = Tolerances({"drive.moment": Normal("0.3 N m")})


def swinging(rfes, step=2e-4, moment=1.0):
    """A flexible arm that begins to turn."""
    drive, method = MomentRamp("A", moment, 0.02), GeneralisedAlpha(step=step)
    return Simulation(discretise(arm(rfes=rfes)), drive=drive, duration=0.04, method=method, save_every=1e-3)


def shown(simulation):
    return np.asarray(simulate(simulation).motion.rate)[1:]


@pytest.mark.long
def test_links_and_steps_of_a_mechanism_are_checked(refused):
    simulation, noise = swinging(2), 1e-3 * np.random.default_rng(0).normal(size=40)
    data = {"time_s": np.linspace(1e-3, 0.04, 40), "rate_rad_s": shown(swinging(2, moment=1.1)) + noise}
    for finer in (simulation, [swinging(3)] * 2):
        with refused("`finer`", "twice as many"):
            identify(simulation, data, SENSORS, MOMENT, finer=finer)
    found = identify(simulation, data, SENSORS, MOMENT, finer=swinging(3), starts=2, samples=64)
    by = {one.what: one for one in found.divisions}
    assert found.status == "coarse" and by["rfes"].coarse, str(found)
    assert by["rfes"].now == {"arm": 2} and by["rfes"].wanted["arm"] > 2 and "2 in arm" in str(found)
    assert by["step"].now[""] == pytest.approx(2e-4)
    # The finer machines say the same by themselves.
    moment = 1.0 + found.estimate[0]
    mine = shown(swinging(2, moment=moment))
    slope = (shown(swinging(2, moment=moment + 0.01)) - mine) / 0.01
    for what, finer in (("rfes", swinging(3, moment=moment)), ("step", swinging(2, 1e-4, moment))):
        expected = -4.0 / 3.0 * (slope @ (shown(finer) - mine)) / (slope @ slope)
        assert by[what].movement[0] == pytest.approx(expected, rel=0.02), what
    unchecked = identify(simulation, data, SENSORS, MOMENT, starts=2, samples=64)
    assert {one.what for one in unchecked.divisions} == {"step", "save_every"} and "was not checked" in str(unchecked)


@pytest.mark.parametrize(
    "rfes, status",
    [pytest.param(3, "coarse", marks=pytest.mark.long), pytest.param(15, "ok", marks=pytest.mark.exhaustive)],
)
def test_few_rfes_are_too_coarse_for_what_another_engine_has_measured(rfes, status):
    """See `benchmarks/exudyn_measured.py`: with three rfes all errors are found 7 to 14 % too small."""
    study = load_study(Path(__file__).parents[2] / "studies" / "identify_misassembly" / "study.toml")

    def simulation(n):
        model = discretise(study.mechanism, {"coupler": n, "rocker": n})
        return Simulation.of(study, model=model, method=GeneralisedAlpha(step=5e-4), save_every=2e-3, duration=0.3)

    file, truth = Path(__file__).with_name("measured_by_exudyn.csv"), np.array([*np.radians([0.25, -0.15]), 4e-4])
    sensors = {
        "rate_rad_s": Sensor(0.1), "D_moment_x_Nm": Sensor(0.4, offset=0.1), "D_moment_z_Nm": Sensor(0.4)
    }  # fmt: skip
    tolerances = {
        name: Normal("0.5 mm" if ".d_" in name else "0.5 deg") for name in ("D.delta_x", "D.delta_z", "D.d_y")
    }
    found = identify(
        simulation(rfes), file, sensors, tolerances, starts=4, samples=64, finer=simulation(2 * rfes - 1)
    )  # fmt: skip
    assert found.status == status, str(found)
    (of_rfes,) = [one for one in found.divisions if one.what == "rfes"]
    assert of_rfes.coarse == (status == "coarse")
    if status == "coarse":  # what the finer model says is what is missing
        short = found.estimate / truth - 1.0
        assert (short < -0.05).all() and (
            np.abs((found.estimate + of_rfes.movement) / truth - 1.0) < np.abs(short)
        ).all()
    else:
        assert ((found.low <= truth) & (truth <= found.high)).all()
