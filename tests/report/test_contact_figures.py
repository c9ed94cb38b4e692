"""Orbits of pins in their bushes, columns of contacts, and which contacts carry in runs and turns."""

import csv
import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import Clearance, discretise
from rfem_jax.mechanics import Load
from rfem_jax.mechanics.forces.bush_contacts import ContactState
from rfem_jax.report.analyses.turn_report import turn_figure, turn_text, write_turn
from rfem_jax.report.contents.files import contact_columns
from rfem_jax.report.contents.summary import summarise, summarise_run
from rfem_jax.report.contents.tables import results_text
from rfem_jax.report.drawings.contact_figures import orbit_figures
from rfem_jax.simulation import Turn

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
    return SimpleNamespace(status=0, contacts=contacts)


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
    columns = contact_columns({"D": history()})
    assert list(columns) == [
        *(f"D_penetration_{name}_m" for name in ("start", "end", "axial")),
        *(f"D_contact_force_{name}_N" for name in ("start", "end", "axial")),
    ]
    np.testing.assert_allclose(columns["D_penetration_end_m"], 1e-5)
    np.testing.assert_allclose(columns["D_contact_force_end_N"], 10.0)
    assert not contact_columns({})


def test_results_tell_how_the_contacts_of_a_pin_carry(study):
    run: Any = synthetic_run(0.0)
    assert "contacts" not in summarise_run(study, run)
    run.contacts, run.contact_losses, run.contact_changes = {"D": history()}, {"D": np.array([0.0, 0.25])}, 6.0
    assert summarise_run(study, run)["contact_changes"] == 6
    found = summarise_run(study, run)["contacts"]
    assert found == {
        "D": {
            "carrying_at_start": ["end"],
            "largest_penetration": pytest.approx(1e-5),
            "largest_contact_force": pytest.approx(10.0),
            "carrying_share": {"start": 0.0, "end": 1.0, "axial": 0.0},
            "contact_loss": 0.25,
        }
    }


def test_a_turn_tells_which_contacts_carry_where_and_which_pins_float(study, tmp_path):
    """The second end carries but at the last position, where the pin floats; the first position is not assembled."""
    cases, positions = len(study.cases), np.linspace(0.0, np.pi, 9)
    contacts = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), (cases, *x.shape)), history())
    depth: Any = np.array(contacts.penetration)
    depth[:, -1, 1], depth[:, 4, 1] = -1e-6, 2e-5
    contacts = contacts._replace(penetration=depth, normal_force=1e6 * np.maximum(depth, 0.0))
    zero, status = np.zeros((cases, 9)), np.zeros((cases, 9), int)
    status[:, 0] = 1
    ones: Any = np.ones((cases, 9, 3))
    loads = {joint.name: Load(ones, ones) for joint in study.mechanism.joints}
    parts: Any = zero + positions, loads, zero, zero, {}, status, {"D": contacts}
    turn: Any = Turn(*parts)
    model = discretise(study.mechanism)
    write_turn(tmp_path, study, model, turn)
    content = json.loads((tmp_path / "turn.json").read_text(encoding="utf-8"))
    found = content["cases"][study.cases[0].name]["contacts"]["D"]
    assert found["carrying_share"] == {"start": 0.0, "end": 7 / 8, "axial": 0.0} and found["floating_share"] == 1 / 8
    assert found["largest_contact_force"] == pytest.approx(20.0)
    assert found["largest_contact_force_at"] == found["largest_penetration_at"] == pytest.approx(np.pi / 2)
    assert content["units"]["largest_contact_force"] == "N"
    rows = list(csv.DictReader((tmp_path / "turn.csv").read_text(encoding="utf-8").splitlines()))
    assert [row["D_carrying"] for row in rows[1:9]] == ["end"] * 7 + ["none"]
    assert float(rows[4]["D_penetration_end_m"]) == 2e-5 and float(rows[4]["D_contact_force_end_N"]) == 20.0
    text = turn_text(study, model, turn)
    assert "88 %" in text and "The pin floats" in text and text.count("at positions of: D.") == cases
    figure = turn_figure(study, model, turn)
    (axes,) = [axes for axes in figure.axes if axes.get_ylabel() == "contact force, N"][:1]
    np.testing.assert_allclose(np.asarray(axes.lines[1].get_ydata())[1:], [10.0] * 3 + [20.0] + [10.0] * 3 + [0.0])


def test_the_printed_results_name_pins_that_float_at_the_start(study):
    runs: Any = {case.name: synthetic_run(float(number)) for number, case in enumerate(study.cases)}
    statuses = dict.fromkeys(runs, ("ok", ""))
    assert "Contacts of joints" not in results_text(study, summarise(study, runs, statuses))
    floating = history()
    floating = floating._replace(penetration=floating.penetration.at[0, 1].set(-1e-6))
    for run in runs.values():
        run.contacts = {"D": history(), "B": floating}
        run.contact_losses = dict.fromkeys(run.contacts, np.zeros(2))
    text = results_text(study, summarise(study, runs, statuses))
    assert "Contacts of joints with clearance" in text and "89 %" in text
    names = ", ".join(f"B (case {case.name})" for case in study.cases)
    assert f"held by nothing but their weak spring: {names}." in text
