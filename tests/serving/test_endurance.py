"""The long runs of ``benchmarks/endurance.py``, short."""

import json
import subprocess
import sys
from pathlib import Path

_SCRIPT = Path(__file__).parents[2] / "benchmarks" / "endurance.py"


def test_a_server_survives_requests_connections_and_replacements() -> None:
    numbers = {"requests": 200, "connections": 100, "replacements": 2, "fuzz": 0, "attacks": 0, "hostile": 5}
    numbers |= {"pause": 0.1}
    flags = [text for name, number in numbers.items() for text in (f"--{name}", str(number))]
    ended = subprocess.run(
        [sys.executable, str(_SCRIPT), "--json", *flags], capture_output=True, text=True, timeout=300, check=False
    )
    figures = json.loads(ended.stdout.splitlines()[-1])
    # Memory of a server this young still grows, so the figure is there and not judged.
    assert figures["rss_late_mb"] > 0
    assert figures["codes"] == {"OK": 200}
    assert figures["connections_survived"] == 100
    assert figures["failed_calls"] == 0
    assert figures["versions_seen"] == 3
    assert figures["replaced_answers"] > 0
    assert figures["hostile_messages"] > 100
    assert not {"UNKNOWN", "INTERNAL"} & figures["hostile_codes"].keys()
    assert figures["hostile_tracebacks"] == 0
