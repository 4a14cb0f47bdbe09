"""One network a LineMOD class on held-out renderings and on real frames, beside published figures.

    python benchmarks/linemod.py --runs runs/linemod --data DIR [--frames DIR] [--sheets DIR] [--json]

Writes docs/results/linemod.json and linemod.md anew after each class. A class whose weights, number of renderings and
real labels are those of its row is kept as it is, so the same command goes on where it stopped.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro
from curio_train.cli import answer
from curio_train.data.bop import BopDataset
from curio_train.evaluation.evaluate import evaluate
from curio_train.evaluation.linemod_markdown import markdown
from curio_train.evaluation.linemod_sheet import write_sheet
from curio_train.evaluation.linemod_table import Candidate, candidates, is_current, load_table, make_row
from curio_train.evaluation.real_frames import evaluate_real_frames
from curio_train.evaluation.results import Results, Row, save_results
from curio_train.evaluation.subject import load_subject

COMMAND = "python benchmarks/linemod.py"


@dataclass(frozen=True)
class Settings:
    """What to score.

    Attributes:
        runs: Folder of runs or exported models, one a class and method.
        data: BOP data set of real frames, lm or lmo.
        frames: BOP data set whose frames are listed one by one, where it has the class.
        sheets: Folder for a contact sheet a class, which show the data set: never in this repository.
        num_images: Held-out renderings.
        columns: Frames of a contact sheet.
        results: The file of results; the page lies beside it.
        cache: Where image sets that a world draws once are kept.
        json: Print the results as one JSON object on the last line.
    """

    runs: Path
    data: Path
    frames: Path | None = None
    sheets: Path | None = None
    num_images: int = 500
    columns: int = 6
    results: Path = Path("docs/results/linemod.json")
    cache: Path = Path("~/.cache/curio-pose")
    json: tyro.conf.FlagCreatePairsOff[bool] = False


def log(text: str) -> None:
    """Progress, on stderr."""
    print(text, file=sys.stderr, flush=True)


def score(settings: Settings, candidate: Candidate) -> Row:
    """Everything that is said of one network."""
    result = evaluate(
        candidate.path,
        num_images=settings.num_images,
        data=settings.data,
        cache=settings.cache,
        progress=lambda text: log(f"{candidate.path.name}: {text}"),
        warn=log,
    )
    frames = []
    if settings.frames is not None and candidate.name in BopDataset(settings.frames).classes:
        frames = evaluate_real_frames(load_subject(candidate.path, settings.data), settings.frames, None)["targets"]
    return make_row(result, candidate, settings.data, frames)


def draw(settings: Settings, candidate: Candidate) -> None:
    """The contact sheet of one network, where one is wanted."""
    if settings.sheets is not None:
        file = settings.sheets / f"{candidate.name}-{candidate.method}.png"
        write_sheet(load_subject(candidate.path, settings.data), settings.data, file, settings.columns)
        log(f"{file}")


def main(settings: Settings) -> int:
    """Score what is left."""
    table: Results = load_table(settings.results)
    for candidate in candidates(settings.runs):
        rows = table.setdefault(candidate.method, {})
        if is_current(rows.get(candidate.name), candidate, settings.num_images, settings.data):
            log(f"{candidate.path.name}: kept")
        else:
            rows[candidate.name] = score(settings, candidate)
        draw(settings, candidate)
        save_results(settings.results, table)
        settings.results.with_suffix(".md").write_text(markdown(table, COMMAND), encoding="utf-8")
    if settings.json:
        print(json.dumps(table))
    return 0


if __name__ == "__main__":
    chosen = tyro.cli(Settings, description=__doc__)
    sys.exit(answer(lambda _: main(chosen)))
