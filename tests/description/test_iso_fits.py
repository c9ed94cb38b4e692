"""ISO limits and fits against published limits, and the table of grades against the formulas of the standard."""

import json
from pathlib import Path

import numpy as np
import pytest

import rfem_jax.description
from rfem_jax.description.basics.iso_fits import deviations, fit

# Limits in micrometres as machinists' tables print them (ISO 286-2).
PUBLISHED = {
    "25 H7": (0, 21),
    "25 g6": (-20, -7),
    "25 K7": (-15, 6),
    "25 N7": (-28, -7),
    "25 P7": (-35, -14),
    "25 N9": (-52, 0),
    "25 JS7": (-10.5, 10.5),
    "25 F8": (20, 53),
    "25 E9": (40, 92),
    "25 D10": (65, 149),
    "25 G7": (7, 28),
    "25 k6": (2, 15),
    "25 k8": (0, 33),
    "25 n6": (15, 28),
    "25 p6": (22, 35),
    "25 js6": (-6.5, 6.5),
    "25 h9": (-52, 0),
    "25 f7": (-41, -20),
    "25 e8": (-73, -40),
    "25 d9": (-117, -65),
    "3 N7": (-14, -4),
    "3 K7": (-10, 0),
    "3 P9": (-31, -6),
    "30 H6": (0, 13),
    "30.5 H6": (0, 16),
    "100 H8": (0, 54),
    "100 P7": (-59, -24),
    "100 P8": (-91, -37),
    "500 H11": (0, 400),
    "500 d12": (-860, -230),
    "8 K6": (-7, 2),
}


@pytest.mark.parametrize("code", PUBLISHED)
def test_limits_are_those_of_published_tables(code):
    np.testing.assert_allclose(np.array(deviations(code)) * 1e6, PUBLISHED[code], atol=1e-9)


def test_clearance_of_a_fit():
    found = fit("25 H7/g6")
    assert found.size == pytest.approx(0.025)
    np.testing.assert_allclose(np.array(found.clearance) * 1e6, (7, 41))
    np.testing.assert_allclose(np.array(fit("25 mm H7/p6").clearance) * 1e6, (-35, -1))


def test_grades_follow_the_formulas_of_the_standard():
    """i = 0.45 D^(1/3) + 0.001 D um, D [mm] the geometric mean of the range; IT5 to IT12 = 7 i, 10 i, ... 160 i."""
    path = Path(rfem_jax.description.__file__).parent / "basics" / "iso_286.json"
    table = json.loads(path.read_text(encoding="utf-8"))
    ends = np.array([1.0, *table["up_to_mm"]])
    mean = np.sqrt(ends[1:] * ends[:-1])
    unit = 0.45 * np.cbrt(mean) + 0.001 * mean
    for grade, factor in zip(range(5, 13), (7, 10, 16, 25, 40, 64, 100, 160), strict=True):
        width = np.array(table["grades_um"][str(grade)], dtype=float)
        # The standard rounds to even numbers, and raises the smallest sizes.
        assert np.all(np.abs(width - factor * unit)[1:] <= np.maximum(0.045 * width, 1.0)[1:]), grade
        assert abs(width[0] - factor * unit[0]) <= 0.14 * width[0]


def test_codes_that_are_none_are_refused(refused):
    for code, pieces in (
        ("25H7", ("size in mm", "'25H7'")),
        ("25 M7", ("`M7`", "JS")),
        ("25 H4", ("`H4`", "grades 5 to 12")),
        ("600 H7", ("up to 500 mm",)),
        ("25 K9", ("K9 over 3 mm",)),
        ("25 H7/g6", ("is a fit",)),
        (25, ("size in mm",)),
    ):
        with refused("`iso`", *pieces):
            deviations(code, "iso")
    for code in ("25 H7", "25 h7/G6", "25 H7/H6"):
        with refused("`fit`", "a hole and a shaft"):
            fit(code, "fit")
