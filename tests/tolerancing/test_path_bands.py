"""Bands of paths in Monte Carlo studies, beside the closed paths of a hand that is too long or is turned."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

from rfem_jax import (
    InputError,
    Joint,
    Mechanism,
    Normal,
    Point,
    PrescribedRate,
    Problem,
    RungeKutta4,
    Simulation,
    Tolerances,
    Uniform,
    discretise,
    monte_carlo,
    path_bands,
)
from rfem_jax.tolerancing.sampling.sampled_paths import TIMES
from tests.mechanisms import link

LENGTH, RATE, STEP = 0.3, 6.0, 5e-3


def of_hand(duration=0.5, plane="xz"):
    hand = Mechanism(
        [link("hand", LENGTH)], [Joint("A", "base", "hand")], driven_joint="A",
        points=[Point("tip", "hand", LENGTH), Point("middle", "hand", 0.5 * LENGTH)],
        plane=plane,
    )  # fmt: skip
    simulation = Simulation(
        discretise(hand), drive=PrescribedRate("A", RATE), method=RungeKutta4(step=STEP), duration=duration,
        save_every=STEP,
    )  # fmt: skip
    return Problem(simulation, ("tip.max_deviation",))


@pytest.fixture(scope="module")
def problem():
    return of_hand()


@pytest.fixture(scope="module")
def result(problem):
    widths = {"hand.length": Normal("0.4 mm"), "A.d_y": Uniform("0.2 mm")}
    return monte_carlo(problem, Tolerances(widths), 64, jax.random.key(3))


@pytest.mark.long
def test_parts_of_a_hand_s_deviations(problem, result):
    bands = path_bands(problem, result)
    assert list(bands) == ["tip", "middle"]
    longer, aside = result.errors.T
    tip = bands["tip"]
    assert len(tip.deviations) == 64 and len(tip.times) == TIMES and tip.times[-1] == pytest.approx(0.5)
    # The hand turns about y: across its path is towards its hinge, out of the plane is where the hinge is shifted to.
    along, across, out = np.moveaxis(tip.parts_of_deviations, 2, 0)
    assert_allclose(along, 0.0, atol=1e-12)
    assert_allclose(across, np.tile(-longer[:, None], TIMES), atol=1e-12)
    assert_allclose(out, np.tile(aside[:, None], TIMES), atol=1e-12)
    assert_allclose(tip.distances, np.tile(np.hypot(longer, aside)[:, None], TIMES), rtol=1e-9)
    assert_allclose(tip.low[:, 1], np.quantile(-longer, 0.025), rtol=1e-9)
    assert_allclose(tip.high[:, 2], np.quantile(aside, 0.975), rtol=1e-9)
    assert_allclose(tip.largest[:, 1], -longer.min(), rtol=1e-9)
    assert_allclose(tip.smallest[:, 2], aside.min(), rtol=1e-9)
    angle = RATE * tip.times
    assert_allclose(tip.perfect[:, 0], LENGTH * np.cos(angle), atol=1e-9)
    # The middle of a longer hand is its middle.
    assert_allclose(bands["middle"].parts_of_deviations[..., 1], np.tile(-0.5 * longer[:, None], TIMES), atol=1e-12)


@pytest.mark.long
def test_forms_of_a_band(problem, result):
    (band,) = path_bands(problem, result, ["tip"], samples=16, level=0.5).values()
    assert len(band.deviations) == 16
    data = band.to_xarray()
    assert data.deviation.dims == ("sample", "time", "component") and data.high.attrs["units"] == "m"
    assert_allclose(data.low.sel(part="across"), band.low[:, 1])
    table = band.to_pandas()
    assert_allclose(table["across_high_m"], band.high[:, 1])
    assert "16 samples at 65 times" in str(band) and "50 % from" in str(band)


def test_few_saved_times_are_taken_once(result):
    (band, _) = path_bands(of_hand(10 * STEP), result, samples=4).values()
    assert_allclose(band.times, STEP * np.arange(11), atol=1e-15)


def test_bands_of_no_good_sample_and_of_unknown_points(problem, result):
    assert path_bands(problem, replace(result, status=np.ones_like(result.status))) == {}
    with pytest.raises(InputError, match="no point `tp`; did you mean `tip`"):
        path_bands(problem, result, ["tp"])


@pytest.mark.long
def test_parts_of_deviations_in_the_plane_of_x_and_y(result):
    """d_y of a joint is along its hinge, which is z there; the hand turns from x to y, and across is towards its
    hinge."""
    (band, _) = path_bands(of_hand(10 * STEP, "xy"), result, samples=4).values()
    longer, aside = result.errors[:4].T
    assert_allclose(band.perfect[:, 1], LENGTH * np.sin(RATE * band.times), atol=1e-9)
    expected = np.stack([0.0 * longer, -longer, aside], axis=1)[:, None] + np.zeros((4, len(band.times), 3))
    assert_allclose(band.parts_of_deviations, expected, atol=1e-12)
