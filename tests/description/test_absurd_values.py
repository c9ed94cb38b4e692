"""Numbers that no mechanism has and studies that cannot end are refused where they are read, each in one sentence."""

from pathlib import Path

import pytest

from rfem_jax import InputError, load_study
from rfem_jax.description import nearest

TEXT = (Path(__file__).parents[2] / "studies" / "four_bar" / "study.toml").read_text(encoding="utf-8")
MONTE_CARLO = """
[tolerances]
"D.delta_x" = "0.2 deg"
[monte_carlo]
n = 16
metrics = ["D.rms_moment"]
"""
DIGITS = 400 * "9"


def changed(old, new, text=TEXT):
    assert old in text
    return text.replace(old, new, 1)


@pytest.fixture
def refuse(tmp_path, refused):
    """The text as a study file must be refused with all pieces."""

    def check(text, *pieces):
        file = tmp_path / "study.toml"
        file.write_text(text, encoding="utf-8")
        with refused(*pieces):
            load_study(file)

    return check


@pytest.mark.parametrize(
    ("old", "new", "pieces"),
    [
        ('"210 GPa"', "1e300", ("`youngs_modulus`", "1e+20 Pa")),
        ('"210 GPa"', "1e-300", ("`youngs_modulus`", "smaller")),
        ('"210 GPa"', DIGITS, ("`youngs_modulus`", "double precision", "400 characters")),
        ('"10 mm" ', "1e300", ("`width`", "1e+09 m")),
        ('"10 mm" ', "1e-300", ("`width`", "smaller")),
        ("7850.0", "1e300", ("`density`",)),
        ("7850.0", "1e-300", ("`density`",)),
        ("damping = 1e-5", "damping = 1e300", ("`damping`",)),
        ("poisson_ratio = 0.3", "poisson_ratio = 1e300", ("`poisson_ratio`", "larger than 1e+50, but")),
        ("rfes = 5", f"rfes = {DIGITS}", ("`rfes`", "at most 1000", "400 characters")),
        ("rfes = 5", "rfes = 1000000", ("`rfes`", "at most 1000")),
        ("step = 1e-5", "step = 1e-15", ("`duration`", "5e+14 steps")),
        ("duration = 0.5", "duration = 1e9", ("`duration`", "1e+14 steps")),
        ("step = 1e-5\nsave_every = 1e-3", "step = 1e-8\nsave_every = 1e-8", ("`save_every`", "5e+07 intervals")),
        ('"rk4"', '"euler"', ("`name`", "'euler'")),
        ('name = "P5"', f'name = "{300 * "P"}"', ("`name`", "at most 100 characters", "has 300")),
        ('"D.delta_x" = "0.5 deg"', '"D.delta_x" = "91 deg"', ("case `P2`", "right angle", "1.588")),
        ('"D.d_y" = "0.5 mm"', '"D.d_y" = 0.31', ("case `P4`", "longest link", "0.31 m")),
        ('"D.d_y" = "0.5 mm"', '"crank.length" = -0.12', ("case `P4`", "`crank.length` greater than 0", "0.12 m")),
        ('"D.d_y" = "0.5 mm"', '"bar.height" = "-11 mm"', ("case `P4`", "`bar.height` greater than 0", "-0.011 m")),
        ('"D.d_y" = "0.5 mm"', '"steel.damping" = "-1 s"', ("case `P4`", "`steel.damping` at least 0", "-1 s")),
        ("title = ", f"title = {5000 * '['}{5000 * ']'} #", ("brackets",)),
    ],
)
def test_what_no_mechanism_has(old, new, pieces, refuse):
    refuse(changed(old, new), *pieces)


@pytest.mark.parametrize(
    ("old", "new", "pieces"),
    [
        ("n = 16", "n = 1", ("`n`", "at least 2")),
        ("n = 16", "n = 1000000000000", ("`n`", "at most 100000000")),
        ("n = 16", "n = 16\nbatch = 10000000", ("`batch`", "at most 100000")),
        ("n = 16", 'n = 16\nlimits = { "D.rms_moment" = -1.0 }', ("`limits`", "never negative", "-1.0")),
        ("n = 16", f'n = 16\nlimits = {{ "D.rms_moment" = {DIGITS} }}', ("`limits`", "400 characters")),
        ('"0.2 deg"', "2.0", ("`tolerances`", "right angle", "`D.delta_x`")),
        ('"D.delta_x" = "0.2 deg"', '"D.d_x" = { interval = [-1.0, 0.0] }', ("`tolerances`", "`D.d_x` has 1 m")),
    ],
)
def test_what_no_task_can_mean(old, new, pieces, refuse):
    refuse(changed(old, new, TEXT + MONTE_CARLO), *pieces)


def test_the_study_itself_and_open_limits_are_taken(tmp_path):
    file = tmp_path / "study.toml"
    limits = 'limits = { "D.rms_moment" = [-inf, 1.0], "A.rms_force" = [1.0, inf], end_energy = -1.0 }'
    file.write_text(TEXT + MONTE_CARLO + limits, encoding="utf-8")
    assert len(load_study(file).tasks.monte_carlo.limits) == 3


def test_a_mark_of_byte_order_is_no_content(tmp_path):
    file = tmp_path / "study.toml"
    file.write_bytes(b"\xef\xbb\xbf" + TEXT.encode())
    assert load_study(file).title == "Steel four-bar with assembly errors at joint D"


@pytest.mark.parametrize(
    ("name", "known", "expected"),
    [
        ("friction", ["orientation", "position"], None),
        ("damping", ["angle", "name"], None),
        ("other", ["note", "title"], None),
        ("rk5", ["leapfrog", "rk4"], "rk4"),
        ("legnth", ["length", "section"], "length"),
        ("hight", ["width", "height"], "height"),
    ],
)
def test_only_what_is_near_is_suggested(name, known, expected):
    assert nearest(name, known) == expected


def test_a_traced_number_is_no_large_one():
    import jax

    from rfem_jax import Bearing

    with pytest.raises(InputError, match="known before compilation"):
        jax.jit(lambda x: Bearing(dynamic_capacity=x).dynamic_capacity)(1e3)
