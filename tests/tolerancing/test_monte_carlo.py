"""Monte Carlo: closed-form problems, one program for all chunks, devices, processes, refusals."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rfem_jax
from rfem_jax import (
    CorrelatedNormal,
    FunctionProblem,
    InputError,
    Metric,
    Normal,
    Tolerances,
    Uniform,
    expand,
    monte_carlo,
)
from rfem_jax.tolerancing.identification.predictions import Predictor
from rfem_jax.tolerancing.problems import execution
from rfem_jax.tolerancing.problems.linearisation import linearise_points

jax.config.update("jax_enable_x64", True)

KEY = jax.random.key(7)
NAMES = ("a", "b", "c")
HESSIAN = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.3], [0.0, 0.3, 3.0]])
TOLERANCES = Tolerances({"b": Uniform(0.2), "a": Normal(0.6)}, correlated=CorrelatedNormal("c", [[0.01]]))


def quadratic(errors):
    x = jnp.stack([errors[name] for name in NAMES])
    square = 0.5 * x @ jnp.asarray(HESSIAN) @ x
    return {"mean_square": square, "linear": x @ jnp.array([1.0, -2.0, 3.0])}


def vibration(errors):
    """Transcendental functions, a loop and a matrix product: the last bits show who computed it."""
    matrix = jnp.outer(jnp.arange(1.0, 6.0), jnp.arange(2.0, 7.0)) / 40.0

    def step(state, _):
        damping = jnp.exp(-errors["b"] * state**2)
        state = state + 0.1 * jnp.sin(matrix @ state + errors["a"]) * damping
        return state, None

    final = jax.lax.scan(step, jnp.ones(5) * errors["c"], length=20)[0]
    return {"end": jnp.sum(final), "square": final @ final}


QUADRATIC = FunctionProblem(quadratic, NAMES, (Metric("mean_square", "N^2"), Metric("linear", "N")))
VIBRATION = FunctionProblem(vibration, NAMES, ("end", "square"))


@pytest.fixture(scope="module")
def study():
    return monte_carlo(
        QUADRATIC,
        TOLERANCES,
        1024,
        KEY,
        batch=300,
        sobol_indices=True,
        limits={"linear": (-1.0, 1.0)},
    )


def test_statistics_of_a_quadratic_are_its_closed_form(study):
    covariance = np.diag([0.04, 0.04 / 3, 0.01])  # a, b, c
    gradient = np.array([1.0, -2.0, 3.0])
    exact = {"mean_square": 0.5 * np.trace(HESSIAN @ covariance), "linear": 0.0}
    assert study.samples == 2048 and study.good == 2048 and study.failures == {}
    for metric, value in exact.items():
        mean = study.statistics[metric].mean
        assert mean.low < value < mean.high
        assert abs(mean.value - value) < 0.2 * (mean.high - mean.low)
    std = study.statistics["linear"].std
    assert std.low < np.sqrt(gradient @ covariance @ gradient) < std.high
    values = study.values[:2048, 1]
    quantile = study.statistics["linear"].quantiles[0.95]
    assert quantile.low < np.quantile(values, 0.95) < quantile.high
    assert study.yields["linear"].of_good.value == np.mean(np.abs(values) <= 1.0)
    assert study.joint_yield == study.yields["linear"]
    assert study.statistics["linear"].largest == values.max()


def test_samples_are_the_tolerances_distributions(study):
    errors = study.errors[: study.samples]
    assert study.names == ("b", "a", "c")
    assert np.abs(errors[:, 0]).max() < 0.2
    np.testing.assert_allclose(errors.std(axis=0), [0.2 / np.sqrt(3), 0.2, 0.1], rtol=0.02)
    again = [float(QUADRATIC(dict(zip(study.names, row)))[0]["linear"]) for row in study.errors[:5]]
    np.testing.assert_allclose(again, study.values[:5, 1], rtol=1e-12, atol=1e-14)


def test_sobol_indices_of_a_linear_function_are_shares_of_variance(study):
    shares = np.array([4 * 0.04 / 3, 0.04, 9 * 0.01])
    shares /= shares.sum()
    indices = study.sobol_indices["linear"]
    for factor, share in zip(("b", "a", "c"), shares, strict=True):
        for estimate in (indices.first_order[factor], indices.total[factor]):
            assert abs(estimate.value - share) < 0.03 and estimate.low < share < estimate.high


def test_correlated_errors_are_one_factor():
    group = CorrelatedNormal(("a", "c"), [[0.04, 0.018], [0.018, 0.01]])
    tolerances = Tolerances({"b": Uniform(0.2)}, correlated=group)
    study = monte_carlo(QUADRATIC, tolerances, 512, KEY, batch=2048, sobol_indices=True)
    assert len(study.values) == 512 * 4
    together = 0.04 + 9 * 0.01 + 6 * 0.018
    share = together / (together + 4 * 0.04 / 3)
    assert abs(study.sobol_indices["linear"].total["a + c"].value - share) < 0.04


def test_sobol_points_beat_pseudo_random_ones():
    def error(sampling, seed):
        study = monte_carlo(QUADRATIC, TOLERANCES, 512, jax.random.key(seed), batch=512, sampling=sampling)
        return abs(study.statistics["linear"].mean.value)

    assert max(error("sobol", s) for s in range(4)) < 0.3 * np.mean([error("pseudo_random", s) for s in range(4)])


@pytest.mark.parametrize("sampling", ("sobol", "pseudo_random"))
def test_samples_depend_neither_on_batch_nor_on_number(sampling):
    def run(n, batch):
        return monte_carlo(VIBRATION, TOLERANCES, n, KEY, batch=batch, sampling=sampling)

    reference = run(75, 75)
    for n, batch in ((75, 1), (75, 32), (41, 7)):
        study = run(n, batch)
        np.testing.assert_array_equal(study.errors, reference.errors[:n])
        np.testing.assert_array_equal(study.values, reference.values[:n])
    assert len(np.unique(reference.values[:, 0])) == 75
    other = monte_carlo(VIBRATION, TOLERANCES, 75, jax.random.key(8), sampling=sampling)
    assert not np.any(other.errors == reference.errors)


def test_one_program_serves_all_chunks_and_new_widths():
    traces = []

    def counted(errors):
        traces.append(1)
        return {"y": errors["a"] + errors["b"]}

    problem = FunctionProblem(counted, ("a", "b"), ("y",))
    for width, n, batch in ((0.1, 100, 32), (0.2, 37, 16), (0.3, 5, 64)):
        study = monte_carlo(problem, Tolerances({"a": Uniform(width)}), n, KEY, batch=batch)
        assert np.abs(study.values).max() > 0.5 * width
    assert len(traces) == 1


@pytest.mark.parametrize(("lanes", "launches"), [(4, 9), (9, 5), (16, 3), (1000, 1)])
def test_small_chunks_are_launched_together(lanes, launches, monkeypatch, tmp_path):
    sizes = []

    def counted(problem, tolerances, points, lanes):
        sizes.append(len(points))
        return evaluate(problem, tolerances, points, lanes)

    evaluate = execution.evaluate
    monkeypatch.setattr(jax, "local_device_count", lambda: 1)
    alone = monte_carlo(VIBRATION, TOLERANCES, 60, KEY, batch=60)
    monkeypatch.setattr(execution, "evaluate", counted)
    first = monte_carlo(VIBRATION, TOLERANCES, 27, KEY, batch=4, lanes=lanes, resume=tmp_path)
    sizes.clear()
    # The last chunk of three samples is completed, seven are there, eight are new.
    study = monte_carlo(VIBRATION, TOLERANCES, 60, KEY, batch=4, lanes=lanes, resume=tmp_path)
    assert (first.chunks_computed, study.chunks_computed) == (7, 9)
    assert sum(sizes) == 33 and len(sizes) == launches
    np.testing.assert_array_equal(study.errors, alone.errors)
    np.testing.assert_allclose(study.values, alone.values, rtol=1e-14)


def test_failures_are_counted_by_cause_and_not_averaged():
    def function(errors):
        a = errors["a"]
        status = jnp.where(a > 0.8, 3, jnp.where(a < -0.9, 4, 0))
        z = jnp.where(jnp.abs(a) < 0.1, jnp.nan, a)
        return {"y": jnp.where(status != 0, 1e30, a), "z": z}, status

    problem = FunctionProblem(function, ("a",), ("y", "z"), statuses={3: "does not assemble"})
    study = monte_carlo(problem, Tolerances({"a": Uniform(1.0)}), 1000, KEY, limits={"y": 0.5})
    a = study.errors[:, 0]
    good = (a <= 0.8) & (a >= -0.9) & (np.abs(a) >= 0.1)
    assert study.failures == {
        "values not finite": np.sum(np.abs(a) < 0.1),
        "does not assemble": np.sum(a > 0.8),
        "status 4": np.sum(a < -0.9),
    }
    assert study.good == good.sum()
    np.testing.assert_allclose(study.statistics["y"].mean.value, a[good].mean(), rtol=1e-12)
    assert np.isnan(study.values[~good]).all()
    passes = np.sum(a[good] <= 0.5)
    assert study.yields["y"].of_good.value == passes / good.sum()
    assert study.yields["y"].of_all.value == passes / 1000
    assert "does not assemble" in str(study)


def test_a_study_where_every_sample_fails_says_so():
    problem = FunctionProblem(lambda e: {"y": e["a"] / 0.0 * 0.0}, ("a",), ("y",))
    study = monte_carlo(problem, Tolerances({"a": Uniform(1.0)}), 10, KEY, limits={"y": 1.0})
    assert study.good == 0 and np.isnan(study.statistics["y"].mean.value)
    assert np.isnan(study.yields["y"].of_good.value) and study.yields["y"].of_all.value == 0.0
    assert "10 failed (10 values not finite)" in str(study)


def test_control_variate_leaves_the_mean_and_cuts_the_variance():
    def function(errors):
        a, b = errors["a"], errors["b"]
        return {"y": jnp.exp(a) * jnp.cos(b), "kink": jnp.sqrt(a**2)}

    problem = FunctionProblem(function, NAMES, ("y", "kink"))
    tolerances = Tolerances({"b": Uniform(interval=(-0.2, 0.4)), "a": Normal(0.6)})
    exact = np.exp(0.02) * (np.sin(0.4) + np.sin(0.2)) / 0.6
    options = {"batch": 400, "sampling": "pseudo_random"}
    study = monte_carlo(problem, tolerances, 400, KEY, control_variate=True, **options)
    controlled, plain = study.controlled_means["y"], study.statistics["y"].mean
    assert controlled.mean.low < exact < controlled.mean.high
    assert controlled.variance_reduction > 100
    assert controlled.mean.high - controlled.mean.low < 0.1 * (plain.high - plain.low)
    assert "kink" not in study.controlled_means and "kink" in study.control_note
    away = expand(problem, at={"a": 0.1, "c": 0.5}, names=("c", "a"))  # another point, fewer errors
    other = monte_carlo(problem, tolerances, 400, KEY, control_variate=away, **options)
    assert other.controlled_means["y"].mean.low < exact < other.controlled_means["y"].mean.high
    assert 1.5 < other.controlled_means["y"].variance_reduction < controlled.variance_reduction


def test_control_variate_is_refused_where_samples_failed():
    problem = FunctionProblem(lambda e: {"y": jnp.log(0.9 + e["a"])}, ("a",), ("y",))
    study = monte_carlo(problem, Tolerances({"a": Uniform(1.0)}), 64, KEY, control_variate=True)
    assert study.good < 64 and study.controlled_means is None
    assert "bias" in study.control_note


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"n": 0}, "`n` must be a whole number"),
        pytest.param({"batch": 2.5}, "`batch`", marks=pytest.mark.wrong_types),
        ({"lanes": 0}, "`lanes`"),
        pytest.param({"key": 7}, "jax.random.key(7)", marks=pytest.mark.wrong_types),
        ({"sampling": "sobel"}, "did you mean `sobol`"),
        ({"limits": {"lineer": 1.0}}, "did you mean `linear`"),
        ({"limits": {"linear": (2.0, 1.0)}}, "`linear` has (2.0, 1.0)"),
        ({"quantiles": (0.5, 95.0)}, "`quantiles`"),
        ({"confidence": 95.0}, "`confidence`"),
        pytest.param({"control_variate": "quadratic"}, "`control_variate`", marks=pytest.mark.wrong_types),
        pytest.param({"tolerances": {"a": 0.1}}, "`tolerances` must be a Tolerances", marks=pytest.mark.wrong_types),
        ({"tolerances": Tolerances({"d": Uniform(0.1)})}, "`d` is not known"),
    ],
)
def test_bad_requests_are_refused_before_anything_runs(changes, words):
    request = {"tolerances": TOLERANCES, "n": 8, "key": KEY, **changes}
    problem = FunctionProblem(lambda e: pytest.fail("it ran"), NAMES, QUADRATIC.metrics)
    with pytest.raises(InputError, match="Argument `.*must") as caught:
        monte_carlo(problem, **request)
    assert words in str(caught.value)


def test_raw_keys_pass_and_are_the_same_keys():
    raw = monte_carlo(QUADRATIC, TOLERANCES, 8, jax.random.PRNGKey(7), sampling="pseudo_random")
    typed = monte_carlo(QUADRATIC, TOLERANCES, 8, KEY, sampling="pseudo_random")
    np.testing.assert_array_equal(raw.errors, typed.errors)


def test_progress_is_told_to_a_function_or_shown(capfd):
    told = []
    monte_carlo(QUADRATIC, TOLERANCES, 20, KEY, batch=8, progress=lambda *seen: told.append(seen))
    assert told == [(8, 20), (16, 20), (20, 20)]
    monte_carlo(QUADRATIC, TOLERANCES, 20, KEY, batch=8, progress=True)
    lines = [line for line in capfd.readouterr().err.splitlines() if "%" in line]
    assert [line.partition("%")[0].split() for line in lines] == [
        ["20", "samples:", share] for share in ("40", "80", "100")
    ]
    assert "s remaining" in lines[1]


def test_result_prints_all_its_tables(study):
    text = str(study)
    assert "2048 samples (sobol), 0 failed" in text
    for words in ("mean_square", "N^2", "all limits", "total index"):
        assert words in text


# Two processes on the loopback address, and two devices: the same numbers as one, to the last bit.
SCRIPT = """
import sys, jax
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, {tests!r})
folder, port, process = sys.argv[1], sys.argv[2], int(sys.argv[3])
if port != "0":
    jax.distributed.initialize(f"127.0.0.1:{{port}}", num_processes=2, process_id=process)
