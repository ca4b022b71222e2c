"""What a long run has counted so far, kept so that it can go on after any end: one file per shard, never changed.

A file is named by the request's fingerprint and the shard's range, written whole or not at all, and ends in its own
digest; so it says by itself whether it can be used. Requests follow from the study and from earlier answers alone, so
a run that is started again asks the same and finds what is there.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import threading
import time
import tomllib
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from mauvecl.host.errors import InputError
from mauvecl.host.files.bounded import read_bytes
from mauvecl.host.files.parsed import json_data, read_text
from mauvecl.host.files.whole import UNFINISHED, write_whole
from mauvecl.host.version import VERSION
from mauvecl.runs.durable import alone, differing_keys
from mauvecl.runs.shards import FORM

if TYPE_CHECKING:
    from mauvecl.results.sums import Arrays
    from mauvecl.study.study import Study

FOLDER, MANIFEST = "checkpoint", "manifest.json"
#: What shards are called: fingerprint, part, start, count.
SHARD_NAME = re.compile(r"[0-9a-f]{32}-[0-9]+-[0-9]+-[0-9]+\.npz")
#: Shards are held back so long before the first is written: short runs leave no files.
PATIENCE_S = 20.0
DIGEST_BYTES = 32


class Checkpoint:
    """Shards of one run, in a folder; use it in a `with` block.

    Parameters
    ----------
    folder : Path
        The run's output folder, which is there.
    verb : str
    study : Study
    resume : bool
        Go on with what is there.
    restart : bool
        Forget what is there.
    patience_s : float
        See `PATIENCE_S`.
    held : bool
        Whether the caller holds the folder, so that no other process writes there.

    Attributes
    ----------
    resumed, damaged : int
        Shards taken from files so far, and files that could not be used.
    messages : list of str
        What the user must be told.
    """

    def __init__(
        self,
        folder: Path,
        verb: str,
        study: Study,
        *,
        resume: bool = False,
        restart: bool = False,
        patience_s: float = PATIENCE_S,
        held: bool = False,
    ) -> None:
        self.parent, self.folder, self.verb, self.study = folder, folder / FOLDER, verb, study
        self._resume, self._restart, self._patience_s, self._is_held = resume, restart, patience_s, held
        self.resumed = self.damaged = 0
        self.messages: list[str] = []
        self._held: list[tuple[str, Arrays]] = []
        self._lock = threading.Lock()
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Take hold of the output folder, and look at what is there.

        Raises
        ------
        InputError
            If another process writes there; if there is a run to resume and it is not said what to do with it; or if
            it is another study's, with the keys that differ.
        """
        if not self._is_held:
            self._stack.enter_context(alone(self.parent, "output folder"))
        try:
            self._look()
        except BaseException:
            self._stack.close()
            raise
        self._started, self._written = time.monotonic(), any(self._files())
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is not None:
                # Interrupted or failed: what is held back is worth keeping, unless it took no time.
                self._write_held(only_if_late=not self._written)
        except InputError:
            # The reason to stop is told already.
            pass
        finally:
            self._stack.close()

    def _look(self) -> None:
        if self._restart:
            self._remove()
        if not any(self._files()):
            return
        if not self._resume:
            raise InputError(
                f"{str(self.folder)!r} holds an unfinished run, expected `resume=True` to continue it or "
                "`restart=True` to forget it"
            )
        try:
            manifest = json_data(read_text(self.folder / MANIFEST, "manifest"), "manifest")
            if manifest["digest"] != _digest_of(manifest):
                raise ValueError
            theirs = {"mauvecl": manifest["mauvecl"], "verb": manifest["verb"], **manifest["study"]}
            form = manifest.get("form", 1)
        except (OSError, ValueError, KeyError, TypeError):
            # Files are named by what they answer: those of another study are never asked for.
            self.messages.append(
                f"The manifest of {str(self.folder)!r} was damaged or missing and is written anew; the shards that "
                "belong to this study are used."
            )
            self._write_manifest()
            return
        if form != FORM:
            raise InputError(
                f"the unfinished run in {str(self.folder)!r} keeps its counts in form {form}, expected form {FORM} as "
                "this version writes: `restart=True` to forget it"
            )
        ours = {"mauvecl": VERSION, "verb": self.verb, **self._plain_study()}
        differing = differing_keys(ours, theirs)
        if differing:
            raise InputError(
                f"the unfinished run in {str(self.folder)!r} differs in {', '.join(differing)}, expected the same "
                "study, or `restart=True` to forget it"
            )

    def get(self, name: str) -> Arrays | None:
        """A shard that was counted before, or None."""
        path = self.folder / f"{name}.npz"
        try:
            data = path.read_bytes()
            body, digest = data[:-DIGEST_BYTES], data[-DIGEST_BYTES:]
            if _named(name, body) != digest:
                raise ValueError
            with np.load(io.BytesIO(body)) as arrays:
                shard = {key: arrays[key] for key in arrays.files}
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, zipfile.BadZipFile):
            with self._lock:
                self.damaged += 1
            return None
        with self._lock:
            self.resumed += 1
        return shard

    def put(self, name: str, shard: Arrays) -> None:
        """Keep a shard; on the disk once the run has lasted `patience_s`.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        with self._lock:
            self._held.append((name, shard))
            self._write_held(only_if_late=not self._written)

    def _write_held(self, *, only_if_late: bool = False) -> None:
        if only_if_late and time.monotonic() - self._started < self._patience_s:
            return
        if not self._written and self._held:
            self._write_manifest()
            self._written = True
        while self._held:
            name, shard = self._held[0]
            body = io.BytesIO()
            np.savez(body, **shard)  # type: ignore[arg-type]
            data = body.getvalue()
            write_whole(self.folder / f"{name}.npz", data, _named(name, data))
            self._held.pop(0)

    @property
    def kept(self) -> int:
        """Files of shards that are there."""
        return sum(1 for path in self._files() if path.suffix == ".npz")

    def forget(self) -> None:
        """Remove it: the answer is written."""
        self._held = []
        self._remove()

    def _files(self) -> Iterator[Path]:
        """The files in its folder that are a checkpoint's own, by their names.

        Raises
        ------
        InputError
            If there is a manifest of something else.
        """
        names = sorted(os.listdir(self.folder)) if self.folder.is_dir() else []
        shards = [name for name in names if SHARD_NAME.fullmatch(name)]
        if MANIFEST in names and not shards and not _is_ours(self.folder / MANIFEST):
            raise InputError(f"{str(self.folder / MANIFEST)!r} is not mauvecl's, expected another output folder")
        yield from (self.folder / name for name in names if name in shards or name == MANIFEST)

    def _remove(self) -> None:
        """Remove its own files, and its folder where nothing else is in it."""
        for path in [*self._files(), *self.folder.glob(f"{UNFINISHED}*")]:
            name = path.name.removeprefix(UNFINISHED)
            if name == MANIFEST or SHARD_NAME.fullmatch(name):
                path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self.folder.rmdir()

    def _plain_study(self) -> dict[str, object]:
        return dict(tomllib.loads(self.study.toml()))

    def _write_manifest(self) -> None:
        manifest = {"mauvecl": VERSION, "form": FORM, "verb": self.verb, "study": self._plain_study()}
        text = json.dumps(manifest | {"digest": _digest_of(manifest)}, indent=2)
        write_whole(self.folder / MANIFEST, text.encode())


def _is_ours(manifest: Path) -> bool:
    """Whether a manifest is whole and a checkpoint's."""
    try:
        content = json.loads(read_bytes(manifest, "manifest"))
        return bool(content["digest"] == _digest_of(content))
    except (InputError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return False


def _named(name: str, body: bytes) -> bytes:
    """Digest of a file with its name: a file in another's place is noticed."""
    return hashlib.sha256(name.encode() + b"\0" + body).digest()


def _digest_of(manifest: Mapping[str, object]) -> str:
    content = {key: value for key, value in manifest.items() if key != "digest"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
