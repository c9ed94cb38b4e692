"""Pictures drawn by two processes are those that one draws, and what the other cannot draw is drawn here."""

import os
import signal

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="pictures need the extra `plots`")

from matplotlib.ticker import FuncFormatter

from rfem_jax.report.drawings import pictures
from rfem_jax.report.drawings.style import SETTINGS, new_figure


def curves(count, formatter=None):
    figures = {}
    for i in range(count):
        figure = new_figure(3.0, 2.0)
        axes = figure.subplots()
        axes.plot(np.linspace(0.0, 1.0 + i, 20) ** 2)
        axes.set_xlabel(f"number {i}")
        if formatter is not None:
            axes.yaxis.set_major_formatter(formatter)
        figures[f"curve_{i}"] = figure
    return figures


@pytest.fixture
def other(monkeypatch):
    """The other process, of this test alone."""
    monkeypatch.setattr(pictures, "_other", None)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    pictures.draw_beside()
    started = pictures._other
    assert started is not None
    yield started
    started.end()
    assert started.process.returncode is not None


def contents(paths):
    return {path.name: path.read_bytes() for path in paths}


def alone(folder, figures, monkeypatch):
    folder.mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(pictures, "_other", None)
        return contents(pictures.write_pictures(folder, figures))


def drawn_here(monkeypatch):
    """Names of the pictures that this process draws, in a list that fills."""
    names, draw = [], pictures._drawn
    monkeypatch.setattr(pictures, "_drawn", lambda figure: names.append(figure.axes[0].get_xlabel()) or draw(figure))
    return names


def test_two_processes_write_what_one_writes(tmp_path, other, monkeypatch):
    expected = alone(tmp_path / "alone", curves(12), monkeypatch)
    here = drawn_here(monkeypatch)
    written = pictures.write_pictures(tmp_path, curves(12))
    assert [path.name for path in written] == list(expected)
    assert contents(written) == expected
    assert 0 < len(here) < 12 and other.process.poll() is None


def test_figures_that_cannot_be_sent_are_drawn_here(tmp_path, other, monkeypatch):
    formatter = FuncFormatter(lambda value, _: f"{value:.1f}")
    expected = alone(tmp_path / "alone", curves(3, formatter), monkeypatch)
    assert contents(pictures.write_pictures(tmp_path, curves(3, formatter))) == expected


def test_a_process_that_is_gone_is_not_missed(tmp_path, other, monkeypatch):
    expected = alone(tmp_path / "alone", curves(4), monkeypatch)
    other.process.kill()
    assert contents(pictures.write_pictures(tmp_path, curves(4))) == expected


def test_a_file_that_it_cannot_write_is_an_error_here(tmp_path, other):
    with pytest.raises(FileNotFoundError):
        other.draw(tmp_path / "nowhere" / "curve.png", curves(1)["curve_0"], SETTINGS)
    assert other.draw(tmp_path / "curve.png", curves(1)["curve_0"], SETTINGS) and (tmp_path / "curve.png").exists()


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_an_interruption_is_for_the_command_alone(tmp_path, other):
    assert other.draw(tmp_path / "before.png", curves(1)["curve_0"], SETTINGS)
    os.kill(other.process.pid, signal.SIGINT)
    assert other.draw(tmp_path / "after.png", curves(1)["curve_0"], SETTINGS)


def test_one_core_draws_alone(monkeypatch):
    monkeypatch.setattr(pictures, "_other", None)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    pictures.draw_beside()
    assert pictures._other is None
