"""What deploy/ promises, held to it without a container engine (with one: benchmarks/container.py)."""

import json
import re
import shutil
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from curio_serve.errors import UsageError
from curio_serve.server.config import read_config

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
MANIFESTS = sorted((DEPLOY / "kubernetes").glob("*.yaml"))


def _manifest(name: str) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((DEPLOY / "kubernetes" / f"{name}.yaml").read_text())
    return found


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.stem)
def test_manifests_fit_the_schema(path: Path) -> None:
    kubernetes_validate.validate(yaml.safe_load(path.read_text()), "1.30", strict=True)


def test_the_validator_sees_a_wrong_field() -> None:
    manifest = _manifest("deployment")
    manifest["spec"]["template"]["spec"]["containers"][0]["readinessprobe"] = {}
    with pytest.raises(kubernetes_validate.ValidationError, match="readinessprobe"):
        kubernetes_validate.validate(manifest, "1.30", strict=True)


def test_manifests_select_the_pods_of_the_deployment() -> None:
    pod = _manifest("deployment")["spec"]["template"]["metadata"]["labels"]
    assert _manifest("deployment")["spec"]["selector"]["matchLabels"] == pod
    assert _manifest("disruption")["spec"]["selector"]["matchLabels"] == pod
    assert _manifest("network")["spec"]["podSelector"]["matchLabels"] == pod
    assert _manifest("service")["spec"]["selector"] == pod


def test_services_do_not_pass_for_settings(models_dir: Path) -> None:
    pod = _manifest("deployment")["spec"]["template"]["spec"]
    assert pod["enableServiceLinks"] is False
    name = _manifest("service")["metadata"]["name"].upper().replace("-", "_")
    with pytest.raises(UsageError, match="SERVICE_HOST is no setting"):  # what a link would do
        read_config([str(models_dir)], {f"{name}_SERVICE_HOST": "10.0.0.1"})


def test_what_the_image_and_compose_take_is_there() -> None:
    copied = re.findall(r"^COPY (?!--from)(.+) \S+$", (DEPLOY / "Dockerfile").read_text(), re.MULTILINE)
    missing = [name for line in copied for name in line.split() if not (ROOT / name).exists()]
    assert copied
    assert not missing
    sent = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert sent == {name.partition("/")[0] for line in copied for name in line.split()}
    services = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]
    mounts = [volume.split(":")[0] for service in services.values() for volume in service.get("volumes", [])]
    files = [mount for mount in mounts if mount.startswith("./")]
    assert len(files) == 5
    assert all((DEPLOY / file).is_file() for file in files)


def test_dashboard_and_alerts_ask_for_metrics_that_the_server_has(server: Any) -> None:
    with urllib.request.urlopen(server.metrics_url, timeout=10) as page:
        lines = page.read().decode().splitlines()
    kinds = {line.split()[2]: line.split()[3] for line in lines if line.startswith("# TYPE")}
    exposed = {name if kind != "histogram" else f"{name}_bucket" for name, kind in kinds.items()}
    panels = json.loads((DEPLOY / "grafana" / "dashboard.json").read_text())["panels"]
    texts = [target["expr"] for panel in panels for target in panel["targets"]]
    groups = yaml.safe_load((DEPLOY / "alerts.yml").read_text())["groups"]
    texts += [rule["expr"] for group in groups for rule in group["rules"]]
    asked = {name for text in texts for name in re.findall(r"curio_\w+", text)}
    assert len(asked) >= 7
    assert asked <= exposed


@pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool, which comes with Prometheus, is not installed")
def test_alerts_fire_when_they_should_and_else_not() -> None:
    subprocess.run(["promtool", "test", "rules", str(DEPLOY / "alerts_test.yml")], check=True, timeout=60)


def test_the_health_check_tells_a_server_from_none(start_server: Callable[..., Any], models_dir: Path) -> None:
    server = start_server(models_dir)
    port = server.address.rsplit(":", 1)[1]

    def status() -> int:
        return subprocess.run(
            [sys.executable, str(DEPLOY / "healthcheck.py"), port], check=False, timeout=60, stderr=subprocess.DEVNULL
        ).returncode

    assert status() == 0
    server.stop()
    assert status() == 1