import numpy as np
from test_monte_carlo import KEY, TOLERANCES, VIBRATION, monte_carlo, signals_with_slopes
study = monte_carlo(VIBRATION, TOLERANCES, 150, KEY, batch=20, resume=folder)
from rfem_jax.tolerancing.problems.evaluation import evaluate_points
from rfem_jax.tolerancing.problems.linearisation import linearise_points
from rfem_jax.compilation.keeping import statistics
programs = statistics.traced
np.testing.assert_array_equal(evaluate_points(VIBRATION, TOLERANCES.names, {{}}, study.errors)[0], study.values)
assert statistics.traced == programs > 0
_, jacobians, _ = linearise_points(VIBRATION, TOLERANCES.names, {{}}, study.errors)
found = dict(zip(("signals", "slopes"), signals_with_slopes(study.errors)), jacobians=jacobians)
np.savez(f"{{folder}}-{{process}}.npz", errors=study.errors, values=study.values, **found)
print(len(jax.local_devices()), jax.process_count(), study.chunks_computed)
"""


def signals_with_slopes(errors):
    """What an identification computes: signals at 7 points (T = 1), and their derivatives."""
    problem = FunctionProblem(lambda e: jax.tree.map(lambda one: one[None], vibration(e)), NAMES, ("end", "square"))
    signals = Predictor(problem, ("square", "end"), TOLERANCES.names, {}, times=[0.0])
    plain, found = (signals.at(errors[:7], derivatives=one) for one in (False, True))
    np.testing.assert_allclose(plain.values, found.values, rtol=1e-13)
    return found.values, found.derivatives


def start(folder, port, process, devices):
    library = str(Path(rfem_jax.__file__).parents[1])
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": library}
    environment["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={devices}"
    environment["NPROC"] = "4"
    script = SCRIPT.format(tests=str(Path(__file__).parent))
    return subprocess.Popen(
        [sys.executable, "-c", script, str(folder), str(port), str(process)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process):
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return [int(word) for word in out.split()[-3:]]


@pytest.mark.long
def test_processes_and_devices_give_the_one_process_result(tmp_path):
    if jax.default_backend() != "cpu":
        pytest.skip("the processes of this test run on the CPU")
    reference = monte_carlo(VIBRATION, TOLERANCES, 150, KEY, batch=20)
    _, jacobians, _ = linearise_points(VIBRATION, TOLERANCES.names, {}, reference.errors)
    signals, slopes = signals_with_slopes(reference.errors)
    np.testing.assert_allclose(slopes[:, ::-1, 0], jacobians[:7], rtol=1e-12)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    pair = [start(tmp_path / "processes", port, i, 1) for i in (0, 1)]
    alone = start(tmp_path / "devices", 0, 0, 2)
    assert [finish(p) for p in pair] == [[1, 2, 4], [1, 2, 4]]  # 8 chunks, dealt in turn
    assert finish(alone) == [2, 1, 8]
    for name in ("processes-0", "processes-1", "devices-0"):
        found = np.load(tmp_path / f"{name}.npz")
        np.testing.assert_array_equal(found["errors"], reference.errors)
        np.testing.assert_array_equal(found["values"], reference.values)
        np.testing.assert_allclose(found["jacobians"], jacobians, rtol=1e-12, atol=1e-12 * np.abs(jacobians).max())
        np.testing.assert_allclose(found["signals"], signals, rtol=1e-12)
        np.testing.assert_allclose(found["slopes"], slopes, rtol=1e-12, atol=1e-12 * np.abs(slopes).max())
    for index in range(8):  # the files too: a study may go on with another number of processes
        name = f"chunk-{index:06d}.npz"
        one, two = (tmp_path / kind / name for kind in ("processes", "devices"))
        assert one.read_bytes() == two.read_bytes()
    assert json.loads((tmp_path / "devices" / "manifest.json").read_text())["n"] == 150
