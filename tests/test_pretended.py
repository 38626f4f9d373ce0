"""What `test_device.py` asks of a pretended device, in a process that knows it from the start."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from pretended import OWN

TESTS = Path(__file__).parent


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is here: nothing is pretended")
def test_the_main_job_does_the_same_on_a_device_that_is_not_the_cpu() -> None:
    pytest.importorskip("warp")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-rs"]
    command += ["-m", "not gpu", str(TESTS / "test_device.py")]
    ended = subprocess.run(
        command, cwd=TESTS.parent, env={**os.environ, OWN: "1"}, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stdout
    assert "process of its own" not in ended.stdout
    passed = re.search(r"(\d+) passed", ended.stdout)
    assert passed is not None
    assert int(passed[1]) >= 11
