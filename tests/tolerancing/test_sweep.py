"""Sweeps and response surfaces: designs, exact fits, errors of samples left out, continued runs, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import FunctionProblem, InputError, Metric, fit_response_surface, sweep
from rfem_jax.tolerancing.problems.results_store import StudyFolderError

jax.config.update("jax_enable_x64", True)

NAMES = ("a", "b", "c")
HESSIAN = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.3], [0.0, 0.3, 3.0]])
GRADIENT = np.array([1.0, -2.0, 3.0])


def f(e):
    x = jnp.stack([e[name] for name in NAMES])
    square = 7.0 + x @ jnp.asarray(GRADIENT) + 0.5 * x @ jnp.asarray(HESSIAN) @ x
    return {"square": square, "wave": jnp.sin(30.0 * x[0])}, jnp.where(e["a"] > 0.29, 3, 0)


PROBLEM = FunctionProblem(f, NAMES, (Metric("square", "N"), "wave"), error_units={"a": "m"})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("sweep") / "points"


@pytest.fixture(scope="module")
def grid(folder):
    bounds = {"a": (-0.1, 0.3), "b": ("-5 deg", "5 deg")}
    return sweep(PROBLEM, bounds, levels=4, at={"c": 0.2}, batch=5, resume=folder)


def test_a_grid_holds_all_combinations(grid):
    b = np.radians(5.0)
    expected = [(x, y) for x in np.linspace(-0.1, 0.3, 4) for y in np.linspace(-b, b, 4)]
    np.testing.assert_allclose(grid.errors, expected, atol=1e-15)
    assert (grid.good, list(grid.status[-4:])) == (12, [3] * 4) and np.all(np.isnan(grid.values[-4:]))
    for (x, y), value in zip(expected[:12], grid.values[:12, 0], strict=True):
        e = np.array([x, y, 0.2])
        assert value == pytest.approx(7.0 + GRADIENT @ e + 0.5 * e @ HESSIAN @ e, rel=1e-12)
    row = grid.rows()[3]
    assert {"a_m", "b_rad", "square_N", "wave", "square_surface_N", "wave_surface", "status", "point"} == set(row)
    assert "Sweep over 2 quantities: 16 points (4 levels of each), 4 failed" in str(grid)


def test_a_sweep_continues_in_its_folder(grid, folder):
    bounds = {"a": (-0.1, 0.3), "b": ("-5 deg", "5 deg")}
    (folder / "chunk-000001.npz").unlink()
    again = sweep(PROBLEM, bounds, levels=4, at={"c": 0.2}, batch=5, resume=folder)
    assert again.chunks_computed == 1
    np.testing.assert_array_equal(again.values, grid.values)
    with pytest.raises(StudyFolderError, match="levels"):
        sweep(PROBLEM, bounds, levels=3, at={"c": 0.2}, batch=5, resume=folder)
    with pytest.raises(StudyFolderError, match="tolerances"):
        sweep(PROBLEM, bounds, levels=4, at={"c": 0.1}, batch=5, resume=folder)


def test_sobol_points_fill_the_ranges_and_a_larger_sweep_begins_with_a_smaller_one():
    bounds = {"a": (0.0, 0.2), "b": (-1.0, 0.0), "c": (0.1, 0.2)}
    small, large = (sweep(PROBLEM, bounds, design="sobol", n=n, key=jax.random.key(4), batch=64) for n in (64, 128))
    np.testing.assert_array_equal(small.errors, large.errors[:64])
    low, high = np.array(list(bounds.values())).T
    assert np.all((large.errors > low) & (large.errors < high))
    np.testing.assert_allclose(large.errors.mean(axis=0), 0.5 * (low + high), atol=0.02)
    surface = large.surface
    assert surface.samples == 128
    np.testing.assert_allclose(np.asarray(surface.model.hessian)[0], HESSIAN, atol=1e-9)
    middle = np.asarray(surface.model.point)
    np.testing.assert_allclose(np.asarray(surface.model.gradient)[0], GRADIENT + HESSIAN @ middle, rtol=1e-9)
    np.testing.assert_allclose(surface(large.errors)[:, 0], large.values[:, 0], rtol=1e-12)
    assert surface.cross_validated[0] < 1e-12 and surface.explained[0] == pytest.approx(1.0)
    assert surface.explained[1] < 0.6 and surface.cross_validated[1] > 0.3  # no parabola follows one turn of a sine
    half = np.array(surface.half_range)
    expected = np.abs(GRADIENT + HESSIAN @ middle) * half + 0.5 * np.diagonal(HESSIAN) * half**2
    np.testing.assert_allclose(surface.effects()[0], expected, rtol=1e-9)


def test_the_error_of_samples_left_out_is_that_of_fits_without_them():
    generator = np.random.default_rng(3)
    x = generator.uniform(-1.0, 2.0, (14, 2))
    y = np.stack([np.exp(x[:, 0]) * x[:, 1], generator.normal(size=14)], axis=1)
    whole = fit_response_surface("ab", ("f", "noise"), x, y)
    away = []
    for i in range(14):
        rest = np.arange(14) != i
        away.append(y[i] - fit_response_surface("ab", ("f", "noise"), x[rest], y[rest])(x[i : i + 1])[0])
    np.testing.assert_allclose(whole.cross_validated, np.sqrt(np.mean(np.square(away), axis=0)), rtol=1e-9)
    assert np.all(whole.cross_validated > whole.residual)
    np.testing.assert_allclose(whole.residual**2, np.mean((y - whole(x)) ** 2, axis=0), rtol=1e-9)


def test_designs_without_a_surface_say_why():
    bounds = {"a": (0.0, 0.1), "b": (0.0, 0.1)}
    found = sweep(PROBLEM, bounds, levels=2)
    assert found.surface is None and "more than 6 good samples" in found.surface_note
    assert "No response surface" in str(found) and "square_surface_N" not in found.rows()[0]
    with pytest.raises(InputError, match="three levels"):
        fit_response_surface("a", "f", np.array([[0.0], [0.0], [1.0], [1.0]]), np.arange(4.0)[:, None])


@pytest.mark.parametrize(
    ("bounds", "settings", "word"),
    [
        ({}, {}, "`bounds`"),
        ({"d": (0.0, 1.0)}, {}, "`d`"),
        ({"a": (1.0, 0.0)}, {}, "rise"),
        ({"a": 1.0}, {}, "pairs"),
        ({"a": ("1 deg", "2 deg")}, {}, "length"),
        ({"a": (0.0, 1.0)}, {"at": {"a": 0.0}}, "`at`"),
        ({"a": (0.0, 1.0)}, {"design": "cross"}, "`design`"),
        ({"a": (0.0, 1.0)}, {"levels": 1}, "`levels`"),
        ({"a": (0.0, 1.0), "b": (0.0, 1.0)}, {"levels": 10**5}, "at most"),
    ],
)
def test_bad_requests_are_refused(bounds, settings, word):
    with pytest.raises(InputError, match=word):
        sweep(PROBLEM, bounds, **settings)
