"""Which name a user may have meant: shared words and their meanings before letters."""

import pytest

from rfem_jax import InputError
from rfem_jax.description.basics.errors import nearest
from rfem_jax.description.metrics.catalogue import known_names
from rfem_jax.description.tolerances.tolerances import read_tolerances


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("A.maximum_force", "A.max_force"),  # by letters too
        ("A.largest_moment", "A.max_moment"),  # by letters A.rms_moment
        ("A.peak_torque", "A.peak_moment"),  # by letters A.peak_force
        ("A.mean_force", "A.rms_force"),
        ("A.life", "A.bearing_life"),
        ("A.weight", "A.mass"),
        ("max_power", "peak_drive_power"),
        ("A.max_forse", "A.max_force"),
        ("A.normal_force", "A.max_normal_force"),
        ("energy", "end_energy"),
        ("A.colour", None),
    ],
)
def test_metrics(written, meant):
    assert nearest(written, known_names("A")) == meant


@pytest.mark.parametrize(
    ("written", "known", "meant"),
    [
        ("legnth", ("width", "length"), "length"),
        ("rk5", ("rk4", "dopri5"), "rk4"),
        ("other", ("note", "title"), None),
        ("tilt_x", ("delta_x", "delta_z", "pin_tilt_x"), "delta_x"),
        ("offset_z", ("d_x", "d_z", "delta_z"), "d_z"),
        ("concentricity", ("position", "coaxiality"), "coaxiality"),
        ("x", ("y", "z"), None),
        ("", ("y",), None),
    ],
)
def test_other_names(written, known, meant):
    assert nearest(written, known) == meant


def test_a_zone_that_does_not_exist_is_answered_with_those_that_do():
    for written, words in (
        ("D.flatness", "known are `position`, `coaxiality`, `parallelism`, `perpendicularity`, "),
        ("D.squareness", "did you mean `perpendicularity`?"),
        ("D.tilt_x", "did you mean `delta_x`?"),
    ):
        with pytest.raises(InputError) as caught:
            read_tolerances({written: 1e-4})
        assert words in caught.value.problems[0]
