"""Compile the kernels of a module for an H100; no driver is needed."""

import subprocess
import sys
from pathlib import Path

import pytest


def ptx_of(name: str, folder: Path, package: str = "mover.geometry.kernels") -> str:
    """The code of a module of kernels for sm_90; skips where Warp cannot make it."""
    code = (
        f"import sys, warp as wp; from {package} import {name} as module;"
        "90 in wp.get_cuda_supported_archs() or sys.exit(77);"
        "wp.compile_aot_module(module, arch=90, module_dir=sys.argv[1], use_ptx=True)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True)
    if done.returncode == 77:
        pytest.skip("this build of Warp has no CUDA compiler")
    assert done.returncode == 0, done.stderr.decode()
    text = "".join(p.read_text() for p in folder.glob("*.ptx"))
    assert ".target sm_90" in text
    assert ".entry" in text
    return text
