"""Takes the picture of curio-view in the README.

    python benchmarks/pictures/screenshot.py --out docs/results/view.png

It needs chromium (``apt-get install chromium``) and playwright.
"""

import argparse
import shutil
import socket
import subprocess
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

WINDOW = {"width": 1280, "height": 800}


def main() -> None:
    """Open ``curio-view chairs`` in a headless browser and store what it shows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    out = parser.parse_args().out
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    script = "from curio_train.commands.view import view; view()"
    command = subprocess.Popen([sys.executable, "-c", script, "chairs", "--port", str(port)], stderr=subprocess.PIPE)
    try:
        assert command.stderr is not None
        command.stderr.readline()  # says that it listens
        with sync_playwright() as started:
            options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
            browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=options)
            page = browser.new_page(viewport=WINDOW)
            page.goto(f"http://127.0.0.1:{port}")
            page.get_by_text("image loss").wait_for()
            page.wait_for_timeout(5000)  # until the meshes are drawn
            page.locator("button:near(:text('Software WebGL'))").first.click()
            page.wait_for_timeout(1000)
            page.screenshot(path=out)
            browser.close()
    finally:
        command.terminate()
        command.wait()


if __name__ == "__main__":
    main()
