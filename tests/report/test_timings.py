"""The time that a task will take: what is known of it, by what it took before."""

import dataclasses

import pytest

from rfem_jax import load_study
from rfem_jax.compilation import keeping
from rfem_jax.description.tasks import Tasks
from rfem_jax.report.commands import steps
from rfem_jax.report.terminal import timings

from .conftest import STUDY
from .test_tasks import TASKS


@pytest.fixture
def study(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(STUDY + TASKS, encoding="utf-8")
    return load_study(path)


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Timings are kept in a folder of the test."""
    monkeypatch.setattr(keeping, "wanted", lambda: True)
    monkeypatch.setattr(timings, "user_cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache" / "timings.json"


def test_what_is_told_follows_what_was_measured(study, kept, monkeypatch):
    key = timings.key_of(study, "monte_carlo")
    assert timings.estimate(key, 32) is None
    assert "is not known before" in timings.estimate_text("Monte Carlo", key, 32)
    timings.record(key, 50.0, 32, compiled=True)
    assert timings.estimate(key, 32) == (50.0, "at most, as last time, which included compilation")
    timings.record(key, 16.0, 32, compiled=False)
    assert timings.estimate(key, 320)[0] == pytest.approx(160.0)
    assert "Monte Carlo; about 3 min as last time on this machine;" in timings.estimate_text("Monte Carlo", key, 320)
    monkeypatch.setattr(timings, "_surroundings", lambda: "another version")
    assert timings.estimate(key, 32) == (50.0, "as when it was compiled last")
    kept.write_text('{"a": 3}', encoding="utf-8")
    assert timings.estimate(key, 32) is None


def test_keys_tell_studies_apart_but_not_numbers_of_samples(study):
    more = dataclasses.replace(study.tasks.monte_carlo, n=64)
    tasks = dict(study.tasks.asked)
    grown = dataclasses.replace(study, tasks=Tasks(study.tasks.tolerances, **(tasks | {"monte_carlo": more})))
    assert timings.key_of(grown, "monte_carlo") == timings.key_of(study, "monte_carlo")
    assert timings.samples_of(grown, "monte_carlo") == 64 and timings.samples_of(study, "worst_case") == 1
    others = [timings.key_of(study, task) for task in ("", "sensitivity", "worst_case", "monte_carlo")]
    longer = dataclasses.replace(study, duration=0.6)
    assert len({*others, timings.key_of(longer, "sensitivity")}) == 5


def test_it_is_told_before_and_recorded_after(study, kept, capsys):
    with steps.timed(study, "monte_carlo"):
        said = capsys.readouterr().err
    assert said.startswith("Monte Carlo: 32 simulations in chunks of 8; ") and "not known" in said
    key = timings.key_of(study, "monte_carlo")
    assert timings.estimate(key, 32)[0] < 5.0
    with steps.timed(study, "monte_carlo", "2 chunks of samples are kept"):
        assert "; 2 chunks of samples are kept, and serve; about 1 s as last time" in capsys.readouterr().err
    with steps.timed(study):
        assert capsys.readouterr().err == ""  # too short to be told
    with pytest.raises(KeyboardInterrupt), steps.timed(study, "worst_case"):
        raise KeyboardInterrupt
    assert timings.estimate(timings.key_of(study, "worst_case"), 1) is None


def test_nothing_is_kept_where_programs_are_not(study, tmp_path, monkeypatch):
    monkeypatch.setattr(timings, "user_cache_folder", lambda: tmp_path / "cache")
    key = timings.key_of(study, "sensitivity")
    timings.record(key, 3.0, 1, compiled=False)
    assert timings.estimate(key, 1) is None and not (tmp_path / "cache").exists()


@pytest.mark.parametrize(("seconds", "text"), [(0.1, "1 s"), (89.0, "89 s"), (200.0, "3 min"), (7200.0, "2.0 h")])
def test_words(seconds, text):
    assert timings.duration_text(seconds) == text
