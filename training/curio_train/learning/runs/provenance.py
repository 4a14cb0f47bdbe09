"""Provenance of a run: each session of training adds a line to ``RUN/sittings.jsonl``, for cards and result files."""

import datetime
import json
import os
import platform
import shlex
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO

import torch
from curio_serve.files import check_regular, read_file

from curio_train.errors import CheckpointError

SESSIONS = "sittings.jsonl"
_MAX_BYTES = 1 << 26


@dataclass(frozen=True)
class RunSession:
    """One call of a command."""

    command: str
    """Command line as it was typed."""
    commit: str
    """Commit of the code, with "-dirty" where it had changes; empty where it does not run from a git checkout."""
    machine: str
    """Processor, number of cores this process may use, GPU."""
    started: str
    """UTC, ISO 8601."""


def this_session() -> RunSession:
    """The call that this process carries out."""
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return RunSession(command, commit(), machine(), now)


def open_sessions(run: Path) -> BinaryIO:
    """The file of a run's sessions, to be added to.

    Raises:
        OSError: It cannot be opened, or is no regular file.
    """
    file = run / SESSIONS
    if file.exists():
        check_regular(file.stat(), file)
    return file.open("ab")


def record_session(run: Path) -> None:
    """Add this process to a run's sessions.

    Raises:
        CheckpointError: The folder cannot be written.
    """
    try:
        with open_sessions(run) as file:
            file.write(json.dumps(asdict(this_session())).encode() + b"\n")
    except OSError as exc:
        raise CheckpointError(f"cannot write {run / SESSIONS}: {exc.strerror}; name another run folder: --out") from exc


def run_sessions(run: Path) -> list[RunSession]:
    """A run's sessions, oldest first.

    Raises:
        CheckpointError: They cannot be read.
    """
    try:
        lines = read_file(run / SESSIONS, _MAX_BYTES).decode("utf-8").splitlines()
        whole = [line for line in lines if line.endswith("}")]  # a kill may cut off the last one
        found = [RunSession(**json.loads(line)) for line in whole]
    except (OSError, ValueError, TypeError, RecursionError) as exc:
        raise CheckpointError(f"{run / SESSIONS} cannot be read ({exc}); is {run} a whole run folder?") from exc
    if not found:
        raise CheckpointError(
            f"{run / SESSIONS} has no whole line, expected one a session; is {run} a whole run folder?"
        )
    return found


def last_session(run: Path) -> str:
    """The last session of a run in words."""
    try:
        session = run_sessions(run)[-1]
    except CheckpointError:
        return "it has not said which yet"
    return f"`{session.command}`, started {session.started}"


def commit() -> str:
    """Commit of this package's source, see :class:`RunSession`."""
    here = Path(__file__).resolve()
    if _git(here.parent, "ls-files", here.name) == "":
        return ""  # not in a checkout, or in one that does not track it (a venv inside another project)
    changes = _git(here.parent, "status", "--porcelain", "--untracked-files=no")
    return _git(here.parent, "rev-parse", "HEAD") + ("-dirty" if changes else "")


def _git(folder: Path, *arguments: str) -> str:
    try:
        done = subprocess.run(["git", "-C", folder, *arguments], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def machine() -> str:
    """This machine, see :class:`RunSession`."""
    names = [torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count())]
    return ", ".join([_processor(), f"{len(os.sched_getaffinity(0))} cores", *names])


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()
