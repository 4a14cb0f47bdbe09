"""LineMOD for a call that names no data: its class is checked, then the download is offered."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from curio_train.errors import UsageError
from curio_train.worlds.options import ALL_CLASSES, LinemodOptions

MODELS = Path("models")
"""Where curio-export puts models, and where this repository has those of LM-O."""

_MEGABITS_A_SECOND = 10
_DECLINED = ("n", "no")


def with_linemod(options: LinemodOptions, cache: Path, report: Callable[[str], None]) -> LinemodOptions:
    """The options with a folder of data.

    Args:
        options: As called.
        cache: Where downloads are kept.
        report: Called with what is there already, and what is downloaded.

    Raises:
        UsageError: LineMOD has no such class, or the user declines the download.
        DataError: The download failed.
    """
    from curio_train.data.bop import BopDataset

    names = [] if options.class_name == ALL_CLASSES else options.class_name.split(",")
    for name in names:
        BopDataset.object_id(name)  # before anything is fetched
        _name_models(name, report)
    if options.data is not None:
        return options
    return replace(options, data=fetched_linemod(cache, report, ask=not options.download), download=False)


def fetched_linemod(cache: Path, report: Callable[[str], None], *, ask: bool, frames: bool = False) -> Path:
    """The folder of LineMOD; says what is missing there, and downloads it.

    Args:
        cache: Where downloads are kept.
        report: Called with what is downloaded.
        ask: On a terminal, begin only if the user agrees.
        frames: Whether the real frames are needed, too.

    Raises:
        UsageError: The user declines the download.
        DataError: The download failed.
    """
    from curio_train.data.download import SCORING_ARCHIVES, TRAINING_ARCHIVES, download_linemod, missing_archives

    archives = SCORING_ARCHIVES if frames else TRAINING_ARCHIVES
    if missing := missing_archives(cache, archives):
        _offer(missing, cache, report, ask=ask)
    return download_linemod(cache, archives)


def _name_models(name: str, report: Callable[[str], None]) -> None:
    """A user who only wants to try LineMOD need not train: cards list the objects of their models."""
    cards = [card for card in sorted(MODELS.glob("*/CARD.md")) if f"\n| {name} |" in card.read_text(encoding="utf-8")]
    if cards:
        found = ", ".join(str(card.parent) for card in cards)
        report(f"trained for {name} already: {found}; to try one, curio-detect {cards[-1].parent} IMAGES")


def _offer(archives: list[str], cache: Path, report: Callable[[str], None], *, ask: bool) -> None:
    """Say what will be downloaded; on a terminal, begin only if the user agrees."""
    from curio_train.data.download import REPOSITORY, download_bytes, linemod_folder

    num_bytes = download_bytes(archives)
    minutes = num_bytes * 8 / _MEGABITS_A_SECOND / 1e6 / 60
    report(
        f"LineMOD's archives {', '.join(archives)} ({REPOSITORY}, CC BY 4.0): {num_bytes / 1e6:.1f} MB, "
        f"about {max(1, round(minutes))} min at {_MEGABITS_A_SECOND} Mbit/s, once, to {linemod_folder(cache)}"
    )
    if ask and sys.stdin.isatty() and sys.stderr.isatty():
        print("Download them now? [Y/n] ", end="", file=sys.stderr, flush=True)
        if sys.stdin.readline().strip().lower() in _DECLINED:
            raise UsageError("nothing was downloaded; name a folder in BOP's layout instead: --data DIR")
