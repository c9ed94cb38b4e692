"""What a command took last time is loaded when it starts again, and used where it is the right program."""

import threading

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.compilation import keeping, last_time
from rfem_jax.compilation.executable import Packed
from tests.compilation.functions import oscillator, swing_kept

COMPILED_AS_SHIPPED = True

X = jnp.linspace(0.2, 0.9, 3)


@pytest.fixture
def threads(monkeypatch):
    """The threads that loaded programs, in their order."""
    found, finish = [], Packed.finish

    def watched(packed):
        found.append(threading.current_thread())
        return finish(packed)

    monkeypatch.setattr(Packed, "finish", watched)
    return found


def take(study="study.toml", steps=3):
    """As the command that runs a study, in a process of its own."""
    swing_kept.clear()
    with last_time.loading("run", study):
        found = swing_kept(oscillator(steps=steps), X)
    return np.asarray(found.path)


def test_what_a_command_took_is_loaded_in_the_background_next_time(kept, threads, monkeypatch):
    first = take()
    assert (kept.traced, kept.loaded, kept.written) == (1, 0, 1) and not threads
    reads, read = [], keeping.read
    monkeypatch.setattr(keeping, "read", lambda key: reads.append(key) or read(key))
    np.testing.assert_array_equal(take(), first)
    assert (kept.traced, kept.loaded, kept.written) == (1, 1, 1)
    assert len(threads) == 1 and threads[0] is not threading.main_thread()
    assert len(reads) == 2  # the list, and the program: before it was asked for
    take("another.toml")
    assert kept.loaded == 2 and threads[1] is threading.main_thread()


def test_a_changed_study_takes_its_own_programs_and_is_known_by_them_then(kept, threads):
    take()
    changed = take(steps=4)
    assert (kept.traced, kept.loaded) == (2, 0) and changed.shape[0] == 4
    del threads[:]
    np.testing.assert_array_equal(take(steps=4), changed)
    assert (kept.traced, kept.loaded) == (2, 1)
    assert len(threads) == 1 and threads[0] is not threading.main_thread()


def test_a_program_that_xla_cannot_load_is_traced_anew(kept, monkeypatch):
    first = take()

    def fail(packed):
        raise RuntimeError("of another processor")

    monkeypatch.setattr(Packed, "finish", fail)
    np.testing.assert_array_equal(take(), first)
    assert (kept.traced, kept.loaded, kept.written) == (2, 0, 2)


@pytest.mark.parametrize("what", ["list", "program"])
def test_what_is_damaged_is_not_used(kept, tmp_path, what, monkeypatch):
    first = take()
    for file in (tmp_path / "programs").iterdir():
        is_list = len(file.read_bytes()) < 200
        if is_list == (what == "list"):
            keeping.write(file.stem, b"\xff\n../../nonsense\nwhole, but no program")
    asked, read = [], keeping.read
    monkeypatch.setattr(keeping, "read", lambda key: asked.append(key) or read(key))
    for _ in range(2):
        np.testing.assert_array_equal(take(), first)
        assert kept.traced == (1 if what == "list" else 2)
    assert all(last_time.KEY.fullmatch(key) for key in asked)  # others could lead out of the folder


def test_where_programs_are_not_kept_nothing_is_read_or_remembered(monkeypatch):
    monkeypatch.setattr(keeping, "_choice", keeping._Choice(None))
    for name in ("read", "write"):
        monkeypatch.setattr(keeping, name, lambda *_: pytest.fail("without a folder"))
    take()
    take()


def test_what_was_loaded_in_vain_is_forgotten(kept):
    take()
    with last_time.loading("run", "study.toml"):
        (key,) = last_time._ahead
    assert last_time.take(key) is None
