"""Methods: names, settings that fit, refusals."""

import copy
import inspect
import pickle
from dataclasses import replace

import diffrax
import pytest

from rfem_jax import Automatic, Explicit, GeneralisedAlpha, InputError, Leapfrog, Method, RungeKutta4, description
from rfem_jax.description import FixedStep
from rfem_jax.description.methods import METHOD_CLASSES, named_method


@pytest.mark.parametrize("name", Explicit.names)
def test_adaptive_methods_are_explicit_solvers_of_diffrax_with_an_error_estimate(name):
    (solver,) = [kind for key, kind in vars(diffrax).items() if key.lower() == name]
    assert issubclass(solver, diffrax.AbstractAdaptiveSolver)
    assert not issubclass(solver, diffrax.AbstractImplicitSolver)
    adaptive = Explicit(name, rtol=1e-8, atol="1e-8 %")
    assert adaptive.adaptive and adaptive.atol == pytest.approx(1e-10)
    assert not Explicit(name, step=1e-5).adaptive
    assert Explicit(solver(), step=1e-5) == Explicit(name, step=1e-5) == Explicit(solver=name, step=1e-5)


def test_fixed_methods():
    assert RungeKutta4(step="10 us").step == 1e-5
    assert Leapfrog(step=1e-6, stabilisation=0).stabilisation == 0.0
    assert Automatic(accuracy=1e-4).accuracy == 1e-4
    assert Automatic().accuracy is None


def test_no_other_name_is_known(refused):
    for name in METHOD_CLASSES:
        with refused("`name` of the method", f"`{name}`?"):
            named_method(name + "x", step=1e-5)
    with refused("`name` of the method"):
        named_method(4, step=1e-5)


@pytest.mark.parametrize(
    ("settings", "pieces"),
    [
        ({}, ("`step`", '"rk4"', "missing")),
        ({"name": "leapfrog"}, ("`step`", "missing")),
        ({"name": "euler", "step": 1e-5}, ("`name`", "rk4", "was 'euler'")),
        ({"step": 0.0}, ("`step`", "greater than 0")),
        ({"step": "1 mm"}, ("`step`", "time")),
        ({"step": 1e-5, "rtol": 1e-8}, ("`rtol`", "left out")),
        ({"step": 1e-5, "accuracy": 1e-3}, ("`accuracy`", '"auto"')),
        ({"step": 1e-5, "stabilisation": -1}, ("`stabilisation`", "negative")),
        ({"name": "dopri8"}, ("`rtol`", "`atol`")),
        ({"name": "dopri8", "rtol": 1e-8}, ("`atol`",)),
        ({"name": "dopri8", "rtol": 1e-8, "atol": 0}, ("`atol`", "greater than 0")),
        ({"name": "dopri8", "rtol": -1, "atol": 1e-8}, ("`rtol`", "greater than 0")),
        ({"name": "dopri8", "rtol": 1e-8, "atol": 1e-8, "step": 1e-5}, ("both are",)),
        ({"name": "auto", "step": 1e-5}, ("`step`", "left out")),
        ({"name": "auto", "rtol": 1e-5}, ("`rtol`", "left out")),
        ({"name": "auto", "accuracy": 2.0}, ("`accuracy`", "less than 1")),
        ({"name": "auto", "accuracy": 0.0}, ("`accuracy`", "greater than 0")),
    ],
)
def test_settings_that_do_not_fit_are_refused(refused, settings, pieces):
    with refused(*pieces):
        named_method(**settings)


@pytest.mark.parametrize(
    ("settings", "pieces"),
    [
        ({"spectral_radius": 1.0}, ("`spectral_radius`", "less than 1", "oscillate")),
        ({"spectral_radius": -0.1}, ("`spectral_radius`", "negative")),
        ({"tolerance": 1.0}, ("`tolerance`", "less than 1")),
        ({"corrections": 2.5}, ("`corrections`", "whole number", "2.5")),
        ({"corrections": "4"}, ("`corrections`", "whole number")),
        ({"corrections": True}, ("`corrections`", "whole number")),
        ({"stabilisation": 0.1}, ("`stabilisation`", "left out", '"rk4"')),
        ({"rtol": 1e-8}, ("`rtol`", "left out", '"dopri8"')),
        ({"name": "rk4", "tolerance": 1e-8}, ("`tolerance`", "left out", '"generalised_alpha"')),
    ],
)
def test_settings_of_the_implicit_method(refused, settings, pieces):
    with refused(*pieces):
        named_method(**{"name": "generalised_alpha", "step": 1e-3, **settings})


