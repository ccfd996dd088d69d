"""Some rows of the table of kills; `tests/tools/kill_table.py --kills 60` makes the whole."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow


def test_killed_exports_leave_whole_folders():
    script = Path(__file__).parents[1] / "tools" / "kill_table.py"
    words = [sys.executable, str(script), "--kills", "3", "--only", "export"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    rows = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert len(rows) == 4, done.stderr
    for row in rows:
        assert not row["broken"], row
        assert not row.get("left"), row
    assert done.returncode == 0, done.stdout
