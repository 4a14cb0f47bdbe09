"""What unlabelled frames teach a detector for several objects, scored on frames that it has not learned from.

    python benchmarks/halves.py --data lmo --init NETWORK [--images 4800] [--out runs/halves] [--json]

Every second frame of the data set's scene is learned from and the others are scored, then the halves are swapped. Both
runs begin with a network that has seen no frame (a run of `curio-train linemod --class all`, or models/lmo/2 of commit
10c6bff; models/lmo/8 has seen them), and no label of a frame is opened in training. A call goes on with what is there.
The last line, also in OUT/halves.json, is the mean of both halves: by one read and by nine, of the runs and of what
``curio-export --fast --int8`` makes of them; as served, after render-and-compare, and with ``--plane objects``.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from curio_train.metrics.calibration import calibration_error
from curio_train.metrics.poses import ADD_THRESHOLD

_COMMANDS = Path(sys.executable).parent
_RENDERINGS = 2  # are scored, too, and not looked at here
_TARGETS = "test_targets_bop19.json"
_KEPT = ("add_recall", "add_recall_visible_80", "confidence_ece", "present_auroc", "rotation_deg_median_mean")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="of BOP's layout, with one scene of test frames")
    parser.add_argument("--init", type=Path, required=True, help="run or model that both runs begin with")
    parser.add_argument("--images", type=int, default=4800, help="to train the locator with, half of them photographs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/halves"))
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object on the last line")
    arguments = parser.parse_args()

    out, data = arguments.out.absolute(), arguments.data.absolute()
    frames = sorted(data.glob("test/*/rgb/*.*"))
    if len({frame.parent for frame in frames}) != 1:
        sys.exit(f"{data}: expected the test frames of one scene, found {len(frames)} frames")
    scores: list[dict[str, Any]] = [{}, {}]
    for half in range(2):
        run = out / f"run-{half}"
        _learn(run, data, _linked(out / f"frames-{half}", frames[half::2]), arguments)
        others = _scored(out / f"scored-{1 - half}", data, {int(frame.stem) for frame in frames[1 - half :: 2]})
        for name, network in (("", run), ("fast_", _fast(run, out / f"fast-{half}"))):
            for reads in (1, 9):
                scores[half][f"{name}reads_{reads}"] = _evaluate(network, others, reads)
                scores[half][f"{name}reads_{reads}_plane"] = _evaluate(network, others, reads, on_plane=True)
    result = {name: _mean([one[name] for one in scores]) for name in scores[0]} | {
        "init": "/".join(arguments.init.parts[-2:]),
        "images": arguments.images,
        "seed": arguments.seed,
        "num_frames": len(frames),
    }
    (out / "halves.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=None if arguments.json else 2))


def _linked(folder: Path, parts: Iterable[Path]) -> Path:
    """A folder that shows these files and folders alone."""
    folder.mkdir(parents=True, exist_ok=True)
    for part in parts:
        if not (folder / part.name).exists():
            (folder / part.name).symlink_to(part)
    return folder


def _scored(folder: Path, data: Path, numbers: set[int]) -> Path:
    """The data set with these frames as its only targets."""
    _linked(folder, (part for part in data.iterdir() if part.name != _TARGETS))
    targets = json.loads((data / _TARGETS).read_text(encoding="utf-8"))
    chosen = [target for target in targets if target["im_id"] in numbers]
    (folder / _TARGETS).write_text(json.dumps(chosen), encoding="utf-8")
    return folder


def _learn(run: Path, data: Path, photographs: Path, arguments: argparse.Namespace) -> None:
    if (run / "report.html").exists():  # written last
        return
    given = ["--class", "all", "--data", data, "--photos", photographs, "--init", arguments.init]
    budget = ["--images", arguments.images, "--batch-size", 16, "--micro-batch-size", 16, "--seed", arguments.seed]
    begun = ["--resume", run] if (run / "config.json").exists() else ["--out", run]
    _call("curio-train", "linemod", *given, *budget, *begun)


def _fast(run: Path, models: Path) -> Path:
    """The run exported as models/lmo is: it looks at each object once, and its locator computes in int8."""
    model = models / "lmo"
    if not model.exists():
        _call("curio-export", run, "--out", models, "--name", "lmo", "--half", "--fast", "--int8")
    return model


def _evaluate(run: Path, data: Path, reads: int, *, on_plane: bool = False) -> dict[str, Any]:
    """What ``curio-eval --json`` says of the frames, as read, and refined or moved onto a plane; kept in OUT."""
    kept = data.parent / f"{data.name}-{run.name}-reads-{reads}{'-plane' * on_plane}.json"
    if not kept.exists():
        how = ["--reads", reads, "--num-images", _RENDERINGS, *(["--plane", "objects"] if on_plane else ["--refine"])]
        line = _call("curio-eval", run, "--data", data, "--json", *how)
        kept.write_text(line.splitlines()[-1] + "\n", encoding="utf-8")
    found: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8"))
    return {"served": found["real"]} | ({} if on_plane else {"refined": found["refined"]["real"]})


def _call(command: str, *words: Any) -> str:
    """Run a command to its good end; what it prints."""
    typed = [str(_COMMANDS / command), *map(str, words)]
    done = subprocess.run(typed, check=False, stdout=subprocess.PIPE, text=True, env=os.environ)
    if done.returncode:
        sys.exit(f"{' '.join(typed)} ended with status {done.returncode}")
    return done.stdout


def _mean(halves: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over both halves, of all objects together and of each."""
    return {kind: _of_both([half[kind] for half in halves]) for kind in halves[0]}


def _of_both(halves: list[dict[str, Any]]) -> dict[str, Any]:
    rows = [row for half in halves for one in half["objects"].values() for row in one["targets"]]
    right = [row["add_diameters"] < ADD_THRESHOLD for row in rows]
    of_each = {name: [half["objects"][name]["metrics"] for half in halves] for name in halves[0]["objects"]}
    return _means([half["metrics"] for half in halves], _KEPT) | {
        "num_targets": len(rows),
        # of both halves' answers in one diagram: fewer in a bin let chance make it larger
        "confidence_ece_together": round(calibration_error([row["confidence"] for row in rows], right), 4),
        "objects": {name: _means(metrics, _KEPT[:2]) for name, metrics in of_each.items()},
    }


def _means(metrics: list[dict[str, float]], names: Sequence[str]) -> dict[str, float | None]:
    found = {name: [one[name] for one in metrics if name in one] for name in names}
    return {name: round(float(np.mean(values)), 4) if values else None for name, values in found.items()}


if __name__ == "__main__":
    main()
