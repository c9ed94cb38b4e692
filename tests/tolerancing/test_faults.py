"""Faults: kills, damaged chunks, full disks, folders of other studies, missing processes."""

import errno
import json
import os
import resource
import signal
import subprocess
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rfem_jax
from rfem_jax import FunctionProblem, InputError, Tolerances, Uniform, monte_carlo
from rfem_jax.tolerancing.problems import execution, results_store, sample_values
from rfem_jax.tolerancing.problems.kept_evaluations import fingerprint_problem
from rfem_jax.tolerancing.problems.results_store import ChunkWriteError, CorruptChunkWarning, ResultsStore
from rfem_jax.tolerancing.sampling.monte_carlo_study import monte_carlo_samples

jax.config.update("jax_enable_x64", True)

KEY = jax.random.key(3)
N, BATCH, CHUNKS = 70, 16, 5
TOLERANCES = Tolerances({"a": Uniform(0.5), "b": Uniform(0.1)})


def swing(errors):
    return {"y": jnp.sin(3.0 * errors["a"]) * jnp.exp(errors["b"]), "z": errors["a"] * errors["b"]}


PROBLEM = FunctionProblem(swing, ("a", "b"), ("y", "z"))


def run(folder=None, **changes):
    request = {"problem": PROBLEM, "tolerances": TOLERANCES, "n": N, "key": KEY, "batch": BATCH}
    return monte_carlo(**{**request, **changes}, resume=folder)


def same(study, reference):
    for name in ("errors", "values", "status"):
        np.testing.assert_array_equal(getattr(study, name), getattr(reference, name))
    assert study.statistics == reference.statistics


def marks(folder):
    """What changes when a finished chunk is written again."""
    return {p.name: (p.stat().st_ino, p.stat().st_mtime_ns) for p in folder.glob("chunk-*.npz")}


@pytest.fixture(scope="module")
def reference():
    return run()


# Each run in a process of its own that kills itself, as kill -9 does, at one instant of one write.
SCRIPT = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from test_faults import run, results_store
folder, instant, count = sys.argv[1], sys.argv[2], int(sys.argv[3])
calls = 0
def die():
    os.kill(os.getpid(), signal.SIGKILL)
