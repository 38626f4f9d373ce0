"""MATLAB files, read in a process of their own: scipy's reader can die of a damaged one."""

import pickle
import subprocess
import sys
from pathlib import Path

from ..records import InputError
from .fields import At

READ = """
import pickle, sys, warnings
from scipy.io import loadmat
warnings.simplefilter("ignore")
try:
    said = loadmat(sys.argv[1])
except Exception as error:  # the parser raises anything on broken files
    said = " ".join(f"{type(error).__name__}: {error}".split())[:160]
sys.stdout.buffer.write(pickle.dumps(said))
"""
"""Writes the arrays, or the error in one line."""


def load_mat(path: Path) -> At:
    """The arrays of a MATLAB file.

    Raises:
        InputError: If it cannot be read.
    """
    if not path.is_file():
        raise InputError(f"{path.name}: there is no such file in {path.parent}")
    call = [sys.executable, "-P", "-c", READ, str(path.resolve())]
    done = subprocess.run(call, capture_output=True, check=False)
    said = pickle.loads(done.stdout) if done.returncode == 0 else "its reader died"
    if isinstance(said, str):
        raise InputError(f"{path.name}: cannot be read ({said}), expected a .mat file")
    return At(said, path.name)
