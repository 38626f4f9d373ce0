"""Files that are whole or not there. Imports nothing heavy: commands answer at once."""

import functools
import glob
import hashlib
import os
import re
import shutil
import sys
import tempfile
import time
import zipfile
import zlib
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from tokenize import TokenError

from mover import __version__
from mover.core.errors import InputError

BROKEN = (
    OSError, ValueError, KeyError, IndexError, EOFError, RuntimeError, MemoryError,
    TypeError, AttributeError, zipfile.BadZipFile, zlib.error,
    SyntaxError, TokenError,  # numpy's headers are Python
)  # fmt: skip
"""What reading a broken file of arrays raises."""

LEFT = 3600  # [s], no file is written for so long
INSTEAD = {
    rb"version https://git-lfs": "it is a pointer of Git LFS, not the file: run `git lfs pull`",
    rb"\s*<(!doctype )?html": "it is a web page in place of the file: download the file itself",
    rb"(?s).{4}ftyp(hei|mif|avif)": "it is a picture of a phone (HEIC): save it as JPEG or PNG",
    rb"(?s).{4}ftyp|\x1aE\xdf\xa3": "it is a video: save one of its frames as JPEG or PNG",
    rb"\xff\xfe|\xfe\xff": "it is text in UTF-16: save it as UTF-8",
    rb"\Z": "it is empty: copy or download it again",
}
"""What a file may be instead of what was expected, by its first bytes."""
PICKLES = (".pkl", ".pickle", ".joblib", ".pt", ".pth")
KNOWN = {
    rb"PK\x03\x04|PK\x05\x06": ("it is a zip archive: unpack it", (".npz", *PICKLES)),
    rb"\x1f\x8b": ("it is packed by gzip: unpack it (gunzip)", PICKLES),
    rb"\x93NUMPY": ("it is an array of NumPy: call it .npy", (".npy", *PICKLES)),
    rb'\s*(\{\s*["}]|\[\s*[]{])': ("it is JSON: call it .json", (".json", ".gltf")),
}
"""The same of files whose names do not end as theirs do."""
OTHER_WORDS = r"magic string|Not a ply file|Expecting value: line 1 column 1 "
"""What parsers say of a file that is of another kind."""


@contextmanager
def replacing(path: Path) -> Generator[Path, None, None]:
    """Give a temporary file beside `path` that takes its place when the block ends well.

    Those that a killed process left for the same file are removed an hour later.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in path.parent.glob(f".{glob.escape(path.stem)}-*{glob.escape(path.suffix)}"):
        with suppress(OSError):
            if time.time() - left.stat().st_mtime > LEFT:
                left.unlink()
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    os.close(handle)
    os.chmod(name, 0o644)
    try:
        yield Path(name)
        os.replace(name, path)
    finally:
        Path(name).unlink(missing_ok=True)


def copy_whole(source: Path, target: Path) -> None:
    """Copy a file so that the copy is whole or not there; a file onto itself is left alone."""
    if target.exists() and target.samefile(source):
        return
    with replacing(target) as part:
        shutil.copyfile(source, part)


def instead(path: Path) -> str:
    """What a file is in place of what was expected; empty: nothing that is known."""
    if path.is_file():
        with suppress(OSError), path.open("rb") as file:
            head, kind = file.read(64), path.suffix.lower()
            words = INSTEAD | {k: word for k, (word, own) in KNOWN.items() if kind not in own}
            return next((w for start, w in words.items() if re.match(start, head, re.I)), "")
    return ""


def not_there(path: Path, missing: str = "there is no such file") -> str:
    """What to say of a path that is no file: a pipe is there, or nothing."""
    kinds = {
        "a folder": path.is_dir(), "a pipe": path.is_fifo(), "a socket": path.is_socket(),
        "a device": path.is_char_device() or path.is_block_device(),
    }  # fmt: skip
    return next((f"is no file ({kind})" for kind, there in kinds.items() if there), missing)


def reason(error: Exception, path: Path | None = None) -> str:
    """Why a file cannot be read, in one short line without Python's own words."""
    if path is not None and (found := instead(path)):
        return found
    if isinstance(error, UnicodeError):
        return "it is no text in UTF-8: save it as UTF-8"
    if "cannot identify image file" in str(error):
        return "it is no picture that can be opened, such as JPEG or PNG"
    if large := re.match(r"Image size \((\d+) pixels\) exceeds limit of (\d+)", str(error)):
        return f"it is too large: {large[1]} pixels, at most {large[2]} are read"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    spoken = isinstance(error, ValueError | RuntimeError | SyntaxError | OSError) or path is None
    if spoken and str(error) and not re.search(OTHER_WORDS, str(error)):
        return " ".join(str(error).split())[:160]
    return "it is damaged, cut off or of another kind"


def unreadable(path: Path, why: Exception | str, expected: str) -> InputError:
    """The error of a file that cannot be read, to be raised."""
    said = reason(ValueError(why) if isinstance(why, str) else why, path)
    name = path.name or path.resolve().name
    return InputError(f"{name}: cannot be read ({said}), expected {expected}")


def fingerprint_of_files(settings: str, *paths: Path) -> str:
    """Of settings and of what files, and all in folders, are: names, sizes, times of change."""
    digest = hashlib.sha256(settings.encode())
    for root in paths:
        for path in sorted(root.rglob("*")) if root.is_dir() else [root]:
            if path.is_file():
                file, name = path.stat(), path.relative_to(root).as_posix()
                digest.update(f"\n{name} {file.st_size} {file.st_mtime_ns}".encode())
    return digest.hexdigest()[:16]


@functools.cache
def sources(package: str = "mover") -> str:
    """Digest of the version and sources of `mover`, and of another package that builds on it."""
    digest = hashlib.sha256(__version__.encode())
    for name in dict.fromkeys(("mover", package)):
        for folder in getattr(sys.modules.get(name), "__path__", ()):
            for path in sorted(Path(folder).rglob("*.py")):
                digest.update(path.read_bytes())
    return digest.hexdigest()