def fsync(descriptor, original=os.fsync):
    global calls
    calls += 1
    if calls == count and instant == "half":
        os.ftruncate(descriptor, os.fstat(descriptor).st_size // 2)
        die()
    original(descriptor)
    if calls == count and instant == "written":
        die()
def replace(source, target, original=os.replace):
    original(source, target)
    if calls == count and instant == "renamed":
        die()
os.fsync, os.replace = fsync, replace
study = run(folder)
print(study.chunks_computed)
"""


def start(folder, instant, count):
    # A file and its folder are synchronised: two calls a write; the manifest is the first write.
    library = str(Path(rfem_jax.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": library, "JAX_PLATFORMS": "cpu"}
    script = SCRIPT.format(tests=str(Path(__file__).parent))
    return subprocess.run(
        [sys.executable, "-c", script, str(folder), instant, str(count)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.long
def test_killed_study_continues_bitwise(tmp_path, reference):
    if jax.default_backend() != "cpu":
        pytest.skip("the processes of this test run on the CPU")
    kept = {}
    # (instant, synchronisation at which it dies, finished chunks that it leaves)
    for instant, count, finished in (
        ("half", 1, 0),  # in the middle of the manifest
        ("half", 5, 1),  # manifest, chunk 0, in the middle of chunk 1
        ("written", 1, 1),  # chunk 1 is whole, but not under its name
        ("renamed", 3, 3),  # chunks 1 and 2
    ):
        ended = start(tmp_path, instant, count)
        assert ended.returncode == -signal.SIGKILL, ended.stderr
        found = marks(tmp_path)
        assert len(found) == finished
        assert kept.items() <= found.items()  # no finished chunk is lost or repeated
        kept = found
    study = run(tmp_path)
    assert study.chunks_computed == CHUNKS - 3
    assert kept.items() <= marks(tmp_path).items()
    assert not list(tmp_path.glob("chunk-*.tmp"))
    same(study, reference)
    again = run(tmp_path)
    assert again.chunks_computed == 0
    same(again, reference)


def flip(data):
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 0x10]) + data[middle + 1 :]


@pytest.mark.parametrize(
    "damage",
    [flip, lambda data: data[: len(data) // 2], lambda data: b"", lambda data: b"\x80\x04K\x01."],
    ids=("flipped bit", "cut", "empty", "pickle"),
)
def test_damaged_chunk_is_found_and_computed_again(tmp_path, reference, damage):
    run(tmp_path)
    whole = marks(tmp_path)
    path = tmp_path / "chunk-000002.npz"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.warns(CorruptChunkWarning, match="Chunk 2 in .* is damaged"):
        study = run(tmp_path)
    assert study.chunks_computed == 1
    same(study, reference)
    changed = {name for name, mark in marks(tmp_path).items() if whole[name] != mark}
    assert changed == {path.name}


def test_every_flipped_bit_of_the_numbers_is_found(tmp_path):
    store = ResultsStore(tmp_path, {"study": 1})
    arrays = {"values": np.arange(6.0).reshape(3, 2), "status": np.zeros(3, np.int32)}
    store.write(0, arrays)
    data = store.path(0).read_bytes()
    at = data.index(arrays["values"].tobytes())
    for position in range(at, at + arrays["values"].nbytes):
        damaged = bytearray(data)
        damaged[position] ^= 1
        store.path(0).write_bytes(damaged)
        with pytest.warns(CorruptChunkWarning):
            assert store.read(0) is None
    store.path(0).write_bytes(data)
    np.testing.assert_array_equal(store.read(0)["values"], arrays["values"])


def test_chunk_of_another_place_or_study_is_not_taken(tmp_path, reference):
    run(tmp_path / "one")
    run(tmp_path / "two", key=jax.random.key(4))
    chunks = [tmp_path / "one" / f"chunk-{i:06d}.npz" for i in (0, 1)]
    chunks[0].write_bytes(chunks[1].read_bytes())
    chunks[1].write_bytes((tmp_path / "two" / chunks[1].name).read_bytes())
    with pytest.warns(CorruptChunkWarning) as caught:
        study = run(tmp_path / "one")
    assert len(caught) == 2 and study.chunks_computed == 2
    same(study, reference)


def test_full_disk_ends_clearly_and_keeps_finished_chunks(tmp_path, reference, monkeypatch):
    calls = []

    def fsync(descriptor, original=os.fsync):
        calls.append(descriptor)
        if len(calls) > 7:  # manifest, chunks 0 and 1, file of chunk 2
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        original(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(ChunkWriteError, match="No space left.* finished chunks are kept") as caught:
        run(tmp_path)
    assert caught.value.errno == errno.ENOSPC
    monkeypatch.undo()
    kept = marks(tmp_path)
    assert len(kept) == 3 and not list(tmp_path.glob("*.tmp"))
    study = run(tmp_path)
    assert study.chunks_computed == CHUNKS - len(kept)
    assert kept.items() <= marks(tmp_path).items()
    same(study, reference)


def test_refused_write_of_the_system_is_reported(tmp_path):
    store = ResultsStore(tmp_path, {"study": 1})
    store.write(0, {"values": np.zeros(10)})
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, hard))
    try:
        with pytest.raises(ChunkWriteError, match="Chunk 1 could not be written .*; 1 finished"):
            store.write(1, {"values": np.zeros(1 << 18)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["chunk-000000.npz", "manifest.json"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"batch": 8}, "batch (there 16, here 8)"),
        ({"lanes": 3}, "lanes"),
        ({"key": jax.random.key(4)}, "key (there [0, 3], here [0, 4])"),
        ({"sampling": "pseudo_random"}, "sampling"),
        ({"sobol_indices": True}, "sobol_indices"),
        ({"tolerances": Tolerances({"a": Uniform(0.5), "b": Uniform(0.1 + 1e-16)})}, "tolerances"),
        ({"tolerances": Tolerances({"b": Uniform(0.1), "a": Uniform(0.5)})}, "tolerances"),
        (
            {"problem": FunctionProblem(lambda e: {**swing(e), "z": e["a"] * e["b"] + 1e-15}, ("a", "b"), ("y", "z"))},
            "problem",
        ),
    ],
)
def test_folder_of_another_study_is_refused(tmp_path, changes, words):
    run(tmp_path)
    before = marks(tmp_path)
    with pytest.raises(InputError, match="`resume` must be a new folder or one of") as caught:
        run(tmp_path, **changes)
    assert words in str(caught.value)
    assert marks(tmp_path) == before


EXTENSIONS = [
    {},
    {"sampling": "pseudo_random"},
    {"sobol_indices": True},
    {"sobol_indices": True, "sampling": "pseudo_random"},
]


@pytest.mark.parametrize("options", EXTENSIONS, ids=str)
def test_a_finished_study_is_extended_to_the_bits_of_a_single_run(tmp_path, options):
    small = run(tmp_path / "grown", n=22, **options)
    total = 4 if "sobol_indices" in options else 1  # runs per sample
    stored = 22 * total
    before = marks(tmp_path / "grown")
    grown, whole = run(tmp_path / "grown", **options), run(tmp_path / "whole", **options)
    same(grown, whole)
    assert grown.sobol_indices == whole.sobol_indices
    # Whole chunks are not touched, the last one keeps its samples.
    assert grown.chunks_computed == -(-N * total // BATCH) - stored // BATCH
    after = marks(tmp_path / "grown")
    kept = {f"chunk-{c:06d}.npz" for c in range(stored // BATCH)}
    assert kept == {name for name, mark in before.items() if after[name] == mark}
    for path in (tmp_path / "whole").iterdir():
        assert (tmp_path / "grown" / path.name).read_bytes() == path.read_bytes()
    # Fewer samples again: the first of those that are there.
    again = run(tmp_path / "grown", n=22, **options)
    assert again.chunks_computed == 0 and marks(tmp_path / "grown") == after
    same(again, small)
    assert json.loads((tmp_path / "grown" / "manifest.json").read_text())["n"] == N


def test_samples_that_are_there_are_not_computed_again_by_an_extension(tmp_path, monkeypatch):
    run(tmp_path, n=22)
    counts = []

    def evaluate(problem, tolerances, points, lanes, original=execution.evaluate):
        counts.append(len(points))
        return original(problem, tolerances, points, lanes)

    monkeypatch.setattr(execution, "evaluate", evaluate)
    told = []
    run(tmp_path, n=40, progress=lambda *seen: told.append(seen))
    assert counts == [10, 8]  # the second chunk had 6 of 16 samples
    assert told == [(32, 40), (40, 40)]


def test_an_extension_that_is_interrupted_keeps_the_samples_before_it(tmp_path, reference, monkeypatch):
    run(tmp_path, n=22)
    whole = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def fail(path, payload, original=results_store.write_whole):
        if path.name == "chunk-000001.npz":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        original(path, payload)

    monkeypatch.setattr(results_store, "write_whole", fail)
    with pytest.raises(ChunkWriteError):
        run(tmp_path)
    monkeypatch.undo()
    for name in ("chunk-000000.npz", "chunk-000001.npz"):
        assert (tmp_path / name).read_bytes() == whole[name]
    same(run(tmp_path), reference)


def test_another_process_waits_for_a_chunk_to_be_completed(tmp_path, monkeypatch):
    run(tmp_path, n=22)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(execution, "PATIENCE", 0.2)
    # Chunk 1 is of the other process, and has only 6 of its samples.
    with pytest.raises(TimeoutError, match="1 are missing"):
        run(tmp_path, n=32)


def test_limits_and_quantiles_may_change_on_finished_samples(tmp_path, reference):
    run(tmp_path)
    study = run(tmp_path, limits={"y": 0.1}, quantiles=(0.25,), confidence=0.5)
    assert study.chunks_computed == 0
    assert study.yields["y"].of_good.value == np.mean(reference.values[:, 0] <= 0.1)


def test_folders_that_are_no_study_are_refused(tmp_path):
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "to_anna.txt").write_text("Dear Anna")
    with pytest.raises(InputError, match="holds `to_anna.txt` and no manifest"):
        run(tmp_path / "letters")
    with pytest.raises(InputError, match="is a file"):
        run(tmp_path / "letters" / "to_anna.txt")
    run(tmp_path / "study")
    (tmp_path / "study" / "manifest.json").write_text('{"n": 7')
    with pytest.raises(InputError, match="manifest.json` cannot be read"):
        run(tmp_path / "study")


def test_fingerprint_follows_the_numbers_of_a_problem_and_nothing_else():
    def build(number):
        table = jnp.arange(2000.0) + number
        return FunctionProblem(lambda e: {"y": jnp.sum(table) * e["a"]}, ("a",), ("y",))

    one = fingerprint_problem(build(0.0))
    assert fingerprint_problem(build(0.0)) == one
    assert fingerprint_problem(build(1e-9)) != one


def test_several_processes_need_a_folder_and_do_not_wait_for_ever(tmp_path, monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(execution, "PATIENCE", 0.2)
    with pytest.raises(InputError, match="a folder that all 2 processes share"):
        run()
    with pytest.raises(TimeoutError, match="2 are missing.*finished chunks are kept"):
        run(tmp_path)  # the other process never starts
    assert len(marks(tmp_path)) == 3
    monkeypatch.undo()
    assert run(tmp_path).chunks_computed == 2


def test_samples_of_one_bad_lane_do_not_touch_their_neighbours():
    def diverging(errors):
        # A solver that runs away in some samples: its loop goes on, its values overflow.
        grown = jax.lax.fori_loop(0, 500, lambda _, y: y * (1.0 + 10.0 * errors["a"]), 1.0)
        status = jnp.where(jnp.isfinite(grown), 0, 2)
        return {"y": grown * 0.0 + errors["b"]}, status

    problem = FunctionProblem(diverging, ("a", "b"), ("y",), statuses={2: "diverged"})
    study = run(problem=problem)
    bad = study.status == 2
    assert 0 < bad.sum() < N and study.failures == {"diverged": bad.sum()}
    np.testing.assert_array_equal(study.values[~bad, 0], study.errors[~bad, 1])
    assert np.isnan(study.values[bad]).all()


@pytest.mark.parametrize(
    ("devices", "cores", "specified", "refused"),
    [
        (1, 1, None, False),
        (2, 2, None, True),  # XLA's own choice: as many threads as devices
        (2, 4, None, False),
        (4, 2, None, True),
        (2, 2, "4", False),
        (4, 16, "6", True),  # NPROC counts, not the cores
        (2, 8, "many", False),  # XLA ignores what is no number
    ],
)
def test_devices_without_spare_threads_are_refused(monkeypatch, devices, cores, specified, refused):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    monkeypatch.delenv("NPROC", raising=False)
    if specified is not None:
        monkeypatch.setenv("NPROC", specified)
    found = [types.SimpleNamespace(platform="cpu")] * devices
    if not refused:
        execution.require_threads(found)
        return
    remedy = f'os.environ["NPROC"] = "{2 * max(devices, cores)}"'
    with pytest.raises(InputError, match="`jax_num_cpu_devices` must") as caught:
        execution.require_threads(found)
    assert remedy in str(caught.value) and f"{devices} CPU devices" in str(caught.value)
    execution.require_threads([types.SimpleNamespace(platform="gpu")] * devices)


def test_a_study_on_devices_without_spare_threads_runs_nothing(monkeypatch, tmp_path):
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        pytest.skip("threads are of CPU devices")
    monkeypatch.setattr(jax, "local_devices", lambda: [device] * 64)
    monkeypatch.setenv("NPROC", "64")
    with pytest.raises(InputError, match="NPROC"):
        run(tmp_path)
    assert not marks(tmp_path)


def test_other_studies_evaluate_on_the_chosen_device_or_on_one_where_threads_are_few(monkeypatch):
    device = jax.local_devices()[0]
    if device.platform != "cpu":
        pytest.skip("threads are of CPU devices")
    # Of the devices of this process only their number counts here.
    monkeypatch.setattr(sample_values, "mesh_of", len)
    monkeypatch.setattr(jax, "local_devices", lambda: [device] * 4)
    for threads, used in (("4", 1), ("8", 4)):
        monkeypatch.setenv("NPROC", threads)
        assert sample_values.local_mesh() == used
    with jax.default_device(device):
        assert sample_values.local_mesh() == 1


def test_a_folder_is_judged_before_there_is_a_problem(tmp_path):
    folder, other, metrics = tmp_path / "study", {"mechanism": "b"}, ("y", "z")
    samples = monte_carlo_samples(TOLERANCES, KEY, BATCH, None, "sobol", sobol_indices=False)
    samples.require_folder(folder, metrics, {"mechanism": "a"})
    assert not folder.exists()
    run(folder, description={"mechanism": "a"})
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for same_study in ({"mechanism": "a"}, None, {}):
        samples.require_folder(folder, metrics, same_study)
    with pytest.raises(InputError, match='differs in mechanism .there "a", here "b"'):
        samples.require_folder(folder, metrics, other)
    with pytest.raises(InputError, match="differs in metrics"):
        samples.require_folder(folder, ("y",))
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    # What a study is described by is no part of what it is: the same problem goes on.
    assert run(folder, description=other).chunks_computed == 0
    samples.require_folder(folder, metrics, other)
