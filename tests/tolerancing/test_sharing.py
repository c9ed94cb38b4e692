"""Several processes have one folder: they leave each other's files alone, and notice when one of them stops."""

import os
import platform
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest

from rfem_jax.tolerancing.problems import execution, sharing
from rfem_jax.tolerancing.problems.kept_evaluations import kept_in, remembered
from rfem_jax.tolerancing.problems.results_store import ResultsStore
from rfem_jax.whole_files import PATIENCE, UNFINISHED, remove_abandoned, replacing

from .test_faults import marks, run


def left_by(path, process, machine=None):
    """An unfinished file beside `path`, as process number `process` of a machine names it."""
    with replacing(path) as temporary:
        name = temporary.name.replace(f"-{os.getpid()}-", f"-{process}-")
        temporary.touch()
    path.unlink()
    if machine is not None:
        name = name.replace(platform.node(), machine)
    file = path.with_name(name)
    file.touch()
    return file


@pytest.fixture
def dead():
    """Number of a process that is no more."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.mark.skipif(os.name != "posix", reason="processes are asked for by their numbers")
def test_unfinished_files_of_living_processes_stay(tmp_path, dead, monkeypatch):
    monkeypatch.setattr(platform, "node", lambda: "here")
    path = tmp_path / "chunk-000003.npz"
    living, killed = left_by(path, os.getpid()), left_by(path, dead)
    elsewhere, old = left_by(path, dead, "there"), left_by(path, os.getpid(), "there2")
    os.utime(old, (time.time() - 2 * PATIENCE,) * 2)
    of_another = left_by(tmp_path / "chunk-000004.npz", dead)
    remove_abandoned(path)
    assert sorted(tmp_path.iterdir()) == sorted([living, elsewhere, of_another])
    assert killed.name.endswith(UNFINISHED) and not killed.exists()


def test_a_chunk_that_another_process_writes_is_not_disturbed(tmp_path):
    one, other = ResultsStore(tmp_path, {"study": 1}), ResultsStore(tmp_path, {"study": 1})
    arrays = {"x": np.arange(3.0)}
    with replacing(one.path(0)) as temporary:
        temporary.write_bytes(b"half")
        other.write(0, arrays)
        assert temporary.exists()
        shutil.copy(other.path(0), temporary)
    np.testing.assert_array_equal(one.read(0)["x"], arrays["x"])


class Known:
    """A problem that is known by its name."""

    def fingerprint(self):
        return "known"


def test_evaluations_are_kept_though_another_process_removed_the_folder(tmp_path):
    folder = tmp_path / "optimise.unfinished"
    with kept_in(folder):
        for number in range(2):
            found = remembered(Known(), number, lambda: [np.full(2, float(number))])
            np.testing.assert_array_equal(found[0], float(number))
            assert len(list(folder.glob("chunk-*.npz"))) == 1
            shutil.rmtree(folder)  # as the other one does that has ended


def test_a_process_that_stops_is_noticed_by_its_signs(tmp_path, monkeypatch):
    monkeypatch.setattr(sharing, "EVERY", 0.01)
    monkeypatch.setattr(sharing, "SILENCE", 0.3)
    sign = tmp_path / "process-1.alive"
    sign.write_text("left by an earlier run", encoding="utf-8")
    with sharing.shared_among(0, 2), sharing.SignsOfLife(tmp_path) as signs:
        own = (tmp_path / "process-0.alive").read_text(encoding="utf-8")
        time.sleep(0.5)
        assert (tmp_path / "process-0.alive").read_text(encoding="utf-8") != own
        assert signs.stopped() == []  # it has not begun
        for number in range(20):
            sign.write_text(f"alive {number}", encoding="utf-8")
            time.sleep(0.03)
        assert signs.stopped() == []
        time.sleep(0.5)
        assert signs.stopped() == [1]
    assert not (tmp_path / "process-0.alive").exists()


def test_those_that_are_left_end_with_a_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(sharing.SignsOfLife, "stopped", lambda signs: [1])
    monkeypatch.setattr(execution, "POLL", 0.01)
    with (
        sharing.shared_among(0, 2),
        pytest.raises(TimeoutError, match=r"Process 1 has stopped.*2 chunks are missing.*finished chunks are kept"),
    ):
        run(tmp_path)
    assert len(marks(tmp_path)) == 3
    with sharing.shared_among(0, 1):
        assert run(tmp_path).chunks_computed == 2  # the others serve
    assert (sharing.process_index(), sharing.process_count()) == (0, 1)
