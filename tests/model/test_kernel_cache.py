"""Compiled kernels come from a cache that nobody else can write, and never keep gcc for minutes."""

from __future__ import annotations

import pytest

from soup_nlp.model import compile as kernels

SOURCE = "double two(void) { return 2; }\n"


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    if kernels.find_compiler() is None:
        pytest.skip("there is no C compiler")
    monkeypatch.setenv("SOUP_NLP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_a_library_is_compiled_once(cache):
    made = kernels.shared_library("key", lambda: SOURCE)
    assert made.parent == cache
    stamp = made.stat().st_mtime_ns
    assert kernels.shared_library("key", lambda: pytest.fail("compiled again")) == made
    assert made.stat().st_mtime_ns == stamp


@pytest.mark.parametrize("mode", [0o720, 0o702])
def test_a_library_that_others_can_write_is_not_loaded(mode, cache, caplog):
    made = kernels.shared_library("key", lambda: SOURCE)
    made.chmod(mode)
    other = kernels.shared_library("key", lambda: SOURCE)
    assert other.is_file()
    assert other.parent != cache
    assert "others can write" in caplog.text


@pytest.mark.parametrize("mode", [0o720, 0o702])
def test_a_folder_that_others_can_write_is_not_used(mode, cache, caplog):
    cache.mkdir()
    cache.chmod(mode)
    made = kernels.shared_library("key", lambda: SOURCE)
    assert made.parent != cache
    assert not list(cache.iterdir())
    assert "others can write" in caplog.text


def test_a_source_that_would_take_minutes_is_not_compiled(cache, caplog, monkeypatch):
    monkeypatch.setattr(kernels, "MOST_SOURCE", len(SOURCE) - 1)
    assert kernels.shared_library("key", lambda: SOURCE) is None
    assert "would take minutes" in caplog.text
