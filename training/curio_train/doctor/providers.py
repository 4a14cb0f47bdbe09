"""Runs a model's golden image on each of onnxruntime's execution providers that is here."""

import statistics
import time
from collections.abc import Iterator
from pathlib import Path

from curio_serve.errors import ModelError
from curio_serve.models.golden import GOLDEN_FILE, LARGEST_DIFFERENCE, Golden, read_golden
from curio_serve.models.model import Model, load
from curio_serve.models.runtime import CPU, Runtime, available_providers, short_name

from curio_train.doctor.finding import Finding, State

_NUM_RUNS = 20
_MOST_S = 5.0  # of all runs together; slow networks are run less often


def examine_providers(file: Path) -> Iterator[Finding]:
    """Time and difference of each provider.

    Args:
        file: The model's ONNX file; the golden image is looked for beside it.
    """
    golden = file.with_name(GOLDEN_FILE)
    if not golden.is_file():
        yield Finding("model providers", "good", f"not compared: there is no {GOLDEN_FILE} beside {file.name}")
        return
    for provider in available_providers():
        yield _tried(file, golden, provider)


def _tried(file: Path, golden: Path, provider: str) -> Finding:
    subject = f"model on {short_name(provider)}"
    try:
        model = load(file, runtime=Runtime((provider,)))
        image = read_golden(golden, model)
        off = max(image.differences(model).values())
    except (ModelError, OSError) as exc:
        return _unfit(provider, str(exc))
    text = f"{_milliseconds(model, image):.3g} ms for the golden image ({provider}), {off:.2g} off"
    if off <= LARGEST_DIFFERENCE:
        return Finding(subject, "good", text)
    return _unfit(provider, f"{text}, where at most {LARGEST_DIFFERENCE:.3g} is accepted")


def _unfit(provider: str, text: str) -> Finding:
    """Bad where it is the processor; another provider is merely one that cannot be chosen."""
    state: State = "bad" if provider == CPU else "warning"
    return Finding(f"model on {short_name(provider)}", state, text, "Choose another --provider", fault="provider")


def _milliseconds(model: Model, golden: Golden) -> float:
    """Median time of a run."""
    spent: list[float] = []
    while len(spent) < _NUM_RUNS and sum(spent) < _MOST_S:
        begun = time.perf_counter()
        model.run(golden.image[None])
        spent.append(time.perf_counter() - begun)
    return 1000 * statistics.median(spent)
