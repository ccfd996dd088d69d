"""What every test file shares."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED_DATA = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real pairs; tests that use it carry `pytest.mark.shared`."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"the real pairs are not here: no folder {SHARED_DATA.resolve()}")
    return SHARED_DATA.resolve()
