"""Allocation of 24 tolerances against closed forms, for every cost model; refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, special, stats

from rfem_jax import (
    Exponential,
    FunctionProblem,
    InputError,
    Metric,
    Reciprocal,
    ReciprocalSquared,
    Uniform,
    allocate,
    expand,
)
from rfem_jax.tolerancing.robust_design.allocation import ATTEMPTS, _passes
from rfem_jax.tolerancing.robust_design.corrected_statistics import CorrectedStatistics
from rfem_jax.tolerancing.robust_design.observations import Observer
from rfem_jax.tolerancing.robust_design.request import check_allocation
from rfem_jax.tolerancing.robust_design.verification import ErrorSample, Verified

jax.config.update("jax_enable_x64", True)

KEY = jax.random.key(21)
K = 24
NAMES = tuple(f"e{i}" for i in range(K))
RNG = np.random.default_rng(6)
G, C = RNG.uniform(0.3, 3.0, K), RNG.uniform(0.2, 5.0, K)
BOUNDS = dict.fromkeys(NAMES, (1e-3, 20.0))


def load(errors):
    x = jnp.stack([errors[name] for name in NAMES])
    return {"load": 1.0 + jnp.asarray(G) @ x, "other": 5.0 - x[0]}


PROBLEM = FunctionProblem(load, NAMES, (Metric("load", "N"), Metric("other", "N")))


def on_sphere(shape, radius):
    """t ~ shape with sum (g t)^2 = radius^2."""
    return shape * radius / np.linalg.norm(G * shape)


def exponential_optimum(rate, radius):
    """c r exp(-r t) = 2 lambda g^2 t, so r t = W(c r^2 / (2 lambda g^2)); lambda from the limit."""

    def t(logarithm):
        return special.lambertw(C * rate**2 / (2 * np.exp(logarithm) * G**2)).real / rate

    excess = optimize.brentq(lambda u: np.linalg.norm(G * t(u)) - radius, -20.0, 20.0)
    return t(excess)


# Cost model of each error, its value at t, the optimum on sum (g t)^2 = r^2.
CASES = {
    # c/t^2 = 2 lambda g^2 t: the classical t ~ (c/g^2)^(1/3)
    "reciprocal": (
        Reciprocal, lambda t: C / t, lambda r: on_sphere((C / G**2) ** (1 / 3), r),
    ),
    # 2 c/t^3 = 2 lambda g^2 t
    "reciprocal squared": (
        ReciprocalSquared, lambda t: C / t**2, lambda r: on_sphere((C / G**2) ** (1 / 4), r),
    ),
    "exponential": (
        lambda c: Exponential(c, 2.0), lambda t: C * np.exp(-2 * t),
        lambda r: exponential_optimum(2.0, r),
    ),
    # A user's own: c/sqrt(t), c/2 t^(-3/2) = 2 lambda g^2 t
    "own": (
        lambda c: lambda t: c / jnp.sqrt(t), lambda t: C / np.sqrt(t),
        lambda r: on_sphere((C / G**2) ** (2 / 5), r),
    ),
}  # fmt: skip


def costs(model):
    return {name: model(float(c)) for name, c in zip(NAMES, C, strict=True)}


def fresh_loads(t, n=200_000):
    """Loads of an independent sample: normal errors with three deviations in the tolerance."""
    e = np.random.default_rng(99).normal(size=(n, K)) * t / 3
    return 1.0 + e @ G


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_rss_of_24_tolerances_is_the_closed_form_of_every_cost(case):
    model, price, optimum = CASES[case]
    result = allocate(
        PROBLEM, {"load": 3.0}, costs(model), BOUNDS, "rss", key=KEY, samples=128,
        verify_samples=2048,
    )  # fmt: skip
    exact = optimum(2.0)
    t = np.array([result.tolerances[name] for name in NAMES])
    assert result.status == "ok" and list(result.tolerances) == list(NAMES)
    np.testing.assert_allclose(t, exact, rtol=1e-4)
    assert result.cost == pytest.approx(np.sum(price(exact)), rel=1e-6)
    # The closed-form run of the result, and ours: 99.865 % of the loads are below the limit.
    low, high = result.limits[0].verified_interval
    assert low < 3.0 < high
    share = np.mean(fresh_loads(t) <= 3.0)
    assert share == pytest.approx(stats.norm.cdf(3.0), abs=3e-4)


@pytest.mark.long
def test_yield_of_24_tolerances_is_the_closed_form_and_holds_on_fresh_samples():
    target = 0.9
    result = allocate(
        PROBLEM, {"load": 3.0}, costs(Reciprocal), BOUNDS, "yield", key=KEY, target=target,
        samples=1024, verify_samples=4096,
    )  # fmt: skip
    # The load is normal with deviation |g t|/3: its 90 % quantile is at the limit.
    exact = on_sphere((C / G**2) ** (1 / 3), 3 * 2.0 / stats.norm.ppf(target))
    t = np.array([result.tolerances[name] for name in NAMES])
    assert result.status == "ok" and result.level == target
    assert result.cost == pytest.approx(np.sum(C / exact), rel=0.05)
    # The cost is flat about its optimum, and 1024 samples in 24 dimensions are few.
    np.testing.assert_allclose(t, exact, rtol=0.35)
    assert np.corrcoef(np.log(t), np.log(exact))[0, 1] > 0.97
    # The answer makes use of its own samples, so it may be a little too kind to itself.
    assert np.mean(fresh_loads(t) <= 3.0) == pytest.approx(target, abs=0.02)
    low, high = result.yield_interval
    assert low < target + 0.01 and high >= target and high - low < 0.03
    assert result.verified_yield == pytest.approx(np.mean(fresh_loads(t) <= 3.0), abs=0.02)


@pytest.mark.long
def test_an_infeasible_rss_request_says_which_limit_and_the_best_reachable():
    coarse = dict.fromkeys(NAMES, (0.5, 20.0))
    best = 1.0 + np.linalg.norm(G * 0.5)
    request = {"other": (None, 50.0), "load": 0.5 * (1.0 + best)}
    result = allocate(
        PROBLEM, request, costs(Reciprocal), coarse, "rss", key=KEY, samples=128,
        verify_samples=1024,
    )  # fmt: skip
    assert result.status == "infeasible" and "on load cannot be met" in result.message
    said = float(result.message.split("within the bounds is ")[1].split()[0])
    assert said == pytest.approx(best, rel=0.08)  # fresh samples know the quantile to 3 %
    assert set(result.at_bounds.values()) == {"smallest"}
    assert result.limits[1].verified_margin < 0 < result.limits[0].verified_margin


@pytest.fixture(scope="module")
def model():
    return expand(PROBLEM, names=("e0", "e1"))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"model": "order 1"}, "`model` must be of order 2"),
        ({"bounds": {"e1": (1.0, 2.0), "e0": (1.0, 2.0)}}, "`model` must be of order 2"),
        ({"bounds": {"e0": (1.0, 2.0)}}, "`model` must be of order 2"),
        ({"limits": {"lod": 3.0}}, "did you mean `load`"),
        ({"limits": {}}, "`limits` must map"),
        pytest.param({"limits": 3.0}, "`limits` must map", marks=pytest.mark.wrong_types),
        ({"limits": {"load": (None, None)}}, "finite limits"),
        ({"limits": {"load": (2.0, 1.0)}}, "a largest value or [low, high]"),
        ({"limits": {"load": "3 kg"}}, "a largest value or [low, high]"),
        ({"bounds": {"x": (1.0, 2.0)}}, "`x` is not known"),
        ({"bounds": {"e0": (0.0, 2.0)}}, "0 < smallest < largest"),
        pytest.param({"bounds": [1.0, 2.0]}, "`bounds` must map", marks=pytest.mark.wrong_types),
        ({"cost": {"e0": Reciprocal()}}, "`e1` has none"),
        ({"cost": {"e0": Reciprocal(), "e1": 3.0}}, "callable"),
        ({"criterion": "yield", "target": 1.0}, "`target`"),
        ({"criterion": "robust"}, "`criterion`"),
        ({"limits": {"load": np.inf}}, "finite limits"),
        ({"statistic": "median"}, "`statistic`"),
        ({"mode": "backward"}, "`mode`"),
    ],
)
def test_requests_that_do_not_fit_are_refused(model, changes, words):
    if changes.get("model") == "order 1":
        changes = {"model": expand(PROBLEM, names=("e0", "e1"), order=1)}
    request = {"limits": {"load": 3.0}, "cost": Reciprocal(), "model": model}
    request |= {"bounds": {"e0": (1e-3, 2.0), "e1": (1e-3, 2.0)}}
    with pytest.raises(InputError, match="Argument `.*must") as caught:
        allocate(PROBLEM, **{**request, **changes}, key=KEY)
    assert words in str(caught.value)


@pytest.mark.long
def test_a_model_that_fits_is_used():
    exact = expand(PROBLEM, names=("e0", "e1"))
    request = ({"load": 3.0}, Reciprocal(), {"e0": (1e-3, 20.0), "e1": (1e-3, 20.0)})
    given = allocate(PROBLEM, *request, key=KEY, model=exact)
    own = allocate(PROBLEM, *request, key=KEY)
    assert np.isnan(given.hessian_error) and own.hessian_error >= 0
    assert given.cost == pytest.approx(own.cost, rel=1e-9)
    assert "by differences" in str(own) and "by differences" not in str(given)


def criterion(kind, limit=3.0):
    bounds = {"e0": (1e-3, 20.0), "e1": (1e-3, 20.0)}
    observer = Observer(check_allocation(PROBLEM, {"load": limit}, Reciprocal(), bounds))
    sample = ErrorSample(kind, level=0.9, coverage=3.0, distribution=Uniform, samples=64, verify_samples=64)
    return CorrectedStatistics(observer, KEY, sample, "quantile")


def fresh(h=0.0, low=0.0, fraction=1.0, high=1.0):
    h, low = np.array([h]), np.array([low])
    return Verified(h, low, h, fraction, (0.0, high), 0, "")


@pytest.mark.slow
def test_a_fresh_run_that_falls_short_raises_the_aim_and_so_the_model():
    t = np.array([0.5, 0.4])
    study = criterion("yield")
    before = np.asarray(study.model()(jnp.asarray(t)))
    study.learn(t, fresh(fraction=0.95))
    assert study.aim == 0.9  # more than was asked for: nothing to learn
    study.learn(t, fresh(fraction=0.87))
    assert study.aim == pytest.approx(0.93)
    assert np.asarray(study.model()(jnp.asarray(t)))[0] > before[0]
    study.learn(t, fresh(fraction=0.2))
    assert study.aim == pytest.approx(0.93 + 0.5 * 0.07)  # never beyond what samples can have
    study = criterion("rss")
    before = np.asarray(study.model()(jnp.asarray(t)))
    study.learn(t, fresh(h=0.125))
    np.testing.assert_allclose(np.asarray(study.model()(jnp.asarray(t))), before + 0.125)
    study.learn(t, fresh(h=-0.5))
    np.testing.assert_allclose(np.asarray(study.model()(jnp.asarray(t))), before + 0.125)


def test_a_fresh_run_passes_unless_it_violates_a_limit_beyond_its_interval():
    rss, joint = criterion("rss"), criterion("yield")
    assert _passes(rss, fresh(h=0.1, low=-0.1), 1e-4)
    assert not _passes(rss, fresh(h=0.2, low=0.1), 1e-4)
    assert _passes(joint, fresh(h=9.0, low=9.0, fraction=0.89, high=0.91), 1e-4)
    assert not _passes(joint, fresh(fraction=0.88, high=0.89), 1e-4)


@pytest.mark.long
def test_an_answer_that_fresh_runs_refuse_is_not_verified(monkeypatch):
    # A problem that is worse for fresh samples than for those that found the answer.
    original, runs = CorrectedStatistics.verify, []

    def verify(self, t, key):
        runs.append(t)
        return original(self, 1.5 * t, key)

    monkeypatch.setattr(CorrectedStatistics, "verify", verify)
    monkeypatch.setattr(CorrectedStatistics, "learn", lambda self, t, fresh: None)
    result = allocate(
        PROBLEM, {"load": 3.0}, Reciprocal(), {"e0": (1e-3, 20.0)}, "rss", key=KEY, samples=64,
        verify_samples=512, rounds=4,
    )  # fmt: skip
    assert result.status == "not_verified" and "Independent samples kept violating" in result.message
    assert len(runs) == ATTEMPTS  # each with its own rounds
    assert result.limits[0].verified_margin < 0 <= result.limits[0].predicted_margin


def test_failed_samples_raise_the_quantile_that_the_others_must_hold():
    # One error in twenty fails, those above 0.9; the 90 % quantile of all is 0.8, not 0.71.
    def function(errors):
        x = errors["e0"]
        return {"load": x}, jnp.where(x > 0.9, 4, 0)

    problem = FunctionProblem(function, ("e0",), ("load",))
    bounds = {"e0": (0.1, 10.0)}
    observer = Observer(check_allocation(problem, {"load": 2.0}, Reciprocal(), bounds))
    sample = ErrorSample("yield", level=0.9, coverage=3.0, distribution=Uniform, samples=512, verify_samples=64)
    study = CorrectedStatistics(observer, KEY, sample, "quantile")
    h = study.observe(np.array([1.0]), KEY)
    assert 2.0 + 2.0 * h[0] == pytest.approx(0.8, abs=0.01)
    assert study.failed == pytest.approx(0.05 * 512, abs=2)
    assert study.predicted_yield(np.array([1.0])) == pytest.approx(0.95, abs=0.005)
