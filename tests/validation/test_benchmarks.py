"""Those benchmarks that take seconds; `rfem-jax validate` computes all."""

import numpy as np
import pytest

from rfem_jax import assemble, assembly_errors, discretise
from rfem_jax.validation import (
    beam_tables,
    cantilevers,
    curved_beams,
    four_bar_study,
    large_deflections,
    rotating_beams,
    tilted_hinge,
)
from rfem_jax.validation.lines import NOT_MET, PASS
from rfem_jax.validation.reference_values import read_reference


def computed(run):
    seen = []
    outcome = run(False, seen.append)
    assert seen[-1] == pytest.approx(1.0) and seen == sorted(seen)
    return outcome.lines


def assert_all_pass(lines, count):
    assert len(lines) == count
    assert [line.name for line in lines if line.verdict != PASS] == []


def test_elastica():
    assert_all_pass(computed(large_deflections.elastica), 15)


def test_beams_of_a_handbook():
    """Loads borne and deflections to the last digit that is printed."""
    assert_all_pass(computed(beam_tables.validate), 16)


def test_thick_cantilever():
    assert_all_pass(computed(large_deflections.thick_cantilever), 3)


@pytest.mark.slow
def test_princeton_beam():
    """The rod equations are met.  The table is where it agrees with them; other deviations from it are explained."""
    lines = computed(large_deflections.princeton_beam)
    table = [line for line in lines if line.group.endswith("table")]
    assert len(table) == 28
    assert_all_pass([line for line in lines if line not in table], 24)
    missed = [line for line in table if line.verdict != PASS]
    assert len(missed) == 7 and all(line.verdict == NOT_MET for line in missed)
    assert all("chordwise" in line.name and line.difference > 0.0 for line in missed)


@pytest.mark.slow
def test_linear_elements_do_not_meet_the_elastica():
    """So that the lines above can fail: at P L^2 / E I = 1 the linear form bends 10 % too far."""
    stiff = large_deflections.RIGID
    model = cantilevers.clamped_beam(1.0, (stiff, stiff, stiff, stiff, 1.0, 1.0), 20, "linear")
    bent = cantilevers.bend(model, [0.0, 0.0, 1.0])
    reference = read_reference("elastica")
    assert reference["load"][0] == 1.0
    assert bent.tip[2] > 1.09 * reference["deflection"][0]
    # It hardly shortens: only by the rotation of the last rfe.
    assert -bent.tip[0] < 0.05 * reference["shortening"][0]


@pytest.mark.long
def test_curved_beams():
    assert_all_pass(computed(curved_beams.validate), 12)


@pytest.mark.slow
def test_cantilever():
    assert_all_pass(computed(cantilevers.validate), 15)


def test_law_and_closed_form_of_the_rotating_beams():
    first, second = rotating_beams.BEAMS
    assert first.extension() == pytest.approx(5.143e-4, rel=1e-4)
    times = np.arange(0.0, 20.0, 0.02)
    assert first.lag(times).max() == pytest.approx(read_reference("rotating_beams")["largest_lag"], abs=0.05)
    assert second.lag(times)[-100:] == pytest.approx(0.0, abs=0.02)


def test_initial_axes_of_the_tilted_hinge():
    assert_all_pass(tilted_hinge.axis_lines(), 2)


@pytest.mark.slow
def test_a_crooked_pin_stresses_nothing_at_the_start():
    model = discretise(tilted_hinge.mechanism(2))
    for error in ("C.pin_tilt_x", "C.pin_tilt_z"):
        result = assemble(model, assembly_errors(model, {error: tilted_hinge.TILT}))
        assert result.status == 0
        for load in result.preload.values():
            assert np.abs(load.force).max() < 1e-6 and np.abs(load.moment).max() < 1e-8


def test_the_study_is_the_study_file():
    from pathlib import Path

    from rfem_jax import load_study

    path = Path(__file__).parents[2] / "studies" / "four_bar" / "study.toml"
    ours, specified = four_bar_study.study(), load_study(path)
    assert ours.mechanism == specified.mechanism and ours.method == specified.method
    assert ours.cases == specified.cases[:2]
    assert (ours.duration, ours.save_every) == (specified.duration, specified.save_every)