def test_defaults_belong_to_the_implicit_method_alone():
    implicit = GeneralisedAlpha(step=1e-3, corrections=4.0)
    assert (implicit.spectral_radius, implicit.corrections, implicit.tolerance) == (0.6, 4, 1e-8)
    assert isinstance(implicit.corrections, int) and implicit.implicit
    assert not hasattr(RungeKutta4(step=1e-3), "spectral_radius")


@pytest.mark.parametrize("name", METHOD_CLASSES)
def test_a_method_is_of_the_class_that_has_its_name(name):
    method = named_method(name, **({"step": 1e-3} if name != "auto" else {}))
    kind = METHOD_CLASSES[name]
    assert type(method) is kind and method.name == name and isinstance(method, Method)
    assert method == copy.copy(method) == pickle.loads(pickle.dumps(method)) == replace(method)
    assert hash(method) == hash(replace(method))


def test_names_of_arguments_that_are_wrong_are_told_in_a_sentence(refused):
    assert repr(Automatic(accuracy=1e-3)) == "Automatic(stabilisation=None, accuracy=0.001)"
    with refused("`solver`", "missing"):
        Explicit()
    with refused("`rtol`", "less than 1"):
        Explicit("dopri5", rtol=2.0, atol=1.0)
    with refused("`stepp`", "RungeKutta4", "did you mean `step`?"):
        RungeKutta4(stepp=1e-5)
    with refused("`rtol`", "GeneralisedAlpha", "spectral_radius"):
        GeneralisedAlpha(step=1e-3, rtol=1e-6)
    with refused("by their names", "0.001", "step="):
        GeneralisedAlpha(1e-3)
    with refused("`solver`", "tsit5"):
        Explicit("rk45", rtol=1e-6, atol=1e-8)
    with refused("`solver`", "Runge-Kutta", "Kvaerno5", "diffrax.Dopri8()"):
        Explicit(diffrax.Kvaerno5(), rtol=1e-6, atol=1e-8)


def test_a_solver_of_the_user_stays_as_it_is():
    class Third(diffrax.Bosh3):
        pass

    method = Explicit(Third(), step=1e-4)
    assert type(method.solver) is Third and method.name == "third"
    kept = Explicit(diffrax.Dopri5(scan_kind="lax"), step=1e-4)
    assert kept.solver == diffrax.Dopri5(scan_kind="lax") and kept.name == "dopri5"
    assert replace(method, step=1e-5).solver is method.solver


def test_calls_and_names_of_the_version_before_work_and_warn():
    with pytest.warns(DeprecationWarning, match=r"RungeKutta4\(...\) in place of Method"):
        assert Method("rk4", step=1e-5) == RungeKutta4(step=1e-5)
    with pytest.warns(DeprecationWarning, match="Explicit"):
        assert Method("dopri8", rtol=1e-8, atol=1e-9) == Explicit("dopri8", rtol=1e-8, atol=1e-9)
    with pytest.warns(DeprecationWarning, match=r"Leapfrog\(...\)"):
        assert FixedStep("leapfrog", step=1e-5) == Leapfrog(step=1e-5)
    for before, now in (("AutomaticMethod", Automatic), ("DiffraxMethod", Explicit), ("FixedStepMethod", FixedStep),
                        ("GeneralisedAlphaMethod", GeneralisedAlpha)):  # fmt: skip
        with pytest.warns(DeprecationWarning, match=now.__name__):
            assert getattr(description, before) is now
    assert not hasattr(description, "EulerMethod")


def test_signatures_are_those_of_the_settings():
    assert [*inspect.signature(RungeKutta4).parameters] == ["step", "stabilisation"]
    assert [*inspect.signature(Explicit).parameters] == ["solver", "step", "stabilisation", "rtol", "atol"]


def test_all_mistakes_are_told_at_once():
    with pytest.raises(InputError) as caught:
        GeneralisedAlpha(step=-1.0, tolerance=2.0, corrections=0)
    assert [problem.split("`")[1] for problem in caught.value.problems] == ["step", "corrections", "tolerance"]
    with pytest.raises(InputError) as caught:
        named_method("rk4", step=1e-5, rtol=1e-3, accuracy=1e-3)
    assert [problem.split("`")[1] for problem in caught.value.problems] == ["rtol", "accuracy"]
