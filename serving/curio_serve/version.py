"""The version of this distribution, which every command prints for ``--version``."""

from collections.abc import Sequence

FLAG = "--version"


def answer_version(command: str, arguments: Sequence[str]) -> None:
    """Print the version where it is asked for, and end the process.

    Args:
        command: Name of the command.
        arguments: As typed.

    Raises:
        SystemExit: It was asked for.
    """
    if FLAG not in arguments:
        return
    from importlib.metadata import PackageNotFoundError, version

    try:
        print(f"{command} {version('curio-pose')}")
    except PackageNotFoundError:
        print(f"{command}, of a source tree that is not installed")
    raise SystemExit(0)
