"""Stand-ins for the paper's own captures, whose photographs are not published, and for a user's.

    python benchmarks/make_captures.py [NAME …] [--out DIR] [--photos N] [--tests N] [--json]

Makes the scenes sphere_real, bunny, shapes and part: photographs by path tracing and a model of a small camera, from
two cameras about 90° apart, with true poses kept apart for scoring. What is there already is kept, so an interrupted
call goes on. The last line is what there is: pictures of each scene, megabytes, and seconds of this call.
"""

import argparse
import json
import sys
import time
from pathlib import Path

from synthetic_captures.captures import Amount, make
from synthetic_captures.scenes import NAMES


def main() -> None:
    usual = Amount()
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(NAMES)}; default: all")
    parser.add_argument("--out", type=Path, default=Path("~/.cache/curio-pose/stand_ins").expanduser())
    parser.add_argument("--photos", type=int, default=usual.num_photos, help="for training, of each scene")
    parser.add_argument("--tests", type=int, default=usual.num_tests, help="scenes seen from both cameras")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object on the last line")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(NAMES):
        parser.error(f"found {', '.join(sorted(unknown))}, expected {', '.join(NAMES)}")

    begun = time.perf_counter()
    result: dict[str, object] = {"folder": arguments.out.name}
    for name in arguments.names or NAMES:
        amount = Amount(arguments.photos, arguments.tests)
        new = make(name, arguments.out, amount, lambda text: print(f"\r{text}", end="", file=sys.stderr))
        pictures = list((arguments.out / name).rglob("*.png"))
        size = sum(path.stat().st_size for path in pictures) / 1e6
        result[name] = {"pictures": len(pictures), "new": new, "megabytes": round(size, 1)}
        print(file=sys.stderr)
    result["seconds"] = round(time.perf_counter() - begun, 1)
    print(json.dumps(result) if arguments.json else result)


if __name__ == "__main__":
    main()
