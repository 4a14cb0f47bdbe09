"""Where a step of the renderer spends its time: kernel by kernel, and what shadows add.

    python benchmarks/rendering/renderer_profile.py         the tables, for people
    python benchmarks/rendering/renderer_profile.py --json  as JSON, the content of docs/results/renderer_profile.json

Kernels are those of one forward and backward pass of renderer.py's comparison: 128 images of one object of 5,120 faces.
 Their times are medians of several steps; "ns" is a kernel's time by its entries, which are rays, hits,
edges or points. Shadows are measured in whole steps of 128 images of two worlds, as time of the processor, which other
jobs on the machine disturb least.
"""

import argparse
import json
import statistics
import time
from collections import defaultdict
from dataclasses import replace
from typing import Any

import torch
from curio_train.rendering.renderer import Renderer
from curio_train.scene_code import SceneCode
from curio_train.worlds import WORLDS, build
from curio_train.worlds.generated.generated_world import GeneratedWorld
from renderer import AMBIENT, BATCH, SAMPLES, SIZE, draw_poses, log, our_step, root_mesh, seconds

NUM_STEPS, NUM_KERNELS = 9, 12


def kernels() -> dict[str, Any]:
    """The longest kernels of a step, what the others take together, and what is no kernel's."""
    import drjit

    mesh = root_mesh()
    renderer = Renderer([mesh], [0], SIZE, SIZE, ambient=AMBIENT, samples_per_pixel=SAMPLES)
    poses = draw_poses(mesh, BATCH)
    step, forward = our_step(renderer, poses), our_step(renderer, poses, backward=False)
    seconds(step, 3)
    found: dict[int, list[dict[str, Any]]] = defaultdict(list)
    walls = []
    with drjit.scoped_set_flag(drjit.JitFlag.KernelHistory, True):
        drjit.kernel_history_clear()
        forward(0)
        num_forward = len(drjit.kernel_history())
        for seed in range(NUM_STEPS):
            drjit.kernel_history_clear()
            start = time.perf_counter()
            step(seed)
            walls.append(1e3 * (time.perf_counter() - start))
            for number, entry in enumerate(drjit.kernel_history()):
                found[number].append(entry)
    rows = [_row(entries, number < num_forward) for number, entries in found.items()]
    rows.sort(key=lambda row: -float(row["ms"]))
    total, wall = sum(row["ms"] for row in rows), statistics.median(walls)
    return {
        "kernels": rows[:NUM_KERNELS],
        "other_kernels_ms": round(sum(row["ms"] for row in rows[NUM_KERNELS:]), 2),
        "outside_kernels_ms": round(wall - total, 2),
        "step_ms": round(wall, 2),
        "images_per_s": round(1e3 * BATCH / wall, 1),
    }


def _row(entries: list[dict[str, Any]], forward: bool) -> dict[str, Any]:
    """One kernel over all steps."""
    size, ms = entries[0]["size"], statistics.median(entry["execution_time"] for entry in entries)
    return {
        "pass": "forward" if forward else "backward",
        "type": entries[0]["type"].name,
        "entries": size,
        "operations": entries[0].get("operation_count"),
        "ms": round(ms, 3),
        "ns": round(1e6 * ms / max(size, 1), 1),
    }


def shadows() -> dict[str, dict[str, float]]:
    """Milliseconds of processor time of a step of a world: as it is, without shadows, and the ratio."""
    found = {}
    for name in ("chairs", "light"):
        world = build(WORLDS[name]())
        assert isinstance(world, GeneratedWorld)
        code = world.sample(BATCH, (0,))
        with torch.no_grad():
            behind = world.render({**code, "translation_m": code["translation_m"] + 1000})
        setup, (position, _, *fields) = replace(world.setup, object_shadows=False), world.layout.fields
        plain = GeneratedWorld(name, world.kinds, setup, position, world.orientation, fields)
        times = {"with": _cpu_ms(world, code, None), "without": _cpu_ms(plain, code, behind)}
        log(f"{name}: {times}")
        found[name] = {f"{key}_shadows_cpu_ms": round(value, 1) for key, value in times.items()}
        found[name]["ratio"] = round(times["with"] / times["without"], 2)
    return found


def _cpu_ms(world: GeneratedWorld, code: SceneCode, backgrounds: torch.Tensor | None) -> float:
    def step() -> float:
        attached = {name: value.clone().requires_grad_() for name, value in code.items()}
        start = time.process_time()
        world.render(attached, backgrounds).square().sum().backward()
        return 1e3 * (time.process_time() - start)

    return statistics.median([step() for _ in range(7)][2:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    wanted = parser.parse_args()
    figures = {**kernels(), "shadows": shadows()}
    if wanted.json:
        print(json.dumps(figures))
        return
    for row in figures["kernels"]:
        what = f"{row['pass']}, {row['type']} of {row['operations']} operations"
        print(f"{row['ms']:8.2f} ms = {row['ns']:8.1f} ns x {row['entries']:>9,}  {what}")
    print(json.dumps({key: value for key, value in figures.items() if key != "kernels"}, indent=1))


if __name__ == "__main__":
    main()
