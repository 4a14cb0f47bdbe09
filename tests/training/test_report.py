"""A run's report: what a browser shows of it, what it needs no label for, and that no run fails by it."""

import base64
import html
import itertools
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from curio_train.commands import evaluate as evaluate_command
from curio_train.commands import train as train_command
from curio_train.config import WorldOptions
from curio_train.errors import ReportError
from curio_train.evaluation.evaluate import evaluate
from curio_train.evaluation.reporting.report import REPORT_FILE, report_training
from curio_train.evaluation.reporting.report_figures import reliability
from curio_train.metrics.calibration import reliability_bins
from curio_train.worlds.options import CirclesOptions, LightOptions

WriteRun = Callable[..., Path]
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PICTURE = re.compile(r'<img id="([\w-]+)"[^>]* src="data:image/png;base64,([^"]+)"')
SIZES = """<script>
onload = () => { document.body.dataset.sizes = JSON.stringify(
    Object.fromEntries([...document.images].map(image => [image.id, [image.naturalWidth, image.naturalHeight]]))) }
</script></body>"""


pytestmark = pytest.mark.usefixtures("small_image_sets")


def pictures(page: str) -> dict[str, np.ndarray]:
    return {
        name: cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        for name, data in PICTURE.findall(page)
    }


def write_history(run: Path) -> None:
    rows = [{"step": 20 * n, "images": 64 * n, "seconds": float(n), "image": 90.0 / n} for n in range(1, 6)]
    (run / "history.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"step": 120, "ima')


@pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine; .ci/run installs it where it can")
def test_a_browser_shows_pictures_and_figures_without_a_server(tmp_path: Path, write_run: WriteRun) -> None:
    run = write_run(tmp_path / "run")
    write_history(run)
    result = evaluate(run, num_images=40, cache=tmp_path)
    page = (run / REPORT_FILE).read_text()
    assert "http" not in page  # all that it shows is in it
    shown = tmp_path / "shown.html"
    shown.write_text(page.replace("</body>", SIZES))
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    done = subprocess.run([*command, "--dump-dom", shown.as_uri()], capture_output=True, text=True, timeout=300)
    found = re.search(r'data-sizes="([^"]*)"', done.stdout)
    assert found, done.stderr
    sizes = json.loads(html.unescape(found[1]))
    assert sizes.keys() == {"samples", "histograms", "curves"}
    assert min(min(size) for size in sizes.values()) > 100
    for kind in ("metrics", "untrained"):
        assert f"{result[kind]['scene_error']:.4g}</td>" in done.stdout
    assert all(text in done.stdout for text in ("images/s", "config.json", "torch 2", " cores", 'class="command"'))


@pytest.mark.parametrize("options", [CirclesOptions(), LightOptions()])
def test_after_training_pictures_need_no_labels(tmp_path: Path, write_run: WriteRun, options: WorldOptions) -> None:
    run = write_run(tmp_path / "run", options)
    report_training(run, tmp_path)  # draws the images
    (labels,) = tmp_path.glob("*-*/train.codes.npz")
    labels.unlink()
    labels.mkdir()  # whoever opens it fails, root too
    write_history(run)
    report_training(run, tmp_path)
    page = (run / REPORT_FILE).read_text()
    found = pictures(page)
    assert found.keys() == {"samples", "histograms", "curves"}
    assert all(picture.std() > 1 for picture in found.values())
    assert "<td>64</td>" in page
    assert 'id="scores"' not in page


def test_samples_are_input_prediction_and_novel_view(tmp_path: Path, write_run: WriteRun) -> None:
    run = write_run(tmp_path / "run")
    report_training(run, tmp_path)
    samples = pictures((run / REPORT_FILE).read_text())["samples"]
    height, width = samples.shape[:2]
    thirds = [samples[:, n * width // 3 : (n + 1) * width // 3] for n in range(3)]
    red = [(third[..., 2] > 200) & (third[..., 1] < 60) for third in thirds]  # OpenCV's order is BGR
    assert all(mask.sum() > 6 * 50 for mask in red)
    assert not np.array_equal(red[0], red[1])
    assert height > width


def test_stages_of_training_are_shown(tmp_path: Path) -> None:
    run = tmp_path / "run"
    flags = ["--batch-size", "4", "--micro-batch-size", "4", "--images", "8", "--out", str(run)]
    with pytest.raises(SystemExit) as done:
        train_command.train(["circles", "--method", "noncur", *flags])
    assert done.value.code == 0
    stages = [int(path.stem) for path in sorted((run / "stages").iterdir())]
    assert stages
    assert all(later >= 2 * earlier for earlier, later in itertools.pairwise(stages))
    page = (run / REPORT_FILE).read_text()
    assert page.count('class="stage"') == len(stages)
    assert f"after {stages[-1]} images" in page


def test_the_error_is_shown_over_time(tmp_path: Path, write_run: WriteRun) -> None:
    run = write_run(tmp_path / "run")
    rows = [{"step": n, "images": n, "seconds": 60.0 * n, "image_dssim": 0.2 / n} for n in range(1, 4)]
    for noted, shown in ((1, False), (3, True)):  # one point is no curve
        (run / "history.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows[:noted]))
        report_training(run, tmp_path)
        assert ("error-over-time" in pictures((run / REPORT_FILE).read_text())) == shown


def test_reliability_is_drawn_bin_by_bin() -> None:
    bins = reliability_bins([0.05, 0.95, 0.95, 0.95, 0.95], [False, True, True, True, False])
    png = base64.b64decode(reliability({"renderings": bins}).split(",")[1])
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    blue = (picture[..., 0] > 200) & (picture[..., 2] < 100)  # OpenCV's order is BGR
    rows, columns = np.nonzero(blue)
    assert np.ptp(columns) < 0.12 * picture.shape[1]  # one bar, of the tenth bin
    assert np.ptp(rows) > 0.4 * picture.shape[0]  # three quarters high


def test_what_stops_a_report_is_said(tmp_path: Path, write_run: WriteRun) -> None:
    run = write_run(tmp_path / "run")
    (run / "history.jsonl").write_text('{"step": nonsense}\n')
    with pytest.raises(
        ReportError, match=r"report\.html could not be written \(.*history\.jsonl cannot be read.*the run itself is"
    ):
        report_training(run, tmp_path)


def test_neither_training_nor_evaluation_fails_for_want_of_a_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    (run / (REPORT_FILE + ".part")).mkdir(parents=True)  # in the way of every report
    flags = ["--batch-size", "4", "--micro-batch-size", "4", "--images", "4", "--out", str(run)]
    for command, arguments in (
        (train_command.train, ["circles", "--method", "noncur", *flags]),
        (evaluate_command.evaluate, [str(run)]),
    ):
        with pytest.raises(SystemExit) as exit_:
            command([*arguments, "--cache", str(tmp_path)])
        assert exit_.value.code == 0
        printed = capsys.readouterr()
        assert printed.out
        assert "report.html could not be written" in printed.err
    assert (run / "evaluation.json").exists()
    assert not (run / REPORT_FILE).exists()
