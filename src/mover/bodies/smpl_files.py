"""Finds and reads the user's own files of the SMPL family; none is shipped."""

import os
import zipfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..pickles import load_pickle
from ..records import BROKEN, InputError
from .smpl_arrays import FACE_KEYS, body_from, keys_of
from .smpl_model import SmplBody

FOLDER = "MOVER_BODY_MODELS"
"""Environment variable with the folder of the user's body models."""
ENDINGS = (".npz", ".pkl")
LARGEST = 2 << 30  # [bytes], of an array
OFFICIAL = {
    "neutral": ("basicModel_neutral_lbs_10_207_0_v1.0.0", "basicmodel_neutral_lbs_10_207_0_v1.1.0"),
    "male": ("basicmodel_m_lbs_10_207_0_v1.0.0", "basicmodel_m_lbs_10_207_0_v1.1.0",
             "basicModel_m_lbs_10_207_0_v1.0.0"),
    "female": ("basicModel_f_lbs_10_207_0_v1.0.0", "basicmodel_f_lbs_10_207_0_v1.1.0"),
}  # fmt: skip
"""Names that SMPL's own downloads have."""


def load_smpl(name: str, gender: str = "neutral", place: Path | None = None) -> SmplBody:
    """A body of the SMPL family from the user's file.

    Args:
        name: `smpl`, `smplh` or `smplx`.
        gender: `neutral`, `female` or `male`.
        place: The file, or the folder of the models (`smplx/SMPLX_NEUTRAL.npz` and so on); if not
            given, the folder that the environment variable `MOVER_BODY_MODELS` names.

    Raises:
        InputError: If the file is not there or is not one of this model.
    """
    path = find_file(name, gender, place)
    return _read(path, name, gender, path.stat().st_mtime_ns)


def find_file(name: str, gender: str, place: Path | None = None) -> Path:
    """The user's file of a model.

    Raises:
        InputError: If there is none; the message names where it was looked for.
    """
    if place is None:
        given = os.environ.get(FOLDER)
        if not given:
            raise InputError(
                f"the body model '{name}' is licensed and not shipped, expected its files in the "
                f"folder that {FOLDER} names ({_names(name, gender)[0]}.npz); meshes ('vertices' "
                "and 'faces') are enough without a model"
            )
        place = Path(given)
    if place.is_file():
        return place
    tried = [place / f"{stem}{end}" for stem in _names(name, gender) for end in ENDINGS]
    for path in tried:
        if path.is_file():
            return path
    there = sorted(p.name for p in place.glob("*"))[:8] if place.is_dir() else []
    raise InputError(
        f"{place}: has no file of the body model '{name}' ({gender}), expected "
        f"{_names(name, gender)[0]}.npz or .pkl; found {', '.join(there) or 'nothing'}"
    )


def _names(name: str, gender: str) -> list[str]:
    """Where a file may be in the folder, without its ending."""
    stem = f"{name.upper()}_{gender.upper()}"
    stems = [f"{name}/{stem}", stem, f"models/{name}/{stem}", f"{name}/{gender}/model"]
    if name == "smpl":
        stems += [f"{root}{stem}" for root in ("smpl/", "") for stem in OFFICIAL[gender]]
    return stems


@lru_cache(maxsize=4)
def _read(path: Path, name: str, gender: str, _changed: int) -> SmplBody:
    """The model in a file; read again when the file changes."""
    if path.suffix == ".npz":
        arrays: dict[str, Any] = _npz(path, name)
    else:
        found = load_pickle(path)
        if not isinstance(found, dict):
            raise InputError(f"{path.name}: is no dictionary, expected a file of '{name}'")
        arrays = {str(key): value for key, value in found.items()}
    return body_from(arrays, name, gender, path.name)


def _npz(path: Path, name: str) -> dict[str, Any]:
    """The arrays that the model needs; others, pickled or not, are not opened.

    Raises:
        InputError: If the file is broken, or one of them is a pickled object or too large.
    """
    file = path.name
    wanted = {*keys_of(name), *FACE_KEYS}
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {e.filename.removesuffix(".npy"): e.file_size for e in archive.infolist()}
        for key in wanted & set(sizes):
            if sizes[key] > LARGEST:
                raise InputError(f"{file}: field '{key}' has {sizes[key]} bytes, too many")
        arrays: dict[str, Any] = dict.fromkeys(sizes)
        with np.load(path, allow_pickle=False) as data:
            for key in sorted(wanted & set(sizes)):
                arrays[key] = _member(data, key, file)
    except BROKEN as error:
        why = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        raise InputError(f"{file}: cannot be read ({why}), expected an .npz file") from error
    return arrays


def _member(data: Any, key: str, file: str) -> Any:  # noqa: ANN401
    """One array of numbers."""
    try:
        return data[key]
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
        raise InputError(
            f"{file}: field '{key}' is a pickled object, expected plain numbers"
        ) from error
