"""A drive acts on the model's driven joint; every other one is refused where it is given."""

from dataclasses import replace

import pytest

from rfem_jax import (
    Automatic,
    GeneralisedAlpha,
    InputError,
    MomentRamp,
    PrescribedRate,
    RungeKutta4,
    Simulation,
    Study,
    check_step,
    choose_method,
    discretise,
    run_cases,
    simulate,
)
from rfem_jax.simulation.system.driving import require_driven
from tests.mechanisms import four_bar

EXPLICIT, IMPLICIT = RungeKutta4(step=1e-5), GeneralisedAlpha(step=1e-3)


@pytest.fixture(scope="module")
def models():
    """The same four-bar driven in A, and not driven."""
    return {"A": discretise(four_bar()), None: discretise(replace(four_bar(), driven_joint=None))}


@pytest.mark.parametrize("method", [EXPLICIT, IMPLICIT], ids=lambda method: method.name)
@pytest.mark.parametrize("drive", [MomentRamp("D", 1.5, 0.1), PrescribedRate("D", 2.0)], ids=["moment", "motion"])
@pytest.mark.parametrize(("driven", "found"), [(None, "no joint of the model is driven"), ("A", "that is `A`")])
def test_a_drive_of_another_joint_is_refused(models, driven, found, drive, method):
    with pytest.raises(InputError, match=f"acts on `D` and {found}.*driven_joint='D'"):
        simulate(Simulation(models[driven], drive=drive, duration=0.01, method=method))


def test_so_it_is_where_a_step_is_chosen_or_checked(models):
    drive = MomentRamp("D", 1.5, 0.1)
    with pytest.raises(InputError, match="acts on `D`"):
        choose_method(models["A"], Automatic(), drive, 0.1)
    with pytest.raises(InputError, match="acts on `D`"):
        check_step(models["A"], EXPLICIT, drive)


def test_a_drive_of_no_joint_of_the_tree_is_refused(models):
    for joint in ("C", "a"):
        with pytest.raises(InputError, match=f"must act on a joint of the tree, but acts on `{joint}`"):
            require_driven(models["A"], MomentRamp(joint, 1.5, 0.1))


def test_a_study_runs_on_models_driven_in_its_joint_only(models):
    study = Study("moment on A", four_bar(), MomentRamp("A", 1.5, 0.1), 0.1, IMPLICIT)
    with pytest.raises(InputError, match="no joint of the model is driven"):
        run_cases(study, model=models[None])


def test_the_driven_joint_or_no_drive_pass(models):
    require_driven(models["A"], PrescribedRate("A", 2.0))
    for model in models.values():
        require_driven(model, None)
