"""Orbits of pins in their bushes, and columns of contacts."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import Clearance
from rfem_jax.mechanics.bush_contacts import ContactState
from rfem_jax.report.contact_figures import orbit_figures
from rfem_jax.report.files import contact_columns
from rfem_jax.report.summary import summarise_run

from .conftest import synthetic_run

PLAY = Clearance(radial="0.1 mm", length=0.02, stiffness=1e9)


def history():
    """One turn of both ends around their bush, the second one pressed in."""
    angles = np.linspace(0.0, 2.0 * np.pi, 9)
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    eccentricity = np.stack([0.5e-4 * around, 1.1e-4 * around], axis=1)
    depth = np.stack([-0.5e-4 + 0.0 * angles, 1e-5 + 0.0 * angles, -1e-3 + 0.0 * angles], axis=1)
    parts = eccentricity, 0.0 * angles, depth, np.maximum(depth, 0.0) * 1e6, 0.0 * depth
    return ContactState(*(jnp.asarray(part) for part in parts))


def run_with(contacts) -> Any:
    return SimpleNamespace(contacts=contacts)


def test_a_pin_moves_within_the_circle_of_its_clearance(study):
    joints = [replace(j, clearance=PLAY if j.name == "D" else None) for j in study.mechanism.joints]
    made = replace(study, mechanism=replace(study.mechanism, joints=joints))
    runs = {case.name: run_with({"D": history()}) for case in study.cases}
    figures = orbit_figures(made, runs)
    assert list(figures) == ["orbit_D"]
    for axes, radius in zip(figures["orbit_D"].axes, (0.05, 0.11), strict=True):
        circle, *orbits = axes.lines
        np.testing.assert_allclose(np.hypot(*circle.get_data()), 0.1)
        assert len(orbits) == len(study.cases)
        np.testing.assert_allclose(np.hypot(*orbits[0].get_data()), radius)
        assert axes.get_xlabel().endswith("mm")
    assert not orbit_figures(study, runs)


def test_columns_of_contacts():
    columns = contact_columns(run_with({"D": history()}))
    assert list(columns) == [
        *(f"D_penetration_{name}_m" for name in ("start", "end", "axial")),
        *(f"D_contact_force_{name}_N" for name in ("start", "end", "axial")),
    ]
    np.testing.assert_allclose(columns["D_penetration_end_m"], 1e-5)
    np.testing.assert_allclose(columns["D_contact_force_end_N"], 10.0)
    assert not contact_columns(run_with({}))


def test_results_tell_how_the_contacts_of_a_pin_carry(study):
    run: Any = synthetic_run(0.0)
    assert "contacts" not in summarise_run(study, run)
    run.contacts = {"D": history()}
    found = summarise_run(study, run)["contacts"]
    assert found == {
        "D": {
            "largest_penetration": pytest.approx(1e-5),
            "largest_contact_force": pytest.approx(10.0),
            "carrying_share": {"start": 0.0, "end": 1.0, "axial": 0.0},
        }
    }
