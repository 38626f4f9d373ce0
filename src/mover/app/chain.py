"""From a video to a room, step by step: what is finished stays, what you replace stays, too.

OUT/capture      an ordinary capture: every file in it may be replaced by a better tool's
OUT/room         the result, as `mover run` writes it
OUT/steps.json   what each step was made from, and what it took

A step is done again only where what it was made from has changed; a file that was replaced in
between is what the later steps read.
"""

import hashlib
import json
import shlex
import subprocess
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mover.core.errors import InputError

Say = Callable[[str], None]
FIT = "fit"
OUT = "{out}"  # which marks a command, not a file


@dataclass(frozen=True)
class Steps:
    """The steps of one folder."""

    folder: Path
    say: Say
    names: tuple[str, ...]  #: all steps in their order
    log: dict[str, dict[str, Any]] = field(default_factory=lambda: {})
    """What each took, and the hash of what it was made from."""
    files: dict[str, str] = field(default_factory=lambda: {})
    """Hash of each file that several steps write as they left it, and of the flags that made it."""

    def do(
        self,
        name: str,
        made_from: Iterable[Path | str],
        made: Path,
        work: Callable[[], None],
        *,
        yours: bool = False,
        of: str = "",
    ) -> None:
        """Do a step by `work` unless its last file `made` is there, made from the same.

        `made_from` are files, and words for settings; `yours`: a result that was replaced stays,
        whatever it would be made from now; `of` are the video and its lens.
        """
        key, number = digest(made_from), f"{self.names.index(name) + 1}/{len(self.names)}"
        before = self.log.get(name, {})
        if made.exists() and before.get("made_from") == key:
            self.say(f"{number} {name}: kept")
            return
        if yours and made.exists() and before.get("made") not in (None, digest([made])):
            self.say(f"{number} {name}: {self._staying(name, made, of)}")
            return
        self.say(f"{number} {name} ...")
        start = time.monotonic()
        work()
        seconds = round(time.monotonic() - start, 1)
        self.log[name] = {"made_from": key, "made": digest([made]), "seconds": seconds, "of": of}
        self._save()
        self.say(f"{number} {name}: {seconds:.0f} s")

    def changed(self, file: Path) -> bool:
        """Whether one of `files` was replaced or removed since a step wrote it."""
        return self.files.get(file.name, now := digest([file])) != now

    @contextmanager
    def writing(self, *files: Path) -> Generator[None]:
        """A block that writes files of which those that were replaced go on to be the user's."""
        own = [file for file in files if not (file.exists() and self.changed(file))]
        for file in own:  # a killed process leaves none that looks like the user's
            self.files.pop(file.name, None)
        self._save()
        try:
            yield
        finally:
            self.files.update({file.name: digest([file]) for file in own})
            self._save()

    def stays(self, name: str, file: Path, flags: Sequence[object], of: str) -> bool:
        """Whether a file was replaced and no flag that gives it is new in this command; it is said.

        Of a file that does not stay it is forgotten that it was replaced.
        """
        key = digest_of(flags)
        new = any(flags) and self.files.get(f"flags {file.name}") != key
        if any(flags):
            self.files[f"flags {file.name}"] = key
        if not (file.exists() and self.changed(file)):
            return False
        if new:
            del self.files[file.name]
            self.say(f"{file.name} was yours: what the flags of this command give replaces it")
        else:
            self.say(self._staying(name, file, of))
        return not new

    def _staying(self, name: str, file: Path, of: str) -> str:
        """The line of a file that stays as the user has it."""
        other = self.log.get(name, {}).get("of", of) != of
        since = ", though the video or its lens has changed" if other else ""
        return f"{file.name} is yours and stays{since}; without it, it is made"

    def _save(self) -> None:
        from mover.io.files.fields import write_json

        write_json({"steps": self.log, "files": self.files}, self.folder / "steps.json")

    def undo(self, name: str, made: Path) -> None:
        """Remove what the step made, of another video; what was put in its place stays."""
        if made.exists() and self.log.get(name, {}).get("made") == digest([made]):
            made.unlink()


def steps_in(folder: Path, say: Say, names: tuple[str, ...]) -> Steps:
    """The steps of a folder, with what an earlier run has finished; a damaged log is dropped."""
    folder.mkdir(parents=True, exist_ok=True)
    file, log, files = folder / "steps.json", dict[str, dict[str, Any]](), dict[str, str]()
    if file.is_file():
        try:
            tree = json.loads(file.read_text())
            log = {str(name): dict(step) for name, step in tree["steps"].items()}
            files = dict(tree.get("files", {}))
        except (ValueError, KeyError, TypeError, AttributeError):
            say(f"warning: {file.name} is damaged and is dropped: all steps are done again")
    return Steps(folder, say, names, log, files)


