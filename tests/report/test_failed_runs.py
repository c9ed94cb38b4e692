"""Runs that diverged leave infinite and enormous numbers: these are shown as missing, and nothing warns of them (every
warning of NumPy is an error here)."""

import json
from collections import namedtuple
from types import SimpleNamespace

import numpy as np
import pytest

from rfem_jax import STATUS
from rfem_jax.report.contents.files import write_files
from rfem_jax.report.contents.summary import readable, summarise
from rfem_jax.report.contents.tables import results_text
from rfem_jax.report.drawings.figures import write_figures
from rfem_jax.report.page.animation import quaternions_of, write_arrays
from rfem_jax.report.page.document import write_folder

from .conftest import synthetic_run
from .page_folder import animation, content_of

DIVERGED = next(number for number, one in enumerate(STATUS) if one.name == "diverged")


def as_tree(value):
    """Parts of a synthetic run as trees of JAX, which those of a run are."""
    if isinstance(value, SimpleNamespace):
        parts = {name: as_tree(part) for name, part in vars(value).items()}
        return namedtuple("Part", parts)(**parts)
    return {name: as_tree(part) for name, part in value.items()} if isinstance(value, dict) else value


def run_away(value, number):
    """A run in whose second half, and in whose results, all numbers have gone."""
    if isinstance(value, SimpleNamespace):
        return SimpleNamespace(**{name: run_away(part, number) for name, part in vars(value).items()})
    if isinstance(value, dict):
        return {name: run_away(part, number) for name, part in value.items()}
    if isinstance(value, float):
        return number
    if not np.ndim(value):
        return value
    found = np.array(value, float)
    found[len(found) // 2 :: 2], found[len(found) // 2 + 1 :: 2] = number, -number
    return found


@pytest.mark.long
@pytest.mark.parametrize("number", [np.inf, 1e200, 1.7e308])
def test_a_run_that_diverged_is_reported_without_a_warning(study, runs, statuses, tmp_path, number):
    away = run_away(synthetic_run(2.0), number)
    away.times, away.status = runs["P2"].times, np.asarray(DIVERGED)
    runs = runs | {"P2": readable(SimpleNamespace(**{name: as_tree(part) for name, part in vars(away).items()}))}
    statuses["P2"] = ("diverged", "The run diverged; reduce the step.")
    summaries = summarise(study, runs, statuses)
    assert "P2*" in results_text(study, summaries)
    write_files(tmp_path, study, runs, summaries)
    write_figures(tmp_path, study, runs, summaries)
    case = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["cases"]["P2"]
    assert case["joints"]["A"]["rms_force"] is None and case["driven_joint"]["rate_end"] is None


def test_a_run_that_is_complete_stays_as_it_is(runs):
    assert readable(runs["P1"]) is runs["P1"]
    failed = SimpleNamespace(status=DIVERGED, model=np.inf, errors=np.inf, branch=np.array([1, -1]), x=np.array([1e20]))
    shown = readable(failed)
    assert (shown.model, shown.errors, shown.branch.dtype) == (np.inf, np.inf, failed.branch.dtype)
    np.testing.assert_array_equal(shown.x, failed.x)


@pytest.mark.parametrize("number", [np.inf, 1e200, np.nan])
def test_a_page_of_such_a_file_is_written(study, runs, statuses, tmp_path, number):
    write_files(tmp_path, study, runs, summarise(study, runs, statuses))
    description, cases = animation(study, runs)
    away = {part: np.array(values) for part, values in cases[1].items()}
    for part, values in away.items():
        if part != "times":
            values[1:] = number
    write_arrays(tmp_path, description, [cases[0], away, cases[2]])
    assert content_of(write_folder(tmp_path))["animation"]["motions"][1]["nominal"]["scale"] < 10.0
    assert np.isnan(quaternions_of(np.full((1, 3, 3), number))).all()
