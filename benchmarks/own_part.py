"""The README's section "Your own part" as a user would type it, timed and scored.

    python benchmarks/own_part.py [--method templates] [--minutes 26.5] [--init MODEL] [--seed 0] [--photos 200]
                                  [--tests 50] [--step] [--commands BIN] [--json]

An unpainted STL, 200 path traced photographs of it on a table, a background image and a camera file, calibrated from
photographs of a chessboard, are made first (see ``benchmarks/make_captures.py``); what is there already is kept. Then
the installed commands look at the files, train and export, detect in 50 photographs that nothing has seen, and do that
again through a server. With --step the mesh is a STEP file that OpenCASCADE has drawn, with --method templates nothing
is trained. The last line is the result, also in OUT/own_part.json:

right       share of the unseen photographs in which ADD(-S) is below a tenth of the diameter
add_median  of ADD(-S), in diameters
served_as   largest difference between a served and a local position, metres
reads_9     the same of curio-detect --reads 9
seconds     of each command; of all of them as "total"
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from curio_train.data.bop import ModelInfo
from curio_train.geometry import Pose
from curio_train.meshes.meshes import load_mesh
from curio_train.meshes.symmetries import find_symmetries
from curio_train.metrics.calibration import calibration_error
from curio_train.metrics.poses import ADD_THRESHOLD, add_or_add_s_m, rotation_error_deg
from synthetic_captures.captures import Amount, make

_NEAR_M, _FAR_M = 0.5, 1.0
_SAMPLES_PER_PIXEL = 16  # pixels are small here


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--method", choices=("sleep", "templates"), default="sleep", help="of curio-train capture")
    parser.add_argument("--minutes", type=float, default=26.5, help="of training")
    parser.add_argument("--init", help="network of another object that training begins with: models/ape")
    parser.add_argument("--seed", type=int, default=0, help="of training")
    parser.add_argument("--photos", type=int, default=200, help="unlabelled")
    parser.add_argument("--tests", type=int, default=50, help="photographs that nothing has seen")
    parser.add_argument("--out", type=Path, default=Path("runs/own_part"), help="an earlier run in it is replaced")
    parser.add_argument("--step", action="store_true", help="the mesh as a STEP file (package cadquery-ocp-novtk)")
    parser.add_argument(
        "--commands", type=Path, default=Path(sys.executable).parent, help="folder of the installed commands"
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object on the last line")
    arguments = parser.parse_args()

    out: Path = arguments.out
    make("part", out, Amount(arguments.photos, arguments.tests, _SAMPLES_PER_PIXEL), _show)
    files = out / "part"
    shutil.rmtree(out / "run", ignore_errors=True)
    given = ["--mesh", str(files / "meshes" / "bracket.stl"), "--mesh-unit", "m"]
    if arguments.step:
        from synthetic_captures.step_file import write_bracket

        given = ["--mesh", str(files / "meshes" / "bracket.step")]
        write_bracket(files / "meshes" / "bracket.step")
    commands = arguments.commands.absolute()
    learning = ["--minutes", str(arguments.minutes)] if arguments.method == "sleep" else ["--method", "templates"]
    learning += ["--seed", str(arguments.seed), *(["--init", arguments.init] if arguments.init else [])]
    seconds = _as_typed(commands, given, files, out, learning)
    seconds["serve"] = _served(commands, files, out)
    seconds["total"] = round(sum(seconds.values()), 1)
    scored = _score(files, out / "poses.jsonl") | {"served_as": _difference(out)}
    scored["reads_9"] = _score(files, out / "poses-9.jsonl")
    machine = json.loads((out / "run" / "sittings.jsonl").read_text(encoding="utf-8").splitlines()[0])["machine"]
    budget = {name: vars(arguments)[name] for name in ("method", "photos", "seed", "init")}
    budget |= {"minutes": arguments.minutes} if arguments.method == "sleep" else {}
    result = scored | {"seconds": seconds, "machine": machine} | budget
    (out / "own_part.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(result) if arguments.json else result)


def _show(text: str) -> None:
    print(f"\r{text}", end="", file=sys.stderr)


def _as_typed(commands: Path, mesh: list[str], files: Path, out: Path, learning: list[str]) -> dict[str, float]:
    """The commands that need no server, and how long each took."""
    camera = str(files / "camera.json")
    given = [*mesh, "--camera", camera, "--photos", str(files / "photos")]
    given += ["--background", str(files / "plates" / "a-0.png")]
    distances = ["--near-m", str(_NEAR_M), "--far-m", str(_FAR_M)]
    run, poses, often = out / "run", out / "poses.jsonl", out / "poses-9.jsonl"
    for earlier in (poses, often):
        earlier.unlink(missing_ok=True)
    typed = {
        "look": ["curio-doctor", *given],
        "train": ["curio-train", "capture", *given, *distances, *learning, "--out", str(run)],
        "detect": ["curio-detect", str(run / "models" / "bracket"), str(files / "test" / "a"), "--camera", camera],
    }
    typed["detect_9"] = [*typed["detect"], "--out", str(often), "--reads", "9"]
    typed["detect"] += ["--out", str(poses), "--overlays", str(out / "overlays")]
    return {name: _call(commands, *call) for name, call in typed.items()}


def _call(commands: Path, command: str, *flags: str) -> float:
    """Run a command to its good end; seconds."""
    begun = time.monotonic()
    done = subprocess.run([commands / command, *flags], check=False, env=os.environ)
    if done.returncode:
        sys.exit(f"{command} {' '.join(flags)} ended with status {done.returncode}")
    return round(time.monotonic() - begun, 1)


def _served(commands: Path, files: Path, out: Path) -> float:
    """The same photographs through the server; seconds."""
    begun = time.monotonic()
    line = [commands / "curio-serve", out / "run" / "models", "--port", "0"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True, stderr=subprocess.DEVNULL) as server:
        assert server.stdout is not None
        address = server.stdout.readline().split()[-1]
        flags = ["--camera", str(files / "camera.json"), "--out", str(out / "served.jsonl"), "--overwrite"]
        _call(commands, "curio-detect", f"{address}/bracket", str(files / "test" / "a"), *flags)
        server.terminate()
    return round(time.monotonic() - begun, 1)


def _difference(out: Path) -> float:
    """Largest difference between a served and a local position, metres."""
    places = [
        [json.loads(line)["detections"][0]["translation_m"] for line in (out / name).read_text().splitlines()]
        for name in ("poses.jsonl", "served.jsonl")
    ]
    return float(np.abs(np.subtract(*places)).max())


def _score(files: Path, poses: Path) -> dict[str, Any]:
    """Each detection against where the part truly was."""
    mesh = load_mesh(files / "meshes" / "bracket.stl", "m")
    symmetries = find_symmetries(mesh)
    info = ModelInfo(mesh.diameter_m, symmetries.discrete, symmetries.continuous)
    labels = json.loads((files / "labels" / "test.json").read_text(encoding="utf-8"))["photographs"]
    found = [json.loads(line) for line in poses.read_text(encoding="utf-8").splitlines()]
    add, turned, confidence = [], [], []
    for answer in found:
        (label,) = labels[f"test/a/{Path(answer['image']).name}"]
        true, best = Pose.from_matrix(np.array(label["cam_from_obj"])), answer["detections"][0]
        pose = Pose(np.array(best["rotation"]), np.array(best["translation_m"]))
        add.append(add_or_add_s_m(pose, true, mesh.vertices_m, info) / mesh.diameter_m)
        turned.append(rotation_error_deg(pose, true))
        confidence.append(best["confidence"])
    return {
        "right": sum(error < ADD_THRESHOLD for error in add) / len(add),
        "add_median": statistics.median(add),
        "rotation_deg_median": statistics.median(turned),
        "confidence_mean": statistics.mean(confidence),
        "confidence_ece": calibration_error(confidence, [error < ADD_THRESHOLD for error in add]),
        "num_test": len(found),
    }


if __name__ == "__main__":
    main()
