"""The folder of kept programs: refused unless it belongs to the user; files are complete or absent; limited size."""

import multiprocessing
import os
import stat

import pytest

from rfem_jax.compilation.cache import Folder, UnsafeFolder

KEY, OTHER = "a" * 64, "b" * 64


def test_what_was_written_is_read_again(tmp_path):
    folder = Folder(tmp_path / "deep" / "programs")
    assert folder.read(KEY) is None
    folder.write(KEY, b"one")
    folder.write(OTHER, b"other")
    folder.write(KEY, b"two")
    assert Folder(tmp_path / "deep" / "programs").read(KEY) == b"two"
    assert folder.read(OTHER) == b"other"
    folder.delete(KEY)
    assert folder.read(KEY) is None
    assert stat.S_IMODE(folder.path.stat().st_mode) == 0o700
    assert all(stat.S_IMODE(file.stat().st_mode) == 0o600 for file in folder.path.iterdir())


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o750, 0o755])
def test_a_folder_open_to_others_is_refused(tmp_path, mode):
    path = tmp_path / "programs"
    folder = Folder(path)
    path.chmod(mode)
    with pytest.raises(UnsafeFolder, match="0700"):
        Folder(path)
    with pytest.raises(UnsafeFolder):
        folder.read(KEY)
    with pytest.raises(UnsafeFolder):
        folder.write(KEY, b"content")


def test_links_are_refused(tmp_path):
    real = Folder(tmp_path / "real")
    real.write(KEY, b"content")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with pytest.raises(UnsafeFolder, match="link"):
        Folder(tmp_path / "link")
    file = tmp_path / "real" / f"{KEY}.program"
    file.rename(tmp_path / "elsewhere")
    file.symlink_to(tmp_path / "elsewhere")
    assert real.read(KEY) is None
    real.write(KEY, b"new")
    assert real.read(KEY) == b"new" and not file.is_symlink()


def test_somebody_elses_folder_is_refused(tmp_path, monkeypatch):
    folder = Folder(tmp_path / "programs")
    folder.write(KEY, b"content")
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(UnsafeFolder, match="somebody else"):
        folder.read(KEY)


@pytest.mark.parametrize(
    "damage", [lambda x: x[:-1], lambda x: x[:40] + b"?" + x[41:], lambda x: b"", lambda x: x + b"!"]
)
def test_a_damaged_file_is_deleted(tmp_path, damage):
    folder = Folder(tmp_path / "programs")
    folder.write(KEY, bytes(100))
    file = folder.path / f"{KEY}.program"
    file.write_bytes(damage(file.read_bytes()))
    assert folder.read(KEY) is None
    assert not file.exists()


def test_the_least_recently_used_are_deleted_first(tmp_path):
    folder = Folder(tmp_path / "programs", limit=1000)
    keys = [letter * 64 for letter in "abc"]
    for age, key in zip((300, 200, 100), keys):
        folder.write(key, bytes(250))
        past = os.stat(folder.path).st_mtime - age
        os.utime(folder.path / f"{key}.program", (past, past))
    assert folder.read(keys[0]) is not None  # used again
    folder.write("d" * 64, bytes(250))
    assert [folder.read(key) is None for key in (*keys, "d" * 64)] == [False, True, False, False]
    folder.write("e" * 64, bytes(2000))  # larger than the limit: it stays alone
    assert sorted(file.name[0] for file in folder.path.iterdir()) == ["e"]


def test_unfinished_files_are_deleted(tmp_path):
    folder = Folder(tmp_path / "programs")
    old, new = (folder.path / f"{KEY}.{name}.part" for name in ("old", "new"))
    for file in (old, new):
        file.write_bytes(b"half")
    os.utime(old, (0, 0))
    folder.write(KEY, b"content")
    assert not old.exists() and new.exists()


def _write_and_read(path, letter):
    folder = Folder(path, limit=5000)
    for i in range(200):
        folder.write(KEY, letter * 1000)
        found = folder.read(KEY)
        assert found is None or (len(set(found)) == 1 and len(found) == 1000)
        folder.write(f"{i:064d}", letter * 500)


def test_two_processes_at_once(tmp_path):
    context = multiprocessing.get_context("spawn")
    processes = [
        context.Process(target=_write_and_read, args=(tmp_path / "programs", letter)) for letter in (b"x", b"y")
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0]
    assert Folder(tmp_path / "programs").read(KEY) in (b"x" * 1000, b"y" * 1000)
    assert not list((tmp_path / "programs").glob("*.part"))
