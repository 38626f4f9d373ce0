"""What a tool left on disk, as plain values: arrays, numbers, text, lists and mappings."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...records import BROKEN, InputError
from ..fields import LARGEST_FILE, At, read_json, reason
from ..npz_file import read_npz
from ..safe_pickle import load_pickle

KINDS = (".npz", ".npy", ".pkl", ".pickle", ".joblib", ".pt", ".pth", ".json")


def read_any(path: Path) -> At:
    """The content of a file, read without running anything in it.

    Raises:
        InputError: If it is missing, too large, of another kind, broken, or holds objects.
    """
    if not path.is_file():
        raise InputError(f"{path.name}: there is no such file in {path.parent}")
    if path.stat().st_size > LARGEST_FILE:
        size = path.stat().st_size
        raise InputError(f"{path.name}: has {size} bytes, expected at most {LARGEST_FILE}")
    match path.suffix.lower():
        case ".npz":
            return read_npz(path)
        case ".json":
            return read_json(path)
        case ".npy":
            value = _read_npy(path)
        case ".pt" | ".pth":
            value = _read_torch(path)
        case ".pkl" | ".pickle" | ".joblib":
            value = load_pickle(path)
        case _:
            raise InputError(f"{path.name}: is no file of kind {', '.join(KINDS)}")
    return At(as_plain(value), path.name)


def _read_npy(path: Path) -> object:
    """An array of plain numbers, or the pickled object in its place."""
    try:
        return np.load(path, allow_pickle=False)
    except ValueError:
        return load_pickle(path)
    except BROKEN as error:
        raise InputError(f"{path.name}: cannot be read ({reason(error)})") from error


def _read_torch(path: Path) -> object:
    """A file of torch.save that holds tensors and plain values only."""
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # its parsers raise anything on broken files
        raise InputError(
            f"{path.name}: cannot be read ({reason(error)}), expected torch.save of tensors"
        ) from error


def as_plain(value: Any) -> Any:  # noqa: ANN401
    """Tensors as arrays at any depth, keys as text, arrays of objects as lists."""
    if isinstance(value, torch.Tensor):
        return value.detach().cpu().float().numpy() if value.is_floating_point() else value.numpy()
    if isinstance(value, np.ndarray) and value.dtype == object:
        return as_plain(value.item() if value.ndim == 0 else value.tolist())
    if isinstance(value, Mapping):
        return {str(key): as_plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [as_plain(each) for each in value]
    return value


def natural(path: Path) -> tuple[tuple[int, str], ...]:
    """A key that sorts names as people do: 2 before 10."""
    parts = re.split(r"(\d+)", str(path))
    return tuple((int(p), "") if p.isdigit() else (-1, p) for p in parts)
