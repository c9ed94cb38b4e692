"""Single precision is refused by its name, not blamed on what was being read."""

import jax
import pytest

from rfem_jax import InputError, Joint, Link, Mechanism, MomentRamp, Rectangle, discretise, load_study
from tests.mechanisms import STEEL as MATERIAL
from tests.study_texts import ROUND, STEEL, hinge, link

TEXT = f"""
[simulation]
duration = -1.0
step = 1e-3
{STEEL}{ROUND}{link("arm", 0.1)}{hinge("arm")}
[drive]
joint = "A"
kind = "moment_ramp"
moment = 1.0
rise_time = 0.1
"""


@pytest.fixture
def single_precision():
    jax.config.update("jax_enable_x64", False)
    yield
    jax.config.update("jax_enable_x64", True)


def of_a_file(folder):
    path = folder / "study.toml"
    path.write_text(TEXT, encoding="utf-8")
    return load_study(path)


def of_a_model(_):
    section = Rectangle(0.01, 0.01)
    return discretise(Mechanism([Link("arm", 0.1, section, MATERIAL, rigid=True)], [Joint("A", "base", "arm")]))


@pytest.mark.parametrize("make", [of_a_file, of_a_model, lambda _: MomentRamp("A", 1.0, 0.1)])
def test_single_precision_is_refused_by_its_name_alone(tmp_path, single_precision, make):
    with pytest.raises(InputError) as caught:
        make(tmp_path)
    (problem,) = caught.value.problems  # not even the duration's
    assert problem.startswith("Argument `jax_enable_x64` must be True") and "[drive]" not in problem