def digest(made_from: Iterable[Path | str]) -> str:
    """Hash of words, of files by content, of folders by sizes and times; what lacks counts, too."""
    found = hashlib.sha256()
    for part in made_from:
        if isinstance(part, str):
            found.update(b"word" + part.encode())
        elif part.is_file():
            found.update(b"file" + hashlib.sha256(part.read_bytes()).digest())
        elif part.is_dir():
            stats = sorted((str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in part.iterdir())
            found.update(b"folder" + repr(stats).encode())
        else:
            found.update(b"none")
    return found.hexdigest()[:16]


def digest_of(flags: Sequence[object]) -> str:
    """Hash of what flags give: files by content, all else as words."""
    return digest(flag if isinstance(flag, Path) else str(flag) for flag in flags)


def check_bodies(source: str, tool: str) -> None:
    """Refuse what cannot work, before any other step.

    `source` is `fit`, a file or folder, or a command with {out} in it; `tool` is what writes it, a
    name of `mover import-bodies`, or empty for bodies.npz.

    Raises:
        InputError: If there is no such file or tool.
    """
    from mover.io.formats import names

    if tool and tool not in names("people"):
        raise InputError(f"--bodies-tool: {tool!r} is none of {', '.join(names('people'))}")
    if source != FIT and OUT not in source and not Path(source).exists():
        raise InputError(
            f"--bodies: {source!r} is neither `fit`, nor a file or folder that is there, "
            "nor a command with {out} in it"
        )


def import_bodies(source: str, tool: str, video: Path, capture: Path) -> None:
    """Write CAPTURE/bodies.npz from a file, or by a command.

    A command has the user's {video}, and {frames} and {camera} of the capture.

    Raises:
        InputError: If the command fails, or what was written cannot be read.
    """
    from mover.io.capture.bodies_file import read_bodies, write_bodies
    from mover.io.capture.camera_file import camera_of
    from mover.io.files.cameras import read_camera_file
    from mover.io.people.bodies import bodies_from
    from mover.io.people.found import Known

    file, lens = Path(source), capture / "camera.json"
    if OUT in source:
        file = capture / ("bodies-by-command" if tool else "bodies-by-command.npz")
        places = {"video": video, "frames": capture / "frames", "camera": lens, "out": file}
        run_command_line("--bodies", source, places)
    if tool:
        known = Known(camera_of(read_camera_file(lens, None)))
        bodies = bodies_from(tool, file, known).bodies
    else:
        bodies = read_bodies(file)
    write_bodies(bodies, capture / "bodies.npz")


def run_command_line(flag: str, command: str, places: dict[str, Path]) -> None:
    """Run a user's command, given by a flag, without a shell; `places` stand for names in braces.

    Raises:
        InputError: If it cannot be run, fails, or leaves nothing at {out}.
    """
    words = shlex.split(command)
    for name, place in places.items():
        words = [word.replace("{" + name + "}", str(place.resolve())) for word in words]
    try:
        code = subprocess.run(words, check=False).returncode
    except OSError as error:
        raise InputError(f"{flag}: {words[0]}: {error.strerror or error}") from error
    if code:
        raise InputError(f"{flag}: the command ended with code {code}: {shlex.join(words)}")
    if not places["out"].exists():
        raise InputError(
            f"{flag}: the command wrote nothing to {places['out'].name}, which stands for "
            f"{OUT}: {shlex.join(words)}"
        )


def write_heights(capture: Path, heights: tuple[float, ...]) -> None:
    """Write how tall people are [m] into people.json, for the room; nothing where that is unknown.

    `heights` are those of the tracks in the order of their numbers, or one for all people.

    Raises:
        InputError: If there are others than there are people.
    """
    from mover.io.files.fields import read_json, write_json

    file = capture / "people.json"
    if not heights or not file.is_file():
        return
    tree: dict[str, Any] = read_json(file).value
    tracks = sorted({int(row["track_id"]) for row in tree["annotations"]})
    if len(heights) not in (1, len(tracks)):
        found = f"height: {len(heights)} are given, expected 1, or {len(tracks)}: one a person"
        raise InputError(found)
    each = heights * len(tracks) if len(heights) == 1 else heights
    known = {str(track): height for track, height in zip(tracks, each, strict=True)}
    write_json({**tree, "info": {**tree.get("info", {}), "heights": known}}, file)
