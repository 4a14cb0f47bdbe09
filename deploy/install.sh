#!/usr/bin/env bash
# What the image holds, as one script, so that it can be tested without a container engine:
#     deploy/install.sh PREFIX      (default interpreter python3; PYTHON= chooses another)
# makes a virtual environment with the serving install alone and leaves out what never runs.
set -euo pipefail
prefix=${1:?usage: deploy/install.sh PREFIX}
source=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
"${PYTHON:-python3}" -m venv "$prefix"
"$prefix/bin/pip" install --quiet --no-cache-dir --no-compile "$source"
# pip is for building; tests and headers that packages bring along are for nobody here.
"$prefix/bin/pip" uninstall --quiet --yes pip setuptools 2> /dev/null
site=$("$prefix/bin/python" -c 'import sysconfig; print(sysconfig.get_paths()["platlib"])')
find "$site" -depth -type d \( -name tests -o -name include -o -name __pycache__ \) -exec rm -rf {} +
find "$site" -type f \( -name '*.pyi' -o -name '*.a' \) -delete
# What onnxruntime brings for making models, not for running them.
rm -rf "$site"/onnxruntime/{transformers,quantization,tools,datasets}
# A second copy of the runtime, for programs in C++; Python's extension has it all within itself.
rm -f "$site"/onnxruntime/capi/libonnxruntime.so.*
# Byte code now: the image's root cannot be written to later.
"$prefix/bin/python" -m compileall -q "$site" > /dev/null || true
"$prefix/bin/curio-serve" --help > /dev/null
