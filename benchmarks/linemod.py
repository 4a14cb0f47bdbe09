"""One network a LineMOD class on held-out renderings and on real frames, served and refined, beside published figures.

    python benchmarks/linemod.py --runs runs/linemod --data DIR [--frames DIR] [--sheets DIR] [--json]

Writes docs/results/linemod.json and linemod.md anew after each class. A class whose weights, number of renderings and
real labels are those of its row is kept as it is, so the same command goes on where it stopped.
"""

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import tyro
from curio_train.commands.command_line.running import answer
from curio_train.data.bop import BopDataset
from curio_train.evaluation.evaluate import evaluate
from curio_train.evaluation.real_frames import evaluate_real_frames
from curio_train.evaluation.subject import load_subject
from curio_train.evaluation.unlabelled.candidates import Candidate, candidates
from curio_train.refinement.predictions import with_refinement
from paper.linemod_markdown import markdown
from paper.linemod_sheet import write_sheet
from paper.linemod_table import REFINED, is_current, is_of_one_class, load_table, make_row
from paper.results import Results, Row, save_results

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
        refine: Score every network after render-and-compare, too, which takes most of the time.
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
    refine: bool = True
    columns: int = 6
    results: Path = Path("docs/results/linemod.json")
    cache: Path = Path("~/.cache/curio-pose")
    json: tyro.conf.FlagCreatePairsOff[bool] = False


def log(text: str) -> None:
    """Progress, on stderr."""
    print(text, file=sys.stderr, flush=True)


def score(settings: Settings, candidate: Candidate) -> dict[str, Row]:
    """Everything that is said of one network: by method, as it is served and refined."""
    result = evaluate(
        candidate.path,
        num_images=settings.num_images,
        data=settings.data,
        refine=settings.refine,
        cache=settings.cache,
        progress=lambda text: log(f"{candidate.path.name}: {text}"),
        warn=log,
    )
    served = load_subject(candidate.path, settings.data)
    scored = [(candidate.method, served, result)]
    if settings.refine:
        refiner = replace(served, predict=with_refinement(served.predict, served.world, served.config.method))
        scored.append((candidate.method + REFINED, refiner, result | result["refined"]))
    rows = {}
    for method, subject, found in scored:
        frames = []
        if settings.frames is not None and candidate.name in BopDataset(settings.frames).classes:
            frames = evaluate_real_frames(subject, settings.frames, None)["targets"]
        rows[method] = make_row(found, candidate, settings.data, frames)
    return rows


def draw(settings: Settings, candidate: Candidate) -> None:
    """The contact sheet of one network, where one is wanted."""
    if settings.sheets is not None:
        file = settings.sheets / f"{candidate.name}-{candidate.method}.png"
        write_sheet(load_subject(candidate.path, settings.data), settings.data, file, settings.columns)
        log(f"{file}")


def main(settings: Settings) -> int:
    """Score what is left."""
    table: Results = load_table(settings.results)
    for candidate in filter(is_of_one_class, candidates(settings.runs)):
        methods = [candidate.method, candidate.method + REFINED] if settings.refine else [candidate.method]
        rows = [table.get(method, {}).get(candidate.name) for method in methods]
        if all(is_current(row, candidate, settings.num_images, settings.data) for row in rows):
            log(f"{candidate.path.name}: kept")
        else:
            for method, row in score(settings, candidate).items():
                table.setdefault(method, {})[candidate.name] = row
        draw(settings, candidate)
        save_results(settings.results, table)
        settings.results.with_suffix(".md").write_text(markdown(table, COMMAND), encoding="utf-8")
    if settings.json:
        print(json.dumps(table))
    return 0


if __name__ == "__main__":
    chosen = tyro.cli(Settings, description=__doc__)
    sys.exit(answer(lambda _: main(chosen)))
