"""Cases of ``tests.standin.cases``, each in a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pipeline.conftest import shards  # noqa: F401

ROOT = Path(__file__).parents[2]


@pytest.fixture
def case():
    """Run a case and return what it found."""

    def run(*arguments):
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-m", "tests.standin.cases", *arguments],
            capture_output=True,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            cwd=ROOT,
            timeout=600,
        )
        assert done.returncode == 0, done.stderr[-3000:]
        return json.loads(done.stdout.splitlines()[-1])

    return run
