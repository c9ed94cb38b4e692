"""A method of integration from outside the package: named in a study file, run by the command."""

import json
from dataclasses import dataclass
from typing import ClassVar

import diffrax
import jax
import numpy as np
import pytest

from rfem_jax import (
    Explicit,
    InputError,
    Method,
    Simulation,
    assembly_errors,
    check_step,
    discretise,
    load_study,
    register_method,
    simulate,
)
from rfem_jax.description import FixedStep, methods
from rfem_jax.description.methods import named_method
from rfem_jax.report import command_line
from rfem_jax.report.command_line import main
from rfem_jax.simulation.solvers import catalogue
from tests.programs.conftest import PENDULUM

RK4 = PENDULUM.replace("duration = 0.5", "duration = 0.02\nsave_every = 1e-3").replace("rfes = 2", "rfes = 1")


@dataclass(frozen=True)
class Kutta3(FixedStep):
    """Kutta's method of order 3, its middle node anywhere.

    Args:
        middle: node of the second stage, as a share of the step.
    """

    middle: float = methods.setting(0.5)

    names: ClassVar[tuple[str, ...]] = ("kutta3",)


def make_kutta3(method):
    """The solver of the family of third order with nodes 0, c, 1."""
    c = method.middle
    last = (1.0 - c) / (c * (2.0 - 3.0 * c))
    weights = [(3.0 * c - 1.0) / (6.0 * c), 1.0 / (6.0 * c * (1.0 - c)), (2.0 - 3.0 * c) / (6.0 * (1.0 - c))]
    coefficients = diffrax.ButcherTableau(
        a_lower=(np.array([c]), np.array([1.0 - last, last])),
        b_sol=np.array(weights),
        b_error=np.zeros(3),
        c=np.array([c, 1.0]),
    )

    class Kutta3Solver(diffrax.AbstractERK):
        tableau: ClassVar = coefficients
        interpolation_cls: ClassVar = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

        def order(self, terms):
            return 3

    return Kutta3Solver()


@pytest.fixture
def registered(monkeypatch):
    """The method is known within the test; the settings of the process are left alone."""
    monkeypatch.setattr(methods, "METHOD_CLASSES", dict(methods.METHOD_CLASSES))
    monkeypatch.setattr(catalogue, "_MAKERS", dict(catalogue._MAKERS))
    monkeypatch.setattr(command_line, "set_up_jax", lambda *_: None)
    register_method(Kutta3, make_kutta3)


def run_study(folder, text):
    path, out = folder / "study.toml", folder / "out"
    path.write_text(text, encoding="utf-8")
    assert main(["run", str(path), "--out", str(out)]) == 0
    (case,) = json.loads((out / "results.json").read_text(encoding="utf-8"))["cases"].values()
    assert any(one.suffix == ".png" for one in out.iterdir())
    return case


@pytest.mark.long
def test_its_runs_have_results_and_pictures(registered, tmp_path):
    """The same loads as by the classical method of order 4, but not to the last digit."""
    own = RK4.replace('method = "rk4"', 'method = "kutta3"\nmiddle = 0.4')
    (tmp_path / "rk4").mkdir()
    case, expected = run_study(tmp_path, own), run_study(tmp_path / "rk4", RK4)
    assert case["status"] == "ok"
    force, other = case["joints"]["A"]["rms_force"], expected["joints"]["A"]["rms_force"]
    assert force == pytest.approx(other, rel=1e-6) and force != other


def test_its_step_is_checked_by_its_own_stability_function(registered, tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(RK4, encoding="utf-8")
    study = load_study(path)
    model = discretise(study.mechanism)
    limits = [check_step(model, named_method(name, step=1e-6), study.drive) for name in ("kutta3", "rk4")]
    # On the imaginary axis, that of undamped vibration: |R| <= 1 up to sqrt(3) and up to sqrt(8).
    assert limits[0] / limits[1] == pytest.approx(np.sqrt(3.0 / 8.0), rel=0.05)
    with pytest.raises(InputError, match=r"`step` must be at most .* 'kutta3'"):
        check_step(model, named_method("kutta3", step=1.01 * limits[0]), study.drive)


@pytest.mark.long
def test_its_derivatives_are_the_same_in_both_modes(registered, tmp_path):
    (tmp_path / "study.toml").write_text(RK4, encoding="utf-8")
    study = load_study(tmp_path / "study.toml")
    model = discretise(study.mechanism)
    simulation = Simulation(model, drive=study.drive, duration=1e-4, method=Kutta3(step=1e-5))

    def force(tilt):
        return simulate(simulation, assembly_errors(model, {"A.delta_x": tilt})).metrics.mean_square_force["A"]

    forward, reverse = jax.jacfwd(force)(0.1), jax.grad(force)(0.1)
    assert abs(float(forward)) > 0.0
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)


def test_its_settings_are_checked_like_all_others(registered, tmp_path):
    assert named_method("kutta3", step="1 us") == Kutta3(step=1e-6, middle=0.5)
    for settings, pieces in (
        ({"middle": -0.1}, "`middle` of the method must be greater than 0"),
        ({}, '`step` must be given for the method "kutta3"'),
        ({"step": 1e-5, "rtol": 1e-3}, '`rtol` must be left out with the method "kutta3"'),
    ):
        with pytest.raises(InputError, match=pieces):
            named_method("kutta3", **settings)
    with pytest.raises(InputError, match=r'`middle` must be left out with the method "rk4".*"kutta3"'):
        named_method("rk4", step=1e-5, middle=0.4)


def test_what_cannot_be_registered(registered):
    for kind, pieces in ((Kutta3, "reserved"), (int, "subclass of Method"), (Method, "subclass of Method")):
        with pytest.raises(InputError, match=pieces):
            register_method(kind, make_kutta3)


def test_without_registration_nobody_knows_it():
    with pytest.raises(InputError, match="`name` of the method must be one of"):
        named_method("kutta3", step=1e-5)


@pytest.mark.slow
def test_a_solver_of_the_user_needs_no_class_of_methods(registered, tmp_path):
    (tmp_path / "study.toml").write_text(RK4, encoding="utf-8")
    study = load_study(tmp_path / "study.toml")
    model, settings = discretise(study.mechanism), {"drive": study.drive, "duration": 0.005, "save_every": 1e-3}
    wanted = simulate(Simulation(model, method=Kutta3(step=1e-5, middle=0.4), **settings))
    found = simulate(
        Simulation(model, method=Explicit(make_kutta3(Kutta3(step=1.0, middle=0.4)), step=1e-5), **settings)
    )
    np.testing.assert_array_equal(found.metrics.rms_force["A"], wanted.metrics.rms_force["A"])
    assert found.status == 0
